"""Section 4.3, preset `default`: which cells a transaction's rays cross, in integers.

One call marks cells in bits of its own (`Marks`) to list each once; `bricks` then adds what
is listed to the counters of the map. Rows of the marks are bricks of 8^3 cells.

The walk (Amanatides and Woo, 1987) compares the times of the next crossings t = n/|d| of the three
axes after multiplication by all three |d|: exact. An axis that climbs enters the next cell when it
reaches the border, one that falls when it leaves it, hence at equal times climbing axes go first;
among equals x, then y, then z. Each crossing is a step: a ray through an edge marks a cell beside.

`bricks.walk` calls this: after a change here, `make clean-cache` (see `jit`).
"""

from __future__ import annotations

from typing import NamedTuple

from ..model import Bools, Int32s, Int64s, Uint8s
from .jit import inner, leaf

# Keyed hash modulo a prime as in `matching` (repeated here: see the trap in `jit`).
_P = (1 << 31) - 1
LOW = 1 << 29  # added to what is hashed: no negative numbers
_NEVER = 1 << 61
# Places in Marks.top: rows in use, cells listed, how many of them are ends; for `bricks`, whether
# any counter became zero, and a number that nobody reads; key of the hash.
ROWS, CELLS, ENDS, ZEROED, TOUCHED, KEY = range(6)
BRICK, SLOT, ENTRY, ZERO = 6, 9, 10, 11  # columns of Marks.row after the neighbours
# A place on a ray: below, the number of a cell's bit; above, three counters of the steps that are
# left in the brick along x, y, z, 8 bits each. Below zero one borrows: that sets its highest bit.
_LEFT = 40
_AT = (1 << _LEFT) - 1
_BORROWED = 0x808080 << _LEFT


class Marks(NamedTuple):
    """What one call marks."""

    top: Int64s  # (9,) see above
    table: Int32s  # (T,) rows by hash of the brick; T a power of two, at least twice R
    row: Int32s  # (R, 12) rows at -x +x -y +y -z +z or -1; brick x y z, each + LOW; slot; for
    # `bricks`: entry, whether a counter became zero
    bits: Uint8s  # (R * 64,) bit z * 64 + y * 8 + x of a row: listed
    word: Int64s  # (R * 8,) the same memory
    cell: Int64s  # (L,) numbers of the bits, first of the cells where points end, then of others
    block: Int32s  # (R, 8) for `bricks`


@inner
def _enter(top: Int64s, table: Int32s, row: Int32s, word: Int64s, x: int, y: int, z: int) -> int:
    """Row of a brick, an empty one where the call has none yet."""
    x, y, z = x + LOW, y + LOW, z + LOW
    u, v, w = int(top[KEY]) * x, int(top[KEY + 1]) * y, int(top[KEY + 2]) * z
    h = int(top[KEY + 3]) + (u & _P) + (u >> 31) + (v & _P) + (v >> 31) + (w & _P) + (w >> 31)
    h = (h & _P) + (h >> 31)
    slot = (h if h < _P else h - _P) & (table.shape[0] - 1)
    rows = int(top[ROWS])
    r = int(table[slot])
    while r < rows and row[r, SLOT] == slot:  # else the slot is left from an earlier call
        if row[r, BRICK] == x and row[r, BRICK + 1] == y and row[r, BRICK + 2] == z:
            return r
        slot = (slot + 1) & (table.shape[0] - 1)
        r = int(table[slot])
    top[ROWS] = rows + 1
    table[slot] = rows
    for side in range(6):
        row[rows, side] = -1
    row[rows, BRICK] = x
    row[rows, BRICK + 1] = y
    row[rows, BRICK + 2] = z
    row[rows, SLOT] = slot
    for i in range(rows * 8, rows * 8 + 8):
        word[i] = 0
    return rows


