"""One participant, as somebody with a SLAM of their own uses it."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import numpy as np
import pytest

from dagmap import Accepted, Agent, Cycle, CycleError, Issued, State
from dagmap.config import IssuanceConfig
from scene import QUICK, agent, cycles, pose

WALL = np.random.default_rng(0).uniform([2, -1, -1], [2, 1, 1], (60, 3))


def look(stamp: float, points: np.ndarray = WALL, **more: object) -> Cycle:
    return Cycle(stamp=stamp, pose=np.eye(4), points=points, **more)  # type: ignore[arg-type]


def share(*agents: Agent) -> None:
    for giver in agents:
        for out in giver.outbox():
            for taker in agents:
                if taker is not giver:
                    taker.receive(out.data, 0.0)


def test_the_ten_lines_of_the_readme_run() -> None:
    readme = (Path(__file__).parents[1] / "README.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", readme, re.S)
    assert blocks
    for block in blocks:
        exec(compile(block, "README.md", "exec"), {})


def test_two_robots_that_see_one_wall_confirm_it() -> None:
    a, b = agent("a"), agent("b")
    for robot in (a, b):
        robot.observe(look(0.0), 0.0)
    share(a, b)
    assert a.digest() == b.digest()
    world = a.map
    assert len(world) and (world.witnesses == 2).all()
    assert world.count(State.CONFIRMED) == len(world)
    assert (world.hits == 2).all() and (world.misses == 0).all()
    away = np.linalg.norm(world.positions[:, None] - WALL[None], axis=2).min(axis=1)
    assert away.max() < 0.05 + 0.001  # a mean of observations within delta


def test_events_say_what_happened() -> None:
    a = agent("a")
    events = a.observe(look(0.0), 0.0)
    accepted, issued = events
    assert isinstance(accepted, Accepted) and isinstance(issued, Issued)
    assert accepted.id == issued.id and len(accepted.data) == issued.size
    assert 0 < issued.features <= 60 and issued.bundles >= 1
    assert a.observe(look(1.0), 1.0)


def test_noise_that_nothing_supports_is_not_sent() -> None:
    a = agent("a")
    lonely = np.array([[30.0, 0, 0], [0, 40.0, 0]])
    a.observe(look(0.0, np.concatenate([WALL, lonely])), 0.0)
    for point in lonely:
        assert a.map.near(point, 1.0).size == 0
    assert len(a.map) > 30 and len(a.observing.graph) == 62


def test_frame_and_robots_are_known_to_all() -> None:
    config = msgspec.structs.replace(
        QUICK, start_pose=tuple(map(tuple, pose(5, 0, 0, np.pi / 2).tolist()))
    )
    a, b = agent("a", config), agent("b")
    assert a.frame() is None
    a.observe(Cycle(0.0, pose(1, 0, 0), WALL), 0.0)
    b.observe(look(3.5), 0.0)
    share(a, b)
    assert np.allclose(a.frame(), pose(5, 0, 0, np.pi / 2), atol=1e-3)
    assert np.allclose(b.frame(), np.eye(4))
    assert b.robots.keys() == {"a", "b"}
    place, stamp = b.robots["a"]
    assert np.allclose(place[:3, 3], [5, 1, 0], atol=2e-3) and stamp == 0.0
    assert b.robots["b"][1] == 3.5


def test_robots_without_a_known_start_stay_apart() -> None:
    unknown = msgspec.structs.replace(QUICK, start_pose=None)
    a, b = agent("a", unknown), agent("b", unknown)
    for robot in (a, b):
        robot.observe(look(0.0), 0.0)
    share(a, b)
    assert a.digest() == b.digest()
    assert a.frame() is None and a.robots.keys() == {"a"}
    assert a.map.count(State.CONFIRMED) == 0 and len(a.map) and len(b.map)


def test_what_the_slam_withdraws_leaves_every_map() -> None:
    a, b = agent("a"), agent("b")
    ids = np.arange(60)
    a.observe(look(0.0, ids=ids), 0.0)
    share(a, b)
    before = len(b.map)
    gone = [int(i) for i in ids[:20]]
    a.observe(look(1.0, WALL[:0], removed=gone), 1.0)
    share(a, b)
    assert a.digest() == b.digest()
    assert len(b.map) < before
    for point in WALL[:20]:
        nearest = b.map.near(point, 0.001)
        assert all(len(b.map.provenance(int(i))) for i in nearest)


def test_a_loop_closure_moves_the_points_with_a_short_message() -> None:
    a, b = agent("a"), agent("b")
    for i in range(4):
        a.observe(look(float(i), WALL + i * np.array([0, 0, 3])), float(i))
    share(a, b)
    features = sum(tx.features for tx in b.ledger)
    back = np.stack([pose(0, 0.5, 0)] * 4)
    a.observe(look(9.0, WALL[:0], moved=(np.arange(4.0), back)), 9.0)
    (out,) = a.outbox()
    b.receive(out.data, 9.0)
    assert len(out.data) < 600 and features > 100
    assert a.digest() == b.digest()
    world = b.map
    shifted = np.concatenate([WALL + np.array([0, 0.5, 3 * i]) for i in range(4)])
    away = np.linalg.norm(world.positions[:, None] - shifted[None], axis=2).min(axis=1)
    assert len(world) and away.max() < 0.052


def test_a_repeated_id_is_evidence_and_no_new_feature() -> None:
    a, b = agent("a"), agent("b")
    ids = np.arange(60)
    for i in range(3):
        a.observe(look(float(i), ids=ids), float(i))
    a.tick(9.0)
    share(a, b)
    assert len(a.observing.graph) == 60 and sum(tx.features for tx in b.ledger) <= 60
    assert a.digest() == b.digest()
    assert b.map.hits.max() == a.config.fold.hit_say


def test_a_new_session_starts_a_frame_of_its_own() -> None:
    a = agent("a")
    a.observe(look(5.0, ids=np.arange(60)), 0.0)
    a.observe(look(1.0, ids=np.arange(60), session=1), 1.0)
    assert a.frame() is None and len(a.map)
    counting = msgspec.structs.replace(QUICK.fold, hit_say=2)
    same = agent("s", msgspec.structs.replace(QUICK, same_origin=True, fold=counting))
    same.observe(look(5.0), 0.0)
    same.observe(look(1.0, session=1), 1.0)
    assert np.allclose(same.frame(), np.eye(4))
    assert same.map.hits.max() == 2


def test_a_budget_spreads_the_features_and_loses_none() -> None:
    paced = msgspec.structs.replace(
        QUICK, issuance=IssuanceConfig(features_per_second=20.0, seal_period=0.5)
    )
    a, free = agent("a", paced), agent("b")
    a.observe(look(0.0), 0.0)
    free.observe(look(0.0), 0.0)
    everything = sum(tx.features for tx in free.ledger)
    per_second: list[int] = []
    for step in range(1, 60):
        events = a.tick(0.25 * step)
        per_second.append(sum(e.features for e in events if isinstance(e, Issued)))
    assert sum(per_second) == everything and not a.holds_back
    for i in range(len(per_second) - 3):
        assert sum(per_second[i : i + 4]) <= 21


def test_an_agent_restored_from_its_transactions_goes_on() -> None:
    a, b = agent("a"), agent("b")
    stream = list(cycles(3, count=6, churn=False))
    for cycle in stream[:3]:
        a.observe(cycle, cycle.stamp)
    share(a, b)
    again = Agent.restore(a.identity, a.config, [tx.data for tx in a.ledger])
    assert again.digest() == a.digest() and not again.outbox()
    with pytest.raises(CycleError, match="rise"):
        again.observe(stream[1], 9.0)
    again.observe(stream[4], 10.0)
    share(again, b)
    assert again.digest() == b.digest()
    assert b.ledger.chain(a.identity.author).cut is None


BAD = {
    "nan": (look(1.0, [[0, 0, np.nan]]), "not finite"),
    "far": (look(1.0, [[0, 0, 1e6]]), "beyond"),
    "shape": (look(1.0, [[0, 0]]), r"\(N, 3\)"),
    "text": (look(1.0, [["a", "b", "c"]]), "numbers"),
    "scaled pose": (Cycle(1.0, 2 * np.eye(4), WALL), "rigid"),
    "mirrored pose": (Cycle(1.0, np.diag([1, 1, -1, 1.0]), WALL), "rigid"),
    "pose shape": (Cycle(1.0, np.eye(3), WALL), r"\(4, 4\)"),
    "pose nan": (Cycle(1.0, np.full((4, 4), np.nan), WALL), "finite"),
    "pose out": (Cycle(1.0, pose(536870, 0, 0), [[100.0, 0, 0]]), "drop"),
    "same stamp": (look(0.0), "rise"),
    "stamp nan": (look(float("nan")), "finite"),
    "unknown id": (look(1.0, removed=[999]), "999"),
    "twice": (look(1.0, removed=[3, 3]), "twice"),
    "too few ids": (look(1.0, ids=[1, 2]), "one id a point"),
    "negative ids": (look(1.0, [[0, 0, 1]], ids=[-1]), "whole numbers"),
    "colors": (look(1.0, colors=np.zeros((60, 3))), "uint8"),
    "moved unknown": (look(1.0, moved=([7.0], np.eye(4)[None])), "7.0"),
    "moved shape": (look(1.0, moved=([0.0], np.eye(4))), "moved"),
    "session": (look(1.0, session=-1), "session"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_cycle_is_told_plainly_and_changes_nothing(name: str) -> None:
    a = agent("a")
    a.observe(look(0.0, ids=np.arange(60)), 0.0)
    a.outbox()
    digest, features, waiting = a.digest(), len(a.observing.graph), a.holds_back
    cycle, text = BAD[name]
    with pytest.raises(CycleError, match=text):
        a.observe(cycle, 1.0)
    assert (a.digest(), len(a.observing.graph), a.holds_back) == (digest, features, waiting)
    assert not a.outbox()
    a.observe(look(2.0, ids=np.arange(100, 160)), 2.0)
    assert a.outbox()


def test_an_id_withdrawn_twice_is_told() -> None:
    a = agent("a")
    a.observe(look(0.0, ids=np.arange(60)), 0.0)
    a.observe(look(1.0, WALL[:0], removed=[5]), 1.0)
    with pytest.raises(CycleError, match="removed before"):
        a.observe(look(2.0, WALL[:0], removed=[5]), 2.0)


def test_an_empty_cycle_is_a_pose_and_nothing_else() -> None:
    a, b = agent("a"), agent("b")
    a.observe(Cycle(0.0, pose(1, 2, 3), np.zeros((0, 3))), 0.0)
    a.observe(Cycle(1.0, pose(2, 2, 3), []), 1.0)
    a.tick(5.0)
    share(a, b)
    assert len(b.map) == 0 and a.digest() == b.digest()
    b.observe(look(0.0), 0.0)
    assert np.allclose(b.robots["a"][0], pose(2, 2, 3))


def test_one_point_and_extreme_points() -> None:
    edge = (1 << 29) / 1000
    a, b = agent("a"), agent("b")
    corners = np.array(
        [[x, y, z] for x in (-edge, edge) for y in (-edge, edge) for z in (-edge, edge)]
    )
    a.observe(look(0.0, [[0, 0, 0]]), 0.0)
    a.observe(look(1.0, np.repeat(corners, 20, axis=0)), 1.0)
    share(a, b)
    assert a.digest() == b.digest()
    assert len(b.map) == 8


class TestRepeats:
    """A robot that goes its round again and again does not say for ever what it has said."""

    def rounds(self, repeats: int, count: int = 12) -> list[int]:
        issuance = IssuanceConfig(repeats=repeats)
        robot = agent("a", msgspec.structs.replace(QUICK, issuance=issuance))
        said = []
        for k in range(count):
            events = robot.observe(look(float(k)), float(k))
            robot.tick(k + 0.5)
            said.append(sum(event.features for event in events if isinstance(event, Issued)))
        return said

    def test_what_was_said_often_enough_is_not_said_again(self) -> None:
        said = self.rounds(repeats=3)
        assert min(said[:3]) > 0 and sum(said[4:]) == 0

    def test_unless_it_is_to_say_everything(self) -> None:
        assert min(self.rounds(repeats=0)) > 0

    def test_what_the_fleet_confirms_is_said_once(self) -> None:
        graph = msgspec.structs.replace(QUICK.graph, v_th=1)
        a, b = (agent(name, msgspec.structs.replace(QUICK, graph=graph)) for name in "ab")
        for robot in (a, b):
            robot.observe(look(0.0), 0.0)
        share(a, b)
        a.tick(0.5)
        events = a.observe(look(1.0), 1.0)
        assert not any(event.features for event in events if isinstance(event, Issued))
        assert len(a.observing.graph) == len(WALL), "the graph does not grow either"

    def test_what_is_withdrawn_is_worth_saying_again(self) -> None:
        issuance = IssuanceConfig(repeats=1)
        robot = agent("a", msgspec.structs.replace(QUICK, issuance=issuance))
        ids = np.arange(len(WALL))
        robot.observe(look(0.0, ids=ids), 0.0)
        robot.tick(0.5)
        robot.observe(look(1.0, ids=ids + 1000), 1.0)  # known: left out, its ids kept in mind
        robot.observe(look(2.0, WALL[:0], removed=ids + 1000), 2.0)
        robot.observe(look(3.0, WALL[:0], removed=ids), 3.0)
        robot.tick(3.5)
        events = robot.observe(look(4.0, ids=ids + 2000), 4.0)
        assert any(event.features for event in events if isinstance(event, Issued))
