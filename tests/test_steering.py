"""Section 5: traffic is shaped and capped, and S stays below T, in simulated time."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from itertools import pairwise

import msgspec
import numpy as np
import pytest

from dagmap import Agent, Config, Cycle, GraphConfig, Issued, Overloaded
from dagmap.config import IssuanceConfig, OverheadConfig, TransactionConfig
from dagmap.sim.fleet import Fleet
from dagmap.sim.network import Link, Network
from dagmap.sim.robot import Costs, Happening, Robot, Timed
from scene import agent

PLAIN = Config(
    transaction=TransactionConfig(proof_of_work_bits=0),
    graph=GraphConfig(reference_pitch=0.25, max_parent_distance=0.75),
    issuance=IssuanceConfig(repeats=0),
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


def turns(values: list[float]) -> int:
    """How often a series changes its direction."""
    steps = [b > a for a, b in pairwise(values) if a != b]
    return sum(a != b for a, b in pairwise(steps))


def peak_to_mean(pairs: list[tuple[float, int]], seconds: int) -> float:
    bins = np.zeros(seconds + 5)
    for at, count in pairs:
        bins[int(at)] += count
    return float(bins.max() / bins[:seconds].mean())


def test_a_long_cycle_goes_out_spread_over_its_time() -> None:
    """Figure 11: T = 5 s, the same features, a third of the peaks."""
    config = msgspec.structs.replace(PLAIN, issuance=IssuanceConfig(repeats=0, cycle_period=5.0))
    team = Team(config)
    robots = team.join(2, 5.0, lambda at: 300, 60.0)
    team.fleet.advance(64.0)
    for robot in robots:
        assert robot.issued == robot.observed == 12 * 300
        without = peak_to_mean(robot.observed_at, 60)
        assert without == pytest.approx(5.0)
        assert peak_to_mean(robot.issued_at, 60) <= without / 3


def test_a_short_cycle_goes_out_at_once() -> None:
    team = Team(PLAIN)
    (robot,) = team.join(1, 0.5, lambda at: 200, 5.0)
    team.fleet.advance(6.0)
    assert robot.issued_at == robot.observed_at


def test_a_cycle_that_comes_early_does_not_make_a_burst() -> None:
    config = msgspec.structs.replace(PLAIN, issuance=IssuanceConfig(repeats=0, cycle_period=5.0))
    a = agent("a", config)
    rng = np.random.default_rng(1)
    sent = []
    for tenth in range(200):
        now = tenth / 10
        events = a.tick(now)
        if tenth in (0, 50, 62, 112):
            events += a.observe(Cycle(now, np.eye(4), rng.uniform(1, 3, (500, 3))), now)
        sent += [event.features for event in events if isinstance(event, Issued)]
    assert sum(sent) == 2000 and max(sent) <= 300


def test_what_is_spread_is_not_lost_where_the_slam_ends() -> None:
    config = msgspec.structs.replace(PLAIN, issuance=IssuanceConfig(repeats=0, cycle_period=9.0))
    a = agent("a", config)
    points = np.random.default_rng(1).uniform(1, 3, (500, 3))
    a.observe(Cycle(0.0, np.eye(4), points), 0.0)
    assert a.holds_back and 64 <= a.ledger.features(a.identity.author) < 100
    for tick in range(1, 11):
        a.tick(float(tick))
    assert not a.holds_back and a.ledger.features(a.identity.author) == 500


@pytest.mark.parametrize("cap", [1000, 8000, 30_000])
def test_a_cap_holds_over_any_five_seconds(cap: int) -> None:
    """With everything that the robot sends: answers to a newcomer and announcements too."""
    team = Team(steered(robot_bytes_per_second=cap), Link(loss=0.1))
    team.join(2, 2.0, lambda at: cap // 3, 20.0)
    team.fleet.advance(20.0)
    team.fleet.join("late")
    team.fleet.advance(40.0)
    for out in team.sent.values():
        assert worst_window(out) <= 1.05 * 5 * cap
    for name in ("r0", "r1"):  # and what is allowed is used
        assert sum(size for at, size in team.sent[name]) > 0.6 * 20 * cap
    newcomer = team.fleet.robots["late"].agent
    assert len(newcomer.ledger) > 0


@pytest.mark.parametrize("cap", [500, 1000])
def test_an_answer_larger_than_the_cap_of_seconds_goes_out_all_the_same(cap: int) -> None:
    """And does not keep what the robot has to say itself."""
    capped = msgspec.structs.replace(
        PLAIN, overhead=OverheadConfig(robot_bytes_per_second=float(cap))
    )
    theirs, own = np.random.default_rng(5).uniform([2, -1, -1], [3, 1, 1], (2, 1200, 3))
    speaker, robot, newcomer = agent("speaker"), agent("robot", capped), agent("newcomer")
    speaker.observe(Cycle(0.0, np.eye(4), theirs), 0.0)
    for out in speaker.outbox():
        robot.receive(out.data, 0.0)
    (large,) = speaker.ledger
    assert len(large.data) > 4 * cap and large.id in robot.ledger
    robot.observe(Cycle(0.0, np.eye(4), own[:100] + 10.0), 0.0)
    sent: list[tuple[float, int]] = []
    for step in range(600):
        now = 0.1 * step
        for giver, taker in ((robot, newcomer), (newcomer, robot)):
            giver.tick(now)
            for out in giver.outbox():
                if giver is robot:
                    sent.append((now, len(out.data)))
                taker.receive(out.data, now)
    assert {tx.id for tx in newcomer.ledger} == {tx.id for tx in robot.ledger}
    assert robot.ledger.features(robot.identity.author) > 50
    most = max(5 * cap, len(large.data) + 100)  # one message is not cut in two
    assert worst_window(sent) <= 1.05 * most


def test_what_is_new_to_the_fleet_goes_first() -> None:
    """Half of what the robot sees stands in the map already; the budget is for a fifth."""
    rng = np.random.default_rng(3)
    old, new = (
        rng.uniform([2, -2, -1], [3, 0, 1], (300, 3)),
        rng.uniform([2, 0.5, -1], [3, 2.5, 1], (300, 3)),
    )
    config = msgspec.structs.replace(
        PLAIN, issuance=IssuanceConfig(repeats=0, features_per_second=120.0, seal_period=0.0)
    )
    a, b = agent("a", config), agent("b", PLAIN)
    b.observe(Cycle(0.0, np.eye(4), old), 0.0)
    for out in b.outbox():
        a.receive(out.data, 0.0)
    a.tick(0.0)
    both = np.concatenate([new, old])
    a.observe(Cycle(0.0, np.eye(4), both[rng.permutation(600)]), 0.0)
    a.tick(1.0)
    assert a.ledger.features(a.identity.author) == 120
    grown = len(a.map) - len(b.map)
    assert grown >= 110  # nodes where there were none; a bundle may carry an old ascendant
    for second in range(2, 7):
        a.tick(float(second))
    assert a.ledger.features(a.identity.author) == 600


def test_robots_double_and_the_fleet_stays_under_its_capacity() -> None:
    """Eq. (6): the robots share C_Th, however many there are."""
    capacity, period = 10_000.0, 4.0

    def fly(config: Config, cycles: int) -> Team:
        team = Team(config)
        first = team.join(3, period, lambda at: 900, 60.0)
        team.fleet.advance(40.0)
        rates.append(first[0].agent.steering.shaper.rate or 0.0)
        team.join(3, period, lambda at: 900, 60.0)
        for cycle in range(cycles):
            team.fleet.advance(40.0 + period * (cycle + 1))
            rates.append(first[0].agent.steering.shaper.rate or 0.0)
        return team

    rates: list[float] = []
    team = fly(steered(fleet_bytes_per_second=capacity), 100)
    for start in np.arange(40.0 + 10 * period, 440.0, period):
        assert team.bytes_in(start, start + period) <= capacity * period
    assert rates[0] == pytest.approx(2 * rates[-1]) and turns(rates) <= 1
    assert team.issued_everything()
    free = fly(PLAIN, 5)
    busy = [free.bytes_in(at, at + period) for at in (44.0, 48.0, 52.0)]
    assert min(busy) > capacity * period


def test_a_link_that_drops_to_a_tenth_is_relieved() -> None:
    period, whole = 5.0, 15_000.0

    def fly(config: Config, cycles: int) -> tuple[Team, list[float], list[float]]:
        team = Team(config, Link(bandwidth=whole, queue=1 << 30))
        first = team.join(3, period, lambda at: 1500, 150.0)[0]
        team.fleet.advance(50.0)
        team.network.link = Link(bandwidth=whole / 10, queue=1 << 30)
        delays, rates = [], []
        for cycle in range(cycles):
            team.fleet.advance(50.0 + period * (cycle + 1))
            delays.append(first.agent.sync.delay(team.fleet.now) or 0.0)
            rates.append(first.agent.steering.shaper.rate or 0.0)
        return team, delays, rates

    team, delays, rates = fly(steered(robot_bytes_per_second=7_500.0), 100)
    assert max(delays[10:]) <= 1.0
    assert whole / 100 < rates[10] < whole / 10 and turns(rates) <= 1
    team.network.link = Link(bandwidth=whole, queue=1 << 30)
    team.fleet.advance(team.fleet.now + 250.0)
    assert team.issued_everything()
    _, delays, _ = fly(PLAIN, 12)
    assert min(delays[9:]) > 5.0


def test_a_slam_that_trebles_its_features_does_not_take_the_cycle() -> None:
    """S < T, Eq. (2): N_c, then N'_f, then what a cycle inserts, and a warning."""
    costs, share = Costs(inserted=1.5e-3, sent=0.5e-3, merged=0.2e-3), 0.8

    def count(at: float) -> int:
        return 600 if 20.0 <= at < 45.0 else 200

    def fly(config: Config, cycles: int) -> tuple[Team, list[float], list[float]]:
        team = Team(config, costs=costs)
        first = team.join(3, 1.0, count, 160.0)[0]
        loads, features = [], []
        for cycle in range(cycles):
            team.fleet.advance(1.0 * cycle + 0.5)
            controller = first.agent.steering.controller
            loads.append(controller.load)
            features.append(float(controller.features or 1 << 20))
        return team, loads, features

    team, loads, features = fly(steered(cycle_share=share), 140)
    assert max(loads[30:]) <= share < max(loads[20:30])  # ten cycles after the step
    assert team.events and team.events[0].features is not None and team.events[0].load > share
    assert turns(features[20:120]) <= 1
    team.fleet.advance(300.0)
    assert team.issued_everything()
    _, loads, _ = fly(PLAIN, 45)
    assert min(loads[22:44]) > 1.0


