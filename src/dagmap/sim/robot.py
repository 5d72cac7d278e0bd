"""One simulated robot: an agent, its disk, its clock, and what it did."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Literal, Protocol, TypeAlias

import msgspec
import numpy as np

from ..agent import Agent
from ..equations import Work
from ..messages import Parsers
from ..model import AuthorId, ConfigError, Cycle, Event, Outgoing, TransactionId

Moment: TypeAlias = Literal["between", "unsynced", "unsent"]
Timed: TypeAlias = tuple[float, Cycle]  # when a cycle is handed in, s of simulated time


class Clock(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A robot's clock: wrong from the start, and ever more so."""

    offset: float = 0.0  # s
    drift: float = 0.0  # s per s

    def __post_init__(self) -> None:
        if not -0.5 <= self.drift <= 1.0:
            raise ConfigError(f"Clock: drift = {self.drift!r}, but -0.5 to 1 s/s is wanted")

    def at(self, now: float) -> float:
        """What the robot reads."""
        return now * (1.0 + self.drift) + self.offset


class Costs(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What work takes of a robot's processor, s a feature: simulated time has no other costs."""

    inserted: float = 0.0
    sent: float = 0.0
    merged: float = 0.0

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            if not 0 <= getattr(self, name) < math.inf:
                value = getattr(self, name)
                raise ConfigError(f"Costs: {name} = {value!r}, but a time of at least 0 is wanted")

    def of(self, work: Work) -> float:
        """Seconds."""
        return self.inserted * work.inserted + self.sent * work.sent + self.merged * work.merged


class Disk:
    """Double of the store: what was appended but not synced is gone after a crash."""

    def __init__(self) -> None:
        self._safe: list[bytes] = []
        self._pending: list[bytes] = []

    def append(self, data: bytes) -> None:
        self._pending.append(data)

    @property
    def unsynced(self) -> int:
        """Transactions that a crash would lose."""
        return len(self._pending)

    def sync(self) -> None:
        self._safe += self._pending
        self._pending.clear()

    def crash(self) -> list[bytes]:
        """What is lost."""
        lost, self._pending = self._pending, []
        return lost

    def read(self) -> list[bytes]:
        return list(self._safe)


class Source(Protocol):
    """What a robot's SLAM sees. After a crash it starts anew, in the frame of before."""

    def cycles(self, start: float, session: int) -> Iterator[Timed]:
        """Cycles from a simulated time on, in order of time, by the SLAM's n-th start."""
        ...


class Recording:
    """A recording as a source: its first cycle comes at the first start, and it never waits.

    A start after a crash is a new session, beside those that the recording itself has.
    """

    def __init__(self, cycles: Iterable[Cycle]) -> None:
        self._cycles = iter(cycles)
        self._offset: float | None = None
        self._last: Cycle | None = None  # handed out; it may still have been to come at a crash

    def cycles(self, start: float, session: int) -> Iterator[Timed]:
        last = [] if self._last is None else [self._last]
        for cycle in chain(last, self._cycles):
            self._last = cycle
            if self._offset is None:
                self._offset = start - float(cycle.stamp)
            at = float(cycle.stamp) + self._offset
            if at >= start:  # the sensor saw the others while the robot was down
                yield at, replace(cycle, session=int(cycle.session) + session)


class Liar(Protocol):
    """A robot that does not keep to the rules: it stands between an honest agent and the rest."""

    def cycle(self, cycle: Cycle, now: float) -> Cycle:
        """What the agent is told instead of what the SLAM saw."""
        ...

    def hear(self, data: bytes) -> None:
        """What has arrived, before the agent is told."""
        ...

    def send(self, agent: Agent, outgoing: list[Outgoing], now: float) -> list[Outgoing]:
        """What is sent instead of what the agent wants to send."""
        ...


@dataclass(frozen=True, slots=True)
class Observed:
    """The SLAM put out a cycle of so many points, so many of them new."""

    points: int


@dataclass(frozen=True, slots=True)
class Crashed:
    """The process died: between two steps, before its disk was synced, or before it had sent."""

    moment: Moment


@dataclass(frozen=True, slots=True)
class Restarted:
    """The process is back with so many transactions from its disk."""

    transactions: int


@dataclass(frozen=True, slots=True)
class Received:
    """A message arrived."""

    size: int


Happening: TypeAlias = Event | Observed | Crashed | Restarted | Received


@dataclass(slots=True, eq=False)
class Robot:
    """One agent and what it did."""

    name: str
    agent: Agent
    clock: Clock = field(default_factory=Clock)
    liar: Liar | None = None
    disk: Disk = field(default_factory=Disk)
    up: bool = True
    doom: Moment | None = None  # how it dies in its next step
    session: int = 0  # of its SLAM
    cycles: int = 0
    observed: int = 0  # points handed in by the SLAM
    issued: int = 0  # features sent in own transactions
    transactions: int = 0
    bytes_sent: int = 0  # a broadcast counted once
    bytes_received: int = 0
    messages: int = 0  # received
    observed_at: list[tuple[float, int]] = field(default_factory=list)  # (s, points)
    issued_at: list[tuple[float, int]] = field(default_factory=list)  # (s, features)
    own: set[TransactionId] = field(default_factory=set)  # what it truly issued
    withdrawn: set[int] = field(default_factory=set)  # numbers of issued features it took back
    source: Source | None = None
    stream: Iterator[Timed] = field(default_factory=lambda: iter(()))
    plays: bool = False  # whether its SLAM goes on
    charged: Work = field(default_factory=Work)  # what the agent was told the time of
    _ids: set[int] = field(default_factory=set)  # that this session has handed in
    _stamps: set[float] = field(default_factory=set)

    @property
    def honest(self) -> bool:
        return self.liar is None

    @property
    def author(self) -> AuthorId:
        return self.agent.identity.author

    def restart(self, now: float, parsers: Parsers) -> None:
        """Come back from the disk; the SLAM starts a new session."""
        self.up, self.doom = True, None
        self.withdrawn.clear()  # what was not said before the crash never will be
        before = self.agent
        self.agent = Agent.restore(before.identity, before.config, self.disk.read(), parsers)
        self.charged = replace(self.agent.steering.controller.work)
        self.session += 1
        self._ids, self._stamps = set(), set()
        if self.source is not None:
            self.stream = self.source.cycles(now, self.session)

    def charge(self, costs: Costs) -> None:
        """Tell the agent what its last step took."""
        work = self.agent.steering.controller.work
        self.agent.took(costs.of(work.since(self.charged)))
        self.charged = replace(work)

    def perceived(self, cycle: Cycle) -> Cycle:
        """The cycle as this robot's clock stamps it, in the session that its SLAM is in.

        What a former session saw is left out of `moved` and `removed`.
        """
        stamp, moved, removed = self.clock.at(float(cycle.stamp)), cycle.moved, cycle.removed
        if moved is not None:
            stamps = [self.clock.at(float(at)) for at in np.asarray(moved[0]).ravel()]
            kept = [i for i, at in enumerate(stamps) if not self.session or at in self._stamps]
            moved = ([stamps[i] for i in kept], np.asarray(moved[1])[kept])
        if self.session:
            removed = [id_ for id_ in _whole(cycle.removed) if id_ in self._ids]
            self._stamps.add(stamp)
            self._ids.update(_whole(cycle.ids))
            self._ids.difference_update(removed)
        self._note_withdrawn(removed)
        return replace(cycle, stamp=stamp, moved=moved, removed=removed)

    def _note_withdrawn(self, removed: object) -> None:
        """Which issued features the SLAM takes back, as the agent numbers them."""
        observing = self.agent.observing
        nodes = np.array([observing.node_of(id_) for id_ in _whole(removed)], np.int64)
        numbers = observing.issuance.number[nodes[nodes >= 0]]
        self.withdrawn.update(numbers[numbers >= 0].tolist())


def _whole(ids: object) -> list[int]:
    return [] if ids is None else [int(id_) for id_ in np.asarray(ids).ravel().tolist()]
