"""One run of a scenario: sets the fleet up, lets it work and agree, and measures."""

from __future__ import annotations

import gc
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeAlias

import msgspec

from ..metrics import nearest, thin
from ..model import (
    Accepted,
    ConfigError,
    Cycle,
    Floats,
    Forked,
    Issued,
    MapChanged,
    Rejected,
    State,
)
from ..worldmap import WorldMap
from .fleet import Check, Fleet
from .liars import make_liar
from .network import Network, Position
from .robot import Costs, Happening, Recording, Restarted, Robot, Source, Timed
from .scenario import Scenario
from .scene import Scene, Walker
from .truth import Lies, Quality, judge_lies, judge_quality, seen_by

Told: TypeAlias = Callable[[float], None]
SAMPLE = 1.0  # s between two looks at how far apart the robots are


class Report(msgspec.Struct, frozen=True, kw_only=True):
    """What a run gave. Times in s of simulated time unless they are called wall."""

    name: str
    seed: int
    robots: int
    liars: int
    agreed: bool  # all honest robots hold the same transactions and the same map
    digest: str
    agreement_s: float | None  # see `Mission.play`
    agreement_periods: float | None  # the same in announcement periods
    map_agreement_s: float | None  # the same until the last robot had folded it, too
    ideal_s: float | None  # what a flood without loss would take from then on
    simulated_s: float
    wall_s: float
    messages: int
    messages_per_s: float
    transactions: int  # of honest robots
    bytes_sent: int  # a broadcast once
    bytes_carried: int  # one copy for every robot in reach, lost or not
    bytes_received: int
    bytes_minimum: int  # one copy of every transaction for every honest robot but its author
    divergence: list[tuple[float, float]]  # (s, largest share of transactions that one lacks)
    map: dict[str, int]
    rejected: dict[str, int]  # refusals by honest robots, by reason
    quality: Quality | None
    lies: Lies | None


class _Walk:
    """A walker as a source of the simulator."""

    def __init__(self, walker: Walker, until: float) -> None:
        self.walker, self._until = walker, until

    def cycles(self, start: float, session: int) -> Iterator[Timed]:
        return ((float(c.stamp), c) for c in self.walker.cycles(self._until, start, session))


