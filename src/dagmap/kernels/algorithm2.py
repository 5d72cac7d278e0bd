"""Section 4.3, preset `paper`: Algorithm 2 as printed, with undo. O(N) a bundle, for comparison.

U is the set of nodes here. A feature that meets a node is no node of its own: its number leads to
that node. So ChangeParent(a_n, a'_n), "whatever refers to a_n refers to a'_n from now on", is the
entry in `features`, where references are looked up when the node that refers is added.

No ChangeParent can close a cycle in this form, so none has to be refused. Only added nodes have
references, and they get them once: a reference leads to a node of an earlier bundle or to one that
was added in the same bundle for a feature with a lower number (`_refer` drops any other). Ordered
by (bundle, number of the feature) every reference goes strictly down.
"""

from __future__ import annotations

from typing import NamedTuple

from ..model import Bools, Int32s, Int64s, Uint8s
from .jit import inner, leaf

NODES, ENTRIES, SERIAL = 0, 1, 2  # places in Graph.sizes
AUTHOR, SEEN, NEXT = 0, 1, 2  # columns of Graph.entries
_FAR = 1 << 62


class Graph(NamedTuple):
    """U, the nodes of one fold; rows beyond `sizes` are spare."""

    sizes: Int64s  # (3,) nodes and entries in use; a number that no search has used before
    seed: Int32s  # (N, 3) mm, the first observation: distances are to it
    offset: Int64s  # (N, 3) sum over the observations of their offsets from the seed, mm
    observed: Int32s  # (N,) observations
    color: Int64s  # (N, 3) sum of the colours
    color_count: Int32s  # (N,) observations with a colour
    hits: Int32s  # (N,) h
    misses: Int32s  # (N,) m
    witnesses: Int32s  # (N,) authors that observed the node
    first: Int32s  # (N,) newest entry of the node
    entries: Int32s  # (E, 3) author, observations of the author, next entry of the node or -1
    parents: Int32s  # (N, P) nodes that the node refers to, -1 none
    found: Int32s  # (N,) room for a search
    visited: Int64s  # (N,) number of the last search that came by


class Seen(NamedTuple):
    """The features of a transaction; see `fold.Block`."""

    xyz: Int32s
    color: Uint8s
    colored: Bools
    parents: Int64s


@leaf
def split(
    base: int,
    alive: Bools,
    parents: Int64s,
    cores: Int64s,
    order: Int64s,
    starts: Int64s,
    owner: Int64s,
    place: Int64s,
) -> None:
    """Cut a block into bundles: bundle j is order[starts[j]:starts[j + 1]], its core first.

    A bundle holds its core and those of the core's ascendants in the block that are in no earlier
    bundle. What is not alive is left out; where that is the core, the highest number left takes
    its place. After the core the numbers ascend. order (n,), starts (k + 1,) are written; owner
    (n,) and place (k + 1,) are room to work in.
    """
    n, k = alive.shape[0], cores.shape[0]
    for i in range(n):
        owner[i] = k  # of each feature: its bundle, k where it is in none
    for j in range(k):
        depth = 0
        if 0 <= cores[j] < n and owner[cores[j]] == k:
            owner[cores[j]] = j
            order[0] = cores[j]  # a stack, for now
            depth = 1
        while depth > 0:
            depth -= 1
            i = int(order[depth])
            for column in range(parents.shape[1]):
                parent = int(parents[i, column]) - base
                if 0 <= parent < i and owner[parent] == k:
                    owner[parent] = j
                    order[depth] = parent
                    depth += 1
    for j in range(k + 1):
        starts[j] = 0
    for i in range(n):
        if alive[i] and owner[i] < k:
            starts[owner[i] + 1] += 1
    for j in range(k):
        starts[j + 1] += starts[j]
        place[j] = starts[j]
    for i in range(n - 1, -1, -1):  # the highest number of a bundle, its core, comes first
        j = int(owner[i])
        if alive[i] and j < k:
            if place[j] == starts[j]:
                order[place[j]] = i
                place[j] = starts[j + 1]
            else:
                place[j] -= 1
                order[place[j]] = i


@inner
def _distance2(graph: Graph, node: int, xyz: Int32s, i: int) -> int:
    dx = int(graph.seed[node, 0]) - int(xyz[i, 0])
    dy = int(graph.seed[node, 1]) - int(xyz[i, 1])
    dz = int(graph.seed[node, 2]) - int(xyz[i, 2])
    return dx * dx + dy * dy + dz * dz


@inner
def _nearest(graph: Graph, xyz: Int32s, i: int, found: int) -> tuple[int, int]:
    """GetAdjacentNodes: nearest of the `found` nodes (of all where -1) and its squared distance.

    Ties go to the lower id.
    """
    best, at = _FAR, -1
    for k in range(found if found >= 0 else int(graph.sizes[NODES])):
        node = int(graph.found[k]) if found >= 0 else k
        d2 = _distance2(graph, node, xyz, i)
        if d2 < best or (d2 == best and node < at):
            best, at = d2, node
    return at, best


@inner
def _ascendants(graph: Graph, node: int) -> int:
    """GetAscendants: what a node refers to, directly or indirectly, into graph.found; how many."""
    serial = int(graph.sizes[SERIAL]) + 1
    graph.sizes[SERIAL] = serial
    graph.visited[node] = serial
    found, done = 0, -1
    while done < found:
        at = int(graph.found[done]) if done >= 0 else node
        for column in range(graph.parents.shape[1]):
            parent = int(graph.parents[at, column])
            if parent >= 0 and graph.visited[parent] != serial:
                graph.visited[parent] = serial
                graph.found[found] = parent
                found += 1
        done += 1
    return found


