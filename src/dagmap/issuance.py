"""Section 4.2: which features go out and when. Threshold, issued set, truncation, pacing.

Keeps, beside the adjacency DAG of the running SLAM frame, what the wire needs of each node: the
cycle that saw it, its place in that cycle's sensor frame and its colour.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from .config import Config
from .graph import AdjacencyDag
from .kernels.columns import distinct, grown
from .model import Bools, Int32s, Int64s, Uint8s
from .payload import Bundle, Sighting

_PART = 1.0  # s between the parts in which a long cycle goes out
_WORTH = 64  # features below which a part is not worth its envelope
_LOOK = 8  # times what may go out that is looked at for news
ROOM = 50_000  # bytes of records in a transaction at most
ALL = 1 << 40  # more features than there are
Known: TypeAlias = Callable[[Int32s], Bools]  # of points (N, 3) mm in the SLAM frame


@dataclass(frozen=True, slots=True)
class Allowance:
    """What may go out now, as traffic and load have it (section 5)."""

    features: int = ALL
    per_bundle: int = ALL  # N'_f: what a bundle holds at most
    room: int = ROOM  # bytes of records in a transaction


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Features that go out together, before they are cut into transactions."""

    nodes: Int64s  # ids in the DAG, ascending
    sightings: tuple[Sighting, ...]


