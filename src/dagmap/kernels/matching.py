"""Section 4.3, preset `default`: observations meet the nearest seed within delta, with undo.

Seeds (a node's first observation) never move and lie more than delta apart, so a grid cell holds a
bounded number of them against anybody, and hits never touch the grid. A bucket is a chain of
nodes, the newest first; nodes of other cells that share it are told apart by their distance alone.
Whatever is created last is the head of its chain, so undoing in reverse order only pops heads.
"""

from __future__ import annotations

from typing import NamedTuple

from ..model import Bools, Int32s, Int64s, Uint8s
from .jit import inner, leaf

# Hashes are a x + b y + c z + d modulo the prime p with secret a, b, c, d: whatever coordinates
# somebody chooses, two of them collide with probability 1/p (Carter and Wegman, 1979).
_P = (1 << 31) - 1
_LOW = 1 << 29  # makes coordinates positive; products stay below 2^62
X, Y, Z, OLDER = 0, 1, 2, 3  # columns of Nodes.seed; OLDER: next node of the same bucket
AUTHOR, HITS, CYCLE, NEXT, SEEN = 0, 1, 2, 3, 4  # columns of Nodes.entries
NODES, ENTRIES = 0, 1  # places in Nodes.sizes
FIRST_SEEN = -1  # undo: the observation made the author's entry at the node
MOMENTS = 6  # as many make a place lasting; more are not told apart
NOT_COUNTED = -2  # undo: no hit, the author's cycle had counted already


class Nodes(NamedTuple):
    """The map of one fold; rows beyond `sizes` are spare."""

    sizes: Int64s  # (2,) nodes and entries in use
    key: Int64s  # (4,) multipliers a, b, c and offset d of the hash, below p
    buckets: Int32s  # (B,) newest node of each bucket or -1; B a power of two, at least 8
    seed: Int32s  # (N, 4) x y z mm, and the next older node of the bucket
    offset: Int64s  # (N, 3) sum over the observations of their offsets from the seed, mm
    observed: Int32s  # (N,) observations
    color: Int64s  # (N, 3) sum of the colours
    color_count: Int32s  # (N,) observations with a colour
    first: Int32s  # (N,) newest entry of the node
    entries: Int32s  # (E, 5) author, hits, last counted cycle, next entry or -1, observations
    origin: Int32s  # (N, 3) mm, where the sensor of the first observation was


class Seen(NamedTuple):
    """What a transaction contributes; see `fold.Block`."""

    xyz: Int32s
    alive: Bools
    starts: Int64s
    cycle: Int32s
    color: Uint8s
    colored: Bools
    sightings: Int64s
    sighting_cycle: Int32s
    origin: Int32s


@inner
def _bucket(key: Int64s, mask: int, cx: int, cy: int, cz: int) -> int:
    """Bucket of a cell: a hash of its octet (2^3 cells), the cell in the octet in the low bits."""
    u = int(key[0]) * ((cx >> 1) + _LOW)
    v = int(key[1]) * ((cy >> 1) + _LOW)
    w = int(key[2]) * ((cz >> 1) + _LOW)
    h = int(key[3]) + (u & _P) + (u >> 31) + (v & _P) + (v >> 31) + (w & _P) + (w >> 31)
    h = (h & _P) + (h >> 31)
    if h >= _P:
        h -= _P
    return ((h << 3) | (cx & 1) | ((cy & 1) << 1) | ((cz & 1) << 2)) & mask


