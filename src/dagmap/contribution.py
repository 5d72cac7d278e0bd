"""What one transaction adds to the map: its features, carried into the fleet's frames.

Only the placed positions are kept (15 B a feature with the colour); when a pose changes, the
positions in the sensor's frame are decoded again from the transaction's bytes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from .config import Config
from .fold import Block
from .kernels.columns import grown
from .kernels.geometry import carry_segments
from .model import AuthorId, Bools, FrameId, Int32s, Int64s
from .payload import Anchor, Link, Sighting
from .transaction import Transaction

Placement: TypeAlias = tuple[FrameId, Int32s]  # component, (7,) pose of a frame in it
Frames: TypeAlias = Callable[[AuthorId, int], Placement]  # of an author's session
Key: TypeAlias = tuple[int, AuthorId, int]  # the canonical order
_NO_NUMBERS, _NO_CYCLES = np.zeros(0, np.int64), np.zeros(0, np.int32)


@dataclass(slots=True)
class Author:
    """What the counted transactions of one author say, beside features."""

    id: AuthorId
    index: int  # local and dense; nothing that others see depends on it
    name: str | None = None
    anchors: dict[int, Anchor] = field(default_factory=dict)  # newest, by cycle
    retracted: Bools = field(default_factory=lambda: np.zeros(0, np.bool_))  # by feature number
    links: dict[tuple[FrameId, FrameId], Link] = field(default_factory=dict)
    bases: list[int] = field(default_factory=list)  # first feature number of each contribution
    keys: list[Key] = field(default_factory=list)  # of the same contributions
    seen_in: dict[int, list[Key]] = field(default_factory=dict)  # contributions by cycle
    sessions: set[int] = field(default_factory=set)  # of its anchors, the first ones
    linked: Counter[AuthorId] = field(default_factory=Counter)  # links to frames of each author

    def take_link(self, link: Link, most: int, authors: int) -> bool:
        """Take a link in the place of an older one between its frames; or as a new one, where
        fewer than `most` lead to its target's author, and to fewer others than `authors`."""
        ends, to = (link.source, link.target), link.target.author
        if ends not in self.links:
            if self.linked[to] >= most or (to not in self.linked and len(self.linked) >= authors):
                return False
            self.linked[to] += 1
        self.links[ends] = link
        return True

    def retract(self, numbers: Int64s) -> list[Key]:
        """Mark features (ascending numbers) as withdrawn; the contributions that held them."""
        if len(numbers) == 0:
            return []
        self.retracted = grown(self.retracted, int(numbers[-1]) + 1, False)
        numbers = numbers[~self.retracted[numbers]]
        self.retracted[numbers] = True
        hit = np.searchsorted(np.array(self.bases, np.int64), numbers, side="right") - 1
        return [self.keys[i] for i in np.unique(hit).tolist()]


@dataclass(slots=True, eq=False)
class Part:
    """What a contribution adds to one component of frames, as it was last placed."""

    component: FrameId
    alive: Bools | None  # None: all features
    origins: Int32s  # (s, 3) sensor position of each segment, mm in the component
    sightings: tuple[Sighting, ...]


