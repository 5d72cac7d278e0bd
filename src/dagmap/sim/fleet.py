"""Several agents on one clock and one network: recordings in, one map out.

Every recording starts at time zero, so robots recorded one after the other map side by side.
"""

from __future__ import annotations

import hashlib
import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import msgspec

from ..agent import Agent
from ..config import Config
from ..identity import Identity
from ..model import Cycle, DagmapError, Event, Issued
from .network import Link, Network

TICK = 0.1  # s between the ticks of an agent
PATIENCE = 120.0  # s of simulated time that the fleet gets to agree once all is quiet


@dataclass(slots=True)
class Robot:
    """One agent and what it did."""

    name: str
    agent: Agent
    cycles: int = 0
    observed: int = 0  # points handed in by the SLAM
    issued: int = 0  # features sent in own transactions
    transactions: int = 0
    bytes_sent: int = 0  # a broadcast counted once
    bytes_received: int = 0
    observed_at: list[tuple[float, int]] = field(default_factory=list)  # (s, points)
    issued_at: list[tuple[float, int]] = field(default_factory=list)  # (s, features)


OnEvent = Callable[[Robot, Event], None]


@dataclass(frozen=True, slots=True)
class Progress:
    """One more cycle was taken by a robot (or, without a robot, time has passed)."""

    robot: str | None
    now: float


class Fleet:
    """Agents by name. `run` drives them through their recordings until they agree."""

    def __init__(
        self,
        config: Config,
        link: Link | None = None,
        seed: int = 0,
        on_event: OnEvent | None = None,
    ) -> None:
        self._config, self._on_event = config, on_event
        self._network = Network(link or Link(), seed)
        self._started = 0  # agents that joined, so that their ticks interleave
        self._ticks: list[tuple[float, str]] = []
        self._addresses: dict[bytes, str] = {}
        self.robots: dict[str, Robot] = {}
        self.now = 0.0

    def join(self, name: str) -> Robot:
        """Add a robot now, with an empty ledger. Its key follows from its name, for replays."""
        if name in self.robots:
            raise DagmapError(f"two robots are called {name}; rename one of the recordings")
        secret = hashlib.blake2b(b"dagmap replay " + name.encode(), digest_size=32).digest()
        agent = Agent(Identity.from_seed(secret), msgspec.structs.replace(self._config, name=name))
        self.robots[name] = Robot(name, agent)
        self._addresses[agent.identity.author] = name
        self._started += 1
        heapq.heappush(self._ticks, (self.now + TICK * (self._started % 7) / 7, name))
        return self.robots[name]

    def run(self, recordings: Mapping[str, Iterable[Cycle]]) -> Iterator[Progress]:
        """Play the recordings side by side from now on, then let the fleet agree."""
        for name in recordings:
            if name not in self.robots:
                self.join(name)
        for at, name, cycle in _merged(recordings, self.now):
            yield from self._pass_time(at)
            self._observe(self.robots[name], cycle)
            yield Progress(name, self.now)
        deadline = self.now + PATIENCE
        while not self.agrees() and self.now < deadline:
            yield from self._pass_time(self.now + TICK)

    def agrees(self) -> bool:
        """Whether all ledgers count the same transactions and nothing waits to be sent."""
        agents = [robot.agent for robot in self.robots.values()]
        ends = [
            {author: (chain.end, chain.cut) for author, chain in agent.ledger.chains.items()}
            for agent in agents
        ]
        return all(end == ends[0] for end in ends) and not any(agent.holds_back for agent in agents)

    def _pass_time(self, until: float) -> Iterator[Progress]:
        """Deliver and tick in order of time up to `until`."""
        while True:
            tick = self._ticks[0][0]
            arrival = self._network.next_arrival
            at = tick if arrival is None else min(tick, arrival)
            if at > until:
                break
            self.now = max(self.now, at)
            for name, data in self._network.arrivals(self.now):
                robot = self.robots[name]
                robot.bytes_received += len(data)
                self._after(robot, robot.agent.receive(data, self.now))
            if tick <= self.now:
                _, name = heapq.heappop(self._ticks)
                self._after(self.robots[name], self.robots[name].agent.tick(self.now))
                heapq.heappush(self._ticks, (tick + TICK, name))
                yield Progress(None, self.now)
        self.now = max(self.now, until)

    def _observe(self, robot: Robot, cycle: Cycle) -> None:
        before = robot.agent.observing.observed
        self._after(robot, robot.agent.observe(cycle, self.now))
        robot.cycles += 1
        points = robot.agent.observing.observed - before
        robot.observed += points
        robot.observed_at.append((self.now, points))

    def _after(self, robot: Robot, events: list[Event]) -> None:
        """Hand events on (a store must see them first), then send the outbox."""
        for event in events:
            if self._on_event is not None:
                self._on_event(robot, event)
            if isinstance(event, Issued):
                robot.transactions += 1
                robot.issued += event.features
                robot.issued_at.append((self.now, event.features))
        for out in robot.agent.outbox():
            robot.bytes_sent += len(out.data)
            names = [self._addresses.get(out.to)] if out.to is not None else list(self.robots)
            for name in names:
                if name is not None and name != robot.name:
                    self._network.send(name, out.data, self.now)


def _merged(
    recordings: Mapping[str, Iterable[Cycle]], start: float
) -> Iterator[tuple[float, str, Cycle]]:
    """Cycles of all recordings by time, each recording's first cycle at `start`."""

    def timed(name: str, cycles: Iterable[Cycle]) -> Iterator[tuple[float, str, Cycle]]:
        first: float | None = None
        for cycle in cycles:
            first = float(cycle.stamp) if first is None else first
            yield start + max(0.0, float(cycle.stamp) - first), name, cycle

    streams = (timed(name, cycles) for name, cycles in recordings.items())
    return heapq.merge(*streams, key=lambda item: item[:2])