class Issuance:
    """What is valid and waits to be sent. One per SLAM frame."""

    def __init__(self, config: Config, graph: AdjacencyDag) -> None:
        self._config, self.graph = config, graph
        self.number: Int64s = np.zeros(0, np.int64)  # issue number of a node, -1: not issued
        self.cycle: Int32s = np.zeros(0, np.int32)
        self.place: Int32s = np.zeros((0, 3), np.int32)  # mm, sensor frame of the cycle
        self.color: Uint8s = np.zeros((0, 3), np.uint8)
        self.colored: Bools = np.zeros(0, np.bool_)
        self.seen_again: Int32s = np.zeros(0, np.int32)  # latest cycle that saw it again, or -1
        self._again: list[Int64s] = []
        self._news = False  # whether `_again` may hold what can go out
        self._ripened: list[Int64s] = [np.zeros(0, np.int64)]
        self._allowance = 0.0
        self._last: float | None = None
        self._sealed_at: float | None = None
        self._cycle_at: float | None = None
        self._period = config.issuance.cycle_period  # T, s

    def begin(self, now: float) -> None:
        """A cycle of the SLAM begins; T is the time between two of them, smoothed."""
        if self._cycle_at is not None and now > self._cycle_at:
            gap = now - self._cycle_at
            self._period = 0.75 * self._period + 0.25 * gap if self._period else gap
        self._cycle_at = now

    def add(
        self, nodes: Int64s, cycle: Int32s, place: Int32s, color: Uint8s, colored: Bools
    ) -> None:
        """Remember what the wire needs of newly inserted nodes; note which of them are valid."""
        if len(nodes) == 0:
            return
        first, end = int(nodes[0]), int(nodes[-1]) + 1
        self.number = grown(self.number, end, -1)
        self.cycle = grown(self.cycle, end, 0)
        self.place = grown(self.place, end, 0)
        self.color = grown(self.color, end, 0)
        self.colored = grown(self.colored, end, False)
        self.seen_again = grown(self.seen_again, end, -1)
        self.cycle[first:end] = cycle
        self.place[first:end] = place
        self.color[first:end] = color
        self.colored[first:end] = colored
        self.revalue(nodes)

    def revalue(self, nodes: Int64s) -> None:
        """Nodes whose validity is new: those above V_th become cores of bundles (Alg. 1)."""
        valid = self.graph.validity(nodes) > self._config.graph.v_th
        self._ripen(nodes[valid])

    def unissued(self) -> Int64s:
        """Nodes that are neither issued nor withdrawn, ascending."""
        return np.flatnonzero(self.graph.open())

    def see_again(self, nodes: Int64s, cycle: int) -> None:
        """Nodes that the SLAM observed once more. Only the latest such cycle is kept a node."""
        self.seen_again[nodes] = cycle
        self._again.append(nodes)
        self._news = True

    @property
    def waiting(self) -> bool:
        """Whether valid features have not gone out yet."""
        return bool(self.graph.open(self._ripe).any())

    def batch(self, now: float, allowed: Allowance, known: Known) -> Batch | None:
        """What may go out now, or None. Marks it as issued; the caller must send it.

        known: tells which places the fleet's map has. Where not all fits, they come last.
        """
        limit = min(self._limit(now), self._part(now), allowed.features)
        per_bundle = min(self._config.issuance.features_per_bundle, allowed.per_bundle)
        nodes = self._take(limit, per_bundle, known) if limit > 0 else np.zeros(0, np.int64)
        sightings = self._sightings() if limit > 0 else ()
        if len(nodes) == 0 and not sightings:
            return None
        self._allowance -= len(nodes)
        self._sealed_at = now
        return Batch(nodes, sightings)

    def bundle(self, nodes: Int64s, base: int) -> Bundle:
        """The record of these nodes (ascending), which get the numbers from `base` on."""
        self.number[nodes] = np.arange(base, base + len(nodes))
        self._news = True
        parents = self.graph.parents(nodes)
        numbers = np.where(parents >= 0, self.number[parents], -1)
        breaks = np.flatnonzero(
            (np.diff(self.cycle[nodes]) != 0) | (np.diff(self.colored[nodes].view(np.int8)) != 0)
        )
        starts = np.concatenate([[0], breaks + 1, [len(nodes)]]).astype(np.int64)
        heads = nodes[starts[:-1]]
        return Bundle(
            base,
            self.place[nodes],
            numbers.astype(np.int64),
            self.color[nodes],
            starts,
            self.cycle[heads].astype(np.int64),
            self.colored[heads].astype(np.uint8),
        )

    def _limit(self, now: float) -> int:
        """How many features may go out: Eq. (6) as a rate, spread evenly over time."""
        rate = self._config.issuance.features_per_second
        if rate is None:
            return ALL
        elapsed = 0.0 if self._last is None else max(0.0, now - self._last)
        self._last = now
        self._allowance = min(self._allowance + elapsed * rate, max(rate, 1.0))
        period = self._config.issuance.seal_period
        if self._sealed_at is not None and now - self._sealed_at < period:
            return 0
        return int(self._allowance)

    def _part(self, now: float) -> int:
        """How many features may go out if those of a long cycle are spread over it."""
        if self._cycle_at is None or self._period < max(self._config.issuance.spread_from, _PART):
            return ALL
        if self._sealed_at is not None and now - self._sealed_at < _PART:
            return 0
        waiting = np.count_nonzero(self.graph.open(self._ripe))
        parts = max(1, round((self._cycle_at + self._period - now) / _PART))
        return max(_WORTH, math.ceil(waiting / parts)) if waiting else ALL

    def _take(self, limit: int, per_bundle: int, known: Known) -> Int64s:
        """Cores, newest first, each with its unissued ascendants, until the limit is reached."""
        if len(self._ripe) == 0:
            return self._ripe
        cores = self._ripe[self.graph.open(self._ripe)]
        cores = distinct(cores)[::-1]
        if len(cores) > limit:
            cores = self._news_first(cores, limit, known)
        taken, frontier, done, changed = self.graph.take(cores, per_bundle, limit)
        self._ripened = [cores[done:]]
        self._ripen(frontier)  # the nearest truncated inherit the core's validity (5.2)
        self.revalue(changed)
        return taken

    def _news_first(self, cores: Int64s, limit: int, known: Known) -> Int64s:
        """What is new to the fleet before what repeats, each newest first.

        Looks at as many of the newest as find `limit` news, and at no more than a few times that.
        """
        looked = cores[: _LOOK * limit]
        repeats = known(self.graph.positions(looked))
        return np.concatenate([looked[~repeats], cores[len(looked) :], looked[repeats]])

    def _ripen(self, nodes: Int64s) -> None:
        if len(nodes):
            self._ripened.append(nodes)

    @property
    def _ripe(self) -> Int64s:
        """What was valid when it was looked at, in any order and number."""
        if len(self._ripened) > 1:
            self._ripened = [np.concatenate(self._ripened)]
        return self._ripened[0]

    def _sightings(self) -> tuple[Sighting, ...]:
        """Repeated observations of features that are out by now, by cycle."""
        if not self._again or not self._news:
            return ()
        self._news = False
        nodes = np.unique(np.concatenate(self._again))
        nodes = nodes[self.seen_again[nodes] >= 0]
        out = self.number[nodes] >= 0
        self._again = [nodes[~out & self.graph.alive(nodes)]]
        nodes = nodes[out & self.graph.alive(nodes)]
        cycles = self.seen_again[nodes]
        self.seen_again[nodes] = -1
        return tuple(
            Sighting(int(cycle), np.sort(self.number[nodes[cycles == cycle]]))
            for cycle in np.unique(cycles)
        )