@inner
def ceil_sqrt(value: int) -> int:
    """The smallest integer whose square is at least `value` (0 to 2^62), by Newton's method."""
    if value <= 1:
        return value
    wanted = value - 1
    root = 1
    while root * root <= wanted >> 2:
        root <<= 1
    root <<= 1  # Newton's method falls monotonically from above: sqrt(wanted) < root
    while True:
        better = (root + wanted // root) >> 1
        if better >= root:
            return root + 1
        root = better


@inner
def _ray(limit: int, ox: int, oy: int, oz: int, px: int, py: int, pz: int) -> tuple[int, int, int]:
    """From an origin to a point, at most `limit` mm long: shortened towards the origin."""
    dx, dy, dz = px - ox, py - oy, pz - oz
    d2 = dx * dx + dy * dy + dz * dz
    if d2 > limit * limit:
        length = ceil_sqrt(d2)
        dx = dx * limit // length if dx >= 0 else -(-dx * limit // length)
        dy = dy * limit // length if dy >= 0 else -(-dy * limit // length)
        dz = dz * limit // length if dz >= 0 else -(-dz * limit // length)
    return dx, dy, dz


@inner
def _first_crossing(cell: int, origin: int, d: int, scale: int) -> int:
    """Twice the time of an axis' first crossing, times the product of all |d|; + 1 if falling."""
    if d > 0:
        return 2 * (cell - origin % cell) * scale
    if d < 0:
        return 2 * (origin % cell) * scale + 1
    return _NEVER


@inner
def _mark(bits: Uint8s, cells: Int64s, count: int, at: int) -> int:
    """Set a bit and, where it was not set, list it: how many are listed then (one may be spare)."""
    before = int(bits[at >> 3])
    bits[at >> 3] = before | (1 << (at & 7))
    cells[count] = at
    return count + 1 - ((before >> (at & 7)) & 1)


@inner
def _walk(
    marks: Marks,
    cell: int,
    limit: int,
    origins: Int32s,
    k: int,
    xyz: Int32s,
    alive: Bools,
    begin: int,
    end: int,
) -> bool:
    """List the cells from origin k to the points begin to end - 1. False: too little room."""
    top, table, row, bits, word, cells, _ = marks
    ox, oy, oz = int(origins[k, 0]), int(origins[k, 1]), int(origins[k, 2])
    cx, cy, cz = ox // cell, oy // cell, oz // cell
    for i in range(begin, end):
        if not alive[i]:
            continue
        dx, dy, dz = _ray(limit, ox, oy, oz, int(xyz[i, 0]), int(xyz[i, 1]), int(xyz[i, 2]))
        steps = abs((ox + dx) // cell - cx) + abs((oy + dy) // cell - cy)
        steps += abs((oz + dz) // cell - cz)
        count, room = int(top[CELLS]), row.shape[0] - int(top[ROWS])
        if min(room - steps // 8 - 4, cells.shape[0] - count - steps - 2) < 0:
            return False
        ux, uy, uz = max(abs(dx), 1), max(abs(dy), 1), max(abs(dz), 1)
        ux, uy, uz = uy * uz, ux * uz, ux * uy
        tx = _first_crossing(cell, ox, dx, ux)
        ty = _first_crossing(cell, oy, dy, uy) - tx  # after x
        tz = _first_crossing(cell, oz, dz, uz) - tx
        ux, uy, uz = 2 * cell * ux, 2 * cell * uy, 2 * cell * uz  # between crossings
        gx, gy, gz = 1 if dx > 0 else -1, 1 if dy > 0 else -1, 1 if dz > 0 else -1
        kx, ky, kz = gx - (1 << _LEFT), 8 * gy - (256 << _LEFT), 64 * gz - (65536 << _LEFT)
        bx, by, bz = cx >> 3, cy >> 3, cz >> 3
        r = _enter(top, table, row, word, bx, by, bz)
        at = (r << 9) | (cz & 7) << 6 | (cy & 7) << 3 | (cx & 7)
        count = _mark(bits, cells, count, at)
        left = (cx ^ 7 if dx > 0 else cx) & 7 | ((cy ^ 7 if dy > 0 else cy) & 7) << 8
        at += (left | ((cz ^ 7 if dz > 0 else cz) & 7) << 16) << _LEFT
        for _ in range(steps):
            x = ~((ty | tz) >> 63)  # -1 where x is next, else 0: nobody can predict a branch here
            y = ((ty - tz - 1) >> 63) & ~x
            z = ~(x | y)
            stride = (x & kx) + (y & ky) + (z & kz)
            at += stride
            ty += (y & uy) - (x & ux)
            tz += (z & uz) - (x & ux)
            if at & _BORROWED:
                at -= 8 * stride + (r << 9)  # in at the other side
                bx, by, bz = bx + (x & gx), by + (y & gy), bz + (z & gz)
                side = (y & 2) + (z & 4) + (((x & gx) + (y & gy) + (z & gz) + 1) >> 1)
                beyond = int(row[r, side])
                if beyond < 0:
                    beyond = _enter(top, table, row, word, bx, by, bz)
                    row[r, side] = beyond
                    row[beyond, side ^ 1] = r
                r = beyond
                at += r << 9
            count = _mark(bits, cells, count, at & _AT)
        top[CELLS] = count
    return True


@inner
def _list_ends(marks: Marks, cell: int, xyz: Int32s, alive: Bools) -> bool:
    """List the cells in which points end. False: too little room."""
    top, table, row, bits, word, cells, _ = marks
    for i in range(xyz.shape[0]):
        if not alive[i]:
            continue
        count = int(top[CELLS])
        if int(top[ROWS]) >= row.shape[0] or count + 1 >= cells.shape[0]:
            return False
        cx, cy, cz = int(xyz[i, 0]) // cell, int(xyz[i, 1]) // cell, int(xyz[i, 2]) // cell
        r = _enter(top, table, row, word, cx >> 3, cy >> 3, cz >> 3)
        at = (r << 9) | (cz & 7) << 6 | (cy & 7) << 3 | (cx & 7)
        top[CELLS] = _mark(bits, cells, count, at)
    top[ENDS] = top[CELLS]
    return True


@leaf
def list_cells(
    marks: Marks,
    cell: int,
    limit: int,
    origins: Int32s,
    starts: Int64s,
    xyz: Int32s,
    alive: Bools,
) -> bool:
    """List once each the cells where points end, then those that rays cross and no point ends in.

    origins (s, 3), starts (s + 1,): see `evidence`. `limit` 0 walks no rays. An earlier list is
    forgotten. False: there is too little room; give it more and call again.
    """
    marks.top[ROWS] = 0
    marks.top[CELLS] = 0
    if not _list_ends(marks, cell, xyz, alive):
        return False
    if limit > 0:
        for k in range(origins.shape[0]):
            begin, end = int(starts[k]), int(starts[k + 1])
            if not _walk(marks, cell, limit, origins, k, xyz, alive, begin, end):
                return False
    return True
