"""NPZ: NumPy's arrays, unrounded. `dagmap evaluate` reads it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..export import atomic_write
from ..exported import MapTable
from ._writer import WriteOptions

SUFFIXES = (".npz",)
ABOUT = "NumPy arrays"


def write(path: Path, table: MapTable, options: WriteOptions) -> None:
    named = {"state": "states"}  # as in a WorldMap
    arrays: dict[str, Any] = {"positions": table.positions, "colors": table.colors}
    arrays["robots"] = np.array(table.robots, np.str_)
    arrays |= {named.get(name, name): column for name, column in table.fields.items()}
    with atomic_write(path) as file:
        np.savez_compressed(file, **arrays)
