"""The read side: queries answer what a scan over all nodes would."""

from __future__ import annotations

import numpy as np
import pytest

from dagmap import State, WorldMap
from scene import agent, cycles


@pytest.fixture(scope="module")
def maps() -> tuple[WorldMap, WorldMap]:
    """A map half-way, and at the end, of two robots."""
    a, b = agent("a"), agent("b")
    streams = [list(cycles(seed, count=6)) for seed in (1, 2)]
    half = None
    for step in range(6):
        for robot, other, stream in ((a, b, streams[0]), (b, a, streams[1])):
            robot.observe(stream[step], float(step))
            for out in robot.outbox():
                other.receive(out.data, float(step))
        half = half or (a.map if step == 3 else None)
    return half, a.map


def test_columns_belong_together(maps: tuple[WorldMap, WorldMap]) -> None:
    _, world = maps
    n = len(world)
    assert n > 50 and world.positions.shape == (n, 3) and world.colors.shape == (n, 3)
    rejected = 2 * world.hits <= world.hits + world.misses
    confirmed = ~rejected & (world.witnesses >= 2)
    assert np.array_equal(world.states == State.REJECTED, rejected)
    assert np.array_equal(world.states == State.CONFIRMED, confirmed)
    assert sum(world.count(state) for state in State) == n
    assert world.count(State.CONFIRMED) and world.count(State.TENTATIVE)


def test_a_map_cannot_be_changed(maps: tuple[WorldMap, WorldMap]) -> None:
    for name in ("positions", "hits", "misses", "witnesses", "states", "colors"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(maps[1], name)[:] = 0


@pytest.mark.parametrize("radius", [0.0, 0.1, 0.7, 100.0])
def test_near_finds_what_a_scan_finds(maps: tuple[WorldMap, WorldMap], radius: float) -> None:
    world, rng = maps[1], np.random.default_rng(4)
    for point in [*rng.uniform(-3, 3, (40, 3)), world.positions[5], [1e6, 0, 0]]:
        away = np.linalg.norm(world.positions - point, axis=1)
        expected = [int(i) for i in np.argsort(away, kind="stable") if away[i] <= radius]
        expected = [i for i in expected if world.kept[i]]
        assert world.near(point, radius).tolist() == expected


def test_within_and_occupied(maps: tuple[WorldMap, WorldMap]) -> None:
    world = maps[1]
    low, high = [1.9, -1, -1], [2.1, 1, 1]
    found = world.within((low, high))
    inside = ((world.positions >= low) & (world.positions <= high)).all(axis=1) & world.kept
    assert found.tolist() == np.flatnonzero(inside).tolist() and len(found)
    kept = world.positions[world.kept]
    assert world.occupied(kept).all()
    assert not world.occupied(kept + 50.0).any() and len(world.occupied(np.zeros((0, 3)))) == 0


def test_provenance_names_every_observation(maps: tuple[WorldMap, WorldMap]) -> None:
    world = maps[1]
    counts = [len(world.provenance(i)) for i in range(len(world))]
    assert counts == world.counts.tolist()
    robots = [{o.robot for o in world.provenance(i)} for i in range(len(world))]
    assert [len(r) for r in robots] == world.witnesses.tolist()
    assert set.union(*robots) == {"a", "b"}
    assert all(0.0 <= o.stamp <= 5.0 for i in range(20) for o in world.provenance(i))
    with pytest.raises(IndexError):
        world.provenance(len(world))


def test_diff_tells_what_is_new(maps: tuple[WorldMap, WorldMap]) -> None:
    before, after = maps
    diff = after.diff(before)
    old = {tuple(s) for s in before.seeds.tolist()}
    new = {tuple(s) for s in after.seeds.tolist()}
    assert len(diff.added) == len(new - old) > 0
    assert len(diff.removed) == len(old - new)
    assert len(diff.changed) > 0
    same = after.diff(after)
    assert len(same.added) == len(same.removed) == len(same.changed) == 0


def test_an_empty_map_answers_too() -> None:
    world = agent("nobody").map
    assert len(world) == 0 and world.near([0, 0, 0], 5.0).size == 0
    assert world.within(([-1] * 3, [1] * 3)).size == 0
    assert not world.occupied([[0.0, 0, 0]]).any()
