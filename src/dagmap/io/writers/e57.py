"""E57 through pye57: one scan a state, since the format has no columns of one's own there."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

import numpy as np

from ...model import State
from ..export import atomic_write
from ..exported import MapTable
from ._writer import WriteOptions, library

SUFFIXES = (".e57",)
ABOUT = "E57: one scan a state, intensity is the number of witnesses"


def write(path: Path, table: MapTable, options: WriteOptions) -> None:
    pye57 = library("pye57", "e57", path)
    part = path.with_name(f".{path.name}.{os.getpid()}.e57")  # the library wants a name
    try:
        with atomic_write(path) as file:
            image = pye57.E57(str(part), mode="w")
            for state in State:
                _write_scan(image, table, state)
            image.close()
            file.write(part.read_bytes())
    finally:
        with suppress(OSError):
            part.unlink()


def _write_scan(image: object, table: MapTable, state: State) -> None:
    rows = table.fields["state"] == state
    if not rows.any():
        return
    data = {f"cartesian{axis}": table.positions[rows, i] for i, axis in enumerate("XYZ")}
    for i, channel in enumerate(("Red", "Green", "Blue")):
        data[f"color{channel}"] = table.colors[rows, i]
    data["intensity"] = table.fields["witnesses"][rows].astype(np.float64)
    image.write_scan_raw(data, name=state.name.lower())  # type: ignore[attr-defined]
