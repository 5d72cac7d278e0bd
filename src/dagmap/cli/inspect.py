"""`dagmap inspect`: what a recording holds, and what of it would be used."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.table import Table

from ..io.sources import Description, Options, Source, describe_source


def show_source(path: Path, options: Options, as_json: bool) -> int:
    """0: it can be read; 1: it cannot, the message says why. Raises DagmapError."""
    found = describe_source(path, options)
    if as_json:
        sys.stdout.write(json.dumps({"path": str(path), **asdict(found)}) + "\n")
    else:
        _show(path, found)
    return 0 if found.problem is None else 1


def tell_notes(source: Source, console: Console) -> None:
    """What was chosen of a recording, and what is only assumed of it."""
    for note in source.notes:
        console.print(f"{source.name}: {note}", soft_wrap=True, markup=False)


def tell_skips(source: Source, console: Console) -> None:
    """What --keep-going has left out."""
    skips = source.skips
    for line in skips.told:
        console.print(f"left out: {line}", soft_wrap=True, markup=False)
    if skips.count > len(skips.told):
        console.print(f"left out: {skips.count - len(skips.told)} more in {source.name}")


def _show(path: Path, found: Description) -> None:
    console = Console()
    console.print(f"{path}: {found.kind}", soft_wrap=True, markup=False)
    if found.items:
        table = Table()
        for heading in ("name", "type", "count", "used for"):
            table.add_column(heading)
        for item in found.items:
            table.add_row(item.name, item.kind, f"{item.count:,}", item.use)
        console.print(table)
    for note in found.notes:
        console.print(note, soft_wrap=True, markup=False)
    if found.cycles is not None:
        console.print(f"{found.cycles:,} cycles")
    if found.problem is not None:
        console.print(found.problem, soft_wrap=True, markup=False)
