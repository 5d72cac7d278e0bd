"""Section 4.3, preset `default`: which cells a transaction's rays cross, in integers.

Counters stand in bricks of 8^3 cells: per brick and author eight blocks for `pass` and eight for
`end`, one for each layer of 8 x 8 cells. A block exists exactly as long as one of its counters is
not zero, an entry (brick, author) as long as it has a block, a brick as long as it has an entry.
A block is small (bytes) until a counter leaves the range of a byte; then it moves to a wide one.

One call marks cells in bits of its own (`Marks`), lists each cell once, and adds at the end.

The walk (Amanatides and Woo, 1987) compares the times of the next crossings t = n/|d| of the three
axes after multiplication by all three |d|: exact. An axis that climbs enters the next cell when it
reaches the border, one that falls when it leaves it, hence at equal times climbing axes go first;
among equals x, then y, then z. Each crossing is a step: a ray through an edge marks one cell beside.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from ..model import Bools, Int32s, Int64s, Uint8s
from .jit import kernel

Int8s: TypeAlias = npt.NDArray[np.int8]

# Keyed hash modulo a prime as in `matching` (repeated here: see the trap in `jit`).
_P = (1 << 31) - 1
_LOW = 1 << 29
_NEVER = 1 << 62
_FREED = -2  # in column FIRST: the brick waits in the list of free ones
LAYERS = 8
# Places in Bricks.top: rows ever used and heads of the lists of freed ones, then the key of the hash.
BRICKS, ENTRIES, SMALL, WIDE, FREE_BRICK, FREE_ENTRY, FREE_SMALL, FREE_WIDE = range(8)
LIVE, ROWS, CELLS, KEY = range(8, 12)
OLDER, FIRST, ROW = 3, 4, 5  # columns of Bricks.brick after x y z
AUTHOR, NEXT, PASS, END = 0, 1, 2, 10  # columns of Bricks.entry; PASS and END: 8 blocks each,
NONE = -1  # a small one from 0 up, or a wide one from -2 down
BRICK, ENTRY, ZERO = 6, 7, 8  # columns of Marks.row after the neighbours
_LEFT = 0x808080 << 40
_AT = (1 << 40) - 1  # borrows of the three counters (8 bits each) of steps left inside a brick


class Bricks(NamedTuple):
    """The ray evidence of one map."""

    top: Int64s  # (15,) see above
    buckets: Int32s  # (B,) newest brick of each bucket or -1; B a power of two
    brick: Int32s  # (N, 6) x y z, next brick of the bucket, newest entry, row in the marks
    entry: Int32s  # (E, 18) author, next entry of the brick, blocks
    small: Int8s  # (C, 64) counters of one layer, x fastest
    word: Int32s  # (C, 16) the same memory; a freed block holds the next free one
    wide: Int32s  # (W, 64) as `small`


class Marks(NamedTuple):
    """What one call marks: `top[ROWS]` bricks and `top[CELLS]` cells. `word` is `bits`' memory."""

    row: Int32s  # (R, 9) rows of the neighbours at -x +x -y +y -z +z or -1; brick, entry, any zero
    bits: Uint8s  # (R * 128,) bit z * 64 + y * 8 + x of a row: passed; 512 bits on: ended
    word: Int64s  # (R * 16,)
    cell: Int64s  # (L,) the cells: number of the bit


@kernel
def _bucket(top: Int64s, mask: int, x: int, y: int, z: int) -> int:
    u = int(top[KEY]) * (x + _LOW)
    v = int(top[KEY + 1]) * (y + _LOW)
    w = int(top[KEY + 2]) * (z + _LOW)
    h = int(top[KEY + 3]) + (u & _P) + (u >> 31) + (v & _P) + (v >> 31) + (w & _P) + (w >> 31)
    h = (h & _P) + (h >> 31)
    if h >= _P:
        h -= _P
    return h & mask


@kernel
def _find(top: Int64s, buckets: Int32s, brick: Int32s, x: int, y: int, z: int) -> int:
    b = int(buckets[_bucket(top, buckets.shape[0] - 1, x, y, z)])
    while b >= 0 and (brick[b, 0] != x or brick[b, 1] != y or brick[b, 2] != z):
        b = int(brick[b, OLDER])
    return b


