"""Section 4.3, preset `default`: the counters of the ray evidence.

Counters stand in bricks of 8^3 cells: per brick and author eight blocks for `pass` and eight for
`end`, one for each layer of 8 x 8 cells. A block exists exactly as long as one of its counters is
not zero, an entry (brick, author) as long as it has a block, a brick as long as it has an entry.
A block is small (bytes) until a counter leaves the range of a byte; then it moves to a wide one.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from ..model import Bools, Int32s, Int64s
from .jit import inner, leaf
from .rays import BRICK, CELLS, ENDS, ENTRY, LOW, ROWS, TOUCHED, ZERO, ZEROED, Marks, list_cells

Int8s: TypeAlias = npt.NDArray[np.int8]

# Keyed hash modulo a prime as in `matching` (repeated here: see the trap in `jit`).
_P = (1 << 31) - 1
_NEVER = 1 << 62
_FREED = -2  # in column FIRST: the brick waits in the list of free ones
LAYERS = 8
# Places in Bricks.top: rows ever used, heads of the lists of freed ones, bricks, key of the hash.
BRICKS, ENTRIES, SMALL, WIDE, FREE_BRICK, FREE_ENTRY, FREE_SMALL, FREE_WIDE, LIVE, KEY = range(10)
OLDER, FIRST = 3, 4  # columns of Bricks.brick after x y z
AUTHOR, NEXT, PASS, END = 0, 1, 2, 10  # columns of Bricks.entry; PASS and END: 8 blocks each,
NONE = -1  # a small one from 0 up, a wide one from -2 down, or none
# What a walk is at, in this order; each may run out of room of its own.
LISTING, FINDING, ADDING, DONE = range(4)


class Bricks(NamedTuple):
    """The ray evidence of one map."""

    top: Int64s  # (13,) see above
    buckets: Int32s  # (B,) newest brick of each bucket or -1; B a power of two
    brick: Int32s  # (N, 5) x y z, next brick of the bucket, newest entry
    entry: Int32s  # (E, 18) author, next entry of the brick, blocks
    small: Int8s  # (C, 64) counters of one layer, x fastest
    word: Int32s  # (C, 16) the same memory; a freed block holds the next free one
    wide: Int32s  # (W, 64) as `small`


@inner
def _bucket(top: Int64s, mask: int, x: int, y: int, z: int) -> int:
    u = int(top[KEY]) * (x + LOW)
    v = int(top[KEY + 1]) * (y + LOW)
    w = int(top[KEY + 2]) * (z + LOW)
    h = int(top[KEY + 3]) + (u & _P) + (u >> 31) + (v & _P) + (v >> 31) + (w & _P) + (w >> 31)
    h = (h & _P) + (h >> 31)
    return (h if h < _P else h - _P) & mask


@inner
def find_brick(top: Int64s, buckets: Int32s, brick: Int32s, x: int, y: int, z: int) -> int:
    b = int(buckets[_bucket(top, buckets.shape[0] - 1, x, y, z)])
    while b >= 0 and (brick[b, 0] != x or brick[b, 1] != y or brick[b, 2] != z):
        b = int(brick[b, OLDER])
    return b


@inner
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
    buckets[bucket] = b
    top[LIVE] += 1
    return b


@inner
def _entry(top: Int64s, brick: Int32s, entry: Int32s, b: int, author: int) -> int:
    """The entry of a brick and an author, one without blocks where there was none."""
    e = int(brick[b, FIRST])
    while e >= 0 and entry[e, AUTHOR] != author:
        e = int(entry[e, NEXT])
    if e >= 0:
        return e
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


@inner
def _new_small(top: Int64s, word: Int32s) -> int:
    c = int(top[FREE_SMALL])
    if c >= 0:
        top[FREE_SMALL] = word[c, 0]
    else:
        c = int(top[SMALL])
        top[SMALL] = c + 1
    for i in range(16):
        word[c, i] = 0
    return c


@inner
def _widen(top: Int64s, small: Int8s, word: Int32s, wide: Int32s, c: int) -> int:
    """Move a small block to a wide one."""
    w = int(top[FREE_WIDE])
    if w >= 0:
        top[FREE_WIDE] = wide[w, 0]
    else:
        w = int(top[WIDE])
        top[WIDE] = w + 1
    for i in range(64):
        wide[w, i] = small[c, i]
    word[c, 0] = top[FREE_SMALL]
    top[FREE_SMALL] = c
    return -2 - w


@leaf
def walk(
    bricks: Bricks,
    marks: Marks,
    cell: int,
    limit: int,
    author: int,
    origins: Int32s,
    starts: Int64s,
    xyz: Int32s,
    alive: Bools,
    sign: int,
    at: Int64s,
) -> int:
    """Add `sign` in the cells of one transaction's rays and ends; see `evidence`.

    at: (2,) what the walk is at and how many cells it has added, zeros for a new one. Returns what
    it is at: DONE, or what there is too little room for; give it more and call again.
    """
    if at[0] == LISTING and list_cells(marks, cell, limit, origins, starts, xyz, alive):
        at[0] = FINDING
    if at[0] == FINDING and _find_entries(bricks, marks, author):
        at[0] = ADDING
    if at[0] == ADDING:
        at[1] = _add_cells(bricks, marks, sign, int(at[1]))
        if at[1] == marks.top[CELLS]:
            if marks.top[ZEROED]:
                _free_zeros(bricks, marks)
            at[0] = DONE
    return int(at[0])


@leaf
def _find_entries(bricks: Bricks, marks: Marks, author: int) -> bool:
    """Give every row of the marks its entry; False where there is too little room."""
    top, buckets, brick, entry = bricks.top, bricks.buckets, bricks.brick, bricks.entry
    row = marks.row
    rows = int(marks.top[ROWS])
    if min(brick.shape[0] - int(top[BRICKS]), entry.shape[0] - int(top[ENTRIES])) < rows:
        return False
    for r in range(rows):
        x, y, z = int(row[r, BRICK]), int(row[r, BRICK + 1]), int(row[r, BRICK + 2])
        x, y, z = x - LOW, y - LOW, z - LOW
        b = find_brick(top, buckets, brick, x, y, z)
        if b < 0:
            b = _new_brick(top, buckets, brick, x, y, z)
        row[r, ENTRY] = _entry(top, brick, entry, b, author)
        row[r, ZERO] = 0
    marks.top[ZEROED] = 0
    marks.top[TOUCHED] = _copy_blocks(entry, bricks.small, row, marks.word, marks.block, rows)
    return True


@inner
def _copy_blocks(
    entry: Int32s, small: Int8s, row: Int32s, word: Int64s, block: Int32s, rows: int
) -> int:
    """Copy the entries' `pass` blocks to the marks; read where `_add_cells` will write.

    Here the processor waits for many lines of memory at once, there for one after another.
    """
    touched = 0
    for r in range(rows):
        e = int(row[r, ENTRY])
        for layer in range(LAYERS):
            c = int(entry[e, PASS + layer])
            block[r, layer] = c
            touched |= int(small[max(c, 0) * int(word[r * LAYERS + layer] != 0), 0])
    return touched


@leaf
def _add_cells(bricks: Bricks, marks: Marks, sign: int, begin: int) -> int:
    """Add `sign` to the counters of what is listed, from `begin` on.

    Returns how many cells are listed, or the one before which blocks run out.
    """
    top, entry = bricks.top, bricks.entry
    small, word, wide = bricks.small, bricks.word, bricks.wide
    row, cells, block = marks.row, marks.cell, marks.block
    count, ends = int(marks.top[CELLS]), int(marks.top[ENDS])
    for i in range(begin, count):
        at = int(cells[i])
        r, layer, at = at >> 9, at >> 6 & 7, at & 63
        e = int(row[r, ENTRY])
        c = int(entry[e, END + layer]) if i < ends else int(block[r, layer])
        if c == NONE:
            if int(top[SMALL]) >= small.shape[0]:
                return i
            c = _new_small(top, word)
            entry[e, (END if i < ends else PASS) + layer] = c
            block[r, layer] = entry[e, PASS + layer]
        counter = sign + (int(small[c, at]) if c >= 0 else int(wide[-2 - c, at]))
        if c >= 0 and not -128 <= counter <= 127:
            if int(top[WIDE]) >= wide.shape[0]:
                return i
            c = _widen(top, small, word, wide, c)
            entry[e, (END if i < ends else PASS) + layer] = c
            block[r, layer] = entry[e, PASS + layer]
        if c >= 0:
            small[c, at] = counter
        else:
            wide[-2 - c, at] = counter
        if counter == 0:
            row[r, ZERO] = marks.top[ZEROED] = 1
    return count


@inner
def _is_zero(block: Int32s, c: int) -> bool:
    rest = 0
    for i in range(block.shape[1]):
        rest |= int(block[c, i])
    return rest == 0


@inner
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


@inner
def _drop(bricks: Bricks, x: int, y: int, z: int, e: int) -> None:
    """Free an entry of a brick, and the brick where it was its last."""
    top, buckets, brick, entry = bricks.top, bricks.buckets, bricks.brick, bricks.entry
    b = find_brick(top, buckets, brick, x, y, z)
    at, before = int(brick[b, FIRST]), -1
    while at != e:
        before, at = at, int(entry[at, NEXT])
    if before < 0:
        brick[b, FIRST] = entry[e, NEXT]
    else:
        entry[before, NEXT] = entry[e, NEXT]
    entry[e, NEXT] = top[FREE_ENTRY]
    top[FREE_ENTRY] = e
    if brick[b, FIRST] >= 0:
        return
    bucket = _bucket(top, buckets.shape[0] - 1, x, y, z)
    at, before = int(buckets[bucket]), -1
    while at != b:
        before, at = at, int(brick[at, OLDER])
    if before < 0:
        buckets[bucket] = brick[b, OLDER]
    else:
        brick[before, OLDER] = brick[b, OLDER]
    brick[b, FIRST] = _FREED
    brick[b, OLDER] = top[FREE_BRICK]
    top[FREE_BRICK] = b
    top[LIVE] -= 1


@leaf
def _free_zeros(bricks: Bricks, marks: Marks) -> None:
    """Free the blocks that have become zero, and the entries and bricks that this leaves empty."""
    entry, row = bricks.entry, marks.row
    for r in range(int(marks.top[ROWS])):
        if row[r, ZERO] == 0:
            continue
        e = int(row[r, ENTRY])
        kept = False
        for column in range(PASS, PASS + 2 * LAYERS):
            c = _free_if_zero(bricks.top, bricks.word, bricks.wide, int(entry[e, column]))
            entry[e, column] = c
            kept = kept or c != NONE
        if not kept:
            x, y, z = int(row[r, BRICK]), int(row[r, BRICK + 1]), int(row[r, BRICK + 2])
            _drop(bricks, x - LOW, y - LOW, z - LOW, e)


@leaf
def rebuild(bricks: Bricks) -> None:
    """Fill a new, empty array of buckets (all -1)."""
    top, buckets, brick = bricks.top, bricks.buckets, bricks.brick
    for b in range(int(top[BRICKS])):
        if brick[b, FIRST] != _FREED:
            x, y, z = int(brick[b, 0]), int(brick[b, 1]), int(brick[b, 2])
            bucket = _bucket(top, buckets.shape[0] - 1, x, y, z)
            brick[b, OLDER] = buckets[bucket]
            buckets[bucket] = b


@inner
def count_at(small: Int8s, wide: Int32s, c: int, at: int) -> int:
    if c >= 0:
        return int(small[c, at])
    return 0 if c == NONE else int(wide[-2 - c, at])


@leaf
def read(bricks: Bricks, cell: int, xyz: Int32s, passes: Int32s, ends: Int32s) -> None:
    """passes, ends (N, A) of the cells of xyz (N, 3); both come in as zeros."""
    top, buckets, brick = bricks.top, bricks.buckets, bricks.brick
    entry, small, wide = bricks.entry, bricks.small, bricks.wide
    for i in range(xyz.shape[0]):
        cx, cy, cz = int(xyz[i, 0]) // cell, int(xyz[i, 1]) // cell, int(xyz[i, 2]) // cell
        b = find_brick(top, buckets, brick, cx >> 3, cy >> 3, cz >> 3)
        e = int(brick[b, FIRST]) if b >= 0 else -1
        at = (cy & 7) << 3 | (cx & 7)
        while e >= 0:
            author = int(entry[e, AUTHOR])
            passes[i, author] = count_at(small, wide, int(entry[e, PASS + (cz & 7)]), at)
            ends[i, author] = count_at(small, wide, int(entry[e, END + (cz & 7)]), at)
            e = int(entry[e, NEXT])
