"""Algorithm 1 and its reverse: nodes enter the graph, leave it, and find new parents.

A kernel that might run out of rows in the pool stops and says how far it came; the caller grows
the pool and calls again. Rows of nodes must have been reserved before. The arrays are described
in `lattice`.
"""

from __future__ import annotations

from ..model import Int32s, Int64s
from .ascendants import valid
from .jit import inner, kernel
from .lattice import (
    CELL,
    CHILD,
    CHILDREN,
    CORNER,
    FLAGS,
    ISSUED,
    LATTICE,
    MARKED,
    N_C,
    NOBODY,
    NODES,
    PARENTS,
    POOLED,
    RANK,
    TAKEN,
    WITHDRAWN,
    add,
    cell,
    home,
    remove,
    search,
    wide,
)


@inner
def _attach(
    nodes: Int32s, pool: Int32s, table: Int32s, best: Int64s, numbers: Int64s,
    node: int, place: int, j: int,
) -> None:  # fmt: skip
    """Alg. 1, l. 2 to 8: the j-th of the last search becomes the parent of `node` at `place`."""
    row = best[j, CELL]
    if best[j, RANK] < LATTICE:
        parent = best[j, RANK]
        nodes[node, PARENTS + place] = parent
        nodes[node, PARENTS + best.shape[0] + place] = nodes[parent, CHILD]
        nodes[parent, CHILD] = 8 * node + place
        nodes[parent, CHILDREN] += 1
        if nodes[parent, CHILDREN] == numbers[N_C]:
            remove(nodes, pool, numbers, row, parent)
    else:
        if row < 0:
            x, y, z = best[j, CORNER], best[j, CORNER + 1], best[j, CORNER + 2]
            row = cell(pool, table, numbers, x, y, z)
        pool[row, TAKEN] += 1
        nodes[node, PARENTS + place] = -2 - row


@kernel
def insert(
    nodes: Int32s, validity: Int64s, pool: Int32s, table: Int32s, best: Int64s, numbers: Int64s,
    stop: int,
) -> int:  # fmt: skip
    """Insert the nodes up to `stop`, whose positions are entered and which have no relations yet.

    Returns how many nodes the graph then has.
    """
    n_p = best.shape[0]
    for node in range(numbers[NODES], stop):
        if numbers[POOLED] + n_p + 9 > pool.shape[0]:  # own cell, the parents' cells, a split
            break
        search(nodes, pool, table, best, numbers, node)  # Alg. 1, l. 1
        for j in range(n_p):
            if best[j, RANK] < NOBODY:
                _attach(nodes, pool, table, best, numbers, node, j, j)
        validity[node] = valid(nodes, validity, n_p, node)  # Alg. 1, l. 10
        add(nodes, pool, numbers, home(nodes, pool, table, numbers, node), node)  # the last line
        numbers[NODES] = node + 1
    return int(numbers[NODES])


@kernel
def reopen(
    nodes: Int32s, pool: Int32s, table: Int32s, numbers: Int64s, ids: Int64s, start: int
) -> int:
    """Enter ids from place `start` on in the terminals. Returns how far there was room."""
    for i in range(start, ids.shape[0]):
        if numbers[POOLED] + 9 > pool.shape[0]:
            return i
        add(nodes, pool, numbers, home(nodes, pool, table, numbers, ids[i]), ids[i])
    return int(ids.shape[0])


@inner
def _unlink(nodes: Int32s, n_p: int, parent: int, link: int) -> None:
    """Take a child out of its parent's list."""
    following = nodes[link >> 3, PARENTS + n_p + (link & 7)]
    at = nodes[parent, CHILD]
    if at == link:
        nodes[parent, CHILD] = following
    else:
        while nodes[at >> 3, PARENTS + n_p + (at & 7)] != link:
            at = nodes[at >> 3, PARENTS + n_p + (at & 7)]
        nodes[at >> 3, PARENTS + n_p + (at & 7)] = following
    nodes[parent, CHILDREN] -= 1


@inner
def _leave(
    nodes: Int32s, pool: Int32s, table: Int32s, numbers: Int64s, n_p: int, node: int
) -> None:
    """Take a node from its parents; those that are open again return to the terminals."""
    for place in range(n_p):
        parent = wide(nodes[node, PARENTS + place])
        nodes[node, PARENTS + place] = -1
        if parent >= 0:
            _unlink(nodes, n_p, parent, 8 * node + place)
            alive = nodes[parent, FLAGS] & WITHDRAWN == 0
            if alive and nodes[parent, CHILDREN] == numbers[N_C] - 1:
                add(nodes, pool, numbers, home(nodes, pool, table, numbers, parent), parent)
        elif parent < -1:
            pool[-2 - parent, TAKEN] -= 1


@inner
def _choose(
    nodes: Int32s, pool: Int32s, table: Int32s, best: Int64s, numbers: Int64s,
    node: int, place: int,
) -> None:  # fmt: skip
    """Fill an empty place among the parents of `node`: the nearest that is not its parent yet.

    The search is for N_p older ones, so no cycle can close; fewer than N_p are parents already.
    """
    search(nodes, pool, table, best, numbers, node)
    for j in range(best.shape[0]):
        name = best[j, RANK] if best[j, RANK] < LATTICE else -2 - best[j, CELL]
        known = False
        for i in range(best.shape[0]):
            known = known or (i != place and nodes[node, PARENTS + i] == name)
        if best[j, RANK] < NOBODY and not known:
            _attach(nodes, pool, table, best, numbers, node, place, j)
            break


@kernel
def withdraw(
    nodes: Int32s, validity: Int64s, pool: Int32s, table: Int32s, best: Int64s, numbers: Int64s,
    ids: Int64s, start: int, touched: Int64s, count: int,
) -> tuple[int, int]:  # fmt: skip
    """Withdraw ids (ascending, alive) from place `start` on.

    Appends to `touched` the nodes that have lost or changed parents, each once, and marks them.
    Returns how far it came and the number of entries in `touched`.
    """
    n_p = best.shape[0]
    for i in range(start, ids.shape[0]):
        node = ids[i]
        if numbers[POOLED] + nodes[node, CHILDREN] + 9 * n_p + 1 > pool.shape[0]:  # cells, splits
            return i, count
        if nodes[node, CHILDREN] < numbers[N_C]:
            remove(nodes, pool, numbers, home(nodes, pool, table, numbers, node), node)
        nodes[node, FLAGS] |= WITHDRAWN
        if nodes[node, FLAGS] & ISSUED:  # keeps its place, its parents and its children
            continue
        _leave(nodes, pool, table, numbers, n_p, node)
        validity[node] = 0
        while nodes[node, CHILD] >= 0:
            link = wide(nodes[node, CHILD])
            lowest = link
            while link >= 0:
                lowest = link if link < lowest else lowest
                link = wide(nodes[link >> 3, PARENTS + n_p + (link & 7)])
            _unlink(nodes, n_p, node, lowest)
            child = lowest >> 3
            nodes[child, PARENTS + (lowest & 7)] = -1
            _choose(nodes, pool, table, best, numbers, child, lowest & 7)
            if nodes[child, FLAGS] & MARKED == 0:
                nodes[child, FLAGS] |= MARKED
                touched[count] = child
                count += 1
    return ids.shape[0], count
