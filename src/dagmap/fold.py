"""Section 4.3: one map out of the transactions of many, taken in order, undone in reverse.

`DefaultFold` is DAGmap's own consensus, `PaperFold` is Algorithm 2 as printed, for comparison. Both
hold plain columns and leave the work to kernels. Nothing that they answer depends on the salt
or on how the authors are numbered.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from . import weighing
from .config import FoldConfig
from .evidence import RayEvidence, hash_key, plain, with_room
from .kernels import algorithm2, matching
from .model import Bools, Int32s, Int64s, State, Uint8s

__all__ = [
    "Block",
    "DefaultFold",
    "Fold",
    "NodeColumns",
    "PaperFold",
    "RayEvidence",
    "Verdict",
    "make_fold",
]

D = TypeVar("D", bound=np.generic)
_SAY = (16, 32, 64)  # of one author: observations around, passes through, ends before a node


@dataclass(slots=True, eq=False)
class Block:
    """What one transaction contributes; positions are in the fleet frame already."""

    author: int  # local index: small, dense; no result depends on the numbering
    base: int  # feature i has the author's number base + i
    xyz: Int32s  # (n, 3) mm
    alive: Bools  # (n,) False: left out (withdrawn, unknown pose, out of range)
    cycle: Int32s  # (n,) the author's cycle that saw the feature, 0 and up
    color: Uint8s  # (n, 3)
    colored: Bools  # (n,)
    parents: Int64s | None  # (n, P) the author's numbers, -1 none; only Algorithm 2 needs them
    cores: Int64s  # (k,) indices of the bundles' cores, in order; only Algorithm 2 needs them
    sightings: Int64s  # (s,) the author's numbers of features seen again: evidence only
    sighting_cycle: Int32s  # (s,)
    origin: Int32s  # (n, 3) mm, where the sensor was that saw the feature


@dataclass(frozen=True, slots=True, eq=False)
class NodeColumns:
    """Read-only views of a fold's nodes, good until it next applies or undoes something."""

    seed: Int32s  # (N, 3) mm, the first observation
    offset: Int64s  # (N, 3) mm, sum of the observations' offsets from the seed
    count: Int32s  # (N,) observations, at least 1
    color: Int64s  # (N, 3) sum of the colours
    color_count: Int32s  # (N,) observations with a colour

    def columns(self) -> tuple[Int32s, Int64s, Int32s, Int64s, Int32s]:
        """All of them, in the order of the fields."""
        return self.seed, self.offset, self.count, self.color, self.color_count

    @staticmethod
    def empty() -> NodeColumns:
        """No nodes."""
        return DefaultFold(FoldConfig()).columns()


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """What the fleet thinks of the nodes."""

    hits: Int32s  # (N,)
    misses: Int32s  # (N,)
    witnesses: Int32s  # (N,) authors that saw the node
    states: Uint8s  # (N,) see `State`

    def columns(self) -> tuple[Int32s, Int32s, Int32s, Uint8s]:
        """All of them, in the order of the fields."""
        return self.hits, self.misses, self.witnesses, self.states

    @staticmethod
    def empty() -> Verdict:
        """No nodes."""
        none = np.zeros(0, np.int32)
        return _verdict(none, none, none, 1)


class Fold(Protocol):
    """The map as a function of the blocks applied and not undone. `len()`: its nodes."""

    def __len__(self) -> int: ...

    def apply(self, block: Block) -> None:
        """Fold a block in. An author's blocks come with rising numbers."""

    def undo(self, block: Block) -> None:
        """The exact inverse: `block` is the last one applied and not yet undone."""

    def feature_nodes(self, author: int) -> Int32s:
        """(F,) node of each feature number of an author, -1 where there is none; read-only."""

    def columns(self) -> NodeColumns:
        """The nodes, in the order in which they came into being."""

    def settled(self, author: int, xyz: Int32s, repeats: int) -> Bools:
        """(N,) places (N, 3) mm of which the author has said all that counts: it said so
        `repeats` times, or once where as many authors as confirm a node say the same."""

    def evaluate(self, rays: RayEvidence) -> Verdict:
        """Hits, misses, witnesses and states of all nodes."""

    @property
    def nbytes(self) -> int:
        """Memory held."""


