"""Dense grids of cells: what rays pass through, and how much of a cloud falls where it should.

Places are int32 in 256ths of a cell, counted from the low corner of the grid; a cell's index is
its (x, y, z) in C order.
"""

from __future__ import annotations

from ..model import Int32s, Int64s
from .jit import inner, leaf

SHIFT = 8  # a cell has 2^8 steps along each axis
MANY = 255  # rays through a cell that are counted
LONGEST = 1024  # steps of a ray that are looked at, before its end: no sensor sees further


@inner
def _at(x: int, y: int, z: int, shape: Int64s) -> int:
    """Index of the cell of a place, -1 outside of the grid."""
    cx, cy, cz = x >> SHIFT, y >> SHIFT, z >> SHIFT
    if cx < 0 or cy < 0 or cz < 0 or cx >= shape[0] or cy >= shape[1] or cz >= shape[2]:
        return -1
    return (cx * int(shape[1]) + cy) * int(shape[2]) + cz


@leaf
def pass_through(
    origins: Int32s, points: Int32s, shape: Int64s, short: int, passes: Int32s
) -> None:
    """Count in `passes` (cells,) the rays (N, 3) to (N, 3) that pass through a cell.

    A ray is looked at once a cell of its longest axis, no earlier than LONGEST such steps before
    its end, and no more from `short` of them on.
    """
    for i in range(points.shape[0]):
        x, y, z = int(origins[i, 0]), int(origins[i, 1]), int(origins[i, 2])
        dx, dy, dz = int(points[i, 0]) - x, int(points[i, 1]) - y, int(points[i, 2]) - z
        steps = (max(abs(dx), abs(dy), abs(dz)) >> SHIFT) + 1
        for s in range(max(0, steps - short - LONGEST), steps - short):
            at = _at(x + dx * s // steps, y + dy * s // steps, z + dz * s // steps, shape)
            if at >= 0 and passes[at] < MANY:
                passes[at] += 1


@leaf
def tally(
    grid: Int32s,
    shape: Int64s,
    points: Int32s,
    marks: Int32s,
    shifts: Int32s,
    free: int,
    penalty: int,
    out: Int64s,
) -> None:
    """For every shift (K, 3) of the points (M, 3): how many lie in cells with a bit of their mark,
    less `penalty` times those that lie in cells with the bit `free` instead.

    grid: (cells,) bits; marks: (M,) bits; out: (K,) is written.
    """
    for k in range(shifts.shape[0]):
        sx, sy, sz = int(shifts[k, 0]), int(shifts[k, 1]), int(shifts[k, 2])
        total = 0
        for i in range(points.shape[0]):
            at = _at(int(points[i, 0]) + sx, int(points[i, 1]) + sy, int(points[i, 2]) + sz, shape)
            if at >= 0:
                bits = int(grid[at])
                if bits & int(marks[i]):
                    total += 1
                elif bits & free:
                    total -= penalty
        out[k] = total


@leaf
def nearest_facing(
    which: Int32s,
    shape: Int64s,
    places: Int32s,
    facings: Int32s,
    points: Int32s,
    normals: Int32s,
    reach: int,
    alike: int,
    out: Int64s,
) -> None:
    """For points (N, 3): the nearest of the places (S, 3) in a cell at most `reach` cells away
    that faces alike, the first on a tie; -1 where there is none.

    which: (cells,) the place in a cell, -1 for none. facings, normals: (S, 3), (N, 3), of one
    length; alike: least product of two that are. out: (N,) is written.
    """
    step = 1 << SHIFT
    for i in range(points.shape[0]):
        x, y, z = int(points[i, 0]), int(points[i, 1]), int(points[i, 2])
        u, v, w = int(normals[i, 0]), int(normals[i, 1]), int(normals[i, 2])
        out[i], best = -1, 1 << 62
        for a in range(-reach, reach + 1):
            for b in range(-reach, reach + 1):
                for c in range(-reach, reach + 1):
                    at = _at(x + a * step, y + b * step, z + c * step, shape)
                    row = int(which[at]) if at >= 0 else -1
                    if row < 0:
                        continue
                    dx, dy, dz = (
                        int(places[row, 0]) - x,
                        int(places[row, 1]) - y,
                        int(places[row, 2]) - z,
                    )
                    away = dx * dx + dy * dy + dz * dz
                    along = (
                        u * int(facings[row, 0])
                        + v * int(facings[row, 1])
                        + w * int(facings[row, 2])
                    )
                    if away < best and along >= alike:
                        best = away
                        out[i] = row
