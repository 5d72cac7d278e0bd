"""A simulated fleet whose traffic, delays and load are watched: for the tests of section 5."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

import msgspec
import numpy as np

from dagmap import Config, Cycle, GraphConfig, Overloaded
from dagmap.config import IssuanceConfig, LedgerConfig, OverheadConfig, TransactionConfig
from dagmap.sim.fleet import Fleet
from dagmap.sim.network import Link, Network
from dagmap.sim.robot import Costs, Happening, Robot, Timed

PLAIN = Config(
    transaction=TransactionConfig(proof_of_work_bits=0),
    graph=GraphConfig(reference_pitch=0.25, max_parent_distance=0.75),
    issuance=IssuanceConfig(repeats=0),
    ledger=LedgerConfig(fold_period=60.0),  # nobody looks at the map: what is watched is the way
)
TICK = 0.2


class Corridor:
    """A robot that sees so many new points every cycle, none of them twice."""

    def __init__(self, seed: int, period: float, count: Callable[[float], int], end: float) -> None:
        self.seed, self.period, self.count, self.end = seed, period, count, end

    def cycles(self, start: float, session: int) -> Iterator[Timed]:
        rng, number, at = np.random.default_rng(self.seed), 0, start
        while at < self.end:
            pose = np.eye(4)
            pose[:3, 3] = 0.5 * number, 10.0 * self.seed, 0.0
            points = rng.uniform([0, -2, -1], [2, 2, 1], (self.count(at), 3))
            yield at, Cycle(stamp=at, pose=pose, points=points)
            number, at = number + 1, at + self.period


class Team:
    """A fleet whose traffic and load are watched."""

    def __init__(
        self, config: Config, link: Link | None = None, costs: Costs | None = None
    ) -> None:
        self.sent: dict[str, list[tuple[float, int]]] = defaultdict(list)
        self.events: list[Overloaded] = []
        self.network = Network(link or Link(), 1)
        self.fleet = Fleet(config, self.network, self._note, tick=TICK, costs=costs)
        plain = self.network.send

        def send(sender: str, receivers: object, size: int, now: float) -> object:
            self.sent[sender].append((now, size))
            return plain(sender, receivers, size, now)  # type: ignore[arg-type]

        self.network.send = send  # type: ignore[method-assign, assignment]

    def _note(self, robot: Robot, happening: Happening) -> None:
        if isinstance(happening, Overloaded):
            self.events.append(happening)

    def join(
        self, number: int, period: float, count: Callable[[float], int], end: float
    ) -> list[Robot]:
        first = len(self.fleet.robots)
        robots = []
        for i in range(first, first + number):
            robots.append(self.fleet.join(f"r{i}"))
            self.fleet.play(f"r{i}", Corridor(i, period, count, end))
        return robots

    def bytes_in(self, start: float, end: float) -> int:
        """Bytes that all robots put on the network."""
        return sum(size for out in self.sent.values() for at, size in out if start <= at < end)

    def issued_everything(self) -> bool:
        """Whether all that any SLAM put out has gone out and is known to everybody."""
        robots = list(self.fleet.robots.values())
        everything = all(robot.issued == robot.observed for robot in robots)
        return everything and self.fleet.agrees()


def steered(**limits: float) -> Config:
    return msgspec.structs.replace(PLAIN, overhead=OverheadConfig(**limits))  # type: ignore[arg-type]


def worst_window(out: list[tuple[float, int]], span: float = 5.0) -> int:
    """The most bytes in any span of time."""
    at, size = np.array([t for t, _ in out]), np.array([s for _, s in out])
    total = np.concatenate([[0], np.cumsum(size)])
    before = np.searchsorted(at, at - span + 1e-9, "right")
    return int((total[1:] - total[before]).max())


def turns(values: Sequence[float]) -> int:
    """How often a series changes its direction."""
    steps = [b > a for a, b in pairwise(values) if a != b]
    return sum(a != b for a, b in pairwise(steps))
