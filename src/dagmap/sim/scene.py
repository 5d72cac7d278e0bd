"""Scenes with truth: robots walk through a building and hand in what their SLAM makes of it.

    scene = Scene(SceneConfig(), SensorConfig(), MotionConfig(), robots=3, seed=1)
    walker = scene.robot(0)
    for cycle in walker.cycles(until=60.0):
        agent.observe(cycle, now=cycle.stamp)
    errors = scene.distance(agent.map.positions)

Everything follows from the seed, for each robot alone: it does not matter which other robots
there are, nor who is asked first.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..model import Bools, Cycle, Floats, Int64s
from .building import Building, SceneConfig, enter, inverse
from .looking import PERSON, Ids, Looking, Pose, View
from .odometry import Odometry, pose_matrix
from .sensor import SensorConfig
from .walk import MotionConfig, Route

__all__ = ["MotionConfig", "Scene", "SceneConfig", "Seen", "SensorConfig", "Walker"]

PERSON_SIZE = (0.5, 1.75)  # m, width and height
PEOPLE_SPEED = 1.1  # m/s
FOUND_WRONG = 0.7  # share of bad points that a SLAM withdraws when it closes a loop
_TIMES = 64  # at which it is remembered where people stand
_BUILDING, _SENSOR, _SLAM, _COLORS = range(4)  # what chance is drawn for


class Seen(NamedTuple):
    """What a walker has handed in so far, a row a point."""

    points: Floats  # (N, 3) m in the fleet frame, where it truly is: no noise, drift or outlier
    stamps: Floats  # (N,) s
    sessions: Int64s  # (N,)
    ids: Ids  # (N,)
    outliers: Bools  # (N,) handed in far from where it is
    people: Bools  # (N,) on a person

    @property
    def reference(self) -> Floats:
        """(M, 3) points that a complete map holds: neither outliers nor on people."""
        return np.asarray(self.points[~(self.outliers | self.people)])


_NOTHING = Seen(
    np.zeros((0, 3)),
    np.zeros(0),
    np.zeros(0, np.int64),
    np.zeros(0, np.uint64),
    np.zeros(0, np.bool_),
    np.zeros(0, np.bool_),
)


class Scene:
    """A building with people and robots. Raises ValueError for a negative seed."""

    def __init__(
        self,
        scene: SceneConfig,
        sensor: SensorConfig,
        motion: MotionConfig,
        robots: int,
        seed: int,
    ) -> None:
        self.sensor, self.motion, self.robots, self.seed = sensor, motion, robots, seed
        rng = self.chance(_BUILDING)
        self.building = Building(scene, rng)
        self._starts = rng.permutation(self.building.rooms)
        rooms = rng.integers(self.building.rooms, size=scene.people).tolist()
        self._people = [
            Route(self.building, room, PEOPLE_SPEED, f"{seed} person {number}")
            for number, room in enumerate(rooms)
        ]
        self._people_at: dict[float, list[tuple[float, float]]] = {}
        self._walkers: dict[int, Walker] = {}

    def chance(self, *purpose: int) -> np.random.Generator:
        """The generator for a purpose; its numbers depend on the seed and the purpose alone."""
        return np.random.default_rng([self.seed, *purpose])

    def robot(self, index: int) -> Walker:
        """The robot of a number below `robots`; always the same object. Raises IndexError."""
        if not 0 <= index < self.robots:
            raise IndexError(f"robot {index} of {self.robots}; numbers are 0 to robots - 1")
        if index not in self._walkers:
            room = int(self._starts[index % len(self._starts)])
            self._walkers[index] = Walker(self, index, room)
        return self._walkers[index]

    def distance(self, points: npt.ArrayLike) -> Floats:
        """(N,) m from points (N, 3) in the fleet frame to the nearest static surface, exactly."""
        return self.building.distance(points)

    def truth(self, spacing: float) -> Floats:
        """(M, 3) m in the fleet frame: a grid of that pitch (m) on all static surfaces."""
        return self.building.truth(spacing)

    def people(self, t: float) -> list[tuple[float, float]]:
        """Where people stand at a time in s, (x, y) m each."""
        if t not in self._people_at:
            if len(self._people_at) >= _TIMES:
                self._people_at.clear()  # robots look at the same times
            self._people_at[t] = [person.position(t) for person in self._people]
        return self._people_at[t]

    def cast(
        self, origins: Floats, directions: Floats, times: Sequence[float]
    ) -> tuple[Floats, Int64s]:
        """As `Building.cast` up to the sensor's range, with people in the way at N times in s."""
        depth, surface = self.building.cast(origins, directions, self.sensor.range)
        if not self._people:
            return depth, surface
        people = np.array([self.people(t) for t in times])
        half, height = PERSON_SIZE[0] / 2, PERSON_SIZE[1]
        far = np.abs(people - origins[:, None, :2]).max(axis=2)
        near = int((far <= self.sensor.range + half).sum(axis=1).max())
        if not near:
            return depth, surface
        nearest = np.argsort(far, axis=1, kind="stable")[:, :near, None]
        low, high = np.zeros((2, len(times), near, 3))
        low[..., :2] = np.take_along_axis(people, nearest, axis=1) - half
        high[..., :2], high[..., 2] = low[..., :2] + 2 * half, height
        each = directions.shape[1]
        origin, low, high = (np.repeat(a, each, axis=0) for a in (origins, low, high))
        reach = enter(origin, inverse(directions.reshape(-1, 3)), low, high)[0].reshape(-1, each)
        hit = (reach < depth) & (reach <= self.sensor.range)
        return np.where(hit, reach, depth), np.where(hit, PERSON, surface)


