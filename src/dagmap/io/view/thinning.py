"""Level of detail: few of many points, spread over the whole map, and all of them near an eye."""

from __future__ import annotations

import numpy as np

from ...kernels.morton import morton_order
from ...model import Floats, Int64s

_LIMIT = 1 << 29  # mm; the map's own range
_COARSEST = 20  # cells of 2^20 mm


class Thinning:
    """Points (N, 3) metres, sorted along a Z curve once: then any level costs one pass.

    Level k has one point, the first along the curve, of every cell of 2^k mm, level 0 has them all;
    so the points of a coarser level are among those of a finer one.
    """

    def __init__(self, positions: Floats) -> None:
        places = np.clip(np.rint(positions * 1000.0), -_LIMIT, _LIMIT - 1).astype(np.int32)
        self._order = morton_order(places)
        self._points = np.asarray(positions, np.float64)[self._order]
        cells = places[self._order] + (1 << 19)  # as the curve counts
        differ = np.bitwise_or.reduce(cells[1:] ^ cells[:-1], axis=1)  # from the one before
        self._level = np.full(len(cells), _COARSEST, np.int64)  # up to which a point is shown
        self._level[1:] = np.clip(np.frexp(differ.astype(np.float64))[1] - 1, 0, _COARSEST)

    def __len__(self) -> int:
        return len(self._order)

    def everywhere(self, budget: int) -> Int64s:
        """Indices of at most `budget` points all over the map (more where it is over 1 km wide)."""
        return np.sort(self._order[self._thinned(np.arange(len(self)), budget)])

    def near(self, centre: Floats, radius: float, budget: int) -> Int64s:
        """Indices of all points within `radius` metres of `centre` (3,); of more than `budget`, as
        many evenly."""
        inside = np.flatnonzero(np.linalg.norm(self._points - centre, axis=1) <= radius)
        return np.sort(self._order[self._thinned(inside, budget)])

    def _thinned(self, rows: Int64s, budget: int) -> Int64s:
        """Those of the finest level that fits, and some of the next finer one evenly."""
        levels = self._level[rows]
        counts = np.cumsum(np.bincount(levels, minlength=_COARSEST + 1)[::-1])[::-1]
        fits = np.flatnonzero(counts <= budget)
        level = int(fits[0]) if len(fits) else _COARSEST
        shown = levels >= level
        room = budget - int(shown.sum())
        if level and room > 0:
            finer = np.flatnonzero(levels == level - 1)
            shown[finer[np.linspace(0, len(finer) - 1, room).astype(np.int64)]] = True
        return rows[shown]