@kernel
def _new_brick(top: Int64s, buckets: Int32s, brick: Int32s, x: int, y: int, z: int) -> int:
    b = int(top[FREE_BRICK])
    if b >= 0:
        top[FREE_BRICK] = brick[b, OLDER]
    else:
        b = int(top[BRICKS])
        top[BRICKS] = b + 1
    bucket = _bucket(top, buckets.shape[0] - 1, x, y, z)
    brick[b, 0] = x
    brick[b, 1] = y
    brick[b, 2] = z
    brick[b, OLDER] = buckets[bucket]
    brick[b, FIRST] = -1
    brick[b, ROW] = 0
    buckets[bucket] = b
    top[LIVE] += 1
    return b


@kernel
def _free_brick(top: Int64s, buckets: Int32s, brick: Int32s, b: int) -> None:
    x, y, z = int(brick[b, 0]), int(brick[b, 1]), int(brick[b, 2])
    bucket = _bucket(top, buckets.shape[0] - 1, x, y, z)
    at = int(buckets[bucket])
    if at == b:
        buckets[bucket] = brick[b, OLDER]
    else:
        while brick[at, OLDER] != b:
            at = int(brick[at, OLDER])
        brick[at, OLDER] = brick[b, OLDER]
    brick[b, FIRST] = _FREED
    brick[b, OLDER] = top[FREE_BRICK]
    top[FREE_BRICK] = b
    top[LIVE] -= 1


@kernel
def _enter(
    top: Int64s,
    buckets: Int32s,
    brick: Int32s,
    row: Int32s,
    word: Int64s,
    x: int,
    y: int,
    z: int,
) -> int:
    """Row of a brick in the marks; a brick that is new to the call gets an empty one."""
    b = _find(top, buckets, brick, x, y, z)
    if b < 0:
        return _new_row(top, brick, row, word, _new_brick(top, buckets, brick, x, y, z))
    r = int(brick[b, ROW])
    if int(row[r, BRICK]) != b or r >= int(top[ROWS]):  # r is left from an earlier call
        return _new_row(top, brick, row, word, b)
    return r


@kernel
def _new_row(top: Int64s, brick: Int32s, row: Int32s, word: Int64s, b: int) -> int:
    r = int(top[ROWS])
    top[ROWS] = r + 1
    brick[b, ROW] = r
    row[r, BRICK] = b
    for side in range(6):
        row[r, side] = -1
    for i in range(r * 16, r * 16 + 16):
        word[i] = 0
    return r


@kernel
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


@kernel
def _cut(d: int, limit: int, length: int) -> int:
    """One component of a ray shortened from `length` to `limit`, towards its origin."""
    return d * limit // length if d >= 0 else -(-d * limit // length)


@kernel
def _ray(limit: int, ox: int, oy: int, oz: int, px: int, py: int, pz: int) -> tuple[int, int, int]:
    """From an origin to a point, at most `limit` mm long."""
    dx, dy, dz = px - ox, py - oy, pz - oz
    d2 = dx * dx + dy * dy + dz * dz
    if d2 > limit * limit:
        length = ceil_sqrt(d2)
        return _cut(dx, limit, length), _cut(dy, limit, length), _cut(dz, limit, length)
    return dx, dy, dz


@kernel
def _first_crossing(cell: int, within: int, d: int, scale: int) -> int:
    """Twice the time of an axis' first crossing, times the product of all |d|; + 1 if falling.

    within: mm from the lower border of the origin's cell.
    """
    if d > 0:
        return 2 * (cell - within) * scale
    if d < 0:
        return 2 * within * scale + 1
    return _NEVER


@kernel
def _steps_left(c: int, sign: int) -> int:
    """Steps along one axis until the next but one leaves the brick."""
    return 7 - (c & 7) if sign > 0 else c & 7


@kernel
def _sign(d: int) -> int:
    return 1 if d > 0 else -1


