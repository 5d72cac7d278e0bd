"""Section 5: steps in robots, link and load. Under the limit within ten cycles, then at most one
change of direction in a hundred, and nothing lost for good. In simulated time."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from dagmap import Config
from dagmap.sim.network import Link
from dagmap.sim.robot import Costs
from team import PLAIN, Team, steered, turns

SOON, LONG = 10, 110  # cycles: back under the limit by then; calm until then
STEP = 10  # cycles before it


def calm(levers: Sequence[float]) -> bool:
    """Whether a lever, cycle by cycle from the step on, turns once at most when it should."""
    return len(levers) >= LONG and turns(levers[SOON : LONG + 1]) <= 1


def everything_comes(team: Team) -> bool:
    """Whether all that is valid goes out and is known to everybody, once no SLAM adds to it."""
    end = team.fleet.now + 2000.0
    while team.fleet.now < end and not team.issued_everything():
        team.fleet.advance(team.fleet.now + 50.0)
    return team.issued_everything()


class Doubled:
    """Some robots that map all the time; at the step as many join."""

    def __init__(self, config: Config, robots: int, features: int, cycles: int) -> None:
        self.team, period = Team(config), 5.0
        end = (STEP + cycles) * period
        first = self.team.join(robots, period, lambda at: features, end)
        self.team.fleet.advance(STEP * period)
        self.team.join(robots, period, lambda at: features, end)
        self.carried: list[float] = []  # bytes/s of all, in each cycle since
        self.rates: list[list[float]] = [[] for _ in first]
        for cycle in range(cycles):
            start = (STEP + cycle) * period
            self.team.fleet.advance(start + period)
            self.carried.append(self.team.bytes_in(start, start + period) / period)
            for rates, robot in zip(self.rates, first, strict=True):
                rates.append(robot.agent.steering.shaper.rate or 0.0)


@pytest.mark.parametrize(("robots", "features", "capacity"), [(2, 480, 3_600.0)])
def test_robots_double(robots: int, features: int, capacity: float) -> None:
    """Eq. (6): the robots share C_Th, however many there are."""
    run = Doubled(steered(fleet_bytes_per_second=capacity), robots, features, LONG + 1)
    assert max(run.carried[SOON:]) <= capacity
    assert all(calm(rates) for rates in run.rates)
    assert min(run.carried[SOON:LONG]) > 0.5 * capacity  # what is allowed is used
    assert not run.team.issued_everything()
    assert everything_comes(run.team)
    free = Doubled(PLAIN, robots, features, 2 * SOON)
    assert min(free.carried[SOON:]) > capacity


class Weakened:
    """Robots that map all the time, whose links drop to a tenth at the step."""

    def __init__(
        self, config: Config, robots: int, features: int, whole: float, cycles: int
    ) -> None:
        self.team, self.whole, period = Team(config, Link(bandwidth=whole)), whole, 5.0
        self.team.network.link = self.link(1.0)
        end = (STEP + cycles) * period
        everybody = self.team.join(robots, period, lambda at: features, end)
        self.team.fleet.advance(STEP * period)
        self.team.network.link = self.link(0.1)
        self.delays: list[float] = []  # s, the longest
        self.rates: list[list[float]] = [[] for _ in everybody]
        for cycle in range(cycles):
            self.team.fleet.advance((STEP + cycle + 1) * period)
            now = self.team.fleet.now
            self.delays.append(max(robot.agent.sync.delay(now) or 0.0 for robot in everybody))
            for rates, robot in zip(self.rates, everybody, strict=True):
                rates.append(robot.agent.steering.shaper.rate or 0.0)

    def link(self, part: float) -> Link:
        return Link(bandwidth=part * self.whole, queue=1 << 30)


@pytest.mark.parametrize(("robots", "features", "whole"), [(3, 1000, 10_000.0)])
def test_the_link_drops_to_a_tenth(robots: int, features: int, whole: float) -> None:
    """Messages take less than a second again, and the fleet goes on with what the link carries."""
    limited = steered(robot_bytes_per_second=whole / 2)
    run = Weakened(limited, robots, features, whole, LONG + 1)
    assert max(run.delays[SOON:LONG]) <= 1.0
    for rates in run.rates:
        assert calm(rates) and 0.2 < min(rates[2 * SOON : LONG]) / (whole / 10) < 0.9
    assert not run.team.issued_everything()
    run.team.network.link = run.link(1.0)
    assert everything_comes(run.team)
    free = Weakened(PLAIN, robots, features, whole, 2 * SOON)
    assert min(free.delays[SOON:]) > 5.0


class Trebled:
    """Robots whose SLAM trebles its features at the step."""

    def __init__(self, config: Config, costs: Costs, features: int, cycles: int) -> None:
        self.team = Team(config, costs=costs)
        end = float(STEP + cycles)
        first, *_ = self.team.join(3, 1.0, lambda at: 3 * features if at >= STEP else features, end)
        self.loads: list[float] = []
        self.levers: list[tuple[float, float, float]] = []  # N_c, N'_f, features a cycle
        for cycle in range(STEP + cycles):
            self.team.fleet.advance(cycle + 0.5)
            controller = first.agent.steering.controller
            most = float(1 << 30)
            if cycle >= STEP:
                self.loads.append(controller.load)
                self.levers.append(
                    (controller.n_c, controller.n_f or most, controller.features or most)
                )


@pytest.mark.parametrize(
    ("costs", "features"),
    [
        (Costs(inserted=1.5e-3, sent=0.5e-3, merged=0.2e-3), 200),
        (Costs(inserted=1.5e-3, sent=0.5e-3, merged=0.2e-3), 300),
        (Costs(inserted=0.5e-3, sent=2e-3, merged=0.2e-3), 200),
        (Costs(inserted=1e-3, sent=0.5e-3, merged=0.6e-3), 170),
    ],
)
def test_the_slam_trebles_its_features(costs: Costs, features: int) -> None:
    """S < T, Eq. (2): N_c, then N'_f, then what a cycle inserts, and a warning."""
    share = 0.8
    run = Trebled(steered(cycle_share=share), costs, features, LONG + 1)
    assert max(run.loads[SOON:]) <= share < max(run.loads[:SOON])
    assert all(calm(lever) for lever in zip(*run.levers, strict=True))
    held_back = run.levers[-1][2] < 1 << 30
    assert bool(run.team.events) == held_back
    assert not run.team.issued_everything()
    assert everything_comes(run.team)
    free = Trebled(PLAIN, costs, features, 2 * SOON)
    assert min(free.loads[2:]) > 1.0
