"""What ids stand for, and withdrawals and moves in bounded steps."""

from __future__ import annotations

import random

import msgspec
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from chains import CONFIG
from dagmap import Agent, Cycle, Identity
from dagmap.config import IssuanceConfig
from dagmap.naming import UNKNOWN, Naming
from dagmap.observing import REARRANGED

SILENT = msgspec.structs.replace(CONFIG, issuance=IssuanceConfig(features_per_second=0.1))
IDS = st.integers(0, (1 << 64) - 1) | st.integers(0, 40)
TASKS = st.lists(
    st.tuples(st.sampled_from(["put", "take", "get"]), st.lists(IDS, max_size=60)), max_size=25
)


def ids_of(values: list[int]) -> np.ndarray:
    return np.array(values, np.uint64)


@given(TASKS, st.integers(0, (1 << 62) - 1))
@settings(deadline=None)
def test_naming_answers_as_a_dict_does(tasks: list[tuple[str, list[int]]], salt: int) -> None:
    naming, twin = Naming(salt), dict[int, int]()
    for i, (task, ids) in enumerate(tasks):
        if task == "put":
            numbers = [100 * i + k - 3 for k in range(len(ids))]
            naming.put(ids_of(ids), np.array(numbers, np.int64))
            twin.update(zip(ids, numbers, strict=True))
        elif task == "take":
            ids = list(dict.fromkeys(ids))
            found = naming.take(ids_of(ids)).tolist()
            assert found == [twin.pop(id_, UNKNOWN) for id_ in ids]
        else:
            assert naming.get(ids_of(ids)).tolist() == [twin.get(id_, UNKNOWN) for id_ in ids]
        assert len(naming) == len(twin)
    every = [id_ for _, ids in tasks for id_ in ids]
    assert naming.get(ids_of(every)).tolist() == [twin.get(id_, UNKNOWN) for id_ in every]


def test_naming_holds_many_in_a_row_and_gives_them_back() -> None:
    naming, ids = Naming(7), np.arange(5000, dtype=np.uint64) << np.uint64(40)
    naming.put(ids, np.arange(5000))
    naming.take(ids[::2])
    assert (naming.get(ids[::2]) == UNKNOWN).all() and len(naming) == 2500
    assert (naming.get(ids[1::2]) == np.arange(1, 5000, 2)).all()


def at(x: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


@given(st.randoms(use_true_random=False))
@settings(max_examples=25, deadline=None)
def test_whatever_is_removed_and_moved_at_once_ends_where_it_belongs(rng: random.Random) -> None:
    """Small steps, new ones before the old are done: the DAG ends with the points that are left,
    each where its cycle lies by its newest pose."""
    agent, numbers = Agent(Identity.from_seed(bytes(32)), SILENT), np.random.default_rng(1)
    step = agent.observing._arrangement.step
    points: dict[int, tuple[int, np.ndarray]] = {}  # cycle and place of each id that is left
    poses: list[float] = []
    for cycle in range(rng.randint(2, 8)):
        count = rng.randint(0, 30)
        ids = np.arange(100 * cycle, 100 * cycle + count, dtype=np.uint64)
        places = np.round(numbers.uniform(0, 1, (count, 3)), 3)
        gone = rng.sample(sorted(points), rng.randint(0, len(points)))
        moved = rng.sample(range(cycle), rng.randint(0, cycle))
        for other in moved:
            poses[other] = float(rng.randint(0, 50))
        back = ([float(i) for i in moved], np.array([at(poses[i]) for i in moved]))
        agent.observing.rearrange = lambda: None  # type: ignore[method-assign]
        agent.observe(
            Cycle(float(cycle), at(0.0), places, ids=ids, removed=gone,
                  moved=back if moved else None),
            float(cycle),
        )  # fmt: skip
        for id_ in gone:
            del points[id_]
        points.update({int(id_): (cycle, place) for id_, place in zip(ids, places, strict=True)})
        poses.append(0.0)
        for _ in range(rng.randint(0, 4)):
            step(rng.randint(1, 40))
    for _ in range(10_000):
        if not agent.observing.rearranging:
            break
        step(rng.randint(1, 40))
    assert not agent.observing.rearranging
    graph = agent.observing.graph
    wanted = {
        id_: np.round(1000 * (place + at(poses[cycle])[:3, 3])).astype(int).tolist()
        for id_, (cycle, place) in points.items()
    }
    nodes = {id_: agent.observing.node_of(id_) for id_ in points}
    assert {id_: graph.positions([node])[0].tolist() for id_, node in nodes.items()} == wanted
    assert sorted(nodes.values()) == np.flatnonzero(graph.alive()).tolist()


def test_a_step_costs_no_more_than_was_said() -> None:
    agent = Agent(Identity.from_seed(bytes(32)), SILENT)
    points = np.random.default_rng(1).uniform(0, 3, (3000, 3))
    for cycle in range(4):
        agent.observe(Cycle(float(cycle), np.eye(4), points), float(cycle))
    moved = ([0.0, 1.0, 2.0], np.array([at(5.0)] * 3))
    graph = agent.observing.graph
    before, most = len(graph), 0
    agent.observe(Cycle(9.0, np.eye(4), points[:0], moved=moved), 9.0)
    while agent.observing.rearranging:
        most, before = max(most, len(graph) - before), len(graph)
        agent.observing.rearrange()
    assert 0 < most <= REARRANGED // 3 + 1
    assert len(graph) == 21_000 and int(graph.alive().sum()) == 12_000
