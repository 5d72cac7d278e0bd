"""What readers of point clouds share: the points that are worth keeping, in the scan's order."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ...model import Floats, Uint8s
from ._source import Options

_SHIFT = 21  # bits of a voxel's number along one axis


def doubles(values: npt.NDArray[np.generic]) -> Floats:
    """The same numbers as doubles. A NaN that signals is a NaN, nothing to be warned of."""
    with np.errstate(invalid="ignore"):
        return values.astype(np.float64)


def thinned(
    points: Floats, colors: Uint8s | None, options: Options
) -> tuple[Floats, Uint8s | None]:
    """(N, 3) m and (N, 3) RGB or None: the first point of each voxel, `max_features` at most.

    Left out is what is not finite, lies in the sensor itself (as drivers say "no echo"), or beyond
    `max_depth`. Of too many voxels every so-and-so-many-th is kept, in the order of the scan.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        distance = np.sqrt((points**2).sum(axis=1))
    most = np.inf if options.max_depth is None else options.max_depth
    rows = np.flatnonzero((distance > 1e-6) & (distance <= most) & np.isfinite(distance))
    rows = rows[first_of_voxels(points[rows], options.voxel)]
    if len(rows) > options.max_features:
        rows = rows[np.arange(options.max_features) * len(rows) // options.max_features]
    return points[rows], None if colors is None else colors[rows]


def first_of_voxels(points: Floats, edge: float) -> npt.NDArray[np.int64]:
    """Ascending indices of the first point in each voxel."""
    if not len(points):
        return np.zeros(0, np.int64)
    half = 1 << (_SHIFT - 1)
    cells = np.clip(np.floor(points / edge), -half, half - 1).astype(np.int64) + half
    keys = (cells[:, 0] << _SHIFT | cells[:, 1]) << _SHIFT | cells[:, 2]
    return np.sort(np.unique(keys, return_index=True)[1])
