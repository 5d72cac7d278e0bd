"""`dagmap export`: the map, or a part of it, in a format that other programs open."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import typer

from ..io.exported import Filter, MapTable, choose
from ..io.ledger_map import read_map
from ..io.writers import WriteOptions, formats, write_map
from ..model import OutputError, State
from .evaluate import states_named


@dataclass(frozen=True, slots=True)
class Export:
    """One run of the command. Raises DagmapError."""

    source: Path
    out: Path
    config: Path | None
    states: str
    wanted: tuple[tuple[str, ...], tuple[float, ...] | None, float | None, float | None]
    options: WriteOptions
    force: bool
    json: bool

    def run(self) -> None:
        robots, box, since, until = self.wanted
        wanted = Filter(tuple(states_named(self.states, "--state")), robots, box, since, until)
        self._check_out()
        whole = read_map(self.source, self.config)
        table = choose(whole, wanted)
        if not len(table):
            raise OutputError(
                f"{self.source}: none of {len(whole)} nodes passes; loosen --state, --robot, "
                "--box, --since or --until"
            )
        write_map(self.out, table, self.options)
        self._show(table, len(whole))

    def _check_out(self) -> None:
        """Before the work, not after it."""
        if self.out.suffix.lower() not in formats():
            known = "; ".join(f"{suffix} {about}" for suffix, about in sorted(formats().items()))
            raise OutputError(f"{self.out}: the suffix names the format: {known}")
        if self.out.exists() and not self.force:
            raise OutputError(f"{self.out}: exists already; name another file, or say --force")

    def _show(self, table: MapTable, whole: int) -> None:
        states = {s.name.lower(): int((table.fields["state"] == s).sum()) for s in State}
        if self.json:
            found = {"out": str(self.out), "nodes": len(table), "of": whole, "states": states}
            found["robots"] = list(table.robots)
            sys.stdout.write(json.dumps(found) + "\n")
            return
        counts = ", ".join(f"{count:,} {name}" for name, count in states.items() if count)
        typer.echo(f"{self.out}: {len(table):,} of {whole:,} nodes ({counts})", err=True)
