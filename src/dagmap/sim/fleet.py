"""Several agents on one clock and one network, driven by one queue of events.

Time is simulated: an event is an arrival, a tick, a cycle of a SLAM, a crash or a restart. Events
at one time are handled in the order in which they were planned, so a run is a pure function of
what was put in and of the seed.
"""

from __future__ import annotations

import hashlib
import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import count
from typing import TypeAlias

import msgspec

from ..agent import Agent
from ..config import Config
from ..identity import Identity
from ..messages import Parsers
from ..model import Accepted, AuthorId, ConfigError, Cycle, DagmapError, Event, Issued
from ..transaction import id_of
from .network import Link, Network
from .robot import (
    Clock,
    Costs,
    Crashed,
    Happening,
    Liar,
    Moment,
    Observed,
    Received,
    Recording,
    Restarted,
    Robot,
    Source,
)
from .shared import SharedParsers

TICK = 0.1  # s between the ticks of an agent
PATIENCE = 120.0  # s of simulated time that the fleet gets to agree once all is quiet
Watch: TypeAlias = Callable[[Robot, Happening], None]
Check: TypeAlias = Callable[[Robot], None]


class Crash(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A robot's process dies at `at` (s) and is back `down` seconds later.

    moment: "between" two steps; "unsynced", in the next one that has something to store, before the
    disk was synced; or "unsent", in the next one after that, before it has sent.
    """

    robot: str
    at: float
    down: float = 1.0
    moment: Moment = "between"

    def __post_init__(self) -> None:
        if not (self.at >= 0 and self.down >= 0):
            raise ConfigError(
                f"Crash: at = {self.at!r}, down = {self.down!r}, but times of at least 0 are wanted"
            )


@dataclass(frozen=True, slots=True)
class Progress:
    """One more cycle was taken by a robot (or, without a robot, time has passed)."""

    robot: str | None
    now: float


@dataclass(frozen=True, slots=True)
class _Seen:
    """A cycle that the SLAM of a session will put out."""

    session: int
    cycle: Cycle


_TICK, _RESTART = object(), object()
_What: TypeAlias = object  # bytes that arrive, a _Seen, a Crash, or one of the two above


class Fleet:
    """Robots by name, on one queue of events.

    on_event: told of everything that happens, before what follows from it is sent.
    check: called after every event with the robot that it concerned.
    costs: what the robots' work is taken to cost; None: nothing.
    """

    def __init__(
        self,
        config: Config,
        network: Network | None = None,
        on_event: Watch | None = None,
        check: Check | None = None,
        tick: float = TICK,
        parsers: Parsers | None = None,
        costs: Costs | None = None,
    ) -> None:
        self._costs = costs
        self._config, self._on_event, self._check = config, on_event, check
        self._network = network or Network(Link(), 0)
        self._tick, self._parsers = tick, parsers or SharedParsers().parsers
        self._queue: list[tuple[float, int, Robot, _What]] = []
        self._planned = count()
        self._addresses: dict[AuthorId, Robot] = {}
        self.robots: dict[str, Robot] = {}
        self.now = 0.0
        self.delivered = 0  # messages

    def join(self, name: str, clock: Clock | None = None, liar: Liar | None = None) -> Robot:
        """Add a robot now, with an empty ledger. Its key follows from its name, for replays."""
        if name in self.robots:
            raise DagmapError(f"two robots are called {name}; rename one of the recordings")
        secret = hashlib.blake2b(b"dagmap replay " + name.encode(), digest_size=32).digest()
        config = msgspec.structs.replace(self._config, name=name)
        agent = Agent(Identity.from_seed(secret), config, self._parsers)
        robot = self.robots[name] = Robot(name, agent, clock or Clock(), liar)
        self._addresses[agent.identity.author] = robot
        interleaved = self._tick * (len(self.robots) % 7) / 7
        self._plan(self.now + interleaved, robot, _TICK)
        return robot

    def play(self, name: str, source: Source) -> None:
        """Feed a robot from a source from now on, again after each restart."""
        robot = self.robots[name]
        robot.source, robot.stream = source, source.cycles(self.now, robot.session)
        self._plan_cycle(robot)

    def crash(self, crash: Crash) -> None:
        """Plan a crash and the restart after it."""
        robot = self.robots[crash.robot]
        self._plan(crash.at, robot, crash)
        self._plan(crash.at + crash.down, robot, _RESTART)

    def run(self, recordings: Mapping[str, Iterable[Cycle]]) -> Iterator[Progress]:
        """Play the recordings side by side from now on, then let the fleet agree."""
        for name, cycles in recordings.items():
            if name not in self.robots:
                self.join(name)
            self.play(name, Recording(cycles))
        while any(robot.plays for robot in self.robots.values()):
            robot, what = self.step()
            if isinstance(what, _Seen) or what is _TICK:
                yield Progress(robot.name if isinstance(what, _Seen) else None, self.now)
        deadline = self.now + PATIENCE
        while self.now < deadline and not self.agrees():
            self.advance(self.now + self._tick)
            yield Progress(None, self.now)

    def advance(self, until: float) -> None:
        """Handle every event up to a time."""
        while self._queue[0][0] <= until:
            self.step()
        self.now = until

    def step(self) -> tuple[Robot, _What]:
        """Handle the next event."""
        at, _, robot, what = heapq.heappop(self._queue)
        self.now = at
        if type(what) is bytes:
            self._arrive(robot, what)
        elif what is _TICK:
            self._plan(at + self._tick, robot, _TICK)
            if robot.up:
                self._after(robot, robot.agent.tick(robot.clock.at(at)))
        elif isinstance(what, _Seen):
            self._observe(robot, what)
        elif what is _RESTART:
            self._restart(robot)
        elif isinstance(what, Crash) and robot.up:
            if what.moment == "between":
                self._die(robot, what.moment)
            else:
                robot.doom = what.moment
        if self._check is not None and robot.up:
            self._check(robot)
        return robot, what

    def agrees(self, robots: Iterable[Robot] | None = None) -> bool:
        """Whether all ledgers count the same transactions, nothing waits to be sent, and all that
        is known is folded."""
        agents = [robot.agent for robot in (self.robots.values() if robots is None else robots)]
        if any(agent.holds_back or agent.searching or not agent.settled for agent in agents):
            return False
        first = _ends(agents[0]) if agents else {}
        return all(_ends(agent) == first for agent in agents[1:])

    def _plan(self, at: float, robot: Robot, what: _What) -> None:
        heapq.heappush(self._queue, (at, next(self._planned), robot, what))

    def _plan_cycle(self, robot: Robot) -> None:
        following = next(robot.stream, None)
        robot.plays = following is not None
        if following is not None:
            self._plan(max(following[0], self.now), robot, _Seen(robot.session, following[1]))

    def _arrive(self, robot: Robot, data: bytes) -> None:
        if not robot.up:
            return
        self.delivered += 1
        robot.messages += 1
        robot.bytes_received += len(data)
        if self._on_event is not None:
            self._on_event(robot, Received(len(data)))
        if robot.liar is not None:
            robot.liar.hear(data)
        self._after(robot, robot.agent.receive(data, robot.clock.at(self.now)))

    def _observe(self, robot: Robot, what: _Seen) -> None:
        if not robot.up or what.session != robot.session:
            return  # with a restart the SLAM begins anew
        seen = robot.perceived(what.cycle)
        if robot.liar is not None:
            seen = robot.liar.cycle(seen, self.now)
        before = robot.agent.observing.observed
        events = robot.agent.observe(seen, robot.clock.at(self.now))
        points = robot.agent.observing.observed - before
        robot.cycles += 1
        robot.observed += points
        robot.observed_at.append((self.now, points))
        if self._on_event is not None:
            self._on_event(robot, Observed(points))
        self._after(robot, events)
        if robot.up:
            self._plan_cycle(robot)

    def _after(self, robot: Robot, events: list[Event]) -> None:
        """What a robot's runtime does after every step: store, sync, then send."""
        if self._costs is not None:
            robot.charge(self._costs)
        for event in events:
            if self._on_event is not None:
                self._on_event(robot, event)
            if isinstance(event, Accepted):
                robot.disk.append(event.data)
            elif isinstance(event, Issued):
                robot.own.add(event.id)
                robot.transactions += 1
                robot.issued += event.features
                robot.issued_at.append((self.now, event.features))
        if robot.doom == "unsynced" and robot.disk.unsynced:
            return self._die(robot, robot.doom)
        robot.disk.sync()
        if robot.doom == "unsent":
            return self._die(robot, robot.doom)
        self._send(robot)
        return None

    def _send(self, robot: Robot) -> None:
        outgoing = robot.agent.outbox()
        if robot.liar is not None:
            outgoing = robot.liar.send(robot.agent, outgoing, self.now)
        for out in outgoing:
            robot.bytes_sent += len(out.data)
            if out.to is None:
                receivers = [name for name in self.robots if name != robot.name]
            else:
                to = self._addresses.get(out.to)
                receivers = [to.name] if to is not None and to is not robot else []
            for at, name in self._network.send(robot.name, receivers, len(out.data), self.now):
                self._plan(at, self.robots[name], out.data)

    def _die(self, robot: Robot, moment: Moment) -> None:
        robot.up, robot.doom = False, None
        robot.own.difference_update(map(id_of, robot.disk.crash()))  # nobody was told of these
        if self._on_event is not None:
            self._on_event(robot, Crashed(moment))

    def _restart(self, robot: Robot) -> None:
        if robot.up:
            robot.doom = None  # its last step never came
            return
        robot.restart(self.now, self._parsers)
        if self._on_event is not None:
            self._on_event(robot, Restarted(len(robot.agent.ledger)))
        self._plan_cycle(robot)


def _ends(agent: Agent) -> dict[AuthorId, tuple[int, int | None]]:
    return {author: (chain.end, chain.cut) for author, chain in agent.ledger.chains.items()}
