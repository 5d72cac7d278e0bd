"""What a fold takes and gives: blocks of features in, nodes and verdicts out (section 4.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from .evidence import RayEvidence, with_room
from .kernels import algorithm2, matching
from .model import Bools, Int32s, Int64s, State, Uint8s

D = TypeVar("D", bound=np.generic)


@dataclass(slots=True, eq=False)
class Block:
    """What one transaction contributes; positions are in the fleet frame already.

    Features come in segments, each seen in one cycle: starts[k] to starts[k + 1] is the k-th.
    """

    author: int  # local index: small, dense; no result depends on the numbering
    base: int  # feature i has the author's number base + i
    xyz: Int32s  # (n, 3) mm
    alive: Bools  # (n,) False: left out (withdrawn, unknown pose, out of range)
    starts: Int64s  # (k + 1,)
    cycle: Int32s  # (k,) the author's cycle that saw the features, 0 and up
    color: Uint8s  # (n, 3)
    colored: Bools  # (k,)
    parents: Int64s | None  # (n, P) the author's numbers, -1 none; only Algorithm 2 needs them
    cores: Int64s  # indices of the bundles' cores, in order; only Algorithm 2 needs them
    sightings: Int64s  # (s,) the author's numbers of features seen again: evidence only
    sighting_cycle: Int32s  # (s,)
    origin: Int32s  # (k, 3) mm, where the sensor was that saw the features


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
        none = np.zeros(0, np.int32)
        xyz = np.zeros((0, 3), np.int64)
        return NodeColumns(xyz.astype(np.int32), xyz, none, xyz, none)


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
        return verdict_of(none, none, none, 1)


class Fold(Protocol):
    """The map as a function of the blocks applied and not undone. `len()`: its nodes."""

    def __len__(self) -> int: ...

    def apply(self, block: Block) -> None:
        """Fold a block in. An author's blocks come with rising numbers."""

    def undo(self, block: Block) -> None:
        """The exact inverse: `block` is the last one applied and not yet undone."""

    def drop_records(self, keep: int) -> None:
        """Drop all but the last `keep` rows of what undoing needs: a block has one row for itself
        and one for each feature and sighting. What has none left cannot be undone."""

    def feature_nodes(self, author: int) -> Int32s:
        """(F,) node of each feature number of an author, -1 where there is none; read-only."""

    def columns(self) -> NodeColumns:
        """The nodes, in the order in which they came into being."""

    def settled(self, author: int, xyz: Int32s, repeats: int) -> Bools:
        """(N,) places (N, 3) mm of which the author has said all that counts: it said so
        `repeats` times, or once where as many authors as confirm a node say the same; with 0
        repeats, those that have a node."""

    def evaluate(self, rays: RayEvidence) -> Verdict:
        """Hits, misses, witnesses and states of all nodes."""

    @property
    def nbytes(self) -> int:
        """Memory held."""


class Features:
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

    def drop(self, keep: int) -> None:
        """Drop all but the last `keep` rows of the undo records."""
        self.undo = self.undo[self.top - keep : self.top].copy()
        self.top = keep

    def of(self, author: int) -> Int32s:
        nodes = self._nodes.get(author, np.zeros(0, np.int32))
        return view(nodes, self._lengths.get(author, 0))

    @property
    def nbytes(self) -> int:
        return self.undo.nbytes + sum(nodes.nbytes for nodes in self._nodes.values())


def columns_of(nodes: matching.Nodes | algorithm2.Graph, n: int) -> NodeColumns:
    return NodeColumns(
        view(nodes.seed[:, :3], n),
        view(nodes.offset, n),
        view(nodes.observed, n),
        view(nodes.color, n),
        view(nodes.color_count, n),
    )


def verdict_of(hits: Int32s, misses: Int32s, witnesses: Int32s, wanted: int) -> Verdict:
    states = np.where(witnesses >= wanted, State.CONFIRMED, State.TENTATIVE).astype(np.uint8)
    states[hits <= misses] = State.REJECTED  # 2h <= h + m
    return Verdict(hits, misses, witnesses, states)


def view(column: npt.NDArray[D], rows: int) -> npt.NDArray[D]:
    view = column[:rows]
    view.flags.writeable = False
    return view