def make_fold(config: FoldConfig, salt: int = 0) -> Fold:
    """The fold that the preset names."""
    return PaperFold(config, salt) if config.preset == "paper" else DefaultFold(config, salt)


class _Features:
    """The node of each feature number, per author, and the records for undoing."""

    def __init__(self) -> None:
        self._nodes: dict[int, Int32s] = {}
        self._lengths: dict[int, int] = {}
        self.undo = np.zeros(0, np.int32)
        self.top = 0

    def open(self, block: Block) -> tuple[int, Int32s, Int32s]:
        """Room for a block: where its rows begin, the author's rows, and its undo record."""
        n, before = len(block.xyz), self._lengths.get(block.author, 0)
        base = block.base if n else before
        if base < before:
            raise ValueError(f"feature {base} of author {block.author} was folded in before")
        nodes = with_room(self._nodes.get(block.author, np.zeros(0, np.int32)), base + n)
        nodes[before:base] = -1  # numbers between the blocks were left out
        self._nodes[block.author], self._lengths[block.author] = nodes, base + n
        size = n + len(block.sightings)
        self.undo = with_room(self.undo, self.top + size + 1)
        record = self.undo[self.top : self.top + size]
        self.undo[self.top + size] = before
        self.top += size + 1
        return base, nodes[: base + n], record

    def last(self, block: Block) -> tuple[int, Int32s, Int32s]:
        """The same as `open` gave for the last block, which `block` must be."""
        n, length = len(block.xyz), self._lengths.get(block.author, -1)
        top = self.top - n - len(block.sightings) - 1
        if top < 0 or (n and length != block.base + n):
            raise ValueError(f"not the last block applied: author {block.author}, {block.base}")
        nodes = self._nodes[block.author][:length]
        return length - n, nodes, self.undo[top : self.top - 1]

    def close(self, block: Block) -> None:
        """Forget the last block."""
        self._lengths[block.author] = int(self.undo[self.top - 1])
        self.top -= len(block.xyz) + len(block.sightings) + 1

    def of(self, author: int) -> Int32s:
        nodes = self._nodes.get(author, np.zeros(0, np.int32))
        return _view(nodes, self._lengths.get(author, 0))

    @property
    def nbytes(self) -> int:
        return self.undo.nbytes + sum(nodes.nbytes for nodes in self._nodes.values())


