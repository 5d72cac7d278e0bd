"""Sections 4.1 and 4.2: validity below a change (Eq. 1), and the ascendants that make a bundle.

The columns of `nodes` are described in `lattice`.
"""

from __future__ import annotations

from ..model import Int32s, Int64s, Uint8s
from .jit import inner, kernel, leaf
from .lattice import CHILD, FLAGS, ISSUED, MARKED, PARENTS, WITHDRAWN, wide

SATURATED = (1 << 63) - 1


@inner
def _push(heap: Int64s, size: int, name: int) -> None:
    """Add a number to a heap whose least is on top."""
    at = size
    while at > 0 and heap[(at - 1) >> 1] > name:
        heap[at] = heap[(at - 1) >> 1]
        at = (at - 1) >> 1
    heap[at] = name


@inner
def _pop(heap: Int64s, size: int) -> int:
    """Take the least number from the top of a heap of `size`."""
    least, name = heap[0], heap[size - 1]
    at, down = 0, 1
    while down < size - 1:
        if down + 1 < size - 1 and heap[down + 1] < heap[down]:
            down += 1
        if heap[down] >= name:
            break
        heap[at] = heap[down]
        at, down = down, 2 * down + 1
    heap[at] = name
    return int(least)


@inner
def valid(nodes: Int32s, validity: Int64s, n_p: int, node: int) -> int:
    """Eq. (1), saturating; a lattice node counts 1, a node without parents has 1."""
    total = 0
    for place in range(n_p):
        parent = nodes[node, PARENTS + place]
        if parent != -1:
            gain = 1 if parent < 0 else validity[parent]
            total = total + gain if total <= SATURATED - gain else SATURATED
    return total if total > 0 else 1


@kernel
def revalidate(
    nodes: Int32s, validity: Int64s, n_p: int, reset: bool, changed: Int64s, count: int,
    heap: Int64s,
) -> int:  # fmt: skip
    """Recompute the validity of the first `count` entries of `changed` and of all below, by id.

    The entries are marked nodes, in any order, each once. Overwrites `changed` with the ids whose
    validity has changed, ascending; returns their number. `heap` is scratch, one entry a node.
    Parents have lower ids than their children, so nobody is visited twice.
    """
    size = 0
    for i in range(count):
        _push(heap, size, changed[i])
        size += 1
    count = 0
    while size > 0:
        node = _pop(heap, size)
        size -= 1
        flags = nodes[node, FLAGS]
        nodes[node, FLAGS] = flags & ~MARKED
        if flags & (WITHDRAWN | ISSUED) == WITHDRAWN:  # has left after its parents changed
            continue
        value = 1 if reset and flags & ISSUED else valid(nodes, validity, n_p, node)
        if value == validity[node]:
            continue
        validity[node] = value
        changed[count] = node
        count += 1
        link = nodes[node, CHILD]
        while link >= 0:
            child = wide(link >> 3)
            if nodes[child, FLAGS] & MARKED == 0:
                nodes[child, FLAGS] |= MARKED
                _push(heap, size, child)
                size += 1
            link = nodes[child, PARENTS + n_p + (link & 7)]
    return count


@kernel
def gather(
    nodes: Int32s, n_p: int, cores: Int64s, start: int, most: int, room: int, out: Int64s
) -> tuple[int, int]:
    """Issue the bundles of cores from place `start` on, as long as they need not be cut.

    Fills `out` with them: each core that is not issued and its ascendants, issued ones not walked
    through. Stops before a bundle of more than `most` features, or more than `room` in all.
    Returns how far it came and the number of features.
    """
    count = 0
    for i in range(start, cores.shape[0]):
        limit = most if most < room - count else room - count
        if limit == 0:
            return i, count
        if nodes[cores[i], FLAGS] & ISSUED:
            continue
        out[count] = cores[i]
        nodes[cores[i], FLAGS] |= ISSUED
        at, end = count, count + 1
        while at < end <= count + limit:
            for place in range(n_p):
                parent = nodes[out[at], PARENTS + place]
                if parent >= 0 and nodes[parent, FLAGS] & ISSUED == 0:
                    nodes[parent, FLAGS] |= ISSUED
                    out[end] = parent
                    end += 1
            at += 1
        if end > count + limit:
            for j in range(count, end):
                nodes[out[j], FLAGS] &= ~ISSUED
            return i, count
        count = end
    return cores.shape[0], count


@leaf
def count_children(children: Uint8s, parents: Int64s, most: int) -> bool:
    """Count new children of features, unless one of these would have more than `most` then.

    children: (F,) of each feature. parents: (n, P) features below F, -1 none.
    """
    slots, left = parents.shape[1], parents.size
    done, room = 0, True
    while done < left and room:
        parent = int(parents[done // slots, done % slots])
        room = parent < 0 or children[parent] < most
        if room:
            if parent >= 0:
                children[parent] += 1
            done += 1
    if not room:
        while done > 0:
            done -= 1
            parent = int(parents[done // slots, done % slots])
            if parent >= 0:
                children[parent] -= 1
    return room