@contextmanager
def _without_collector() -> Iterator[None]:
    """Agents make no cycles of references, and looking for some in a large fleet takes a fifth of
    the time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


class Mission:
    """A scenario with a seed. The same two give the same timeline.

    recordings: cycles by robot, in place of the synthetic scene. reference: (N, 3) m in the fleet
    frame, what is truly there, to judge maps of recordings by.
    """

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        recordings: dict[str, Iterable[Cycle]] | None = None,
        on_event: Callable[[Robot, Happening], None] | None = None,
        check: Check | None = None,
        reference: Floats | None = None,
    ) -> None:
        self._reference = reference
        self.scenario, self.seed = scenario.drawn(seed), seed
        self._on_event, self._rejected = on_event, Counter[str]()
        self._scene: Scene | None = None
        self._walkers: dict[str, Walker] = {}
        self._recordings = recordings or {}
        unknown = sorted(self._recordings.keys() - set(self.scenario.names))
        if unknown:
            raise ConfigError(f"recordings of {unknown}, but the robots are {self.scenario.names}")
        if not self._recordings:
            self._scene = self._build_scene()
        network = Network(scenario.link, seed, self.scenario.partitions, self._where)
        self.fleet = Fleet(
            scenario.config,
            network,
            self._note,
            check=check,
            tick=scenario.tick,
            costs=scenario.costs if scenario.costs != Costs() else None,
        )
        self._network = network
        self._divergence: list[tuple[float, float]] = []
        self._cause = self._effect = 0.0  # s: last honest news or return, and last word of any
        self._folded = 0.0  # s: when a map changed last
        self.stage = "simulating"  # for those who watch: what a run is at
        self._set_up()

    @property
    def honest(self) -> list[Robot]:
        return [robot for robot in self.fleet.robots.values() if robot.honest]

    def run(self, told: Told | None = None) -> Report:
        """Play the mission, let the fleet agree, measure. `told` hears how far the time is."""
        started = time.perf_counter()
        took = self.play(told)
        self._enter("comparing maps", told)
        digests = {robot.agent.digest() for robot in self.honest if robot.up}
        return self._report(took, digests, time.perf_counter() - started)

    def play(self, told: Told | None = None) -> float | None:
        """Play the mission and let the fleet agree: all know the same, and have folded it.

        Returns how long that took, s: from when the last honest transaction was issued, the last
        partition over and the last robot there, to when the last robot knew. None: it has not.
        """
        with _without_collector():
            self._play(told)
        return max(0.0, self._effect - self._settled()) if self._quiet() else None

    def _play(self, told: Told | None) -> None:
        scenario, joining = self.scenario, dict(self._joining())
        while self.fleet.now < scenario.seconds:
            following = min(joining.values(), default=scenario.seconds)
            self._pass(min(self.fleet.now + SAMPLE, following, scenario.seconds), told)
            for name in [name for name, at in joining.items() if at <= self.fleet.now]:
                self._join(name)
                del joining[name]
        self._enter("agreeing", told)
        while not self._quiet() and self.fleet.now < scenario.seconds + scenario.patience:
            self._pass(self.fleet.now + scenario.tick, told)

    def _enter(self, stage: str, told: Told | None) -> None:
        self.stage = stage
        if told is not None:
            told(self.fleet.now)

    def _settled(self) -> float:
        """When the last of what keeps robots from agreeing was over, s."""
        ends = [cut.end for cut in self.scenario.partitions if cut.end <= self.fleet.now]
        return max([self._cause, *ends])

    def _build_scene(self) -> Scene:
        s = self.scenario
        scene = Scene(s.scene, s.sensor, s.motion, s.robots, self.seed)
        self._walkers = {name: scene.robot(i) for i, name in enumerate(s.names)}
        return scene

    def _where(self, name: str, now: float) -> Position:
        return self._walkers[name].position(now) if name in self._walkers else (0.0, 0.0, 0.0)

    def _set_up(self) -> None:
        late = dict(self._joining())
        for name in self.scenario.names:
            if name not in late:
                self._join(name)

    def _joining(self) -> Iterator[tuple[str, float]]:
        """Names of the honest robots that come late, and when."""
        honest = self.scenario.names[: self.scenario.robots - self.scenario.lying]
        late = self.scenario.late
        return zip(honest[len(honest) - len(late) :], late, strict=True)

    def _join(self, name: str) -> None:
        scenario, index = self.scenario, self.scenario.names.index(name)
        honest = index < scenario.robots - scenario.lying
        liar = None if honest else make_liar(name.rstrip("0123456789"), self.seed + index)
        self.fleet.join(name, scenario.clock(index, self.seed), liar)
        source: Source
        if name in self._walkers:
            source = _Walk(self._walkers[name], scenario.seconds)
        else:
            source = Recording(self._recordings.get(name, ()))
        self.fleet.play(name, source)
        self._cause = self.fleet.now
        for crash in scenario.crashes:
            if crash.robot == name and crash.at >= self.fleet.now:
                self.fleet.crash(crash)

    def _note(self, robot: Robot, happening: Happening) -> None:
        if robot.honest:
            match happening:
                case Accepted() | Forked():
                    self._effect = self.fleet.now
                case MapChanged():
                    self._folded = self.fleet.now
                case Issued() | Restarted():
                    self._cause = self.fleet.now
                case Rejected(reason):
                    self._rejected[reason.value] += 1
        if self._on_event is not None:
            self._on_event(robot, happening)

    def _pass(self, until: float, told: Told | None) -> None:
        before = self.fleet.now
        self.fleet.advance(until)
        if int(before / SAMPLE) != int(until / SAMPLE):
            self._divergence.append((round(until, 3), self._apart()))
            if told is not None:
                told(until)

    def _apart(self) -> float:
        """The largest share of all honest transactions that one honest robot lacks."""
        honest = self.honest
        total = sum(len(robot.own) for robot in honest)
        authors = {robot.author for robot in honest}
        held = [
            sum(c.end for author, c in robot.agent.ledger.chains.items() if author in authors)
            for robot in honest
            if robot.up
        ]
        return max((total - least) / total for least in held) if total and held else 0.0

    def _quiet(self) -> bool:
        """Whether all is over: every honest robot knows what the others know, and has folded it.

        Each gets its tick after the last news: whether a map was read meanwhile changes nothing.
        """
        honest = self.honest
        if any(robot.plays or not robot.up for robot in honest):
            return False
        if self.fleet.now < self._effect + self.scenario.tick:
            return False
        counts = {len(robot.agent.ledger.chains) for robot in honest}
        return len(counts) == 1 and self._apart() == 0.0 and self.fleet.agrees(honest)

    def _ideal(self, now: float) -> float | None:
        """How long a flood would take over the links as they are, each hop one mean delay."""
        low, high = self.scenario.link.delay
        hop = max((low + high) / 2 + self.scenario.link.tail, 0.001)
        names = [robot.name for robot in self.honest]
        reached = [1 << i for i in range(len(names))]
        full = (1 << len(names)) - 1
        step = max(hop, self.scenario.tick)
        spent = 0.0
        while any(mask != full for mask in reached):
            if spent > self.scenario.patience:
                return None
            before, changed = list(reached), False
            for i, sender in enumerate(names):
                for j, receiver in enumerate(names):
                    if before[i] & ~reached[j] and self._network.connects(
                        sender, receiver, now + spent
                    ):
                        reached[j] |= before[i]
                        changed = True
            spent += hop if changed else step
        return spent

    def _quality(self, world: WorldMap) -> Quality | None:
        if self._scene is not None:
            return judge_quality(world, seen_by(self._walkers, self.honest), self._scene.distance)
        if self._reference is None:
            return None
        there = thin(self._reference)
        return judge_quality(world, there, lambda cloud: nearest(cloud, there))

    def _report(self, took: float | None, digests: set[bytes], wall: float) -> Report:
        robots, honest = list(self.fleet.robots.values()), self.honest
        good = {robot.author for robot in honest}
        unique = {
            tx.id: len(tx.data) * (len(honest) - (tx.author in good))
            for robot in honest
            for tx in robot.agent.ledger
        }
        world = honest[0].agent.map
        period = self.scenario.config.sync.announce_period
        return Report(
            name=self.scenario.name,
            seed=self.seed,
            robots=len(robots),
            liars=self.scenario.lying,
            agreed=took is not None and len(digests) == 1,
            digest=min(digests).hex() if digests else "",
            agreement_s=took,
            agreement_periods=None if took is None else took / period,
            map_agreement_s=None
            if took is None
            else max(0.0, max(self._effect, self._folded) - self._settled()),
            ideal_s=self._ideal(self._settled()),
            simulated_s=self.fleet.now,
            wall_s=wall,
            messages=self.fleet.delivered,
            messages_per_s=self.fleet.delivered / max(wall, 1e-9),
            transactions=sum(len(robot.own) for robot in honest),
            bytes_sent=sum(robot.bytes_sent for robot in robots),
            bytes_carried=self._network.carried,
            bytes_received=sum(robot.bytes_received for robot in honest),
            bytes_minimum=sum(unique.values()),
            divergence=self._divergence,
            map={"nodes": len(world), **{s.name.lower(): world.count(s) for s in State}},
            rejected=dict(sorted(self._rejected.items())),
            quality=self._quality(world),
            lies=judge_lies(honest[0], honest, self.scenario.lying, self._scene)
            if self.scenario.lying
            else None,
        )