def test_nothing_is_limited_unless_it_is_asked_for() -> None:
    costs = Costs(inserted=1.0, sent=1.0, merged=1.0)
    team = Team(PLAIN, costs=costs)
    (robot,) = team.join(1, 1.0, lambda at: 50, 10.0)
    team.fleet.advance(11.0)
    controller = robot.agent.steering.controller
    assert controller.load > 1 and not team.events
    assert controller.rate is None and controller.features is None and controller.n_f is None
    assert robot.agent.observing.graph.n_c == PLAIN.graph.n_c
    assert robot.issued_at == robot.observed_at


def overloaded(points: int, ids: np.ndarray | None, config: Config) -> Agent:
    """An agent that inserts 64 points a cycle, after a cycle of so many points."""
    a = agent("a", config)
    rng = np.random.default_rng(5)
    for second in range(12):
        a.observe(Cycle(float(second), np.eye(4), rng.uniform(1, 3, (100, 3))), float(second))
        a.took(5.0)
    assert a.steering.controller.features == 64
    a.observe(Cycle(12.0, np.eye(4), rng.uniform(1, 3, (points, 3)), ids=ids), 12.0)
    return a


def test_points_left_for_later_may_be_removed_moved_and_seen_again() -> None:
    ids = np.arange(300, dtype=np.uint64)
    a = overloaded(300, ids, steered(cycle_share=0.5))
    waits = [i for i in range(300) if a.observing.node_of(i) < 0]
    assert len(waits) == 300 - 64
    moved = np.eye(4)
    moved[0, 3] = 0.5
    back = (np.array([12.0]), moved[None])
    again, gone = waits[:50], waits[50:80]
    place = np.random.default_rng(6).uniform(1, 3, (50, 3))
    a.observe(Cycle(13.0, np.eye(4), place, ids=np.array(again), removed=gone, moved=back), 13.0)
    for second in range(14, 200):
        a.tick(float(second))
    assert not a.holds_back and len(a.observing.backlog) == 0
    assert all(a.observing.node_of(i) < 0 for i in gone)
    kept = [i for i in range(300) if i not in gone]
    nodes = np.array([a.observing.node_of(i) for i in kept])
    assert (nodes >= 0).all() and len(set(nodes.tolist())) == len(kept)
    late = np.array([a.observing.node_of(i) for i in waits[80:]])
    places = a.observing.graph.positions(late) / 1000.0
    assert places[:, 0].min() > 1.45  # they were inserted where the closure put their cycle
    assert a.ledger.features(a.identity.author) == 12 * 100 + 270


def test_a_new_session_first_takes_what_was_left_for_later() -> None:
    a = overloaded(300, None, steered(cycle_share=0.5))
    assert len(a.observing.backlog) > 200
    a.observe(Cycle(0.0, np.eye(4), np.ones((1, 3)), session=1), 13.0)
    assert len(a.observing.backlog) == 0
    for second in range(14, 60):
        a.tick(float(second))
    assert a.ledger.features(a.identity.author) == 12 * 100 + 301


def test_the_room_for_later_is_bounded_and_what_is_lost_is_told() -> None:
    config = steered(cycle_share=0.5, backlog=100)
    a = overloaded(300, None, config)
    assert len(a.observing.backlog) == 100
    events = a.observe(Cycle(13.0, np.eye(4), np.ones((1, 3))), 13.0)
    told = [event for event in events if isinstance(event, Overloaded)]
    assert told and told[0].dropped > 0 and told[0].waiting == 100
