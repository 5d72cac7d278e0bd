"""Section 4.3, preset `default`: what the rays say of a node, each author's part bounded."""

from __future__ import annotations

from ..model import Bools, Int32s, Int64s, Uint8s
from .bricks import (
    AUTHOR,
    BRICKS,
    END,
    FIRST,
    LAYERS,
    NEXT,
    NONE,
    PASS,
    Bricks,
    count_at,
    find_brick,
)
from .jit import inner, leaf
from .rays import ceil_sqrt

_NEVER = 1 << 62
PASSED, ENDED, BEFORE, LISTED = 0, 1, 2, 3  # columns of what an author says of a node


@inner
def _touch(part: Int32s, touched: Int32s, count: int, author: int) -> int:
    """Put an author on the list of those who say something; how many are on it."""
    if part[author, LISTED] == 0:
        part[author, LISTED] = 1
        touched[count] = author
        count += 1
    return count


@inner
def _read_cell(bricks: Bricks, e: int, layer: int, at: int, part: Int32s, touched: Int32s) -> int:
    """Passes and ends in the cell of a node, by author; how many authors have any."""
    count = 0
    while e >= 0:
        free = count_at(bricks.small, bricks.wide, int(bricks.entry[e, PASS + layer]), at)
        ended = count_at(bricks.small, bricks.wide, int(bricks.entry[e, END + layer]), at)
        if free > 0 or ended > 0:
            author = int(bricks.entry[e, AUTHOR])
            count = _touch(part, touched, count, author)
            part[author, PASSED] = max(0, free)
            part[author, ENDED] = max(0, ended)
        e = int(bricks.entry[e, NEXT])
    return count


@inner
def _mark_ends(bricks: Bricks, solid: Uint8s) -> None:
    """Set the bit of every cell in which points of anybody end. Most of a ray's cells have none."""
    for b in range(int(bricks.top[BRICKS])):
        e = int(bricks.brick[b, FIRST])
        while e >= 0:
            for layer in range(LAYERS):
                c = int(bricks.entry[e, END + layer])
                for at in range(64 if c != NONE else 0):
                    if count_at(bricks.small, bricks.wide, c, at) > 0:
                        row = layer << 3 | at >> 3
                        solid[b, row] = int(solid[b, row]) | 1 << (at & 7)
            e = int(bricks.entry[e, NEXT])


@inner
def _read_ray(
    bricks: Bricks,
    solid: Uint8s,
    cell: int,
    limit: int,
    origin: Int32s,
    seed: Int32s,
    node: int,
    length: int,
    part: Int32s,
    touched: Int32s,
    count: int,
) -> int:
    """Ends between the sensor and a node, by author, looked up every half cell of the way.

    Left out is what lies within a cell's edge of either end, in their cells, or beyond `limit`.
    """
    x, y, z = int(origin[node, 0]), int(origin[node, 1]), int(origin[node, 2])
    dx, dy, dz = int(seed[node, 0]) - x, int(seed[node, 1]) - y, int(seed[node, 2]) - z
    ox, oy, oz = (x + dx) // cell, (y + dy) // cell, (z + dz) // cell
    lx, ly, lz = x // cell, y // cell, z // cell  # the cell looked up before
    bx = by = bz = _NEVER
    b = -1
    for s in range(cell, min(length - cell, limit), max(1, cell // 2)):
        cx, cy, cz = (x + dx * s // length) // cell, (y + dy * s // length) // cell, 0
        cz = (z + dz * s // length) // cell
        if (cx == lx and cy == ly and cz == lz) or (cx == ox and cy == oy and cz == oz):
            continue
        lx, ly, lz = cx, cy, cz
        if cx >> 3 != bx or cy >> 3 != by or cz >> 3 != bz:
            bx, by, bz = cx >> 3, cy >> 3, cz >> 3
            b = find_brick(bricks.top, bricks.buckets, bricks.brick, bx, by, bz)
        if b < 0 or not solid[b, (cz & 7) << 3 | (cy & 7)] >> (cx & 7) & 1:
            continue
        at = (cy & 7) << 3 | (cx & 7)
        e = int(bricks.brick[b, FIRST])
        while e >= 0:
            c = int(bricks.entry[e, END + (cz & 7)])
            ended = 0 if c == NONE else count_at(bricks.small, bricks.wide, c, at)
            if ended > 0:
                author = int(bricks.entry[e, AUTHOR])
                count = _touch(part, touched, count, author)
                part[author, BEFORE] += ended
            e = int(bricks.entry[e, NEXT])
    return count


@leaf
def judge(
    bricks: Bricks,
    cell: int,
    limit: int,
    say: Int64s,
    seed: Int32s,
    origin: Int32s,
    first: Int32s,
    entries: Int32s,
    part: Int32s,
    touched: Int32s,
    solid: Uint8s,
    out: Int32s,
    denied: Bools,
) -> None:
    """What the rays say of every node, each author's part bounded by its say.

    say: (4,) at most of an author's hits, misses, passes (and as many ends), and ends before the
    node. seed, origin, first, entries: see `matching.Nodes`. part: (A, 4) zeros, and zeros again
    afterwards; touched: (A,); solid: (B, 64) zeros, a bit for every cell of every brick.
    out: (N, 7) is written: hits, witnesses, against, distance, passed, ended, hidden.
    denied: (E,) is written: by entry, whether more of the author's own passes than ends are there;
    who has no row in `part` has no rays.
    """
    top, buckets, brick = bricks.top, bricks.buckets, bricks.brick
    bx = by = bz = _NEVER  # the brick of the node before, most often this one's too
    newest = -1
    _mark_ends(bricks, solid)
    for node in range(out.shape[0]):
        x, y, z = int(seed[node, 0]), int(seed[node, 1]), int(seed[node, 2])
        cx, cy, cz = x // cell, y // cell, z // cell
        if cx >> 3 != bx or cy >> 3 != by or cz >> 3 != bz:
            bx, by, bz = cx >> 3, cy >> 3, cz >> 3
            b = find_brick(top, buckets, brick, bx, by, bz)
            newest = int(brick[b, FIRST]) if b >= 0 else -1
        at = (cy & 7) << 3 | (cx & 7)
        dx, dy, dz = x - int(origin[node, 0]), y - int(origin[node, 1]), z - int(origin[node, 2])
        length = ceil_sqrt(dx * dx + dy * dy + dz * dz)
        count = _read_cell(bricks, newest, cz & 7, at, part, touched)
        count = _read_ray(
            bricks, solid, cell, limit, origin, seed, node, length, part, touched, count
        )
        h = w = 0
        mine = int(first[node])
        while mine >= 0:
            author = int(entries[mine, 0])
            denied[mine] = author < part.shape[0] and (
                min(int(say[2]), int(part[author, PASSED]))
                > min(int(say[2]), int(part[author, ENDED]))
            )
            h += min(int(say[0]), int(entries[mine, 1]))
            w += 1
            mine = int(entries[mine, 3])
        against = passed = ended = hidden = 0
        for k in range(count):
            author = int(touched[k])
            before = int(part[author, BEFORE])
            free = max(0, int(part[author, PASSED]) - int(part[author, ENDED]))
            against += min(int(say[1]), free + before)
            passed += min(int(say[2]), int(part[author, PASSED]))
            ended += min(int(say[2]), int(part[author, ENDED]))
            hidden += min(int(say[3]), before)
            for column in range(4):
                part[author, column] = 0
        out[node, 0] = h
        out[node, 1] = w
        out[node, 2] = against
        out[node, 3] = length
        out[node, 4] = passed
        out[node, 5] = ended
        out[node, 6] = hidden
