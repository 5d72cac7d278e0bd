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
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..model import Bools, Cycle, Floats, Int64s
from .building import Building, SceneConfig, enter
from .sensor import Sensor, SensorConfig, displace
from .walk import MotionConfig, Odometry, Route, matrices

__all__ = ["MotionConfig", "Scene", "SceneConfig", "Seen", "SensorConfig", "Walker"]

PERSON = (0.5, 1.75)  # m, width and height
PEOPLE_SPEED = 1.1  # m/s
FOUND_WRONG = 0.7  # share of bad points that a SLAM withdraws when it closes a loop
_PERSON_SURFACE = -1
_BUILDING, _SENSOR, _COLORS = range(3)  # what chance is drawn for


class Seen(NamedTuple):
    """What a walker has handed in so far, a row a point."""

    points: Floats  # (N, 3) m in the fleet frame, where it truly is: no noise, drift or outlier
    stamps: Floats  # (N,) s
    sessions: Int64s  # (N,)
    ids: npt.NDArray[np.uint64]  # (N,)
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
        self._people_at: tuple[float, Floats] = math.nan, np.zeros((0, 2))
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

    def people(self, t: float) -> Floats:
        """(P, 2) m where people stand at a time in s."""
        if t != self._people_at[0]:
            places = np.array([person.position(t) for person in self._people]).reshape(-1, 2)
            self._people_at = t, places
        return self._people_at[1]

    def cast(self, origin: Floats, directions: Floats, t: float) -> tuple[Floats, Int64s]:
        """As `Building.cast` up to the sensor's range, with people (surface -1) in the way."""
        depth, surface = self.building.cast(origin, directions, self.sensor.range)
        people = self.people(t)
        half, height = PERSON[0] / 2, PERSON[1]
        near = np.abs(people - origin[:2]).max(axis=1) <= self.sensor.range + half
        if not near.any():
            return depth, surface
        people = people[near]
        low = np.column_stack([people - half, np.zeros(len(people))])
        high = np.column_stack([people + half, np.full(len(people), height)])
        with np.errstate(divide="ignore"):
            inverse = 1.0 / directions
        reach, _ = enter(origin, inverse, low[None], high[None])
        hit = (reach < depth) & (reach <= self.sensor.range)
        return np.where(hit, reach, depth), np.where(hit, _PERSON_SURFACE, surface)


class Walker:
    """One robot of a scene: where it truly is, and the cycles of its SLAM."""

    def __init__(self, scene: Scene, index: int, room: int) -> None:
        self._scene, self.index = scene, index
        seed = f"{scene.seed} robot {index}"
        self._route = Route(scene.building, room, scene.motion.speed, seed)
        self._seen = [_NOTHING]

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

    def cycles(self, until: float, start: float = 0.0, session: int = 0) -> Iterator[Cycle]:
        """The cycles of a SLAM that starts at `start`: one every period, before `until` (s).

        Poses are in the fleet frame where the SLAM starts, and drift from there. Each call is a
        run of its own: after a restart give it another session (`Config.same_origin` tells that
        it starts in the fleet frame again). The same arguments give the same cycles.
        """
        run = _Run(self._scene, self, session)
        period = self._scene.sensor.period
        for number in range(max(0, math.ceil((until - start) / period))):
            cycle, seen = run.cycle(start + number * period)
            self._seen.append(seen)
            yield cycle

    def seen(self) -> Seen:
        """All that was handed in by now, in that order."""
        columns = zip(*self._seen, strict=True)
        self._seen = [Seen(*(np.concatenate(column) for column in columns))]
        return self._seen[0]


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """What the sensor measured in one cycle, a row a point."""

    local: Floats  # (N, 3) m in the sensor frame, as measured
    true: Floats  # (N, 3) m in the fleet frame
    ids: npt.NDArray[np.uint64]
    outliers: Bools
    surface: Int64s

    @property
    def bad(self) -> Bools:
        return np.asarray(self.outliers | (self.surface == _PERSON_SURFACE))


