"""Section 5: traffic is shaped and capped, and S stays below T, in simulated time."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from dagmap import Agent, Config, Cycle, Issued, Overloaded
from dagmap.config import IssuanceConfig, OverheadConfig
from dagmap.sim.network import Link
from dagmap.sim.robot import Costs
from scene import agent
from team import PLAIN, Team, steered, worst_window


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
