"""Scenes with truth: exact rays and distances, sensors that err as they say, a SLAM that drifts."""

from __future__ import annotations

import hashlib
import itertools
import os
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from dagmap import Cycle
from dagmap.model import ConfigError
from dagmap.quantising import quantise_cycle
from dagmap.sim.building import DOOR_HEIGHT, Building, inverse
from dagmap.sim.odometry import CLOSURE_LENGTH, Odometry
from dagmap.sim.scene import MotionConfig, Scene, SceneConfig, Seen, SensorConfig, Walker
from scene import agent

CLEAN = SensorConfig(noise=0.0, outliers=0.0)
STEADY = MotionConfig(drift=0.0, drift_yaw=0.0)


def make(
    scene: SceneConfig | None = None,
    sensor: SensorConfig = CLEAN,
    motion: MotionConfig = STEADY,
    robots: int = 3,
    seed: int = 1,
) -> Scene:
    return Scene(scene or SceneConfig(), sensor, motion, robots, seed)


def placed(cycle: Cycle) -> np.ndarray:
    """The points of a cycle in the fleet frame, as its SLAM has them."""
    pose = np.asarray(cycle.pose)
    return np.asarray(cycle.points) @ pose[:3, :3].T + pose[:3, 3]


def origins(walker: Walker, cycles: list[Cycle]) -> np.ndarray:
    """Where the sensor truly was, a row for every point of the cycles."""
    counts = [len(np.asarray(cycle.points)) for cycle in cycles]
    return np.repeat([walker.position(cycle.stamp) for cycle in cycles], counts, axis=0)


def bytes_of(cycles: list[Cycle]) -> bytes:
    digest = hashlib.sha256()
    for cycle in cycles:
        parts = [cycle.stamp, cycle.pose, cycle.points, cycle.ids, cycle.colors, cycle.removed]
        parts += [] if cycle.moved is None else list(cycle.moved)
        for part in parts:
            digest.update(b"-" if part is None else np.asarray(part).tobytes())
        digest.update(b"|")
    return digest.digest()


def all_faces(building: Building) -> np.ndarray:
    return np.concatenate([building.faces(cell) for cell in range(len(building.low))])


def slow_cast(faces: np.ndarray, origin: np.ndarray, ray: np.ndarray) -> float:
    """The twin of `cast`: one ray against every rectangle of the building."""
    low, high = faces[:, 0], faces[:, 1]
    row, axis = np.arange(len(faces)), np.argmin(high - low, axis=1)
    with np.errstate(divide="ignore"):
        t = (low[row, axis] - origin[axis]) / ray[axis]
    ahead = np.isfinite(t) & (t > 0)
    hit = origin + np.where(ahead, t, 0.0)[:, None] * ray
    inside = (low <= hit) & (hit <= high)
    inside[row, axis] = True
    return float(t[ahead & inside.all(axis=1)].min())


BUILDINGS = [
    SceneConfig(),
    SceneConfig(rooms=(1, 1), objects=16),
    SceneConfig(rooms=(3, 2), doors=0.0, objects=0, room=3.0),
    SceneConfig(rooms=(2, 3), doors=1.0, objects=6, wall=0.5, door=1.2, height=3.0),
]


@pytest.mark.parametrize("config", BUILDINGS)
def test_rays_end_where_the_first_rectangle_is(config: SceneConfig) -> None:
    scene = make(config, seed=5)
    rng = np.random.default_rng(0)
    walker = scene.robot(0)
    places = np.array([walker.position(t) for t in rng.uniform(0, 200, 12)])
    rays = rng.normal(size=(12, 25, 3))
    rays[:, 0], rays[:, 1] = (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)  # along the walls too
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    depth, surface = scene.building.cast(places, rays, 1000.0)
    faces = all_faces(scene.building)
    for i, j in itertools.product(range(12), range(25)):
        assert depth[i, j] == pytest.approx(slow_cast(faces, places[i], rays[i, j]))
    assert (surface >= 0).all()
    shorter, surface = scene.building.cast(places, rays, 2.0)
    np.testing.assert_array_equal(shorter, np.where(depth <= 2.0, depth, np.inf))
    assert ((surface >= 0) == np.isfinite(shorter)).all()