class Contribution:
    """The features and sightings of one transaction, placed by the newest poses."""

    __slots__ = (
        "author",
        "base",
        "color",
        "colored",
        "cores",
        "cycles",
        "fresh",
        "parents",
        "parts",
        "sightings",
        "size",
        "starts",
        "transaction",
        "xyz",
    )

    def __init__(self, tx: Transaction, author: Author, config: Config) -> None:
        bundle, paper = tx.payload.bundle, config.fold.preset == "paper"
        self.transaction, self.author = tx, author
        self.sightings = tx.payload.sightings
        # observations: features and sightings
        self.size = tx.features + sum(len(sighting.numbers) for sighting in self.sightings)
        self.parts: list[Part] = []
        self.fresh = True  # xyz still holds positions in the sensors' frames
        self.parents: Int64s | None = None
        self.cores = np.zeros(0, np.int64)
        if bundle is None:
            self.base = 0
            self.xyz, self.color = np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8)
            self.starts, self.cycles = np.zeros(1, np.int64), _NO_CYCLES
            self.colored = np.zeros(0, np.bool_)
            return
        self.base, self.xyz, self.color = bundle.base, bundle.position, bundle.color
        self.starts, self.cycles = bundle.starts, bundle.cycles.astype(np.int32)
        self.colored = bundle.colored.astype(np.bool_)
        if paper:
            self.parents, self.cores = bundle.parents, bundle.cores()

    @property
    def key(self) -> Key:
        return self.transaction.key

    @property
    def touched_cycles(self) -> set[int]:
        """Cycles whose anchors this contribution depends on."""
        return {*self.cycles.tolist(), *(sighting.cycle for sighting in self.sightings)}

    def place(self, frames: Frames, config: Config) -> None:
        """Carry every feature from its sensor's frame into the component, in integers.

        Left out is what was retracted, has no known anchor, leaves +-2^29 mm on the way, or lies
        in another component than what comes first: honest transactions lie in one SLAM frame, and
        a map for every feature would be a bomb.
        """
        position = self._positions(config)
        homes = [self._home(cycle, frames) for cycle in self.cycles.tolist()]
        again = [(sighting, self._home(sighting.cycle, frames)) for sighting in self.sightings]
        known = [home for home in (*homes, *(home for _, home in again)) if home is not None]
        component = known[0][1][0] if known else None
        poses = np.zeros((len(homes), 2, 7), np.int32)
        for s, home in enumerate(homes):
            if home is not None and home[1][0] == component:
                poses[s, 0], poses[s, 1] = home[0].pose, home[1][1]
        alive = np.ones(len(position), np.bool_)
        gone = self.author.retracted[self.base : self.base + len(position)]
        if len(gone):
            alive[: len(gone)] &= ~gone
        self.xyz = np.zeros_like(position)
        origins = np.zeros((len(homes), 3), np.int32)
        carry_segments(poses, self.starts, position, self.xyz, origins, alive)
        self.parts = []
        if component is not None:
            mask = None if bool(alive.all()) else alive
            here = (sighting for sighting, home in again if home and home[1][0] == component)
            self.parts = [Part(component, mask, origins, tuple(here))]

    def block(self, part: Part) -> Block:
        """The part in the form that a fold takes."""
        numbers, cycles = _NO_NUMBERS, _NO_CYCLES
        if part.sightings:
            numbers = np.concatenate([s.numbers for s in part.sightings])
            sizes = [len(s.numbers) for s in part.sightings]
            cycles = np.array([s.cycle for s in part.sightings], np.int32).repeat(sizes)
        return Block(
            author=self.author.index,
            base=self.base,
            xyz=self.xyz,
            alive=self.alive(part),
            starts=self.starts,
            cycle=self.cycles,
            color=self.color,
            colored=self.colored,
            parents=self.parents,
            cores=self.cores,
            sightings=numbers,
            sighting_cycle=cycles,
            origin=part.origins,
        )

    def alive(self, part: Part) -> Bools:
        """(n,) which features count; not to be written to."""
        return _all_true(len(self.xyz)) if part.alive is None else part.alive

    def _positions(self, config: Config) -> Int32s:
        if self.fresh:
            self.fresh = False
            return self.xyz
        held = self.transaction.payload.bundle  # only where agents of one process share it
        bundle = held or self.transaction.decode_again(config).bundle
        return self.xyz if bundle is None else bundle.position

    def _home(self, cycle: int, frames: Frames) -> tuple[Anchor, Placement] | None:
        anchor = self.author.anchors.get(cycle)
        return None if anchor is None else (anchor, frames(self.author.id, anchor.session))


class _Everyone:
    """One array for all who ask for one that is all true."""

    def __init__(self) -> None:
        self._held = np.ones(1024, np.bool_)

    def __call__(self, n: int) -> Bools:
        if n > len(self._held):
            self._held = np.ones(2 * n, np.bool_)
        return self._held[:n]


_all_true = _Everyone()
