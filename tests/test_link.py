"""The rate of a robot's link, over hundreds of cycles, with several loads and links.

Announcements, tokens, shaping and steering are the real ones; instead of a map there are bytes.
"""

from __future__ import annotations

import heapq
import random
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median

import pytest

from dagmap import Config
from dagmap.config import OverheadConfig
from dagmap.ledger import Ledger
from dagmap.messages import Heads, Parsers, Transactions
from dagmap.shaping import Urgency
from dagmap.steering import Steering
from dagmap.sync import Sync
from team import turns

TICK, PERIOD, STEP = 0.2, 5.0, 50.0  # s; when the link drops
SOON, CALM = 10, 100  # cycles


class Robot:
    """One that has so many bytes to say each cycle."""

    def __init__(self, number: int, config: Config, load: float) -> None:
        self.me, self.load, self.waiting = bytes([number]) * 8, load, 0.0
        self.sync = Sync(Ledger(config), config, self.me)
        self.steering = Steering(config, self.me)
        self.free = 0.0  # when its radio has sent what it holds
        self.steering.controller.period = PERIOD

    def tick(self, now: float, chance: random.Random) -> list[bytes]:
        self.steering.look(self.sync, now)
        room = self.steering.shaper.room(now)
        assert room is not None
        size = min(room * chance.uniform(0.8, 1.2), 12_000.0, self.waiting)
        if size >= 100:
            self.waiting -= size
            self.steering.post([(Transactions((bytes(int(size) + 200),)), None)], Urgency.OWN)
        self.steering.announce(self.sync, now, False)
        self.steering.shaper.release(now)
        return [out.data for out in self.steering.shaper.take()]


@dataclass
class Radio:
    """Robots, and links that drop to a tenth at `STEP`, and are whole again after `back` cycles."""

    config: Config
    robots: int
    whole: float  # bytes/s
    load: float  # bytes a cycle
    loss: float = 0.0
    way: tuple[float, float] = (0.002, 0.02)  # s
    back: int = 10**9
    rates: list[list[float]] = field(default_factory=list)  # each cycle since, of each robot
    queues: list[float] = field(default_factory=list)  # s, the longest

    def run(self, cycles: int) -> None:
        chance, parsers, number = random.Random(1), Parsers(), 0
        robots = [Robot(i, self.config, self.load) for i in range(self.robots)]
        air: list[tuple[float, int, Robot, Robot, Heads]] = []
        for tick in range(round((STEP + cycles * PERIOD) / TICK)):
            now = tick * TICK
            since = (now - STEP) / PERIOD
            carries = self.whole * (0.1 if 0 <= since < self.back else 1.0)
            while air and air[0][0] <= now:
                at, _, sender, receiver, heads = heapq.heappop(air)
                list(receiver.sync.heard(sender.me, heads, at))
            for robot in robots:
                if tick % round(PERIOD / TICK) == 0:
                    robot.waiting += robot.load * chance.uniform(0.7, 1.3)
                for data in robot.tick(now, chance):
                    robot.free = max(robot.free, now) + len(data) / carries
                    _, message = parsers.message(data, self.config)
                    for other in robots if isinstance(message, Heads) else ():
                        if other is not robot and chance.random() >= self.loss:
                            number += 1
                            at = robot.free + chance.uniform(*self.way)
                            heapq.heappush(air, (at, number, robot, other, message))
            if since >= 0 and tick % round(PERIOD / TICK) == 0:
                self.rates.append([robot.steering.shaper.rate or 0.0 for robot in robots])
                self.queues.append(max(robot.free - now for robot in robots))


def capped(cap: float) -> Config:
    return Config(overhead=OverheadConfig(robot_bytes_per_second=cap))


CASES = [
    Radio(capped(7_500.0), 3, 15_000.0, 15_000.0),
    Radio(capped(7_500.0), 3, 15_000.0, 60_000.0),
    Radio(capped(7_500.0), 2, 15_000.0, 9_000.0),
    Radio(capped(75_000.0), 3, 150_000.0, 250_000.0),
    Radio(capped(75_000.0), 3, 150_000.0, 250_000.0, way=(0.1, 0.3)),
]


@pytest.mark.parametrize("case", range(len(CASES)))
def test_a_link_that_drops_is_used_calmly_for_long(case: int) -> None:
    radio = CASES[case]
    radio.run(300)
    assert max(radio.queues[SOON:]) < 3.0  # s: no queue builds up, and trials end in time
    for rates in zip(*radio.rates, strict=True):
        assert turns(rates[SOON : SOON + CALM]) <= 1
        whole = [turns(rates[at : at + CALM]) for at in range(SOON, 300 - CALM)]
        assert max(whole) <= 2  # a trial that failed long after the step
        assert median(rates[2 * SOON :]) > 0.15 * radio.whole / 10  # least where tokens take long
        assert max(rates[SOON:]) < 2 * radio.whole / 10


@pytest.mark.parametrize("way", [(0.002, 0.02), (0.6, 0.62)])
def test_a_link_that_is_whole_again_is_used(way: tuple[float, float]) -> None:
    """Tokens that come back soon show it at once; else it is tried."""
    radio = Radio(capped(75_000.0), 3, 150_000.0, 250_000.0, way=way, back=40)
    radio.run(200)
    for rates in zip(*radio.rates, strict=True):
        assert max(rates[SOON:40]) < 20_000.0 and rates[-1] > 60_000.0
        assert all(b >= a for a, b in pairwise(rates[SOON:]))


def test_thirty_robots_that_share_little_still_count_each_other() -> None:
    """Each announces itself seldom then; who is forgotten would get a share too much."""
    config = Config(overhead=OverheadConfig(fleet_bytes_per_second=20_000.0))
    radio = Radio(config, 30, 1e6, 10_000.0)
    radio.run(30)
    assert all(rate == pytest.approx(600.0) for rates in radio.rates for rate in rates)