@pytest.mark.parametrize("config", BUILDINGS)
def test_distances_are_those_to_the_nearest_of_all_rectangles(config: SceneConfig) -> None:
    scene = make(config, seed=6)
    size = np.array([*(n * config.room for n in config.rooms), config.height])
    points = np.random.default_rng(1).uniform(-1.0, size + 1.0, (3000, 3))
    faces = all_faces(scene.building)
    nearest = np.clip(points[:, None], faces[:, 0], faces[:, 1]) - points[:, None]
    wanted = np.linalg.norm(nearest, axis=2).min(axis=1)
    np.testing.assert_allclose(scene.distance(points), wanted, atol=1e-12)
    assert scene.distance(np.zeros((0, 3))).shape == (0,)


def test_truth_covers_every_surface_once() -> None:
    scene = make(seed=2)
    truth = scene.truth(0.1)
    assert scene.distance(truth).max() < 1e-12
    assert len(np.unique(np.round(truth, 6), axis=0)) == len(truth)
    faces = all_faces(scene.building)
    sides = np.sort(faces[:, 1] - faces[:, 0], axis=1)
    assert len(truth) == pytest.approx((sides[:, 1] * sides[:, 2]).sum() / 0.01, rel=0.15)
    above = truth[truth[:, 2] < 1e-9] + (0.0, 0.0, 1.99)  # over boxes, none of which is in between
    down = scene.building.cast(above, np.tile([0.0, 0.0, -1.0], (len(above), 1, 1)), 100.0)[0]
    np.testing.assert_allclose(down, 1.99)
    list(scene.robot(0).cycles(60.0))
    seen = scene.robot(0).seen().reference
    gaps = np.array([np.abs(truth - point).max(axis=1).min() for point in seen[::20]])
    assert gaps.max() <= 0.05 + 1e-9


def test_every_room_can_be_reached_and_walkers_keep_clear_of_all() -> None:
    for seed in range(6):
        scene = make(SceneConfig(rooms=(3, 4), doors=0.0, objects=16), seed=seed)
        reached, todo = {0}, [0]
        while todo:
            for other in scene.building.neighbours(todo.pop()):
                if other not in reached:
                    reached.add(other)
                    todo.append(other)
        assert reached == set(range(12))
        places = np.array([scene.robot(0).position(t) for t in np.arange(0, 300, 0.7)])
        assert scene.distance(places).min() > 0.19
        assert len(set(scene.building.room_of(places).tolist())) > 4
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert steps.max() <= 0.7 * STEADY.speed + 1e-9


@pytest.mark.parametrize("kind", ["depth", "lidar", "mono"])
def test_points_without_noise_lie_on_surfaces(kind: str) -> None:
    scene = make(sensor=SensorConfig(kind=kind, noise=0.0, pixel=0.0, outliers=0.0, range=9.0))
    for cycle in scene.robot(1).cycles(40.0):
        assert len(np.asarray(cycle.points)) > 40
        assert scene.distance(placed(cycle)).max() < 1e-9
        assert np.linalg.norm(cycle.points, axis=1).max() <= 9.0 + 1e-9
    seen = scene.robot(1).seen()
    assert scene.distance(seen.points).max() < 1e-9
    assert not seen.outliers.any() and not seen.people.any()


def test_a_closed_room_is_all_that_is_seen() -> None:
    scene = make(SceneConfig(rooms=(1, 1)), sensor=SensorConfig(noise=0.0, range=100.0, outliers=0))
    list(scene.robot(0).cycles(60.0))
    low, high = scene.building.low[0], scene.building.high[0]
    points = scene.robot(0).seen().points
    assert (points >= low - 1e-9).all() and (points <= high + 1e-9).all()
    assert np.abs(points.max(axis=0) - high).max() < 0.1


