"""Robots without descriptors are placed by the shape of what they saw, or told why they are not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
import pytest

from dagmap import Cycle
from dagmap.aligning import Agreement, align
from dagmap.config import PlacingConfig
from dagmap.model import FrameId
from dagmap.surfaces import Shape
from dagmap.surfels import FINE, Surfels, survey
from scene import QUICK, pose

Points = np.ndarray
UNKNOWN = msgspec.structs.replace(
    QUICK, start_pose=None, placing=PlacingConfig(units_per_tick=3000)
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


def furnished(seed: int, size: tuple[float, ...] = (9, 7, 3), boxes: int = 8) -> World:
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
    count: int = 12,
    points: int = 1500,
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


def surfels(cycles: list[Cycle]) -> Surfels:
    places, origins, groups = [], [], []
    for i, cycle in enumerate(cycles):
        at, local = np.asarray(cycle.pose), np.asarray(cycle.points)
        places.append(1000 * (local @ at[:3, :3].T + at[:3, 3]))
        origins.append(np.repeat(1000 * at[None, :3, 3], len(local), axis=0))
        groups.append(np.full(len(local), i))
    found = run(survey(*map(np.concatenate, (places, origins, groups)), FINE * 80.0))
    assert found is not None
    return found


def verdict(one: list[Cycle], other: list[Cycle]) -> tuple[str, list[Agreement]]:
    shape = Shape(UNKNOWN, HERE, THERE)
    found = run(align(surfels(one), surfels(other)))
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
    world = World(np.array([40, 2.5, 2.5]), low, low + (0.4, 0.3, 2.0))
    return (
        walk(world, None, 0, reach=6, along=(0.3, 0.6)),
        walk(world, turned(1), 1, reach=6, along=(0.4, 0.7)),
    )


def _equal_rooms() -> tuple[list[Cycle], list[Cycle]]:
    """The one has seen two rooms that are alike, the other one of them."""
    one = walk(furnished(1)) + walk(furnished(1), None, 3, begin=20.0, at=12.0)
    return one, walk(furnished(1), turned(1), 1)


def _standing() -> tuple[list[Cycle], list[Cycle]]:
    """The one has not moved: all it says hangs on one place."""
    return walk(furnished(1), along=(0.5, 0.5)), walk(furnished(1), turned(1), 1)


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
    one, other = NOT_PLACED[name]()
    for pair in ((one, other), (other, one)):
        reason, _ = verdict(*pair)
        assert reason


def test_it_is_told_why() -> None:
    assert verdict(*_equal_rooms())[0] == "the maps fit in more than one way"
    assert "too plain" in verdict(*_bare())[0]