@inner
def find_twin(nodes: Nodes, shift: int, reach: int, x: int, y: int, z: int) -> int:
    """Node with the nearest seed within `reach` mm, ties to the lower id; -1 where there is none.

    2^shift mm is the cell edge, at least 2 * reach: so at most two cells an axis are touched.
    """
    buckets, seed, key = nodes.buckets, nodes.seed, nodes.key
    mask = buckets.shape[0] - 1
    twin = -1
    best = reach * reach
    for cz in range((z - reach) >> shift, ((z + reach) >> shift) + 1):
        for cy in range((y - reach) >> shift, ((y + reach) >> shift) + 1):
            for cx in range((x - reach) >> shift, ((x + reach) >> shift) + 1):
                node = int(buckets[_bucket(key, mask, cx, cy, cz)])
                while node >= 0:
                    dx = int(seed[node, X]) - x
                    dy = int(seed[node, Y]) - y
                    dz = int(seed[node, Z]) - z
                    d2 = dx * dx + dy * dy + dz * dz
                    if d2 < best or (d2 == best and (twin < 0 or node < twin)):
                        best = d2
                        twin = node
                    node = int(seed[node, OLDER])
    return twin


@inner
def _create(nodes: Nodes, shift: int, x: int, y: int, z: int) -> int:
    node = int(nodes.sizes[NODES])
    mask = nodes.buckets.shape[0] - 1
    bucket = _bucket(nodes.key, mask, x >> shift, y >> shift, z >> shift)
    nodes.seed[node, X] = x
    nodes.seed[node, Y] = y
    nodes.seed[node, Z] = z
    nodes.seed[node, OLDER] = nodes.buckets[bucket]
    nodes.buckets[bucket] = node
    nodes.offset[node, :] = 0
    nodes.observed[node] = 0
    nodes.color[node, :] = 0
    nodes.color_count[node] = 0
    nodes.first[node] = -1
    nodes.sizes[NODES] = node + 1
    return node


@inner
def _discard_newest(nodes: Nodes, shift: int) -> None:
    node = int(nodes.sizes[NODES]) - 1
    cx = int(nodes.seed[node, X]) >> shift
    cy = int(nodes.seed[node, Y]) >> shift
    cz = int(nodes.seed[node, Z]) >> shift
    bucket = _bucket(nodes.key, nodes.buckets.shape[0] - 1, cx, cy, cz)
    nodes.buckets[bucket] = nodes.seed[node, OLDER]
    nodes.sizes[NODES] = node


@inner
def _hit(nodes: Nodes, node: int, author: int, cycle: int) -> int:
    """Count a hit once per author and cycle. Returns what `_take_back` needs."""
    entry = int(nodes.first[node])
    while entry >= 0:
        if int(nodes.entries[entry, AUTHOR]) == author:
            last = int(nodes.entries[entry, CYCLE])
            if cycle <= last:
                return NOT_COUNTED
            nodes.entries[entry, HITS] += 1
            nodes.entries[entry, CYCLE] = cycle
            return last
        entry = int(nodes.entries[entry, NEXT])
    entry = int(nodes.sizes[ENTRIES])
    nodes.entries[entry, AUTHOR] = author
    nodes.entries[entry, HITS] = 1
    nodes.entries[entry, CYCLE] = cycle
    nodes.entries[entry, NEXT] = nodes.first[node]
    nodes.entries[entry, SEEN] = 0
    nodes.first[node] = entry
    nodes.sizes[ENTRIES] = entry + 1
    return FIRST_SEEN


@inner
def _take_back(nodes: Nodes, node: int, author: int, before: int) -> None:
    if before == NOT_COUNTED:
        return
    entry = int(nodes.first[node])
    if before == FIRST_SEEN:
        nodes.first[node] = nodes.entries[entry, NEXT]
        nodes.sizes[ENTRIES] = entry
        return
    while int(nodes.entries[entry, AUTHOR]) != author:
        entry = int(nodes.entries[entry, NEXT])
    nodes.entries[entry, HITS] -= 1
    nodes.entries[entry, CYCLE] = before


@inner
def _note(nodes: Nodes, node: int, author: int, sign: int) -> None:
    """Count an observation in the author's entry, which is there."""
    entry = int(nodes.first[node])
    while int(nodes.entries[entry, AUTHOR]) != author:
        entry = int(nodes.entries[entry, NEXT])
    nodes.entries[entry, SEEN] += sign