def test_other_rooms_are_seen_through_doors_only() -> None:
    scene = make(sensor=SensorConfig(kind="lidar", noise=0.0, outliers=0.0, range=30.0, points=400))
    through = 0
    for cycle in scene.robot(0).cycles(60.0):
        origin, points = np.asarray(cycle.pose)[:3, 3], placed(cycle)
        for axis in (0, 1):  # the wall in the middle of the building, where doors are cut
            beyond = (origin[axis] - 5.0) * (points[:, axis] - 5.0) < 0
            share = (5.0 - origin[axis]) / (points[beyond, axis] - origin[axis])
            crossing = origin + share[:, None] * (points[beyond] - origin)
            aside = np.abs(np.abs(crossing[:, 1 - axis] - 5.0) - 2.5)
            assert (aside <= 0.5).all() and (crossing[:, 2] <= DOOR_HEIGHT).all()
            through += int(beyond.sum())
    assert through > 100


def test_people_are_in_the_way_but_not_in_the_truth() -> None:
    busy = make(SceneConfig(people=12), seed=4)
    empty = make(seed=4)
    np.testing.assert_array_equal(busy.truth(0.5), empty.truth(0.5))
    list(busy.robot(0).cycles(60.0))
    seen = busy.robot(0).seen()
    assert 0.02 < seen.people.mean() < 0.9
    assert busy.distance(seen.reference).max() < 1e-9
    for stamp in (0.0, 7.0, 59.0):
        points = seen.points[seen.people & (seen.stamps == stamp)]
        places = np.array(busy.people(stamp))
        far = np.abs(points[:, None, :2] - places).max(axis=2).min(axis=1)
        np.testing.assert_allclose(far[points[:, 2] < 1.749], 0.25, atol=1e-9)
    moved = np.linalg.norm(np.array(busy.people(0.0)) - np.array(busy.people(10.0)), axis=1)
    assert np.median(moved) > 1.0


def test_noise_is_along_the_ray_and_as_large_as_said() -> None:
    sensor = SensorConfig(kind="lidar", noise=0.03, outliers=0.0, points=500, tracked=0.0)
    scene = make(sensor=sensor)
    cycles = list(scene.robot(0).cycles(30.0))
    errors = np.concatenate([placed(c) for c in cycles]) - scene.robot(0).seen().points
    start = origins(scene.robot(0), cycles)
    rays = scene.robot(0).seen().points - start
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    along = (errors * rays).sum(axis=1)
    assert along.std() == pytest.approx(0.03, rel=0.05)
    assert abs(along.mean()) < 0.002
    assert np.abs(errors - along[:, None] * rays).max() < 1e-9


def test_outliers_are_as_many_and_as_far_off_as_said() -> None:
    sensor = SensorConfig(noise=0.0, outliers=0.2, points=500, tracked=0.0)
    scene = make(sensor=sensor)
    cycles = list(scene.robot(0).cycles(30.0))
    seen = scene.robot(0).seen()
    assert seen.outliers.mean() == pytest.approx(0.2, abs=0.02)
    start = origins(scene.robot(0), cycles)
    true = np.linalg.norm(seen.points - start, axis=1)
    factor = np.concatenate([np.linalg.norm(c.points, axis=1) for c in cycles]) / true
    np.testing.assert_allclose(factor[~seen.outliers], 1.0)
    wrong = factor[seen.outliers]
    assert wrong.min() >= 0.3 - 1e-9 and wrong.max() <= 1.6 + 1e-9
    assert (np.abs(wrong - 1.0) >= 0.15 - 1e-9).all()
    assert (wrong < 0.5).any() and (wrong > 1.4).any()


def spread(motion: MotionConfig, near: float, far: float) -> float:
    """Half the width of the middle 68 % of a single camera's errors at depths between two, m."""
    sensor = SensorConfig(kind="mono", outliers=0.0, points=800, tracked=0.0, range=8.0)
    scene = make(sensor=sensor, motion=motion)
    cycles = list(scene.robot(0).cycles(24.0))
    walker = scene.robot(0)
    points = np.concatenate([c.points for c in cycles])
    length = np.linalg.norm(walker.seen().points - origins(walker, cycles), axis=1)
    ahead = points[:, 0]
    true = ahead * length / np.linalg.norm(points, axis=1)
    chosen = (true > near) & (true < far)
    assert chosen.sum() > 200
    return float(np.subtract(*np.percentile((ahead - true)[chosen], [84, 16]))) / 2


