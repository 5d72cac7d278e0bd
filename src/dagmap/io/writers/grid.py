"""A 2D occupancy grid as Nav2's map server loads it: `map.yaml` with `map.pgm` beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...model import Floats, OutputError, Uint8s
from ..export import atomic_write
from ..exported import MapTable
from ._writer import WriteOptions, along_rays

SUFFIXES = (".yaml",)
ABOUT = "2D occupancy grid for Nav2: YAML, and a PGM beside it"
OCCUPIED, UNKNOWN, FREE = 0, 205, 254  # what ROS's map saver writes
_MARGIN = 1  # cells around
_MOST = 1 << 28  # cells


def write(path: Path, table: MapTable, options: WriteOptions) -> None:
    picture, corner = _draw(path, table, options)
    image = path.with_suffix(".pgm")
    height, width = picture.shape
    text = [
        f"image: {image.name}",
        "mode: trinary",
        f"resolution: {options.resolution:.9g}",
        f"origin: [{corner[0]:.9g}, {corner[1]:.9g}, 0.0]",
        "negate: 0",
        "occupied_thresh: 0.65",
        "free_thresh: 0.196",
    ]
    with atomic_write(image) as file:
        file.write(f"P5\n# DAGmap, {options.resolution:g} m a cell\n".encode())
        file.write(f"{width} {height}\n255\n".encode())
        file.write(picture.tobytes())
    with atomic_write(path) as file:
        file.write(("\n".join(text) + "\n").encode())


def _draw(path: Path, table: MapTable, options: WriteOptions) -> tuple[Uint8s, Floats]:
    """The picture, its first row the furthest in y, and the place of its lower left corner."""
    low, high = options.height
    nodes = options.upright(table.positions)
    nodes = nodes[(nodes[:, 2] >= low) & (nodes[:, 2] <= high)]
    if not len(nodes):
        raise OutputError(
            f"{path}: no node lies between {low:g} and {high:g} m along {options.up}; name the "
            "slice with --height LOW HIGH, and the axis that points up with --up"
        )
    sensors, ends = (options.upright(points) for points in table.rays())
    reach = np.concatenate([nodes[:, :2], sensors[:, :2] if options.free else nodes[:0, :2]])
    first = np.floor(reach.min(axis=0) / options.resolution).astype(np.int64) - _MARGIN
    last = np.floor(reach.max(axis=0) / options.resolution).astype(np.int64) + _MARGIN
    width, height = (int(n) for n in last - first + 1)
    if width * height > _MOST:
        raise OutputError(
            f"{path}: {width} x {height} cells; a coarser --resolution or a smaller --box is wanted"
        )
    cells = np.full((height, width), UNKNOWN, np.uint8)
    if options.free:
        for places in along_rays(sensors, ends, options.resolution / 2):
            inside = places[(places[:, 2] >= low) & (places[:, 2] <= high)]
            _fill(cells, inside, first, options.resolution, FREE)
    _fill(cells, nodes, first, options.resolution, OCCUPIED)
    return np.ascontiguousarray(cells[::-1]), first * options.resolution


def _fill(cells: Uint8s, points: Floats, first: np.ndarray, edge: float, value: int) -> None:
    at = np.floor(points[:, :2] / edge).astype(np.int64) - first
    fits = ((at >= 0) & (at < cells.shape[::-1])).all(axis=1)
    cells[at[fits, 1], at[fits, 0]] = value
