"""Section 4.3: one map out of the transactions of many, taken in order, undone in reverse.

`DefaultFold` is DAGmap's own consensus, `PaperFold` is Algorithm 2 as printed, for comparison. Both
hold plain columns and leave the work to kernels. Nothing that they answer depends on the salt
or on how the authors are numbered.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
import numpy.typing as npt

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

    def evaluate(self, rays: RayEvidence) -> Verdict:
        """Hits, misses, witnesses and states of all nodes."""

    @property
    def nbytes(self) -> int:
        """Memory held."""


def make_fold(config: FoldConfig, salt: int = 0) -> Fold:
    """The fold that the preset names."""
    return PaperFold(config, salt) if config.preset == "paper" else DefaultFold(config, salt)


class _Features:
    """The node of each feature number, per author, and the undo records: both end where they end."""

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
        self._nodes = matching.Nodes(
            sizes=np.zeros(2, np.int64),
            key=hash_key(salt),
            buckets=np.full(64, -1, np.int32),
            seed=np.zeros((0, 4), np.int32),
            offset=np.zeros((0, 3), np.int64),
            count=np.zeros(0, np.int32),
            color=np.zeros((0, 3), np.int64),
            color_count=np.zeros(0, np.int32),
            first=np.zeros(0, np.int32),
            entries=np.zeros((0, 4), np.int32),
        )

    def __len__(self) -> int:
        return int(self._nodes.sizes[matching.NODES])

    def apply(self, block: Block) -> None:
        self._make_room(len(block.xyz), len(block.sightings))
        base, features, undo = self._features.open(block)
        matching.apply(
            self._nodes, self._shift, self._reach, block.author, _seen(block), base, features, undo
        )

    def undo(self, block: Block) -> None:
        base, features, undo = self._features.last(block)
        matching.revert(
            self._nodes, self._shift, block.author, _seen(block), base, features, undo
        )
        self._features.close(block)

    def feature_nodes(self, author: int) -> Int32s:
        return self._features.of(author)

    def columns(self) -> NodeColumns:
        return _columns(self._nodes, len(self))

    def evaluate(self, rays: RayEvidence) -> Verdict:
        say = (self._config.hit_say, self._config.miss_say)
        nodes, n = self._nodes, len(self)
        counted = rays.judge(say, nodes.seed[:n], nodes.first, nodes.entries)
        return _verdict(*counted, self._config.witnesses)

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
                count=with_room(held.count, nodes),
                color=with_room(held.color, nodes),
                color_count=with_room(held.color_count, nodes),
                first=with_room(held.first, nodes),
                entries=with_room(held.entries, entries),
            )
        if nodes > len(held.buckets):
            held = held._replace(buckets=np.full(1 << nodes.bit_length(), -1, np.int32))
            matching.rebuild(held, self._shift)
        self._nodes = held


class PaperFold:
    """Algorithm 2 as printed; see `kernels.algorithm2`. O(N) a bundle; knows no rays."""

    def __init__(self, config: FoldConfig, salt: int = 0) -> None:
        self._config, self._features = config, _Features()
        self._size = self._stamp = 0
        self._seed = np.zeros((0, 3), np.int32)
        self._offset = np.zeros((0, 3), np.int64)
        self._count = np.zeros(0, np.int32)
        self._color = np.zeros((0, 3), np.int64)
        self._color_count = np.zeros(0, np.int32)
        self._parents = np.zeros((0, 0), np.int32)
        self._votes = np.zeros((0, 2), np.int32)  # hits and misses, from 0
        self._witnesses = np.zeros(0, np.int32)
        self._mark = np.zeros(0, np.int32)
        self._seen_by: dict[tuple[int, int], int] = {}  # observations by (node, author)
        self._log: list[tuple[int, list[tuple[int, int, int]]]] = []  # size, (node, row, vote)

    def __len__(self) -> int:
        return self._size

    def apply(self, block: Block) -> None:
        n = len(block.xyz)
        parents = np.zeros((n, 0), np.int64) if block.parents is None else block.parents
        self._make_room(n, parents.shape[1])
        base, features, _ = self._features.open(block)
        features[base:] = -1
        log: list[tuple[int, int, int]] = []  # row -1: no observation; vote 0 hit, 1 miss, -1 none
        self._log.append((self._size, log))
        taken, out = np.zeros(n, np.bool_), np.empty(max(n, 1), np.int64)
        for core in block.cores.tolist():
            end = algorithm2.members(parents, base, core, taken, out)
            rows = np.concatenate([[core], np.sort(out[1:end])]).astype(np.int64)
            rows = rows[block.alive[rows]]  # a core that was left out hands on to the oldest
            if len(rows):
                self._merge(block, parents, features, base, rows, log)
        for number in block.sightings.tolist():
            node = int(features[number]) if number < len(features) else -1
            if node >= 0:
                log.append((node, -1, 0))
                self._votes[node, 0] += 1

    def undo(self, block: Block) -> None:
        size, log = self._log.pop()
        for node, row, vote in reversed(log):
            if vote >= 0:
                self._votes[node, vote] -= 1
            if row >= 0:
                self._observe(block, node, row, -1)
        self._size = size
        self._features.close(block)

    def feature_nodes(self, author: int) -> Int32s:
        return self._features.of(author)

    def columns(self) -> NodeColumns:
        n = self._size
        return NodeColumns(
            _view(self._seed, n),
            _view(self._offset, n),
            _view(self._count, n),
            _view(self._color, n),
            _view(self._color_count, n),
        )

    def evaluate(self, rays: RayEvidence) -> Verdict:
        votes, n = self._votes, self._size
        hits, misses = votes[:n, 0].copy(), votes[:n, 1].copy()
        return _verdict(hits, misses, self._witnesses[:n].copy(), self._config.witnesses)

    @property
    def nbytes(self) -> int:
        columns = (self._seed, self._offset, self._count, self._color, self._color_count)
        more = (self._parents, self._votes, self._witnesses, self._mark)
        return self._features.nbytes + sum(array.nbytes for array in (*columns, *more))

    def _merge(
        self,
        block: Block,
        parents: Int64s,
        features: Int32s,
        base: int,
        rows: Int64s,
        log: list[tuple[int, int, int]],
    ) -> None:
        """Alg. 2 for one bundle; nodes are added core first, then its ascendants by number."""
        self._stamp += 1
        hit, missed = np.empty(len(rows), np.int64), np.empty(len(rows), np.int64)
        size, everything = self._size, np.arange(self._size, dtype=np.int64)
        algorithm2.merge(
            self._seed,
            self._parents,
            everything,
            size,
            plain(block.xyz),
            rows,
            self._config.delta_mm,
            self._mark,
            self._stamp,
            np.empty(size, np.int64),
            hit,
            missed,
        )
        for row, twin, loser in zip(rows.tolist(), hit.tolist(), missed.tolist(), strict=True):
            node = twin if twin >= 0 else self._create(block.xyz[row])
            features[base + row] = node
            self._observe(block, node, row, +1)
            vote = 0 if twin >= 0 else 1 if loser >= 0 else -1
            log.append((node, row, vote))
            if loser >= 0:
                log.append((loser, -1, 1))
        for node, _, vote in log[len(log) - len(rows) - int((missed >= 0).sum()) :]:
            if vote >= 0:
                self._votes[node, vote] += 1
        added = rows[hit < 0]
        numbers = parents[added]
        ends = np.where(numbers >= 0, features[numbers], -1)  # ChangeParent: where each ended
        self._parents[features[base + added]] = ends

    def _create(self, place: Int32s) -> int:
        node, self._size = self._size, self._size + 1
        self._seed[node] = place
        for column in (self._offset, self._count, self._color, self._color_count, self._votes):
            column[node] = 0
        self._witnesses[node] = self._mark[node] = 0
        self._parents[node] = -1
        return node

    def _observe(self, block: Block, node: int, row: int, sign: int) -> None:
        self._offset[node] += sign * (block.xyz[row].astype(np.int64) - self._seed[node])
        self._count[node] += sign
        if block.colored[row]:
            self._color[node] += sign * block.color[row].astype(np.int64)
            self._color_count[node] += sign
        before = self._seen_by.get((node, block.author), 0)
        self._witnesses[node] += int(before == 0) if sign > 0 else -int(before == 1)
        if before + sign:
            self._seen_by[node, block.author] = before + sign
        else:
            del self._seen_by[node, block.author]

    def _make_room(self, n: int, n_p: int) -> None:
        rows = self._size + n
        if self._parents.shape[1] < n_p:
            self._parents = np.full((len(self._parents), n_p), -1, np.int32)
        for name in ("seed", "offset", "count", "color", "color_count", "parents", "votes"):
            setattr(self, f"_{name}", with_room(getattr(self, f"_{name}"), rows))
        self._witnesses = with_room(self._witnesses, rows)
        self._mark = with_room(self._mark, rows)


def _seen(block: Block) -> matching.Seen:
    return matching.Seen(
        plain(block.xyz),
        plain(block.alive),
        plain(block.cycle),
        plain(block.color),
        plain(block.colored),
        plain(block.sightings),
        plain(block.sighting_cycle),
    )


def _columns(nodes: matching.Nodes, n: int) -> NodeColumns:
    return NodeColumns(
        _view(nodes.seed[:, :3], n),
        _view(nodes.offset, n),
        _view(nodes.count, n),
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