def test_noise_of_a_single_camera_grows_with_depth_and_without_baseline() -> None:
    walk = STEADY
    near, far = spread(walk, 0.9, 1.1), spread(walk, 2.7, 3.3)
    assert far / near == pytest.approx(9.0, rel=0.35)  # depth squared
    rotate = MotionConfig(kind="rotate", drift=0.0)
    assert spread(rotate, 0.9, 1.1) > 10 * near
    slow = MotionConfig(speed=0.25, drift=0.0, drift_yaw=0.0)
    assert spread(slow, 0.9, 1.1) / near == pytest.approx(2.0, rel=0.35)


def test_a_robot_that_rotates_stays_and_looks_around() -> None:
    scene = make(motion=MotionConfig(kind="rotate"))
    walker = scene.robot(0)
    cycles = list(walker.cycles(20.0))
    assert {walker.position(t) for t in (0.0, 3.3, 100.0)} == {walker.position(0.0)}
    assert all(np.array_equal(np.asarray(c.pose)[:3, 3], walker.position(0)) for c in cycles)
    turns = [
        np.asarray(a.pose)[:2, 0] @ np.asarray(b.pose)[:2, 0] for a, b in itertools.pairwise(cycles)
    ]
    np.testing.assert_allclose(turns, np.cos(0.5))


def drifting(seed: int, closures: bool = True, until: float = 200.0) -> tuple[Walker, list[Cycle]]:
    motion = MotionConfig(drift=0.02, drift_yaw=0.004, loop_closures=closures)
    sensor = SensorConfig(outliers=0.1, points=30)
    walker = make(SceneConfig(people=2), sensor, motion, seed=seed).robot(0)
    return walker, list(walker.cycles(until))


def offset(walker: Walker, stamp: float, pose: np.ndarray) -> float:
    return float(np.linalg.norm(np.asarray(pose)[:3, 3] - walker.position(stamp)))


def test_poses_drift_slowly_from_the_truth() -> None:
    ends, firsts = [], []
    for seed in range(8):
        walker, cycles = drifting(seed, closures=False)
        errors = [offset(walker, c.stamp, c.pose) for c in cycles]
        assert errors[0] == 0.0 and max(errors[1:6]) < 0.2
        assert np.abs(np.diff(errors)).max() < 0.15
        firsts.append(errors[10])
        ends.append(errors[-1])
        assert all(c.moved is None and c.removed is None for c in cycles)
    assert np.mean(ends) > 5 * np.mean(firsts)


def test_loop_closures_bring_drifted_poses_back() -> None:
    before, after, final, alone = [], [], [], []
    for seed in range(8):
        walker, cycles = drifting(seed)
        known: dict[float, np.ndarray] = {}
        closures = 0
        for cycle in cycles:
            if cycle.moved is not None:
                closures += 1
                stamps, poses = cycle.moved
                assert len(stamps) and set(stamps.tolist()) <= set(known)
                assert stamps.tolist() == sorted(set(stamps.tolist()))
                for stamp, pose in zip(stamps.tolist(), poses, strict=True):
                    before.append(offset(walker, stamp, known[stamp]))
                    after.append(offset(walker, stamp, pose))
                    known[stamp] = pose
            known[cycle.stamp] = np.asarray(cycle.pose)
        assert closures >= 3
        path = np.array([known[stamp][:3, 3] for stamp in sorted(known)])
        assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 0.6  # bent, not torn
        final.append(np.mean([offset(walker, stamp, pose) for stamp, pose in known.items()]))
        walker, cycles = drifting(seed, closures=False)
        alone.append(np.mean([offset(walker, c.stamp, c.pose) for c in cycles]))
    assert np.mean(after) < 0.85 * np.mean(before)
    assert np.mean(final) < 0.5 * np.mean(alone)


