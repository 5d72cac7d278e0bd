"""LAS and LAZ 1.4, point format 7, whole millimetres, through laspy."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from ..export import atomic_write
from ..exported import FIELDS, MapTable
from ._writer import WriteOptions, library, robots_as_text

SUFFIXES = (".las", ".laz")
ABOUT = "LAS 1.4, compressed with the suffix .laz"


def write(path: Path, table: MapTable, options: WriteOptions) -> None:
    laspy = library("laspy", "las", path)
    if path.suffix.lower() == ".laz":
        library("lazrs", "las", path)
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales = np.full(3, 0.001)
    header.offsets = np.floor(table.positions.min(axis=0)) if len(table) else np.zeros(3)
    for name in table.fields:
        if name != "stamp":  # which the format has a place for
            header.add_extra_dim(laspy.ExtraBytesParams(name, FIELDS[name]))
    robots = "\n".join(robots_as_text(table)).encode()
    header.vlrs.append(laspy.VLR("DAGmap", 1, "robots by number", robots))
    out = laspy.LasData(header)
    out.x, out.y, out.z = table.positions.T
    out.red, out.green, out.blue = table.colors.T.astype(np.uint16) * 257  # 0 to 65535
    for name, column in table.fields.items():
        out["gps_time" if name == "stamp" else name] = column
    buffer = io.BytesIO()  # laspy closes what it writes to
    out.write(buffer, do_compress=path.suffix.lower() == ".laz")
    with atomic_write(path) as file:
        file.write(buffer.getvalue())