@inner
def _observe(graph: Graph, node: int, author: int, seen: Seen, i: int) -> None:
    for axis in range(3):
        graph.offset[node, axis] += int(seen.xyz[i, axis]) - int(graph.seed[node, axis])
        if seen.colored[i]:
            graph.color[node, axis] += int(seen.color[i, axis])
    graph.observed[node] += 1
    graph.color_count[node] += int(seen.colored[i])
    entry = int(graph.first[node])
    while entry >= 0:
        if graph.entries[entry, AUTHOR] == author:
            graph.entries[entry, SEEN] += 1
            return
        entry = int(graph.entries[entry, NEXT])
    entry = int(graph.sizes[ENTRIES])
    graph.sizes[ENTRIES] = entry + 1
    graph.entries[entry, AUTHOR] = author
    graph.entries[entry, SEEN] = 1
    graph.entries[entry, NEXT] = graph.first[node]
    graph.first[node] = entry
    graph.witnesses[node] += 1


@inner
def _add(graph: Graph, seen: Seen, i: int) -> int:
    """Add a feature to U."""
    node = int(graph.sizes[NODES])
    graph.sizes[NODES] = node + 1
    for axis in range(3):
        graph.seed[node, axis] = seen.xyz[i, axis]
        graph.offset[node, axis] = 0
        graph.color[node, axis] = 0
    graph.observed[node] = 0
    graph.color_count[node] = 0
    graph.hits[node] = 0
    graph.misses[node] = 0
    graph.witnesses[node] = 0
    graph.first[node] = -1
    graph.visited[node] = 0
    return node


@inner
def _refer(graph: Graph, node: int, seen: Seen, i: int, base: int, features: Int32s) -> None:
    """Let an added node refer to the nodes that its wire parents ended in."""
    for column in range(graph.parents.shape[1]):
        parent = int(seen.parents[i, column]) if column < seen.parents.shape[1] else -1
        known = 0 <= parent < base + i and features[parent] != node
        graph.parents[node, column] = features[parent] if known else -1


@inner
def _merge(
    graph: Graph,
    delta2: int,
    author: int,
    seen: Seen,
    base: int,
    order: Int64s,
    begin: int,
    end: int,
    features: Int32s,
    losers: Int32s,
) -> None:
    """Algorithm 2; line numbers count from below its Input."""
    before = int(graph.sizes[NODES])
    n = int(order[begin])  # Alg. 2, l. 1
    twin, d2 = _nearest(graph, seen.xyz, n, -1)  # l. 3
    found = _ascendants(graph, twin) if twin >= 0 else 0  # l. 4
    for k in range(begin, end):
        i = int(order[k])
        losers[i] = -1
        if k > begin and found > 0:
            twin, d2 = _nearest(graph, seen.xyz, i, found)  # l. 16
        if found > 0 and d2 < delta2:  # l. 8, l. 17
            graph.hits[twin] += 1  # l. 9, l. 18
            features[base + i] = twin  # l. 19, ChangeParent
        else:
            features[base + i] = _add(graph, seen, i)  # l. 6, l. 11, l. 21
            if found > 0:
                graph.misses[features[base + i]] += 1  # l. 12, l. 22
                graph.misses[twin] += 1  # l. 13, l. 23
                losers[i] = twin
        _observe(graph, int(features[base + i]), author, seen, i)
    for k in range(begin, end):
        i = int(order[k])
        if features[base + i] >= before:
            _refer(graph, int(features[base + i]), seen, i, base, features)


@leaf
def apply(
    graph: Graph,
    delta2: int,
    author: int,
    seen: Seen,
    base: int,
    order: Int64s,
    starts: Int64s,
    features: Int32s,
    losers: Int32s,
) -> None:
    """Fold one block in, bundle by bundle as `split` has cut it; within one the core goes first.

    Spare: a node and an entry for each feature. features: (F,) node of each feature number of the
    author, rows base.. are written. losers: (n,) is written: the node that took a miss, or -1.
    """
    for i in range(seen.xyz.shape[0]):
        features[base + i] = -1
        losers[i] = -1
    for j in range(starts.shape[0] - 1):
        if starts[j] < starts[j + 1]:
            begin, end = int(starts[j]), int(starts[j + 1])
            _merge(graph, delta2, author, seen, base, order, begin, end, features, losers)


@inner
def _unobserve(graph: Graph, node: int, author: int, seen: Seen, i: int) -> None:
    for axis in range(3):
        graph.offset[node, axis] -= int(seen.xyz[i, axis]) - int(graph.seed[node, axis])
        if seen.colored[i]:
            graph.color[node, axis] -= int(seen.color[i, axis])
    graph.observed[node] -= 1
    graph.color_count[node] -= int(seen.colored[i])
    entry = int(graph.first[node])
    while graph.entries[entry, AUTHOR] != author:
        entry = int(graph.entries[entry, NEXT])
    graph.entries[entry, SEEN] -= 1
    if graph.entries[entry, SEEN] == 0:  # it is the newest entry, and the node's newest
        graph.first[node] = graph.entries[entry, NEXT]
        graph.sizes[ENTRIES] = entry
        graph.witnesses[node] -= 1


@leaf
def revert(
    graph: Graph,
    author: int,
    seen: Seen,
    base: int,
    order: Int64s,
    count: int,
    features: Int32s,
    losers: Int32s,
) -> None:
    """The exact inverse of the last `apply` not reverted; count: features in bundles."""
    for k in range(count - 1, -1, -1):
        i = int(order[k])
        node = int(features[base + i])
        _unobserve(graph, node, author, seen, i)
        if graph.observed[node] > 0:
            graph.hits[node] -= 1
            continue
        graph.sizes[NODES] = node
        if losers[i] >= 0:
            graph.misses[losers[i]] -= 1