def test_a_closure_returns_to_the_known_place_exactly() -> None:
    motion = MotionConfig(drift=0.05, drift_yaw=0.01)
    odometry = Odometry(motion, np.random.default_rng(3))
    truth = []
    for k in range(25):  # around a square of 20 m, back to the start
        side, way = divmod(min(k * 0.8333333333, 19.999), 5.0)
        corner = [(0, 0), (5, 0), (5, 5), (0, 5)][int(side)]
        ahead = [(1, 0), (0, 1), (-1, 0), (0, -1)][int(side)]
        truth.append(
            (corner[0] + way * ahead[0], corner[1] + way * ahead[1], 1.0, side * np.pi / 2)
        )
        odometry.step(truth[-1])
        drifted = odometry.poses.copy()
        changed = odometry.close()
        assert bool(changed) == (k == 24)
    assert changed == range(1, 25)
    errors = np.abs(odometry.poses - truth)
    assert errors[-1].max() < 1e-9 < 0.05 < np.abs(drifted[-1] - truth[-1]).max()
    assert errors[12:].mean() < np.abs(drifted - truth)[12:].mean()
    assert CLOSURE_LENGTH < 20.0


def test_a_closure_at_a_place_that_is_off_itself_keeps_what_was_seen_between_them() -> None:
    odometry = Odometry(MotionConfig(drift=0.02, drift_yaw=0.05), np.random.default_rng(1))
    truth = [(float(x), 0.0, 1.0, 0.0) for x in range(16)]
    truth += [(float(x), 0.5, 1.0, 0.0) for x in range(14, 7, -1)]  # back, half a metre aside
    for pose in truth:
        odometry.step(pose)
        changed = odometry.close()
        if changed:
            break
    near, far = odometry.poses[changed.stop - 1], odometry.poses[10]
    assert changed.stop - 1 == 20 and np.abs(far - truth[10])[3] > 0.05
    aside = (-0.5 * np.sin(far[3]), 0.5 * np.cos(far[3]), 0.0, 0.0)
    np.testing.assert_allclose(near - far, aside, atol=1e-9)