@inner
def _accumulate(nodes: Nodes, node: int, seen: Seen, i: int, segment: int, sign: int) -> None:
    nodes.observed[node] += sign
    for axis in range(3):
        nodes.offset[node, axis] += sign * (int(seen.xyz[i, axis]) - int(nodes.seed[node, axis]))
    if seen.colored[segment]:
        nodes.color_count[node] += sign
        for channel in range(3):
            nodes.color[node, channel] += sign * int(seen.color[i, channel])


@leaf
def apply(
    nodes: Nodes,
    shift: int,
    reach: int,
    author: int,
    seen: Seen,
    base: int,
    features: Int32s,
    undo: Int32s,
) -> None:
    """Fold one block in. Spare: a node and an entry for each feature, an entry a sighting.

    features: (F,) node of each feature number of the author; rows base.. are written.
    undo: (n + s,) is written: the last counted cycle before, FIRST_SEEN or NOT_COUNTED.
    """
    count = seen.xyz.shape[0]
    for k in range(seen.starts.shape[0] - 1):
        cycle = int(seen.cycle[k])
        for i in range(int(seen.starts[k]), int(seen.starts[k + 1])):
            if not seen.alive[i]:
                features[base + i] = -1
                undo[i] = NOT_COUNTED
                continue
            x, y, z = int(seen.xyz[i, 0]), int(seen.xyz[i, 1]), int(seen.xyz[i, 2])
            node = find_twin(nodes, shift, reach, x, y, z)
            if node < 0:
                node = _create(nodes, shift, x, y, z)
                for axis in range(3):
                    nodes.origin[node, axis] = seen.origin[k, axis]
            _accumulate(nodes, node, seen, i, k, 1)
            features[base + i] = node
            undo[i] = _hit(nodes, node, author, cycle)
            _note(nodes, node, author, 1)
    for j in range(seen.sightings.shape[0]):
        number = int(seen.sightings[j])
        undo[count + j] = NOT_COUNTED
        if 0 <= number < features.shape[0] and features[number] >= 0:
            cycle = int(seen.sighting_cycle[j])
            undo[count + j] = _hit(nodes, int(features[number]), author, cycle)


@leaf
def revert(
    nodes: Nodes,
    shift: int,
    author: int,
    seen: Seen,
    base: int,
    features: Int32s,
    undo: Int32s,
) -> None:
    """The exact inverse of the last `apply` that was not reverted, with the same block."""
    count = seen.xyz.shape[0]
    for j in range(seen.sightings.shape[0] - 1, -1, -1):
        number = int(seen.sightings[j])
        if 0 <= number < features.shape[0] and features[number] >= 0:
            _take_back(nodes, int(features[number]), author, int(undo[count + j]))
    for k in range(seen.starts.shape[0] - 2, -1, -1):
        for i in range(int(seen.starts[k + 1]) - 1, int(seen.starts[k]) - 1, -1):
            node = int(features[base + i])
            if node < 0:
                continue
            _note(nodes, node, author, -1)
            _take_back(nodes, node, author, int(undo[i]))
            _accumulate(nodes, node, seen, i, k, -1)
            if nodes.observed[node] == 0:
                _discard_newest(nodes, shift)


@inner
def _meet(moments: Int32s, author: int, cycle: int, hits: int) -> None:
    """Note a moment, (author, cycle), of which MOMENTS are told apart; row 0 counts them."""
    known = int(moments[0, 0])
    new = known < MOMENTS
    for k in range(1, known + 1):
        new = new and not (moments[k, 0] == author and moments[k, 1] == cycle)
    if new:
        moments[known + 1, 0] = author
        moments[known + 1, 1] = cycle
        moments[0, 0] = known + 1
    moments[0, 1] = max(int(moments[0, 1]), min(hits, MOMENTS))


