"""What all experiments share: `--out`, colours, and the file of results beside the pictures.

An experiment is a module with NAME, PAPER (what the paper printed) and `run(out, ...)`, which draws
its pictures into `out` and returns what `written` gives. Importing this module first makes the
benchmarks importable, whose measurements the experiments use.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from dagmap.model import DagmapError

ROOT = Path(__file__).parents[1]
OFFICE = [ROOT / "examples" / "office" / f"robot{i}" for i in (1, 2, 3)]
OUT = Path("out/figures")
INK, BLUE, RED, ORANGE, GREEN = "#1a1a1a", "#2166d1", "#d7301f", "#e08214", "#1d9a3c"
Row = dict[str, Any]

sys.path.append(str(ROOT / "bench"))  # scenes, traffic and costs that are measured there too


def written(out: Path, name: str, paper: str, measured: list[str], **data: Any) -> Row:
    """Write NAME.json: what the paper printed, what was measured in words, and all numbers."""
    result = {"experiment": name, "paper": paper, "measured": measured, **data}
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{name}.json").write_text(json.dumps(result, indent=1) + "\n")
    return result


class Parser(argparse.ArgumentParser):
    """One that says in a line what is wrong."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}\n")


def between(kind: type, least: float, most: float) -> Callable[[str], float]:
    """The type of an option that is a number in a range."""

    def parsed(text: str) -> float:
        try:
            value: float = kind(text)
        except ValueError:
            value = math.nan
        if not least <= value <= most:
            wanted = "a whole number" if kind is int else "a number"
            raise argparse.ArgumentTypeError(
                f"{text!r}: {wanted} from {least:,} to {most:,} is wanted"
            )
        return value

    return parsed


def folder(text: str) -> Path:
    """The type of `--out`: a folder, made where it is missing."""
    path = Path(text)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise argparse.ArgumentTypeError(
            f"{text}: no folder can be made: {error.strerror}"
        ) from error
    return path


def main(run: Callable[..., Row], *options: tuple[str, type, Any, float, float, str]) -> None:
    """The command line of one experiment: `--out DIR`, and further (name, type, default, least,
    most, help)."""
    parser = Parser(description=sys.modules["__main__"].__doc__)
    parser.add_argument("--out", type=folder, default=str(OUT), help="folder for JSON and PNG")
    for name, kind, default, least, most, text in options:
        described = f"{text} (default {default})"
        parser.add_argument(
            f"--{name}", type=between(kind, least, most), default=default, help=described
        )
    arguments = vars(parser.parse_args())
    try:
        result = run(**arguments)
    except DagmapError as error:
        parser.error(str(error))
    for line in result["measured"]:
        print(f"{result['experiment']}: {line}")
