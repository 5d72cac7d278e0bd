"""Robots without descriptors are placed by the shape of what they saw, or told why they are not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
import pytest

from dagmap import Agent, Cycle, GraphConfig, clouds
from dagmap.aligning import Agreement, align
from dagmap.clouds import Cloud
from dagmap.config import PlacingConfig
from dagmap.kernels.voxels import SHIFT, nearest_facing, pass_through, tally
from dagmap.model import FrameId, pose_matrix
from dagmap.sim.fleet import Fleet
from dagmap.surfaces import Shape
from dagmap.surfels import FINE, Surfels, survey
from scene import QUICK, agent, pose

Points = np.ndarray
UNKNOWN = msgspec.structs.replace(
    QUICK,
    start_pose=None,
    graph=GraphConfig(),
    placing=PlacingConfig(units_per_tick=3000, surfaces=True),
)
HERE, THERE = (FrameId(bytes([n]) * 8) for n in (1, 2))


@dataclass
class World:
    """A room with boxes in it: what a ray meets first. `size` (3,) m, `low`, `high` (B, 3)."""

    size: Points
    low: Points
    high: Points

    def cast(self, origin: Points, rays: Points) -> Points:
        with np.errstate(divide="ignore"):
            walls = (np.where(rays > 0, self.size - origin, -origin) / rays).min(axis=1)
            near, far = ((c - origin)[:, None] / rays for c in (self.low, self.high))
        enter, leave = np.minimum(near, far).max(axis=2), np.maximum(near, far).min(axis=2)
        boxes = np.where((enter > 0) & (enter < leave), enter, np.inf)
        return np.minimum(walls, boxes.min(axis=0, initial=np.inf))


def furnished(seed: int, size: tuple[float, ...] = (9, 7, 3), boxes: int = 12) -> World:
    """Boxes along the walls, the middle is free."""
    rng, full = np.random.default_rng(seed), np.array(size, float)
    extent = rng.uniform(0.4, 1.4, (boxes, 3))
    low = rng.uniform(0, 1, (boxes, 3)) * (full - extent)
    side = rng.integers(0, 2, boxes)
    low[:, 1] = np.where(side, full[1] - extent[:, 1] - 0.2, 0.2)
    return World(full, low, low + extent)


def bare(size: tuple[float, ...] = (9, 7, 3)) -> World:
    return World(np.array(size, float), np.zeros((0, 3)), np.zeros((0, 3)))


def walk(
    world: World,
    start: Points | None = None,
    seed: int = 0,
    count: int = 8,
    points: int = 2000,
    reach: float = 30.0,
    along: tuple[float, float] = (0.25, 0.75),
    begin: float = 0.0,
    at: float = 0.0,
) -> list[Cycle]:
    """A LiDAR goes along x through the middle; 1 cm noise, 2 % of the points anywhere on the ray.

    along: share of x where it begins and ends. at: m, by which the whole world lies further in x.
    """
    rng, out = np.random.default_rng(seed), []
    for i in range(count):
        share = along[0] + (along[1] - along[0]) * i / max(1, count - 1)
        yaw = rng.uniform(-3, 3)
        origin = np.array([share * world.size[0], 0.5 * world.size[1], 1.2])
        rays = rng.normal(size=(points, 3))
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        length = world.cast(origin, rays) + rng.normal(0, 0.01, points)
        length *= np.where(rng.random(points) < 0.02, rng.uniform(0.3, 1.6, points), 1.0)
        seen = (length > 0.1) & (length < reach)
        sensor = pose(*origin, yaw)
        local = (rays[seen] * length[seen, None]) @ sensor[:3, :3]
        sensor[0, 3] += at
        out.append(Cycle(begin + i, sensor if start is None else start @ sensor, local))
    return out


def mirrored(cycles: list[Cycle]) -> list[Cycle]:
    flip = np.diag([-1.0, 1.0, 1.0, 1.0])
    return [
        replace(c, points=np.asarray(c.points) * (-1, 1, 1), pose=flip @ np.asarray(c.pose) @ flip)
        for c in cycles
    ]


def turned(seed: int) -> Points:
    """(4, 4) any turn, and up to 20 m."""
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    out = np.eye(4)
    out[:3, :3] = turn * np.sign(np.linalg.det(turn))
    out[:3, 3] = rng.uniform(-20, 20, 3)
    return out


def run(work: Any) -> Any:
    while True:
        try:
            next(work)
        except StopIteration as done:
            return done.value


def surfels(cycles: list[Cycle]) -> Surfels | None:
    places, origins, groups = [], [], []
    for i, cycle in enumerate(cycles):
        at, local = np.asarray(cycle.pose), np.asarray(cycle.points)
        places.append(1000 * (local @ at[:3, :3].T + at[:3, 3]))
        origins.append(np.repeat(1000 * at[None, :3, 3], len(local), axis=0))
        groups.append(np.full(len(local), i))
    return run(survey(*map(np.concatenate, (places, origins, groups)), FINE * 80.0))


def verdict(one: list[Cycle], other: list[Cycle]) -> tuple[str, list[Agreement]]:
    shape = Shape(UNKNOWN, HERE, THERE)
    here, there = surfels(one), surfels(other)
    found = run(align(here, there)) if here and there else []
    link = shape.conclude(found)
    assert (link is None) == bool(shape.reason)
    return shape.reason, found


def off(found: Points, truth: Points, about: Points) -> tuple[float, float]:
    """Metres at a place, and degrees."""
    error = np.linalg.inv(truth) @ found
    cosine = np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1)
    moved = error[:3, :3] @ about + error[:3, 3] - about
    return float(np.linalg.norm(moved)), float(np.degrees(np.arccos(cosine)))


@pytest.mark.parametrize("seed", range(3))
def test_one_room_is_known_again_from_any_frame(seed: int) -> None:
    world, frames = furnished(seed), (turned(seed), turned(seed + 10))
    reason, found = verdict(
        walk(world, frames[0], 1, along=(0.2, 0.6)), walk(world, frames[1], 2, along=(0.4, 0.8))
    )
    assert reason == ""
    motion = found[0].pose.copy()
    motion[:3, 3] /= 1000
    metres, degrees = off(motion, frames[1] @ np.linalg.inv(frames[0]), frames[0][:3, 3])
    assert metres < 0.03 and degrees < 0.3


Pair = Callable[[], tuple[list[Cycle], list[Cycle]]]


def _other_room() -> tuple[list[Cycle], list[Cycle]]:
    return walk(furnished(1)), walk(furnished(2), turned(1), 1)


def _mirrored() -> tuple[list[Cycle], list[Cycle]]:
    return walk(furnished(1)), mirrored(walk(furnished(1), turned(1), 1))


def _noise() -> tuple[list[Cycle], list[Cycle]]:
    rng = np.random.default_rng(5)
    noise = [replace(c, points=rng.uniform(-4, 4, np.shape(c.points))) for c in walk(bare())]
    return walk(furnished(1)), noise


def _bare() -> tuple[list[Cycle], list[Cycle]]:
    return walk(bare()), walk(bare(), turned(1), 1)


def _wall() -> tuple[list[Cycle], list[Cycle]]:
    wall = [
        [replace(c, points=np.asarray(c.points)[_on_wall(c)]) for c in walk(bare(), None, seed)]
        for seed in (0, 1)
    ]
    return wall[0], [replace(c, pose=turned(1) @ np.asarray(c.pose)) for c in wall[1]]


def _on_wall(cycle: Cycle) -> Points:
    at = np.asarray(cycle.pose)
    return (np.asarray(cycle.points) @ at[:3, :3].T + at[:3, 3])[:, 1] > 6.9


def _corridor() -> tuple[list[Cycle], list[Cycle]]:
    """40 m, and nobody sees an end."""
    world = bare((40, 2.5, 2.5))
    return (
        walk(world, None, 0, reach=6, along=(0.3, 0.6)),
        walk(world, turned(1), 1, reach=6, along=(0.4, 0.7)),
    )


def _bays() -> tuple[list[Cycle], list[Cycle]]:
    """A corridor with a pillar and a cupboard every 2.5 m."""
    low = np.concatenate([[[2.5 * i + 0.5, 0, 0], [2.5 * i + 1.5, 2.2, 0.5]] for i in range(16)])
    world = World(np.array([40, 2.5, 2.5]), low, low + np.array([0.4, 0.3, 2.0]))
    return (
        walk(world, None, 0, reach=6, along=(0.3, 0.6)),
        walk(world, turned(1), 1, reach=6, along=(0.4, 0.7)),
    )


def _equal_rooms() -> tuple[list[Cycle], list[Cycle]]:
    """The one has seen two rooms that are alike, the other one of them."""
    one = walk(furnished(1)) + walk(furnished(1), None, 3, begin=20.0, at=12.0)
    return one, walk(furnished(1), turned(1), 1)


NOT_PLACED: dict[str, Pair] = {
    "another room": _other_room,
    "mirrored": _mirrored,
    "only noise": _noise,
    "a bare room": _bare,
    "a single wall": _wall,
    "a corridor": _corridor,
    "a corridor of equal bays": _bays,
    "two equal rooms": _equal_rooms,
}


@pytest.mark.parametrize("name", NOT_PLACED)
def test_what_shape_cannot_tell_is_not_placed(name: str) -> None:
    reason, _ = verdict(*NOT_PLACED[name]())
    assert reason
    if name == "two equal rooms":
        assert reason == "the maps fit in more than one way"
    if name == "a bare room":
        assert "too plain" in reason


def test_what_one_place_alone_shows_is_not_believed() -> None:
    seen = Agreement(np.eye(4), 900.0, 0.0, 500, 30, np.full(6, 400.0), 1)
    shape = Shape(UNKNOWN, HERE, THERE)
    assert shape.conclude([seen]) is None
    assert shape.reason == "only one keyframe of a robot agrees"
    assert shape.conclude([replace(seen, independent=2)]) is not None
    assert shape.conclude([replace(seen, independent=2, firm=np.arange(6.0))]).inliers == 0


@pytest.fixture(scope="module")
def met() -> tuple[dict[str, Agent], dict[str, Points]]:
    """Ann and bob have walked through one room, each in a frame of its own."""
    starts = {"ann": np.eye(4), "bob": turned(3)}
    cycles = {
        name: walk(furnished(1), start, i, along=(0.2 + 0.2 * i, 0.6 + 0.2 * i))
        for i, (name, start) in enumerate(starts.items())
    }
    fleet = Fleet(UNKNOWN)
    for _ in fleet.run(cycles):
        pass
    return {name: robot.agent for name, robot in fleet.robots.items()}, starts


def test_robots_without_descriptors_find_each_others_frames(
    met: tuple[dict[str, Agent], dict[str, Points]],
) -> None:
    agents, starts = met
    for robot in agents.values():
        a, b = (robot.consensus.frames[FrameId(agents[n].identity.author)] for n in starts)
        assert a[0] == b[0] and robot.unplaced == {}
        found = np.linalg.inv(pose_matrix(b[1])) @ pose_matrix(a[1])
        metres, degrees = off(found, starts["bob"], np.array([4.0, 3.5, 1.2]))
        assert metres < 0.03 and degrees < 0.5
    assert len({robot.digest() for robot in agents.values()}) == 1
    ends = {
        (link.source.author, link.target.author)
        for author in agents["ann"].consensus.authors.values()
        for link in author.links.values()
        if link.inliers
    }
    assert len(ends) == 2  # both have said so
    assert not any(tx.payload.described for tx in agents["ann"].ledger)


def test_an_agent_that_starts_again_keeps_its_link(
    met: tuple[dict[str, Agent], dict[str, Points]],
) -> None:
    ann = met[0]["ann"]
    again = Agent.restore(ann.identity, ann.config, [tx.data for tx in ann.ledger])
    for at in range(3):
        assert not [e for e in again.tick(float(at)) if type(e).__name__ == "Issued"]
    assert again.digest() == ann.digest() and again.unplaced == {}


def test_shape_is_left_out_unless_it_is_wanted(
    met: tuple[dict[str, Agent], dict[str, Points]],
) -> None:
    ann, bob = met[0]["ann"], met[0]["bob"]
    quiet = msgspec.structs.replace(UNKNOWN, placing=PlacingConfig())
    robot = agent("cid", quiet)
    for tx in (*ann.ledger, *bob.ledger):
        robot.take(tx.data)
    robot.observe(walk(furnished(1), None, 7, 1)[0], 0.0)
    robot.tick(1.0)
    assert not robot.searching and robot.placing._surfaces.shapes == {}
    assert all("surfaces = true in [placing]" in why for why in robot.unplaced.values())


def test_a_tick_does_its_share_of_the_search(
    met: tuple[dict[str, Agent], dict[str, Points]],
) -> None:
    ann = met[0]["ann"]
    slow = msgspec.structs.replace(UNKNOWN, placing=PlacingConfig(surfaces=True))
    data = [tx.data for tx in ann.ledger if not tx.payload.links]
    robot = Agent.restore(ann.identity, slow, data)
    robot.settle()
    spent = []
    while not spent or robot.placing.busy:
        links, _ = robot.placing.step(robot.ledger, robot.consensus)
        spent.append(robot.placing.spent)
    assert sum(spent) > 1000 and max(spent) < 24 + 100
    assert links == [] or links[0].inliers


def test_a_cloud_follows_its_chain(met: tuple[dict[str, Agent], dict[str, Points]]) -> None:
    """Points come through the newest poses; what was withdrawn is left out."""
    ann = met[0]["ann"]
    chain, cloud = ann.ledger.chain(ann.identity.author), Cloud()
    while cloud.read_on(chain, ann.config) >= 0:
        pass
    points, origins, groups = cloud.gather(0, 300.0)
    assert len(points) == len(origins) == len(groups) == cloud.count == cloud.sessions[0]
    assert np.median(points, axis=0).min() > 0 and np.percentile(points, 95) < 9000  # the room
    assert groups[0] == 0 and 2 <= groups.max() < 8
    cycle = int(min(cloud.anchors))
    before = cloud.anchors[cycle]
    shifted = before.pose.copy()
    shifted[4] += 1000
    cloud.anchors[cycle] = replace(before, pose=shifted)
    cloud._retracted[:10] = True
    moved, _, _ = cloud.gather(0, 300.0)
    assert len(moved) == len(points) - 10
    assert np.isclose(moved[0] - points[10], (1000, 0, 0)).all()


def test_of_many_points_a_share_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = agent("ann", UNKNOWN)
    for cycle in walk(furnished(1), None, 1, 4, 800):
        robot.observe(cycle, cycle.stamp)
    monkeypatch.setattr(clouds, "MOST_POINTS", 500)
    cloud = Cloud()
    while cloud.read_on(robot.ledger.chain(robot.identity.author), UNKNOWN) >= 0:
        pass
    points, _, groups = cloud.gather(0, 300.0)
    assert cloud.count > 1500 and 100 < len(points) <= 500 and groups.max() >= 2


def _cell(place: list[int], shape: list[int]) -> int:
    """The obvious index of a cell."""
    x, y, z = (coordinate // (1 << SHIFT) for coordinate in place)
    inside = 0 <= x < shape[0] and 0 <= y < shape[1] and 0 <= z < shape[2]
    return (x * shape[1] + y) * shape[2] + z if inside else -1


def test_kernels_of_voxels_do_the_obvious() -> None:
    rng = np.random.default_rng(1)
    shape = np.array([5, 6, 7])
    grid = rng.integers(0, 16, int(shape.prod())).astype(np.int32)
    points = rng.integers(-300, 2000, (40, 3)).astype(np.int32)
    marks = rng.integers(1, 8, 40).astype(np.int32)
    shifts = rng.integers(-500, 500, (9, 3)).astype(np.int32)
    out = np.zeros(9, np.int64)
    tally(grid, shape, points, marks, shifts, 8, 2, out)
    for shift, total in zip(shifts, out, strict=True):
        cells = [_cell(place, shape.tolist()) for place in (points + shift).tolist()]
        wanted = 0
        for cell, mark in zip(cells, marks.tolist(), strict=True):
            bits = int(grid[cell]) if cell >= 0 else 0
            wanted += 1 if bits & mark else -2 if bits & 8 else 0
        assert total == wanted
    passes = np.zeros(len(grid), np.int32)
    ends = points[:20], points[20:]
    pass_through(*ends, shape, 1, passes)
    wanted_passes = np.zeros(len(grid), np.int32)
    for one, other in zip(*(end.tolist() for end in ends), strict=True):
        steps = max(abs(b - a) for a, b in zip(one, other, strict=True)) // (1 << SHIFT) + 1
        for s in range(steps - 1):
            place = [a + (b - a) * s // steps for a, b in zip(one, other, strict=True)]
            cell = _cell(place, shape.tolist())
            wanted_passes[cell] += cell >= 0
    assert passes.tolist() == wanted_passes.tolist()


@pytest.mark.parametrize("reach", [0, 1, 2])
def test_the_nearest_that_faces_alike_is_the_nearest(reach: int) -> None:
    rng = np.random.default_rng(reach)
    shape = np.array([5, 6, 7])
    which = np.full(int(shape.prod()), -1, np.int32)
    places = rng.integers(0, 5 << SHIFT, (60, 3)).astype(np.int32)
    cells = [_cell(place, shape.tolist()) for place in places.tolist()]
    for row, cell in enumerate(cells):
        which[cell] = row
    facings, normals = (rng.integers(-100, 101, (n, 3)).astype(np.int32) for n in (60, 30))
    points = rng.integers(-200, 1800, (30, 3)).astype(np.int32)
    out = np.zeros(30, np.int64)
    nearest_facing(which, shape, places, facings, points, normals, reach, 500, out)
    for point, normal, found in zip(points, normals, out, strict=True):
        away = {}
        for row in sorted(set(which.tolist()) - {-1}):
            apart = (places[row] >> SHIFT) - (point >> SHIFT)
            if np.abs(apart).max() <= reach and facings[row] @ normal >= 500:
                away[row] = int(((places[row].astype(np.int64) - point) ** 2).sum())
        assert (found < 0) == (not away)
        assert found < 0 or away[int(found)] == min(away.values())