class DefaultFold:
    """Observations meet the nearest seed of the whole map within delta; see `kernels.matching`."""

    def __init__(self, config: FoldConfig, salt: int = 0) -> None:
        self._config, self._reach = config, config.delta_mm
        self._shift = max(1, (2 * self._reach - 1).bit_length())  # cells of at least 2 delta
        self._features = _Features()
        self._authors = 0
        self._nodes = matching.Nodes(
            sizes=np.zeros(2, np.int64),
            key=hash_key(salt),
            buckets=np.full(64, -1, np.int32),
            seed=np.zeros((0, 4), np.int32),
            offset=np.zeros((0, 3), np.int64),
            observed=np.zeros(0, np.int32),
            color=np.zeros((0, 3), np.int64),
            color_count=np.zeros(0, np.int32),
            first=np.zeros(0, np.int32),
            entries=np.zeros((0, 5), np.int32),
            origin=np.zeros((0, 3), np.int32),
        )

    def __len__(self) -> int:
        return int(self._nodes.sizes[matching.NODES])

    def apply(self, block: Block) -> None:
        self._make_room(len(block.xyz), len(block.sightings))
        self._authors = max(self._authors, block.author + 1)
        base, features, undo = self._features.open(block)
        matching.apply(
            self._nodes, self._shift, self._reach, block.author, _seen(block), base, features, undo
        )

    def undo(self, block: Block) -> None:
        base, features, undo = self._features.last(block)
        matching.revert(self._nodes, self._shift, block.author, _seen(block), base, features, undo)
        self._features.close(block)

    def feature_nodes(self, author: int) -> Int32s:
        return self._features.of(author)

    def columns(self) -> NodeColumns:
        return _columns(self._nodes, len(self))

    def settled(self, author: int, xyz: Int32s, repeats: int) -> Bools:
        out = np.zeros(len(xyz), np.bool_)
        witnesses = self._config.witnesses
        matching.settled(
            self._nodes, self._shift, self._reach, author, plain(xyz), repeats, witnesses, out
        )
        return out

    def evaluate(self, rays: RayEvidence) -> Verdict:
        config, n = self._config, len(self)
        found = self.weigh(rays)
        entries = self._nodes.entries[: int(self._nodes.sizes[matching.ENTRIES])]
        record = weighing.records(found, self._nodes.first[:n], entries, self._authors)
        place = weighing.blocks(self._nodes.seed[:n, :3], 2 * config.cell_mm)
        gone = weighing.gone(found, place, matching.MOMENTS if config.miss_say else 0)
        misses = weighing.misses(found, record, gone, config.delta_mm, config.doubt)
        return _verdict(found.hits, misses, found.witnesses, config.witnesses)

    def weigh(self, rays: RayEvidence) -> weighing.Evidence:
        """What is seen around every node, and what the rays say of it."""
        nodes, authors, n = self._nodes, self._authors, len(self)
        part, touched = np.zeros(authors, np.int32), np.zeros(authors, np.int32)
        around, reach = np.zeros((n, 2), np.int32), self._config.support_mm
        room = np.zeros((matching.MOMENTS + 1, 2), np.int32)
        matching.support(nodes, self._shift, reach, _SAY[0], part, touched, room, around)
        say = np.array([self._config.hit_say, self._config.miss_say, *_SAY[1:]], np.int64)
        said = rays.judge(say, nodes.seed[:n], nodes.origin, nodes.first, nodes.entries)
        return weighing.Evidence(*(plain(c) for c in said.T), *(plain(c) for c in around.T))

    @property
    def nbytes(self) -> int:
        return self._features.nbytes + sum(array.nbytes for array in self._nodes)

    def _make_room(self, n: int, s: int) -> None:
        held = self._nodes
        nodes, entries = int(held.sizes[0]) + n, int(held.sizes[1]) + n + s
        if nodes > len(held.seed) or entries > len(held.entries):
            held = held._replace(
                seed=with_room(held.seed, nodes),
                offset=with_room(held.offset, nodes),
                observed=with_room(held.observed, nodes),
                color=with_room(held.color, nodes),
                color_count=with_room(held.color_count, nodes),
                first=with_room(held.first, nodes),
                entries=with_room(held.entries, entries),
                origin=with_room(held.origin, nodes),
            )
        if nodes > len(held.buckets):
            held = held._replace(buckets=np.full(1 << nodes.bit_length(), -1, np.int32))
            matching.rebuild(held, self._shift)
        self._nodes = held