def test_a_constant_drift_is_corrected_altogether(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dagmap.sim.odometry.MEMORY", np.inf)  # the drift's direction stays
    odometry = Odometry(MotionConfig(drift=0.0, drift_yaw=0.03), np.random.default_rng(2))
    corners = [(0, 0), (1, 0), (2, 0), (3, 0), (3, 1), (3, 2), (3, 3), (2, 3), (1, 3), (0, 3)]
    truth = [(float(x), float(y), 1.0, 0.1 * x * y) for x, y in [*corners, (0, 2), (0, 1), (0, 0)]]
    for pose in truth:
        odometry.step(pose)
    assert np.abs(odometry.poses - truth).max() > 0.1
    assert odometry.close() == range(1, 13)
    np.testing.assert_allclose(odometry.poses, truth, atol=1e-9)


def test_a_closure_after_every_cycle_moves_no_others(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = make(SceneConfig(rooms=(2, 1), room=12.0), SensorConfig(outliers=0.3), MotionConfig())
    walker, centre = scene.robot(0), scene.building.centre
    monkeypatch.setattr(walker, "pose", lambda t: (*centre(int(t) % 2), 1.0, 0.0))
    cycles = list(walker.cycles(8.0))
    moved = [None if c.moved is None else len(c.moved[0]) for c in cycles]
    assert moved == [None, None, 1, 0, 0, 0, 0, 0]
    one = agent("one")
    for cycle in cycles:
        one.observe(cycle, now=cycle.stamp)


def test_removed_points_were_handed_in_and_are_wrong() -> None:
    walker, cycles = drifting(1)
    seen = walker.seen()
    wrong = set(seen.ids[seen.outliers | seen.people].tolist())
    given: set[int] = set()
    gone: set[int] = set()
    for cycle in cycles:
        removed = set() if cycle.removed is None else set(np.asarray(cycle.removed).tolist())
        assert (cycle.removed is None) == (cycle.moved is None)
        assert removed <= given & wrong - gone
        gone |= removed
        given |= set(np.asarray(cycle.ids).tolist())
        assert not gone & set(np.asarray(cycle.ids).tolist())
    assert 0.4 * len(wrong) < len(gone) < len(wrong)


def test_a_repeated_id_is_the_same_point() -> None:
    scene = make(SceneConfig(people=3), SensorConfig(outliers=0.1, tracked=0.3))
    cycles = list(scene.robot(0).cycles(60.0))
    seen = scene.robot(0).seen()
    assert all(len(np.unique(c.ids)) == len(np.asarray(c.ids)) for c in cycles)
    first: dict[int, np.ndarray] = {}
    again = 0
    for id_, point in zip(seen.ids.tolist(), seen.points, strict=True):
        again += id_ in first
        assert np.abs(first.setdefault(id_, point) - point).max() < 1e-6
    assert 0.1 < again / len(seen.ids) < 0.31


def test_colours_belong_to_surfaces() -> None:
    scene = make(sensor=SensorConfig(noise=0.0, outliers=0.0, colors=True))
    cycles = list(scene.robot(0).cycles(40.0))
    points = np.concatenate([placed(c) for c in cycles])
    colors = np.concatenate([np.asarray(c.colors) for c in cycles])
    room = scene.building.room_of(points)
    floor = (np.abs(points[:, 2]) < 1e-9) & (scene.distance(points) < 1e-9)
    low, high = scene.building.low, scene.building.high
    floor &= ((points >= low[room] - 1e-9) & (points <= high[room] + 1e-9)).all(axis=1)
    for number in np.unique(room):
        assert len(np.unique(colors[floor & (room == number)], axis=0)) == 1
    assert len(np.unique(colors, axis=0)) > 10
    assert next(iter(make().robot(0).cycles(1.0))).colors is None


@pytest.mark.parametrize("kind", ["depth", "lidar", "mono"])
def test_an_agent_takes_all_cycles_and_maps_the_building(kind: str) -> None:
    sensor = SensorConfig(kind=kind, colors=True, points=50)
    scene = make(SceneConfig(rooms=(2, 1), people=2), sensor, MotionConfig())
    one = agent("one")
    for cycle in scene.robot(0).cycles(90.0):
        quantise_cycle(cycle)
        one.observe(cycle, now=cycle.stamp)
    assert any(c.moved is not None for c in scene.robot(0).cycles(90.0))
    one.tick(91.0)
    errors = scene.distance(one.map.positions)
    assert len(errors) > 1000 and np.median(errors) < 0.05


def test_a_run_after_a_restart_is_a_session_of_its_own() -> None:
    scene = make(motion=MotionConfig(drift=0.05))
    walker = scene.robot(0)
    first = list(walker.cycles(10.0))
    second = list(walker.cycles(20.0, start=12.5, session=1))
    assert [c.stamp for c in second] == [12.5 + k for k in range(8)]
    assert {c.session for c in first} == {0} and {c.session for c in second} == {1}
    assert offset(walker, 12.5, second[0].pose) == 0.0 < offset(walker, 9.0, first[-1].pose)
    assert set(walker.seen().sessions.tolist()) == {0, 1}
    one = agent("one")
    for cycle in (*first, *second):
        one.observe(cycle, now=cycle.stamp)


def test_seen_is_what_was_handed_in_so_far() -> None:
    walker = make().robot(0)
    assert walker.seen().reference.shape == (0, 3)
    stream = walker.cycles(100.0)
    count = 0
    for cycle in itertools.islice(stream, 5):
        count += len(np.asarray(cycle.points))
        seen = walker.seen()
        assert isinstance(seen, Seen) and len(seen.points) == count
        assert {len(column) for column in seen} == {count}
        assert seen.ids[-len(cycle.ids) :].tolist() == cycle.ids.tolist()


def test_any_robot_alone_is_the_same_as_among_others() -> None:
    def stream(robots: int, index: int) -> bytes:
        scene = make(SceneConfig(people=2), SensorConfig(), MotionConfig(), robots, seed=9)
        return bytes_of(list(scene.robot(index).cycles(40.0)))

    scene = make(SceneConfig(people=2), SensorConfig(), MotionConfig(), robots=6, seed=9)
    streams = [scene.robot(i).cycles(40.0) for i in (5, 0, 3)]
    taken: list[list[Cycle]] = [[], [], []]
    for row in zip(*streams, strict=True):  # in turns
        for cycles, cycle in zip(taken, row, strict=True):
            cycles.append(cycle)
    assert [bytes_of(cycles) for cycles in taken] == [stream(6, 5), stream(1, 0), stream(4, 3)]
    assert len({bytes_of(cycles) for cycles in taken}) == 3
    rays = [np.asarray(cycles[0].points) for cycles in taken]
    looks = [set(np.round(ray[:, 1:] / ray[:, :1], 6).ravel().tolist()) for ray in rays]
    assert not looks[0] & looks[1] and not looks[1] & looks[2]


def test_a_shorter_run_is_the_beginning_of_a_longer_one() -> None:
    def head(until: float) -> bytes:
        walker = make(SceneConfig(people=2), SensorConfig(), MotionConfig(), seed=3).robot(2)
        return bytes_of(list(itertools.islice(walker.cycles(until), 5)))

    assert head(5.0) == head(33.0) == head(1e6)


def test_robots_start_in_different_rooms() -> None:
    scene = make(SceneConfig(rooms=(3, 3)), robots=20)
    starts = np.array([scene.robot(i).position(0.0) for i in range(20)])
    assert sorted(scene.building.room_of(starts)[:9].tolist()) == list(range(9))
    assert len(np.unique(starts, axis=0)) == 20
    with pytest.raises(IndexError):
        scene.robot(20)


PROGRAM = """
import sys
sys.path[:0] = {paths!r}
from test_scene import *
config = SceneConfig(people=3)
scene = make(config, SensorConfig(outliers=0.1, colors=True), MotionConfig(), seed=7)
print(bytes_of(list(scene.robot(1).cycles(60.0))).hex())
"""


def test_the_same_seed_gives_the_same_bytes_in_every_process() -> None:
    here = Path(__file__).parent
    program = PROGRAM.format(paths=[str(here)])
    out = set()
    for hash_seed in ("0", "1"):
        env = {**os.environ, "PYTHONHASHSEED": hash_seed}
        env["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
        done = subprocess.run(
            [sys.executable, "-c", program], env=env, capture_output=True, timeout=120, check=True
        )
        out.add(done.stdout.decode().strip())
    assert len(out) == 1
    sensor = SensorConfig(outliers=0.1, colors=True)
    for seed, same in ((7, True), (8, False)):
        scene = make(SceneConfig(people=3), sensor, MotionConfig(), seed=seed)
        assert (bytes_of(list(scene.robot(1).cycles(60.0))).hex() in out) == same


@pytest.mark.parametrize(
    ("kind", "text", "named"),
    [
        (SceneConfig, "rooms = [0, 2]", "rooms"),
        (SceneConfig, "rooms = [2, 2, 2]", "rooms"),
        (SceneConfig, "room = 1.0", "room"),
        (SceneConfig, "height = 2.0", "height"),
        (SceneConfig, "objects = 17", "objects"),
        (SceneConfig, "color = 3", "color"),
        (SensorConfig, "kind = 'sonar'", "sonar"),
        (SensorConfig, "period = 0", "period"),
        (SensorConfig, "field = [0, 50]", "field"),
        (SensorConfig, "tracked = 0.9", "tracked"),
        (MotionConfig, "speed = 0", "speed"),
        (MotionConfig, "drift = -1", "drift"),
    ],
)
def test_a_wrong_parameter_is_named(kind: type, text: str, named: str) -> None:
    with pytest.raises((ConfigError, msgspec.ValidationError), match=named):
        msgspec.toml.decode(text, type=kind)


def test_rays_along_an_axis_have_finite_inverses() -> None:
    assert np.isfinite(inverse(np.array([[1.0, 0.0, -0.0]]))).all()
