"""`dagmap tune`: parameters from what recordings show of resolution and noise, without truth."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console
from rich.table import Table

from ..config import Config
from ..io.export import atomic_write
from ..io.sources import Options, open_source
from ..model import DagmapError, OutputError
from ..tuning import Measured, Proposed, gather, measure, proposal, propose
from .inspect import tell_notes, tell_skips


@dataclass(frozen=True, slots=True)
class Tune:
    """One run of the command. Raises DagmapError."""

    recordings: list[Path]
    out: Path | None
    options: Options
    force: bool
    json: bool

    def run(self) -> None:
        if self.out is not None and self.out.exists() and not self.force:
            raise OutputError(f"{self.out}: exists already; name another file, or say --force")
        sources = [open_source(path, self.options) for path in self.recordings]
        named = {source.name: source for source in sources}
        if len(named) < len(sources):
            raise DagmapError("two of the recordings have one name; rename one of them")
        points, period = gather(named)
        console = Console(stderr=True)
        for source in sources:
            tell_notes(source, console)
            tell_skips(source, console)
        measured = measure(points, period)
        proposed = propose(points, measured)
        text = snippet(proposed, ", ".join(named))
        if self.out is not None:
            with atomic_write(self.out) as file:
                file.write(text.encode())
        if self.json:
            values = [asdict(item) for item in proposed]
            found = {"measured": asdict(measured), "proposed": values, "toml": text}
            sys.stdout.write(json.dumps(found) + "\n")
            return
        _show(measured, console)
        if self.out is None:
            sys.stdout.write(text)
        else:
            console.print(f"{self.out}: written; use it as --config, or in a robot's file")


def snippet(proposed: Sequence[Proposed], names: str) -> str:
    """TOML with a reason at each value, as `load_config` reads it. Raises ConfigError."""
    lines = [f"# dagmap tune: from {' '.join(names.split())}"]
    if any(item.field.startswith("fold.") for item in proposed):
        lines.append("# [fold] must be alike on all robots of a fleet.")
    ordered = sorted(proposed, key=lambda item: item.field)
    for group, items in groupby(ordered, key=lambda item: item.field.split(".")[0]):
        lines += ["", f"[{group}]"]
        lines += [f"{i.field.split('.')[1]} = {_toml(i.value)}  # {i.why}" for i in items]
    text = "\n".join(lines) + "\n"
    if msgspec.toml.decode(text, type=Config) != proposal(proposed):
        raise AssertionError(f"what was written is not what was proposed: {text}")
    return text


def _toml(value: Any) -> str:
    return repr(float(value)) if isinstance(value, float) else str(value)


def _show(found: Measured, console: Console) -> None:
    table = Table(title="What the recordings show", show_header=False)
    noise = found.noise
    across = "nothing tells" if noise.across is None else f"{1000 * noise.across:.1f} mm"
    rows = {
        "robots, cycles, points": f"{found.robots}, {found.cycles:,}, {found.points:,}",
        "time between cycles": f"{found.period:.2f} s",
        "points of a cycle, median": f"{found.per_cycle:,.0f}",
        "range: median, 90 %, 99 %": ", ".join(f"{r:.1f}" for r in found.ranges) + " m",
        "neighbours in a scan: median, 90 %": f"{1000 * found.in_scan:.0f}, "
        f"{1000 * found.in_scan_90:.0f} mm",
        "to the nearest point of another cycle": f"{1000 * found.between:.0f} mm "
        f"(where there is one: {found.overlap:.0%})",
        f"noise along the ray, by {noise.method}": f"{1000 * noise.along:.1f} mm",
        "noise across the ray": across,
        "noise along the ray by range": ", ".join(
            f"{1000 * s:.0f} mm at {r:.1f} m" for r, s in noise.at
        ),
        "it grows with the range to the power": f"{noise.power:.1f}",
    }
    if found.between_robots is not None:
        rows["the same between robots"] = f"{1000 * found.between_robots:.1f} mm"
    for name, text in rows.items():
        table.add_row(name, text)
    console.print(table)