class PaperFold:
    """Algorithm 2 as printed; see `kernels.algorithm2`. O(N) a bundle.

    It knows neither rays nor sightings. Hits and misses start at 0, so a node is rejected until it
    was hit more often than missed.
    """

    def __init__(self, config: FoldConfig, salt: int = 0) -> None:
        self._config = config  # no hashing here: the salt changes nothing
        self._features = _Features()
        self._graph = algorithm2.Graph(
            sizes=np.zeros(3, np.int64),
            seed=np.zeros((0, 3), np.int32),
            offset=np.zeros((0, 3), np.int64),
            observed=np.zeros(0, np.int32),
            color=np.zeros((0, 3), np.int64),
            color_count=np.zeros(0, np.int32),
            hits=np.zeros(0, np.int32),
            misses=np.zeros(0, np.int32),
            witnesses=np.zeros(0, np.int32),
            first=np.zeros(0, np.int32),
            entries=np.zeros((0, 3), np.int32),
            parents=np.zeros((0, 1), np.int32),
            found=np.zeros(0, np.int32),
            visited=np.zeros(0, np.int64),
        )

    def __len__(self) -> int:
        return int(self._graph.sizes[algorithm2.NODES])

    def apply(self, block: Block) -> None:
        seen, (order, starts) = _graph_seen(block), _bundles(block)
        self._make_room(len(block.xyz), seen.parents.shape[1])
        base, features, losers = self._features.open(block)
        delta2 = self._config.delta_mm**2
        algorithm2.apply(
            self._graph, delta2, block.author, seen, base, order, starts, features, losers
        )

    def undo(self, block: Block) -> None:
        order, starts = _bundles(block)
        base, features, losers = self._features.last(block)
        algorithm2.revert(
            self._graph,
            block.author,
            _graph_seen(block),
            base,
            order,
            int(starts[-1]),
            features,
            losers,
        )
        self._features.close(block)

    def feature_nodes(self, author: int) -> Int32s:
        return self._features.of(author)

    def columns(self) -> NodeColumns:
        return _columns(self._graph, len(self))

    def parents(self) -> Int32s:
        """(N, P) nodes that each node refers to, -1 none; read-only."""
        return _view(self._graph.parents, len(self))

    def settled(self, author: int, xyz: Int32s, repeats: int) -> Bools:
        return np.zeros(len(xyz), np.bool_)  # in Algorithm 2 every observation counts

    def evaluate(self, rays: RayEvidence) -> Verdict:
        graph, n = self._graph, len(self)
        hits, misses, witnesses = graph.hits[:n], graph.misses[:n], graph.witnesses[:n]
        return _verdict(hits.copy(), misses.copy(), witnesses.copy(), self._config.witnesses)

    @property
    def nbytes(self) -> int:
        return self._features.nbytes + sum(array.nbytes for array in self._graph)

    def _make_room(self, n: int, width: int) -> None:
        graph = self._graph
        nodes, entries = int(graph.sizes[0]) + n, int(graph.sizes[1]) + n
        if width > graph.parents.shape[1]:
            wider = np.full((len(graph.parents), width), -1, np.int32)
            wider[:, : graph.parents.shape[1]] = graph.parents
            graph = graph._replace(parents=wider)
        rows = dict.fromkeys(graph._fields[1:], nodes) | {"entries": entries}
        self._graph = graph._replace(
            **{name: with_room(getattr(graph, name), size) for name, size in rows.items()}
        )


def _bundles(block: Block) -> tuple[Int64s, Int64s]:
    order = np.zeros(len(block.xyz), np.int64)
    starts = np.zeros(len(block.cores) + 1, np.int64)
    alive, cores = plain(block.alive), plain(block.cores)
    room = order.copy(), starts.copy()
    algorithm2.split(block.base, alive, _parents(block), cores, order, starts, *room)
    return order, starts


def _parents(block: Block) -> Int64s:
    none = np.full((len(block.xyz), 1), -1, np.int64)
    return none if block.parents is None else plain(block.parents)


def _graph_seen(block: Block) -> algorithm2.Seen:
    return algorithm2.Seen(
        plain(block.xyz), plain(block.color), plain(block.colored), _parents(block)
    )


def _seen(block: Block) -> matching.Seen:
    return matching.Seen(
        plain(block.xyz),
        plain(block.alive),
        plain(block.cycle),
        plain(block.color),
        plain(block.colored),
        plain(block.sightings),
        plain(block.sighting_cycle),
        plain(block.origin),
    )


def _columns(nodes: matching.Nodes | algorithm2.Graph, n: int) -> NodeColumns:
    return NodeColumns(
        _view(nodes.seed[:, :3], n),
        _view(nodes.offset, n),
        _view(nodes.observed, n),
        _view(nodes.color, n),
        _view(nodes.color_count, n),
    )


def _verdict(hits: Int32s, misses: Int32s, witnesses: Int32s, wanted: int) -> Verdict:
    states = np.where(witnesses >= wanted, State.CONFIRMED, State.TENTATIVE).astype(np.uint8)
    states[hits <= misses] = State.REJECTED  # 2h <= h + m
    return Verdict(hits, misses, witnesses, states)


def _view(column: npt.NDArray[D], rows: int) -> npt.NDArray[D]:
    view = column[:rows]
    view.flags.writeable = False
    return view
