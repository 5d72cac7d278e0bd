"""What all writers share: the options, libraries that may be missing, and voxels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...model import Floats, OutputError
from ..exported import MapTable

_STEPS = 4_000_000  # places along rays that are looked at together

_UP = {
    "z": (0, 1, 2, 1, 1, 1),
    "-z": (0, 1, 2, 1, -1, -1),
    "y": (2, 0, 1, 1, 1, 1),
    "-y": (2, 0, 1, 1, -1, -1),  # a camera's frame: z forward, x right, y down
    "x": (1, 2, 0, 1, 1, 1),
    "-x": (1, 2, 0, 1, -1, -1),
}


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """resolution: m, edge of the cells of grids and octrees. height: m along `up`, the slice of a
    grid. up: the axis of the fleet frame that points up. free: whether what rays passed is
    written as free. Raises OutputError where one is out of its range.
    """

    resolution: float = 0.05
    height: tuple[float, float] = (0.1, 2.0)
    up: str = "z"
    free: bool = True

    def __post_init__(self) -> None:
        if not 0.001 <= self.resolution <= 1000:
            raise OutputError(f"--resolution {self.resolution}: 0.001 to 1000 m is wanted")
        if not self.height[0] < self.height[1]:
            raise OutputError(f"--height {self.height}: the lower one is wanted first")
        if self.up not in _UP:
            raise OutputError(f"--up {self.up}: one of {', '.join(_UP)} is wanted")

    def upright(self, points: Floats) -> Floats:
        """Points (N, 3) turned so that z points up; a rotation, never a mirror."""
        a, b, c, *signs = _UP[self.up]
        return points[:, (a, b, c)] * signs


def library(name: str, extra: str, path: Path) -> Any:
    """A library that an extra brings. Raises OutputError without it."""
    try:
        return import_module(name)
    except ImportError:
        raise OutputError(
            f"{path}: written with {name.split('.')[0]}, which is not installed; "
            f"pip install 'dagmap[{extra}]'"
        ) from None


def columns(table: MapTable) -> npt.NDArray[np.void]:
    """All columns as rows: x y z float32, red green blue, then the fields that there are."""
    kinds: list[tuple[str, Any]] = [(axis, "<f4") for axis in "xyz"]
    kinds += [(channel, "u1") for channel in ("red", "green", "blue")]
    kinds += [(name, column.dtype) for name, column in table.fields.items()]
    rows = np.zeros(len(table), np.dtype(kinds))
    for i, axis in enumerate("xyz"):
        rows[axis] = table.positions[:, i]
    for i, channel in enumerate(("red", "green", "blue")):
        rows[channel] = table.colors[:, i]
    for name, column in table.fields.items():
        rows[name] = column
    return rows


def robots_as_text(table: MapTable) -> list[str]:
    """A line for each number that `robot` may hold."""
    return [f"robot {i} is {name}" for i, name in enumerate(table.robots)]


def along_rays(sensors: Floats, ends: Floats, step: float) -> Iterator[Floats]:
    """Places (K, 3) along rays, `step` m apart, up to half a step before their ends; in batches."""
    length = np.linalg.norm(ends - sensors, axis=1)
    counts = np.maximum(np.ceil(length / step - 0.5), 0).astype(np.int64)
    total = np.cumsum(counts)
    start = 0
    while start < len(counts):
        before = int(total[start - 1]) if start else 0
        end = max(start + 1, int(np.searchsorted(total, before + _STEPS, side="right")))
        many = counts[start:end]
        ray = np.repeat(np.arange(start, end), many)
        index = np.arange(int(many.sum())) - np.repeat(np.cumsum(many) - many, many)
        share = (index * step / np.maximum(length[ray], 1e-9))[:, None]
        yield sensors[ray] + share * (ends[ray] - sensors[ray])
        start = end
