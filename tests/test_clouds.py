"""What robots have published, for a look at its shape: bounded, whatever somebody publishes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from chains import CONFIG, Author, anchor, bundle
from dagmap import clouds, surfels
from dagmap.clouds import Cloud
from dagmap.consensus import Consensus
from dagmap.kernels.voxels import LONGEST, SHIFT, pass_through
from dagmap.ledger import Ledger
from dagmap.payload import Bundle, Payload
from dagmap.surfaces import Surfaces
from dagmap.surfels import survey


def read(author: Author) -> Cloud:
    """The cloud of all that an author has signed."""
    ledger, cloud = Ledger(CONFIG), Cloud()
    for tx in author.chain:
        assert ledger.add(tx).accepted
    while cloud.read_on(ledger.chain(author.identity.author), CONFIG) >= 0:
        pass
    return cloud


def scattered(base: int, count: int) -> Bundle:
    """Each feature in a cycle of its own."""
    one, starts = bundle(base, count), np.arange(count + 1, dtype=np.int64)
    cycles = np.arange(base, base + count, dtype=np.int64)
    return Bundle(
        base, one.position, one.parents, one.color, starts, cycles, np.zeros(count, np.uint8)
    )


def test_of_points_in_ever_new_cycles_a_share_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clouds, "MOST_POINTS", 50)
    author = Author("ann")
    for base in range(0, 1000, 10):
        anchors = tuple(anchor(cycle) for cycle in range(base, base + 10))
        author.make(payload=Payload(anchors=anchors, bundle=scattered(base, 10)))
    points, _, _ = read(author).gather(0, 1.0)
    assert 25 <= len(points) <= 50
    assert np.ptp(points[:, 0]) > 1500, "from the whole way"


def test_what_is_withdrawn_twice_costs_nothing_more() -> None:
    author = Author("ann")
    author.make(features=6)
    for numbers in ([1, 4], [4], [1, 4, 5]):
        author.make(payload=Payload(retracted=np.array(numbers, np.int64)))
    cloud = read(author)
    points, origins, groups = cloud.gather(0, 1.0)
    assert points.tolist() == bundle(0, 6).position[[0, 2, 3]].tolist()
    assert len(origins) == len(groups) == 3
    author.make(features=3)
    assert len(read(author).gather(0, 1.0)[0]) == 6


@pytest.mark.parametrize("odd", [0, 1])
def test_points_at_the_ends_of_the_world_have_no_shape(odd: int) -> None:
    """Whoever says so must not stop the robot that looks at it."""
    rng = np.random.default_rng(0)
    away = np.array([5e8, 5e8, 5e8])
    points = np.concatenate([rng.uniform(0, 900, (300 + odd, 3)) + away, -away + np.eye(300, 3)])
    assert (
        finished(survey(points, np.zeros_like(points), np.zeros(len(points), int), 100.0)) is None
    )


def test_of_a_ray_from_far_away_its_end_is_looked_at() -> None:
    """Sensors stand where their robots say: a ray costs no more than a LiDAR's can."""
    shape, passes = np.array([3 * LONGEST, 1, 1], np.int64), np.zeros(3 * LONGEST, np.int32)
    end = np.array([[3 * LONGEST - 1, 0, 0]], np.int32) << SHIFT
    for away in (3 * LONGEST, 1_000_000):
        passes[:] = 0
        pass_through(end - np.array([[away << SHIFT, 0, 0]], np.int32), end, shape, 2, passes)
        crossed = np.flatnonzero(passes)
        assert crossed.tolist() == list(range(crossed[0], 3 * LONGEST - 3))
        assert 0 <= LONGEST - len(crossed) <= 1


def test_cells_are_spread_to_their_neighbours_slab_by_slab(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    grid = (rng.random((7, 23, 5)) < 0.05).astype(np.int32) << rng.integers(0, 3, (7, 23, 5))
    grid = grid.astype(np.int32)
    around = np.pad(grid, 1)
    wanted = np.zeros_like(grid)
    for x, y, z in np.ndindex(3, 3, 3):
        wanted |= around[x : x + 7, y : y + 23, z : z + 5]
    for size in (1, 50, 1 << 18):
        monkeypatch.setattr(surfels, "_UNIT_CELLS", size)
        spread = grid.copy()
        pieces = sum(1 for _ in surfels._dilate(spread))
        assert (spread == wanted).all() and pieces >= 3
        assert pieces > 30 or size > 1


def finished(work: Any) -> Any:
    while True:
        try:
            next(work)
        except StopIteration as done:
            return done.value


def test_poses_without_points_cost_their_share_of_a_step() -> None:
    """Or whoever sends nothing else would have all of them read in one tick."""
    ann, ben = Author("ann"), Author("ben")
    consensus, ledger = Consensus(CONFIG), Ledger(CONFIG)
    for author, length in ((ann, 1), (ben, 300)):
        for cycle in range(length):
            tx = author.make(payload=Payload(anchors=(anchor(cycle),)))
            assert ledger.add(tx).accepted
            consensus.add(tx)
    consensus.advance()
    me = Surfaces(CONFIG, ann.identity.author)
    steps = 1
    while me.step(ledger, consensus, (), 24) >= 24:
        steps += 1
    assert steps > 300 // 24