class _Run:
    """One run of a robot's SLAM, from its start to a crash or the end."""

    def __init__(self, scene: Scene, walker: Walker, session: int) -> None:
        self._scene, self._walker, self._session = scene, walker, session
        self._rng = scene.chance(_SENSOR, walker.index, session)
        self._sensor = Sensor(scene.sensor)
        self._odometry = Odometry(scene.motion, self._rng)
        self._stamps: list[float] = []
        self._ids = 0  # given so far
        self._tracks = np.zeros((0, 3)), np.zeros(0, np.uint64)  # good points of the last cycle
        self._doubted: list[int] = []  # ids of bad points since the last loop closure
        self._palette = scene.chance(_COLORS).integers(0, 256, (64, 3), np.uint8)

    def cycle(self, t: float) -> tuple[Cycle, Seen]:
        """Look, go on, correct."""
        place, yaw = np.array(self._walker.position(t)), self._walker.heading(t)
        look = self._look(t, place, yaw)
        self._stamps.append(t)
        self._odometry.step(np.array([*place, yaw]))
        changed = self._odometry.close()
        removed = self._withdraw() if changed else None
        self._doubted += look.ids[look.bad].tolist()
        self._tracks = look.true[~look.bad], look.ids[~look.bad]
        poses = matrices(self._odometry.poses[changed.start : changed.stop])
        cycle = Cycle(
            stamp=t,
            pose=poses[-1] if changed else matrices(self._odometry.poses[-1:])[0],
            points=look.local,
            ids=look.ids,
            colors=self._palette[look.surface % 64] if self._scene.sensor.colors else None,
            moved=(np.array([self._stamps[i] for i in changed[:-1]]), poses[:-1])
            if changed
            else None,
            removed=removed,
            session=self._session,
        )
        person = look.surface == _PERSON_SURFACE
        shape = len(person)
        sessions = np.full(shape, self._session, np.int64)
        seen = Seen(look.true, np.full(shape, t), sessions, look.ids, look.outliers, person)
        return cycle, seen

    def _look(self, t: float, place: Floats, yaw: float) -> _Look:
        """Points that the SLAM tracks and new ones, up to the number per cycle."""
        config, rng, sensor = self._scene.sensor, self._rng, self._sensor
        turn = matrices(np.array([[0.0, 0.0, 0.0, yaw]]))[0, :3, :3]
        tracks, track_ids = self._tracked((self._tracks[0] - place) @ turn)
        length = np.sqrt((tracks * tracks).sum(axis=1))
        rays = np.concatenate([tracks / length[:, None], sensor.rays(rng, config.points)])
        depth, surface = self._scene.cast(place, rays @ turn.T, t)
        hit = np.isfinite(depth)
        hit[: len(tracks)] &= np.abs(depth[: len(tracks)] - length) < 1e-6  # nothing in the way
        rows = np.flatnonzero(hit)[: config.points]
        measured, kept = sensor.measure(rng, rays[rows], depth[rows], self._baseline(t))
        rows, measured = rows[kept], measured[kept]
        old = int(np.count_nonzero(rows < len(tracks)))
        factor, outliers = displace(rng, len(rows), config.outliers)
        factor[:old], outliers[:old] = 1.0, False
        fresh = np.arange(self._ids, self._ids + len(rows) - old, dtype=np.uint64)
        self._ids += len(fresh)
        return _Look(
            local=rays[rows] * (measured * factor)[:, None],
            true=place + (rays[rows] * depth[rows, None]) @ turn.T,
            ids=np.concatenate([track_ids[rows[:old]], fresh]),
            outliers=outliers,
            surface=surface[rows],
        )

    def _tracked(self, local: Floats) -> tuple[Floats, npt.NDArray[np.uint64]]:
        """Which of the last cycle's points (N, 3), in the sensor frame now, are looked for."""
        room = int(self._scene.sensor.tracked * self._scene.sensor.points)
        view = np.flatnonzero(self._sensor.in_view(local))
        view = self._rng.permutation(view)[:room]
        return local[view], self._tracks[1][view]

    def _baseline(self, t: float) -> float:
        """m by which the robot moved in the last period (at the start: will move)."""
        period = self._scene.sensor.period
        at = self._walker.position(t)
        other = t - period if self._stamps else t + period
        return math.dist(at, self._walker.position(other))

    def _withdraw(self) -> npt.NDArray[np.uint64]:
        """Ids of the points that a corrected map shows to be wrong: most of them."""
        doubted, self._doubted = np.array(self._doubted, np.uint64), []
        return doubted[self._rng.random(len(doubted)) < FOUND_WRONG]
