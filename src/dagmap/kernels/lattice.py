"""Section 4.1: the reference lattice, the terminals E, and the search for the nearest of both.

Space is cut into cells of one pitch, each centred on its lattice node. A hash table finds a cell;
a cell that nobody has touched is not stored and still offers its own free lattice node, so the
search through shells of cells ends quickly in empty space. A cell keeps its terminals in a list
that runs through the nodes; more than LEAF of them become an octree of integer boxes down to 1 mm,
and below that (equal points) a tree over the digits of the id. Cells and tree records are rows of
one pool and never move, so a parent that is a lattice node is named by the row of its cell.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np

from ..model import Int32s, Int64s
from .jit import inner, kernel

LEAF = 6  # a list of terminals longer than this is split in eight
LAST_LEVEL = -11  # level L > 0: a box of 2^L mm; 0 to -11: one point, ever finer ranges of ids
ID_SHIFT = 30  # of the coarsest digit (3 bits) of an id
SCRATCH = 1024  # four numbers for each record that waits in a tree search: 7 a level, 31 levels

# Columns of `nodes`, one row a feature. From PARENTS on: the parents in order of choice (feature
# id, -1 none, -2 - i the lattice node of pool row i), then for each the next child of that parent.
# A child is named by 8 * id + the place that the parent has with it; -1 ends the list.
X, Y, Z, NEXT, CHILD, CHILDREN, FLAGS, PARENTS = 0, 1, 2, 3, 4, 5, 6, 7
ISSUED, WITHDRAWN, MARKED = 1, 2, 4  # bits of FLAGS
# Columns of `pool`, one row a cell or a record of a tree: the lowest corner of its box; the first
# terminal of its list, or -1, or -2 - i: eight records from row i on; the terminals below it;
# in a cell the children of the lattice node, in a record -1 - i: no terminal below is older than i.
LINK, COUNT, TAKEN, LEAST = 3, 4, 5, 5
POOL_COLUMNS = 6
# Columns of `best`, one row a candidate: squared distance; what decides between equal ones, which
# is the feature's id, or from LATTICE on the place of the lattice node; row and corner of the cell.
DISTANCE, RANK, CELL, CORNER = 0, 1, 2, 3
BEST_COLUMNS = 6
LATTICE = 1 << 60
NOBODY = 1 << 61
_HERE = 3 << 59  # rank of the lattice node of the home cell; the others are counted from it,
_AXIS = 20  # with so many bits an axis
# Entries of `numbers`; then the stack of a tree search.
NODES, POOLED, FREE, PITCH, REACH2, N_C, TOP, SALT = 0, 1, 2, 3, 4, 5, 6, 7
NUMBERS = 8

_MASK = (1 << 31) - 1
_K1, _K2, _K3 = 0x5BD1E995, 0x6C8E9CF5, 0x7FEB352D

# int() leaves an int32 of an array an int32 for the compiler, which then makes another variant of
# whatever is called with it.
wide = cast(Callable[[Any], int], np.int64)


@inner
def _find(pool: Int32s, table: Int32s, salt: int, x: int, y: int, z: int) -> int:
    """Row of the cell with lowest corner x, y, z; -1 - slot where it is not stored.

    The hash multiplies and folds one coordinate after the other, within 62 bits.
    """
    h = ((x ^ salt) & _MASK) * _K1
    h = ((y ^ salt >> 31 ^ h >> 31 ^ h) & _MASK) * _K2
    h = ((z ^ h >> 31 ^ h) & _MASK) * _K3
    mask = table.shape[0] - 1
    slot = (h >> 31 ^ h) & mask
    row = wide(table[slot])
    while row >= 0 and (pool[row, X] != x or pool[row, Y] != y or pool[row, Z] != z):
        slot = (slot + 1) & mask
        row = wide(table[slot])
    return row if row >= 0 else -1 - slot


@inner
def cell(pool: Int32s, table: Int32s, numbers: Int64s, x: int, y: int, z: int) -> int:
    """Row of the cell with lowest corner x, y, z; made where it is missing."""
    row = _find(pool, table, numbers[SALT], x, y, z)
    if row < 0:
        table[-1 - row] = numbers[POOLED]
        row = numbers[POOLED]
        numbers[POOLED] = row + 1
        pool[row, X] = x
        pool[row, Y] = y
        pool[row, Z] = z
    return row


@inner
def home(nodes: Int32s, pool: Int32s, table: Int32s, numbers: Int64s, node: int) -> int:
    """Row of the cell that a node lies in; made where it is missing."""
    pitch = numbers[PITCH]
    half = pitch // 2
    x, y, z = wide(nodes[node, X]), wide(nodes[node, Y]), wide(nodes[node, Z])
    x, y, z = x - (x + half) % pitch, y - (y + half) % pitch, z - (z + half) % pitch
    return cell(pool, table, numbers, x, y, z)


@kernel
def rehash(pool: Int32s, table: Int32s, numbers: Int64s) -> None:
    """Enter every cell of the pool in the (emptied) table."""
    for row in range(numbers[POOLED]):
        if pool[row, TAKEN] >= 0:
            x, y, z = wide(pool[row, X]), wide(pool[row, Y]), wide(pool[row, Z])
            table[-1 - _find(pool, table, numbers[SALT], x, y, z)] = row


@inner
def _part(nodes: Int32s, pool: Int32s, row: int, level: int, node: int) -> int:
    """Which of the eight parts of a record a terminal belongs to."""
    if level <= 0:
        return (node >> (ID_SHIFT + 3 * level)) & 7
    half = 1 << (level - 1)
    part = 0
    for axis in range(3):
        if nodes[node, axis] - wide(pool[row, axis]) >= half:
            part += 1 << axis
    return part


@inner
def _push(nodes: Int32s, pool: Int32s, row: int, node: int) -> None:
    """Put a terminal on the list of a cell or record."""
    nodes[node, NEXT] = pool[row, LINK]
    pool[row, LINK] = node
    pool[row, COUNT] += 1


@inner
def add(nodes: Int32s, pool: Int32s, numbers: Int64s, row: int, node: int) -> None:
    """Enter a terminal below the cell in `row`."""
    level = numbers[TOP]
    while pool[row, LINK] < -1:
        pool[row, COUNT] += 1
        row = -2 - pool[row, LINK] + _part(nodes, pool, row, level, node)
        level -= 1
        if pool[row, COUNT] == 0 or node < -1 - pool[row, LEAST]:
            pool[row, LEAST] = -1 - node
    _push(nodes, pool, row, node)
    if pool[row, COUNT] > LEAF and level > LAST_LEVEL:
        _split(nodes, pool, numbers, row, level)


@inner
def _split(nodes: Int32s, pool: Int32s, numbers: Int64s, row: int, level: int) -> None:
    """Turn the list of a cell or record into eight."""
    base = numbers[FREE]
    if base >= 0:
        numbers[FREE] = pool[base, X]
    else:
        base = numbers[POOLED]
        numbers[POOLED] = base + 8
    half = 1 << (level - 1) if level > 0 else 0
    for i in range(8):
        pool[base + i, X] = pool[row, X] + (i & 1) * half
        pool[base + i, Y] = pool[row, Y] + (i >> 1 & 1) * half
        pool[base + i, Z] = pool[row, Z] + (i >> 2) * half
        pool[base + i, LEAST] = -1
    node = wide(pool[row, LINK])
    pool[row, LINK] = -2 - base
    while node >= 0:
        following = wide(nodes[node, NEXT])
        part = base + _part(nodes, pool, row, level, node)
        if pool[part, COUNT] == 0 or node < -1 - pool[part, LEAST]:
            pool[part, LEAST] = -1 - node
        _push(nodes, pool, part, node)
        node = following


@inner
def remove(nodes: Int32s, pool: Int32s, numbers: Int64s, row: int, node: int) -> None:
    """Take a terminal out from below the cell in `row`."""
    level = numbers[TOP]
    pool[row, COUNT] -= 1
    while pool[row, LINK] < -1:
        row = -2 - pool[row, LINK] + _part(nodes, pool, row, level, node)
        pool[row, COUNT] -= 1
        level -= 1
    at = pool[row, LINK]
    if at == node:
        pool[row, LINK] = nodes[node, NEXT]
    else:
        while nodes[at, NEXT] != node:
            at = nodes[at, NEXT]
        nodes[at, NEXT] = nodes[node, NEXT]


@inner
def _offer(best: Int64s, d: int, rank: int, row: int, x: int, y: int, z: int) -> None:
    """Keep a candidate if it is among the best."""
    j = best.shape[0] - 1
    if d < best[j, DISTANCE] or (d == best[j, DISTANCE] and rank < best[j, RANK]):
        while j > 0 and (
            d < best[j - 1, DISTANCE] or (d == best[j - 1, DISTANCE] and rank < best[j - 1, RANK])
        ):
            for column in range(BEST_COLUMNS):
                best[j, column] = best[j - 1, column]
            j -= 1
        best[j, DISTANCE] = d
        best[j, RANK] = rank
        best[j, CELL] = row
        best[j, CORNER] = x
        best[j, CORNER + 1] = y
        best[j, CORNER + 2] = z


@inner
def _gap(low: int, size: int) -> int:
    """Squared distance along one axis from 0 to the box of points low to low + size - 1."""
    gap = low if low > 0 else 1 - size - low
    return gap * gap if gap > 0 else 0


@inner
def _offer_cell(
    nodes: Int32s, pool: Int32s, best: Int64s, numbers: Int64s, cell: int, node: int
) -> None:
    """Offer the terminals of a cell that are older than `node`, near parts of a tree first."""
    x, y, z = wide(nodes[node, X]), wide(nodes[node, Y]), wide(nodes[node, Z])
    last = best.shape[0] - 1
    top = NUMBERS + 4
    numbers[NUMBERS] = cell
    numbers[NUMBERS + 1] = numbers[TOP]
    numbers[NUMBERS + 2] = 0
    numbers[NUMBERS + 3] = 0
    while top > NUMBERS:
        top -= 4
        row, level, d, least = numbers[top], numbers[top + 1], numbers[top + 2], numbers[top + 3]
        worst = best[last, DISTANCE]
        if d > worst or (d == worst and least > best[last, RANK]):
            continue
        link = wide(pool[row, LINK])
        while link >= 0:
            dx, dy, dz = nodes[link, X] - x, nodes[link, Y] - y, nodes[link, Z] - z
            d = dx * dx + dy * dy + dz * dz
            if d <= best[last, DISTANCE] and link < node:
                _offer(best, d, link, cell, x, y, z)
            link = wide(nodes[link, NEXT])
        if link < -1:
            size = 1 << (level - 1) if level > 0 else 1
            nearest = _part(nodes, pool, row, level, node) if level > 0 else 0
            for i in range(7, -1, -1):
                row = -2 - link + (i ^ nearest)
                if pool[row, COUNT] > 0 and -1 - pool[row, LEAST] < node:
                    d = _gap(pool[row, X] - x, size) + _gap(pool[row, Y] - y, size)
                    numbers[top] = row
                    numbers[top + 1] = level - 1
                    numbers[top + 2] = d + _gap(pool[row, Z] - z, size)
                    numbers[top + 3] = -1 - pool[row, LEAST]
                    top += 4


@inner
def _step(t: int, offset: int, pitch: int) -> int:
    """The t-th cell along an axis, nearest first; `offset`: where the point is in cell 0."""
    upwards = pitch - offset <= offset + 1
    return (t + 1) >> 1 if upwards == (t & 1 == 1) else -((t + 1) >> 1)


@inner
def search(
    nodes: Int32s, pool: Int32s, table: Int32s, best: Int64s, numbers: Int64s, node: int
) -> None:
    """GetAdjacentNodes(E, N_p) of Alg. 1: fill `best`, nearest first, with lower ids than `node`.

    Walks shells of cells around the home cell, and each only as far as something may be found.
    """
    pitch, n_c, salt = numbers[PITCH], numbers[N_C], numbers[SALT]
    last = best.shape[0] - 1
    for j in range(last + 1):
        best[j, DISTANCE] = numbers[REACH2]
        best[j, RANK] = NOBODY
    half = pitch // 2
    x, y, z = wide(nodes[node, X]), wide(nodes[node, Y]), wide(nodes[node, Z])
    ox, oy, oz = (x + half) % pitch, (y + half) % pitch, (z + half) % pitch
    edge = min(ox + 1, oy + 1, oz + 1, pitch - ox, pitch - oy, pitch - oz)
    r = 0
    while r == 0 or (edge + (r - 1) * pitch) * (edge + (r - 1) * pitch) <= best[last, DISTANCE]:
        for tx in range(2 * r + 1):
            sx = _step(tx, ox, pitch)
            u = sx * pitch - ox
            du = _gap(u, pitch)
            if du > best[last, DISTANCE]:
                break
            for ty in range(2 * r + 1):
                sy = _step(ty, oy, pitch)
                v = sy * pitch - oy
                dv = du + _gap(v, pitch)
                if dv > best[last, DISTANCE]:
                    break
                inside = tx < 2 * r - 1 and ty < 2 * r - 1
                for tz in range(2 * r - 1 if inside else 0, 2 * r + 1):
                    sz = _step(tz, oz, pitch)
                    w = sz * pitch - oz
                    if dv + _gap(w, pitch) > best[last, DISTANCE]:
                        break
                    row = _find(pool, table, salt, x + u, y + v, z + w)
                    if row < 0 or pool[row, TAKEN] < n_c:
                        a, b, c = u + half, v + half, w + half
                        d = a * a + b * b + c * c
                        if d <= best[last, DISTANCE]:
                            rank = _HERE + (((sx << _AXIS) + sy) << _AXIS) + sz
                            _offer(best, d, rank, row, x + u, y + v, z + w)
                    if row >= 0 and pool[row, COUNT] > 0:
                        _offer_cell(nodes, pool, best, numbers, row, node)
        r += 1