@inner
def _gather(
    nodes: Nodes, node: int, part: Int32s, touched: Int32s, moments: Int32s, count: int
) -> int:
    """Add a node's observations to the parts of their authors; how many are touched now."""
    entry = int(nodes.first[node])
    while entry >= 0:
        author = int(nodes.entries[entry, AUTHOR])
        seen = int(nodes.entries[entry, SEEN])
        if part[author] == 0 and seen > 0:
            touched[count] = author
            count += 1
        part[author] += seen
        hits = int(nodes.entries[entry, HITS])
        _meet(moments, author, int(nodes.entries[entry, CYCLE]), hits)
        entry = int(nodes.entries[entry, NEXT])
    return count


@leaf
def support(
    nodes: Nodes,
    shift: int,
    reach: int,
    say: int,
    part: Int32s,
    touched: Int32s,
    moments: Int32s,
    out: Int32s,
) -> None:
    """Observations in the nodes whose seeds lie within `reach` mm of each node's, at most `say`
    of an author; the node's own among them.

    part: (A,) zeros, and zeros again afterwards; touched: (A,); moments: (MOMENTS + 1, 2).
    out: (N, 2) is written: the observations, and in how many moments they were made at least:
    distinct last cycles of the entries or hits of one entry, MOMENTS at most.
    """
    buckets, seed, key = nodes.buckets, nodes.seed, nodes.key
    mask = buckets.shape[0] - 1
    for node in range(out.shape[0]):
        x, y, z = int(seed[node, X]), int(seed[node, Y]), int(seed[node, Z])
        count = 0
        moments[0, 0] = moments[0, 1] = 0
        for cz in range((z - reach) >> shift, ((z + reach) >> shift) + 1):
            for cy in range((y - reach) >> shift, ((y + reach) >> shift) + 1):
                for cx in range((x - reach) >> shift, ((x + reach) >> shift) + 1):
                    near = int(buckets[_bucket(key, mask, cx, cy, cz)])
                    while near >= 0:
                        u, v, w = int(seed[near, X]), int(seed[near, Y]), int(seed[near, Z])
                        d2 = (u - x) * (u - x) + (v - y) * (v - y) + (w - z) * (w - z)
                        if d2 <= reach * reach and (
                            u >> shift == cx and v >> shift == cy and w >> shift == cz
                        ):  # a bucket may serve two of these cells
                            count = _gather(nodes, near, part, touched, moments, count)
                        near = int(seed[near, OLDER])
        total = 0
        for k in range(count):
            author = int(touched[k])
            total += min(say, int(part[author]))
            part[author] = 0
        out[node, 0] = total
        out[node, 1] = max(int(moments[0, 0]), int(moments[0, 1]))


@leaf
def settled(
    nodes: Nodes,
    shift: int,
    reach: int,
    author: int,
    xyz: Int32s,
    repeats: int,
    witnesses: int,
    out: Bools,
) -> None:
    """Whether what an author would say of each place adds nothing that counts.

    It has said it `repeats` times, or once where as many authors as are wanted say it. With 0
    repeats: whether there is a node.
    """
    for i in range(xyz.shape[0]):
        x, y, z = int(xyz[i, 0]), int(xyz[i, 1]), int(xyz[i, 2])
        node = find_twin(nodes, shift, reach, x, y, z)
        own = 0
        authors = 0
        entry = int(nodes.first[node]) if node >= 0 else -1
        while entry >= 0:
            authors += 1
            if int(nodes.entries[entry, AUTHOR]) == author:
                own = int(nodes.entries[entry, SEEN])
            entry = int(nodes.entries[entry, NEXT])
        out[i] = node >= 0 and (own >= repeats or (own > 0 and authors >= witnesses))


@leaf
def rebuild(nodes: Nodes, shift: int) -> None:
    """Fill a new, empty array of buckets (all -1); chains come out the newest first again."""
    mask = nodes.buckets.shape[0] - 1
    for node in range(int(nodes.sizes[NODES])):
        cx = int(nodes.seed[node, X]) >> shift
        cy = int(nodes.seed[node, Y]) >> shift
        cz = int(nodes.seed[node, Z]) >> shift
        bucket = _bucket(nodes.key, mask, cx, cy, cz)
        nodes.seed[node, OLDER] = nodes.buckets[bucket]
        nodes.buckets[bucket] = node
