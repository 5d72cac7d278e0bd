"""Section 4.3, preset `paper`: Algorithm 2 as printed, for comparison. O(N) a bundle.

Where pseudo code and prose differ the pseudo code holds. No ChangeParent can close a cycle here:
it redirects edges of nodes that are just being added, and nodes of U never gain parents later.
"""

from __future__ import annotations

from ..model import Bools, Int32s, Int64s
from .jit import kernel

_FAR = (1 << 63) - 1


@kernel
def members(parents: Int64s, base: int, core: int, taken: Bools, out: Int64s) -> int:
    """A core and those of its ascendants in the block that no bundle took yet; marks them taken."""
    out[0] = core
    taken[core] = True
    at, end = 0, 1
    while at < end:
        row = int(out[at])
        at += 1
        for slot in range(parents.shape[1]):
            parent = int(parents[row, slot]) - base
            if parent >= 0 and not taken[parent]:
                taken[parent] = True
                out[end] = parent
                end += 1
    return end


@kernel
def ascendants(parents: Int32s, node: int, mark: Int32s, stamp: int, out: Int64s) -> int:
    """GetAscendants: all nodes that `node` refers to, directly or indirectly."""
    at, end = -1, 0
    while at < end:
        row = node if at < 0 else int(out[at])
        at += 1
        for slot in range(parents.shape[1]):
            parent = int(parents[row, slot])
            if parent >= 0 and int(mark[parent]) != stamp:
                mark[parent] = stamp
                out[end] = parent
                end += 1
        if at == end:
            break
    return end


@kernel
def nearest(seed: Int32s, among: Int64s, count: int, x: int, y: int, z: int) -> tuple[int, int]:
    """GetAdjacentNodes(among, 1): the nearest of the first `count`, ties to the lower node; -1 for
    none. Returns it and its squared distance."""
    best, least = -1, _FAR
    for i in range(count):
        node = int(among[i])
        dx, dy, dz = int(seed[node, 0]) - x, int(seed[node, 1]) - y, int(seed[node, 2]) - z
        d2 = dx * dx + dy * dy + dz * dz
        if d2 < least or (d2 == least and node < best):
            best, least = node, d2
    return best, least


@kernel
def merge(
    seed: Int32s, parents: Int32s, everything: Int64s, size: int, xyz: Int32s, rows: Int64s,
    delta: int, mark: Int32s, stamp: int, scratch: Int64s, hit: Int64s, missed: Int64s,
) -> None:  # fmt: skip
    """One bundle against U: rows[0] is the core n, the others are A_n.

    hit[i]: node of U that row i hits, or -1 where it is to be added; missed[i]: node of U that
    takes a miss with it, or -1.
    """
    hit[:] = -1
    missed[:] = -1
    core = int(rows[0])
    x, y, z = int(xyz[core, 0]), int(xyz[core, 1]), int(xyz[core, 2])
    twin, d2 = nearest(seed, everything, size, x, y, z)  # Alg. 2, l. 3
    if twin < 0:
        return
    count = ascendants(parents, twin, mark, stamp, scratch)  # l. 4
    if count == 0:  # l. 5: add n and A_n
        return
    for i in range(rows.shape[0]):
        if i > 0:
            row = int(rows[i])
            x, y, z = int(xyz[row, 0]), int(xyz[row, 1]), int(xyz[row, 2])
            twin, d2 = nearest(seed, scratch, count, x, y, z)  # l. 16
        if d2 < delta * delta:
            hit[i] = twin  # l. 9, l. 18
        else:
            missed[i] = twin  # l. 11 to 13, l. 21 to 23
