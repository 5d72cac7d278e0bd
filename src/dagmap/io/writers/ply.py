"""PLY: what `map.ply` has, and who saw a node first and when it was last seen."""

from __future__ import annotations

from pathlib import Path

from ..export import atomic_write
from ..exported import MapTable
from ._writer import WriteOptions, columns, robots_as_text

SUFFIXES = (".ply",)
ABOUT = "PLY, binary"
_KINDS = {"<f4": "float", "<f8": "double", "|u1": "uchar", "<u2": "ushort", "<u4": "uint"}


def write(path: Path, table: MapTable, options: WriteOptions) -> None:
    rows = columns(table)
    names = rows.dtype.names or ()
    head = [
        "ply",
        "format binary_little_endian 1.0",
        "comment DAGmap: metres in the fleet frame; state 0 confirmed, 1 tentative, 2 rejected",
        *(f"comment {line}" for line in robots_as_text(table)),
        f"element vertex {len(rows)}",
        *(f"property {_KINDS[rows.dtype[name].str]} {name}" for name in names),
        "end_header\n",
    ]
    with atomic_write(path) as file:
        file.write("\n".join(head).encode())
        file.write(rows.tobytes())