class Walker:
    """One robot of a scene: where it truly is, and the cycles of its SLAM."""

    def __init__(self, scene: Scene, index: int, room: int) -> None:
        self._scene, self.index = scene, index
        seed = f"{scene.seed} robot {index}"
        self._route = Route(scene.building, room, scene.motion.speed, seed)
        self._seen: list[tuple[float, int, View]] = []

    def position(self, t: float) -> tuple[float, float, float]:
        """True (x, y, z) of the sensor at a time in s, m in the fleet frame."""
        still = self._scene.motion.kind == "rotate"
        x, y = self._route.position(0.0 if still else t)
        return x, y, self._scene.sensor.height

    def heading(self, t: float) -> float:
        """True direction of the sensor's x axis at a time in s, rad from the fleet's x axis."""
        if self._scene.motion.kind == "rotate":
            return self._route.heading(0.0) + self._scene.motion.turn * t
        return self._route.heading(t)

    def pose(self, t: float) -> Pose:
        """True (x, y, z) in m and yaw in rad of the sensor at a time in s, in the fleet frame."""
        return (*self.position(t), self.heading(t))

    def cycles(self, until: float, start: float = 0.0, session: int = 0) -> Iterator[Cycle]:
        """The cycles of a SLAM that starts at `start`: one every period, before `until` (s).

        Poses are in the fleet frame where the SLAM starts, and drift from there. Each call is a
        run of its own: after a restart give it another session (`Config.same_origin` tells that
        it starts in the fleet frame again). The same arguments give the same cycles.
        """
        run = _Run(self._scene, self, session)
        period = self._scene.sensor.period
        count = max(0, math.ceil((until - start) / period))
        for first in range(0, count, run.batch):
            numbers = range(first, min(first + run.batch, count))
            for cycle, view in run.cycles([start + number * period for number in numbers]):
                self._seen.append((cycle.stamp, session, view))
                yield cycle

    def seen(self) -> Seen:
        """All that was handed in by now, in that order."""
        if not self._seen:
            return _NOTHING
        stamps, sessions, views = zip(*self._seen, strict=True)
        counts = [len(view.ids) for view in views]
        view = View(*(np.concatenate(column) for column in zip(*views, strict=True)))
        return Seen(
            view.true,
            np.repeat(np.array(stamps), counts),
            np.repeat(np.array(sessions, np.int64), counts),
            view.ids,
            view.outliers,
            view.surface == PERSON,
        )


class _Run:
    """One run of a robot's SLAM, from its start to a crash or the end."""

    def __init__(self, scene: Scene, walker: Walker, session: int) -> None:
        self._scene, self._walker, self._session = scene, walker, session
        chance = scene.chance(_SENSOR, walker.index, session)
        self._looking = Looking(scene.sensor, scene.cast, walker.pose, chance)
        self._rng = scene.chance(_SLAM, walker.index, session)
        self._odometry = Odometry(scene.motion, self._rng)
        self._stamps: list[float] = []
        self._recent: list[View] = []  # since the last loop closure
        self._palette = scene.chance(_COLORS).integers(0, 256, (64, 3), np.uint8)
        self.batch = self._looking.batch  # cycles at a time

    def cycles(self, times: Sequence[float]) -> Iterator[tuple[Cycle, View]]:
        """The next cycles: `batch` of them, or fewer if they are the last."""
        for t, view in zip(times, self._looking.views(times), strict=True):
            yield self._cycle(t, view), view

    def _cycle(self, t: float, view: View) -> Cycle:
        """Go on to where the robot is at `t`; correct the map where a place is known again."""
        self._stamps.append(t)
        self._odometry.step(self._walker.pose(t))
        changed = self._odometry.close()
        moved, removed = None, None
        if changed:
            poses = self._odometry.poses[changed.start : changed.stop - 1]
            stamps = np.array(self._stamps[changed.start : changed.stop - 1])
            matrices = [pose_matrix(pose) for pose in poses.tolist()]
            moved = stamps, np.array(matrices).reshape(-1, 4, 4)
            removed = self._withdraw()
        self._recent.append(view)
        return Cycle(
            stamp=t,
            pose=pose_matrix(self._odometry.poses[-1].tolist()),
            points=view.local,
            ids=view.ids,
            colors=self._palette[view.surface % 64] if self._scene.sensor.colors else None,
            moved=moved,
            removed=removed,
            session=self._session,
        )

    def _withdraw(self) -> Ids:
        """Ids of the points that a corrected map shows to be wrong: most of them."""
        doubted = np.concatenate([view.ids[view.bad] for view in self._recent])
        self._recent = []
        return np.asarray(doubted[self._rng.random(len(doubted)) < FOUND_WRONG])