@kernel
def _mark(bits: Uint8s, listed: Int64s, count: int, at: int) -> int:
    """Set a bit and, where it was not set, list it: how many are listed then (one may be spare)."""
    before = int(bits[at >> 3])
    bits[at >> 3] = before | (1 << (at & 7))
    listed[count] = at
    return count + 1 - ((before >> (at & 7)) & 1)


@kernel
def _room(top: Int64s, brick: Int32s, row: Int32s, listed: Int64s, rows: int, cells: int) -> bool:
    """Whether so many rows and cells more are there for certain."""
    spare = min(brick.shape[0] - int(top[BRICKS]), row.shape[0] - int(top[ROWS])) - rows
    return min(spare, listed.shape[0] - int(top[CELLS]) - cells - 1) >= 0


@kernel
def _walk_segment(
    bricks: Bricks,
    marks: Marks,
    cell: int,
    limit: int,
    origin: Int32s,
    xyz: Int32s,
    alive: Bools,
    last: Int64s,
    begin: int,
    end: int,
) -> int:
    """Mark the cells from the origin (3,) to the points begin to end - 1, both ends included.

    last (n,) gets the bit that the ray marks last, -1 where the ray was cut.
    Returns `end`, or the point before whose ray the rows may run out.
    """
    # One function, arrays in locals: to hand tuples on costs more than twenty steps.
    top, buckets, brick = bricks.top, bricks.buckets, bricks.brick
    row, bits, word, listed = marks.row, marks.bits, marks.word, marks.cell
    ox, oy, oz = int(origin[0]), int(origin[1]), int(origin[2])
    cx, cy, cz = ox // cell, oy // cell, oz // cell
    home = -1
    for i in range(begin, end):
        if not alive[i]:
            continue
        dx, dy, dz = _ray(limit, ox, oy, oz, int(xyz[i, 0]), int(xyz[i, 1]), int(xyz[i, 2]))
        steps = abs((ox + dx) // cell - cx) + abs((oy + dy) // cell - cy)
        steps += abs((oz + dz) // cell - cz)
        if not _room(top, brick, row, listed, steps // 8 + 4, steps + 1):
            return i
        if home < 0:
            home = _enter(top, buckets, brick, row, word, cx >> 3, cy >> 3, cz >> 3)
        ux, uy, uz = max(abs(dx), 1), max(abs(dy), 1), max(abs(dz), 1)
        ux, uy, uz = uy * uz, ux * uz, ux * uy  # products of the others' |d|
        tx = _first_crossing(cell, ox - cx * cell, dx, ux)
        ty = _first_crossing(cell, oy - cy * cell, dy, uy)
        tz = _first_crossing(cell, oz - cz * cell, dz, uz)
        ux, uy, uz = 2 * cell * ux, 2 * cell * uy, 2 * cell * uz  # between crossings
        sx, sy, sz = _sign(dx), 8 * _sign(dy), 64 * _sign(dz)
        left = _steps_left(cx, sx) | _steps_left(cy, sy) << 8 | _steps_left(cz, sz) << 16
        bx, by, bz = cx >> 3, cy >> 3, cz >> 3
        r, at = home, home << 10 | (cz & 7) << 6 | (cy & 7) << 3 | (cx & 7)
        count = _mark(bits, listed, int(top[CELLS]), at)
        at += left << 40
        kx, ky, kz = sx - (1 << 40), sy - (1 << 48), sz - (1 << 56)
        ty -= tx  # from here on: later than the x axis by
        tz -= tx
        for _ in range(steps):
            x = ~((ty | tz) >> 63)
            y = ((ty - tz - 1) >> 63) & ~x
            z = ~(x | y)
            at += (x & kx) + (y & ky) + (z & kz)
            ty += (y & uy) - (x & ux)
            tz += (z & uz) - (x & ux)
            if at & _LEFT:
                at -= (x & (8 * sx - (8 << 40))) + (y & (8 * sy - (8 << 48))) + (z & (8 * sz - (8 << 56)))
                at -= r << 10
                bx, by, bz = bx + (x & sx), by + (y & (sy >> 3)), bz + (z & (sz >> 6))
                side = (y & 2) + (z & 4) + int((x & sx) + (y & sy) + (z & sz) > 0)
                known = int(row[r, side])
                if known < 0:
                    known = _enter(top, buckets, brick, row, word, bx, by, bz)
                    row[r, side] = known
                    row[known, side ^ 1] = r
                r = known
                at += r << 10
            count = _mark(bits, listed, count, at & _AT)
        at &= _AT
        top[CELLS] = count
        whole = ox + dx == xyz[i, 0] and oy + dy == xyz[i, 1] and oz + dz == xyz[i, 2]
        last[i] = at if whole else -1
    return end


@kernel
def _mark_ends(
    bricks: Bricks,
    marks: Marks,
    cell: int,
    xyz: Int32s,
    alive: Bools,
    last: Int64s,
    begin: int,
) -> int:
    """Mark the cells in which points end; `last` where it is known."""
    top, buckets, brick = bricks.top, bricks.buckets, bricks.brick
    row, bits, word, listed = marks.row, marks.bits, marks.word, marks.cell
    for i in range(begin, xyz.shape[0]):
        if not alive[i]:
            continue
        if not _room(top, brick, row, listed, 1, 1):
            return i
        at = int(last[i])
        if at < 0:
            cx, cy, cz = int(xyz[i, 0]) // cell, int(xyz[i, 1]) // cell, int(xyz[i, 2]) // cell
            r = _enter(top, buckets, brick, row, word, cx >> 3, cy >> 3, cz >> 3)
            at = r << 10 | (cz & 7) << 6 | (cy & 7) << 3 | (cx & 7)
        top[CELLS] = _mark(bits, listed, int(top[CELLS]), at + 512)
    return xyz.shape[0]


@kernel
def mark_all(
    bricks: Bricks,
    marks: Marks,
    cell: int,
    limit: int,
    origins: Int32s,
    starts: Int64s,
    xyz: Int32s,
    alive: Bools,
    last: Int64s,
    begin: int,
) -> int:
    """Mark what the n rays cross (tasks 0 to n - 1), then where the points end (n to 2n - 1).

    `limit` 0 walks no rays. `begin` is the first task to do, `last` (n,) comes in as -1. Returns 2n,
    or the task before which rows may run out: grow them and call again.
    """
    n = xyz.shape[0]
    if limit > 0:
        for k in range(origins.shape[0]):
            low, high = max(begin, int(starts[k])), int(starts[k + 1])
            if low < high:
                done = _walk_segment(
                    bricks, marks, cell, limit, origins[k], xyz, alive, last, low, high
                )
                if done < high:
                    return done
    return n + _mark_ends(bricks, marks, cell, xyz, alive, last, max(0, begin - n))


@kernel
def _find_entry(brick: Int32s, entry: Int32s, b: int, author: int) -> int:
    e = int(brick[b, FIRST])
    while e >= 0:
        if entry[e, AUTHOR] == author:
            return e
        e = int(entry[e, NEXT])
    return -1


@kernel
def _new_entry(top: Int64s, brick: Int32s, entry: Int32s, b: int, author: int) -> int:
    e = int(top[FREE_ENTRY])
    if e >= 0:
        top[FREE_ENTRY] = entry[e, NEXT]
    else:
        e = int(top[ENTRIES])
        top[ENTRIES] = e + 1
    for column in range(PASS, PASS + 2 * LAYERS):
        entry[e, column] = NONE
    entry[e, AUTHOR] = author
    entry[e, NEXT] = brick[b, FIRST]
    brick[b, FIRST] = e
    return e


@kernel
def _drop_entry(top: Int64s, brick: Int32s, entry: Int32s, b: int, e: int) -> None:
    """Free an entry that has no block left."""
    if brick[b, FIRST] == e:
        brick[b, FIRST] = entry[e, NEXT]
    else:
        at = int(brick[b, FIRST])
        while entry[at, NEXT] != e:
            at = int(entry[at, NEXT])
        entry[at, NEXT] = entry[e, NEXT]
    entry[e, NEXT] = top[FREE_ENTRY]
    top[FREE_ENTRY] = e


@kernel
def _new_block(top: Int64s, block: Int32s, used: int, free: int) -> int:
    """A zero row of `Bricks.word` or `wide`; used, free: the places in `top` that belong to it."""
    c = int(top[free])
    if c >= 0:
        top[free] = block[c, 0]
    else:
        c = int(top[used])
        top[used] = c + 1
    for i in range(block.shape[1]):
        block[c, i] = 0
    return c


@kernel
def _widen(top: Int64s, small: Int8s, word: Int32s, wide: Int32s, c: int) -> int:
    """Move a small block to a wide one."""
    w = _new_block(top, wide, WIDE, FREE_WIDE)
    for i in range(64):
        wide[w, i] = small[c, i]
    word[c, 0] = top[FREE_SMALL]
    top[FREE_SMALL] = c
    return w


@kernel
def find_entries(bricks: Bricks, marks: Marks, author: int) -> bool:
    """Give every row its entry; False where entries run out: grow them and call again."""
    top, brick, entry, row = bricks.top, bricks.brick, bricks.entry, marks.row
    for r in range(int(top[ROWS])):
        if int(top[ENTRIES]) >= entry.shape[0]:
            return False
        b = int(row[r, BRICK])
        e = _find_entry(brick, entry, b, author)
        row[r, ENTRY] = e if e >= 0 else _new_entry(top, brick, entry, b, author)
        row[r, ZERO] = 0
    return True


@kernel
def add_cells(bricks: Bricks, marks: Marks, sign: int, begin: int) -> int:
    """Add `sign` to what is listed from `begin` on, but where a point ended only to its ends.

    Returns how many cells are listed, or the one before which blocks run out.
    """
    top, entry, small, wide = bricks.top, bricks.entry, bricks.small, bricks.wide
    row, bits, listed = marks.row, marks.bits, marks.cell
    for i in range(begin, int(top[CELLS])):
        at = int(listed[i])
        if at & 512 == 0 and (int(bits[(at >> 3) + 64]) >> (at & 7)) & 1 == 1:
            continue
        r = at >> 10
        e = int(row[r, ENTRY])
        column = PASS + ((at >> 6) & 15)
        if int(top[SMALL]) >= small.shape[0] or int(top[WIDE]) >= wide.shape[0]:
            return i
        c = int(entry[e, column])
        if c == NONE:
            c = _new_block(top, bricks.word, SMALL, FREE_SMALL)
            entry[e, column] = c
        counter = sign + (int(small[c, at & 63]) if c >= 0 else int(wide[-2 - c, at & 63]))
        if c >= 0 and not -128 <= counter <= 127:
            c = -2 - _widen(top, small, bricks.word, wide, c)
            entry[e, column] = c
        if c >= 0:
            small[c, at & 63] = counter
        else:
            wide[-2 - c, at & 63] = counter
        if counter == 0:
            row[r, ZERO] = 1
    return int(top[CELLS])


@kernel
def _is_zero(block: Int32s, c: int) -> bool:
    rest = 0
    for i in range(block.shape[1]):
        rest |= int(block[c, i])
    return rest == 0


@kernel
def _free_if_zero(top: Int64s, word: Int32s, wide: Int32s, c: int) -> int:
    """The block as it is, or NONE where it was zero and is free now."""
    if c >= 0 and _is_zero(word, c):
        word[c, 0] = top[FREE_SMALL]
        top[FREE_SMALL] = c
        return NONE
    if c < NONE and _is_zero(wide, -2 - c):
        wide[-2 - c, 0] = top[FREE_WIDE]
        top[FREE_WIDE] = -2 - c
        return NONE
    return c


@kernel
def free_zeros(bricks: Bricks, marks: Marks) -> None:
    """Free the blocks that have become zero, and the entries and bricks that this leaves empty."""
    top, brick, entry, row = bricks.top, bricks.brick, bricks.entry, marks.row
    for r in range(int(top[ROWS])):
        if row[r, ZERO] == 0:
            continue
        b, e = int(row[r, BRICK]), int(row[r, ENTRY])
        kept = False
        for column in range(PASS, PASS + 2 * LAYERS):
            c = _free_if_zero(top, bricks.word, bricks.wide, int(entry[e, column]))
            entry[e, column] = c
            kept = kept or c != NONE
        if not kept:
            _drop_entry(top, brick, entry, b, e)
            if brick[b, FIRST] < 0:
                _free_brick(top, bricks.buckets, brick, b)


@kernel
def rebuild(bricks: Bricks) -> None:
    """Fill a new, empty array of buckets (all -1)."""
    top, buckets, brick = bricks.top, bricks.buckets, bricks.brick
    for b in range(int(top[BRICKS])):
        if brick[b, FIRST] != _FREED:
            x, y, z = int(brick[b, 0]), int(brick[b, 1]), int(brick[b, 2])
            bucket = _bucket(top, buckets.shape[0] - 1, x, y, z)
            brick[b, OLDER] = buckets[bucket]
            buckets[bucket] = b


@kernel
def _counter(small: Int8s, wide: Int32s, c: int, at: int) -> int:
    if c >= 0:
        return int(small[c, at])
    return 0 if c == NONE else int(wide[-2 - c, at])


@kernel
def read(bricks: Bricks, cell: int, xyz: Int32s, passes: Int32s, ends: Int32s) -> None:
    """passes, ends (N, A) of the cells of xyz (N, 3); both come in as zeros."""
    top, buckets, brick = bricks.top, bricks.buckets, bricks.brick
    entry, small, wide = bricks.entry, bricks.small, bricks.wide
    for i in range(xyz.shape[0]):
        cx, cy, cz = int(xyz[i, 0]) // cell, int(xyz[i, 1]) // cell, int(xyz[i, 2]) // cell
        b = _find(top, buckets, brick, cx >> 3, cy >> 3, cz >> 3)
        e = int(brick[b, FIRST]) if b >= 0 else -1
        at = (cy & 7) << 3 | (cx & 7)
        while e >= 0:
            author = int(entry[e, AUTHOR])
            passes[i, author] = _counter(small, wide, int(entry[e, PASS + (cz & 7)]), at)
            ends[i, author] = _counter(small, wide, int(entry[e, END + (cz & 7)]), at)
            e = int(entry[e, NEXT])


@kernel
def _misses(
    entry: Int32s, small: Int8s, wide: Int32s, e: int, layer: int, at: int, say: int
) -> int:
    """Sum over the authors of a brick, from entry e on: min(say, max(0, passes - ends))."""
    misses = 0
    while e >= 0:
        free = _counter(small, wide, int(entry[e, PASS + layer]), at)
        if free > 0:
            free -= _counter(small, wide, int(entry[e, END + layer]), at)
            misses += min(say, max(0, free))
        e = int(entry[e, NEXT])
    return misses


@kernel
def judge(
    bricks: Bricks,
    cell: int,
    hit_say: int,
    miss_say: int,
    seed: Int32s,
    first: Int32s,
    entries: Int32s,
    hits: Int32s,
    misses: Int32s,
    witnesses: Int32s,
) -> None:
    """Hits, misses and witnesses of every node, each author's part bounded by its say.

    seed, first, entries: see `matching.Nodes`; the entries' columns are author, hits, cycle, next.
    """
    top, buckets, brick = bricks.top, bricks.buckets, bricks.brick
    entry, small, wide = bricks.entry, bricks.small, bricks.wide
    bx = by = bz = _NEVER  # the brick of the node before, most often this one's too
    newest = -1
    for node in range(seed.shape[0]):
        cx, cy, cz = int(seed[node, 0]), int(seed[node, 1]), int(seed[node, 2])
        cx, cy, cz = cx // cell, cy // cell, cz // cell
        if cx >> 3 != bx or cy >> 3 != by or cz >> 3 != bz:
            bx, by, bz = cx >> 3, cy >> 3, cz >> 3
            b = _find(top, buckets, brick, bx, by, bz)
            newest = int(brick[b, FIRST]) if b >= 0 else -1
        at = (cy & 7) << 3 | (cx & 7)
        misses[node] = _misses(entry, small, wide, newest, cz & 7, at, miss_say)
        h = 0
        w = 0
        mine = int(first[node])
        while mine >= 0:
            h += min(hit_say, int(entries[mine, 1]))
            w += 1
            mine = int(entries[mine, 3])
        hits[node] = h
        witnesses[node] = w
