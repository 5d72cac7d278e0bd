"""Section 4.3: one map out of the transactions of many, taken in order, undone in reverse.

`DefaultFold` is DAGmap's own consensus, `PaperFold` is Algorithm 2 as printed, for comparison. Both
hold plain columns and leave the work to kernels. Nothing that they answer depends on the salt
or on how the authors are numbered.
"""

from __future__ import annotations

import numpy as np

from . import weighing
from .blocks import (
    Block,
    Features,
    Fold,
    NodeColumns,
    Verdict,
    columns_of,
    verdict_of,
)
from .config import FoldConfig
from .evidence import RayEvidence, hash_key, plain, with_room
from .kernels import matching
from .model import Bools, Int32s
from .paper_fold import PaperFold

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

_SAY = (16, 32, 64)  # of one author: observations around, passes through, ends before a node


def make_fold(config: FoldConfig, salt: int = 0) -> Fold:
    """The fold that the preset names."""
    return PaperFold(config, salt) if config.preset == "paper" else DefaultFold(config, salt)


class DefaultFold:
    """Observations meet the nearest seed of the whole map within delta; see `kernels.matching`."""

    def __init__(self, config: FoldConfig, salt: int = 0) -> None:
        self._config, self._reach = config, config.delta_mm
        self._shift = max(1, (2 * self._reach - 1).bit_length())  # cells of at least 2 delta
        self._features = Features()
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

    def drop_records(self, keep: int) -> None:
        self._features.drop(keep)

    def feature_nodes(self, author: int) -> Int32s:
        return self._features.of(author)

    def columns(self) -> NodeColumns:
        return columns_of(self._nodes, len(self))

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
        newest = entries[self._nodes.first[:n]].astype(np.int64)
        moment = newest[:, matching.AUTHOR] << 32 | newest[:, matching.CYCLE]
        gone = weighing.gone(found, place, moment) & (config.miss_say > 0)
        balance = weighing.balances(found, record, config.delta_mm)
        doubt = np.full(n, weighing.SIXTEENTHS * (config.doubt or 0))
        if config.doubt is None:
            doubt = weighing.doubts(found, balance, self._nodes.first[:n], entries, self._authors)
        misses = weighing.misses(found, record, balance <= doubt, gone)
        return verdict_of(found.hits, misses, found.witnesses, config.witnesses)

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

    def first_authors(self) -> Int32s:
        """(N,) index of the author whose observation each node began with."""
        nodes, n = self._nodes, len(self)
        oldest = nodes.first[:n].copy()
        while n and (older := nodes.entries[oldest, matching.NEXT]).max() >= 0:
            oldest = np.where(older >= 0, older, oldest)
        return plain(nodes.entries[oldest, matching.AUTHOR])

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


def _seen(block: Block) -> matching.Seen:
    return matching.Seen(
        plain(block.xyz),
        plain(block.alive),
        plain(block.starts),
        plain(block.cycle),
        plain(block.color),
        plain(block.colored),
        plain(block.sightings),
        plain(block.sighting_cycle),
        plain(block.origin),
    )
