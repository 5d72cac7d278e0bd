"""PCD 0.7, binary: what PCL, Open3D and CloudCompare open. Colour is packed as PCL does it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..export import atomic_write
from ..exported import MapTable
from ._writer import WriteOptions, robots_as_text

SUFFIXES = (".pcd",)
ABOUT = "PCD 0.7, binary"
_LETTERS = {"f": "F", "u": "U", "i": "I"}


def write(path: Path, table: MapTable, options: WriteOptions) -> None:
    rows = point_rows(table)
    names = rows.dtype.names or ()
    types = [rows.dtype[name] for name in names]
    head = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "# DAGmap: metres in the fleet frame; state 0 confirmed, 1 tentative, 2 rejected",
        *(f"# {line}" for line in robots_as_text(table)),
        "VERSION 0.7",
        "FIELDS " + " ".join(names),
        "SIZE " + " ".join(str(kind.itemsize) for kind in types),
        "TYPE " + " ".join(_LETTERS[kind.kind] for kind in types),
        "COUNT " + " ".join("1" for _ in names),
        f"WIDTH {len(rows)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(rows)}",
        "DATA binary\n",
    ]
    with atomic_write(path) as file:
        file.write("\n".join(head).encode())
        file.write(rows.tobytes())


def point_rows(table: MapTable) -> np.ndarray:
    """(N,) records as PCL and PointCloud2 have them: x y z m, rgb, and the other fields."""
    kinds: list[tuple[str, Any]] = [(axis, "<f4") for axis in "xyz"]
    kinds += [("rgb", "<f4"), *((name, column.dtype) for name, column in table.fields.items())]
    rows = np.zeros(len(table), np.dtype(kinds))
    for i, axis in enumerate("xyz"):
        rows[axis] = table.positions[:, i]
    rows["rgb"] = _packed_rgb(table)
    for name, column in table.fields.items():
        rows[name] = column
    return rows


def _packed_rgb(table: MapTable) -> np.ndarray:
    """(N,) float32 whose bits are 0x00RRGGBB."""
    red, green, blue = (table.colors[:, i].astype(np.uint32) for i in range(3))
    return (red << 16 | green << 8 | blue).astype("<u4").view("<f4")
