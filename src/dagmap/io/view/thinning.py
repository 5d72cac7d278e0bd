"""Level of detail: few of many points, spread over the whole map, and all of them near an eye."""

from __future__ import annotations

import numpy as np

from ...model import Floats, Int64s

_LIMIT = (1 << 29) - 1  # mm; the map's own range
_BITS = 21  # of a cell's number along an axis: three of them fit into 64 bits
_SPREAD = (  # how they come to every third bit: shift, then keep
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


class Thinning:
    """Points (N, 3) metres, sorted along a Z curve once: then any level costs one pass.

    Level k has one point, the first along the curve, of every cell of 2^k mm (of a map over 2 km
    wide twice as much, and so on), level 0 has them all; so the points of a coarser level are among
    those of a finer one. Without compiled kernels, whose loading would delay a first picture.
    """

    def __init__(self, positions: Floats) -> None:
        places = np.clip(np.rint(positions * 1000.0), -_LIMIT, _LIMIT).astype(np.int64)
        widest = int(np.abs(places).max(initial=0)).bit_length()
        cells = (places >> max(0, widest - _BITS + 1)) + (1 << (_BITS - 1))
        x, y, z = (_spread(column) for column in cells.T)
        self._order = np.argsort(x << 2 | y << 1 | z, kind="stable")
        self._points = np.asarray(positions, np.float64)[self._order]
        cells = cells[self._order]
        differ = np.bitwise_or.reduce(cells[1:] ^ cells[:-1], axis=1)  # from the one before
        self._level = np.full(len(cells), _BITS, np.int64)  # up to which a point is shown
        self._level[1:] = np.clip(np.frexp(differ.astype(np.float64))[1] - 1, 0, _BITS)

    def __len__(self) -> int:
        return len(self._order)

    def everywhere(self, budget: int) -> Int64s:
        """Indices of at most `budget` points all over the map."""
        return np.sort(self._order[self._thinned(np.arange(len(self)), budget)])

    def near(self, centre: Floats, radius: float, budget: int) -> Int64s:
        """Indices of all points within `radius` metres of `centre` (3,); of more than `budget`, as
        many evenly."""
        inside = np.flatnonzero(np.linalg.norm(self._points - centre, axis=1) <= radius)
        return np.sort(self._order[self._thinned(inside, budget)])

    def _thinned(self, rows: Int64s, budget: int) -> Int64s:
        """Those of the finest level that fits, and some of the next finer one evenly."""
        levels = self._level[rows]
        counts = np.cumsum(np.bincount(levels, minlength=_BITS + 1)[::-1])[::-1]
        fits = np.flatnonzero(counts <= budget)
        level = int(fits[0]) if len(fits) else _BITS
        shown = levels >= level
        room = budget - int(shown.sum())
        if level and room > 0:
            finer = np.flatnonzero(levels == level - 1)
            shown[finer[np.linspace(0, len(finer) - 1, room).astype(np.int64)]] = True
        return rows[shown]


def _spread(numbers: Int64s) -> Int64s:
    """(N,) of `_BITS` bits: each bit three places from the next."""
    for shift, kept in _SPREAD:
        numbers = (numbers | (numbers << shift)) & kept
    return numbers
