"""How robots and people move, and where a robot's SLAM believes it is."""

from __future__ import annotations

import bisect
import math
import random
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..config import _Checked
from ..model import Floats
from .building import Building

SWEEP, SWEEP_PERIOD = 0.8, 7.0  # rad, s: who walks looks to the left and to the right
TURN = 1.0  # s in which a walker turns into a new direction, while it walks
CLEAR = 0.5  # m between walls and whoever walks
MEMORY = 5.0  # m along which the direction of drift stays much the same
CLOSURE_REACH = 0.8  # m: a place is known again this near
CLOSURE_LENGTH = 10.0  # m walked at least since that place, and between loop closures


class MotionConfig(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The table [motion]."""

    kind: Literal["walk", "rotate"] = "walk"  # rotate: only turns, where it starts
    speed: float = 0.5  # m/s
    turn: float = 0.5  # rad/s, of a robot that only rotates
    drift: float = 0.005  # m per m walked, standard deviation
    drift_yaw: float = 0.0005  # rad per m walked, standard deviation
    loop_closures: bool = True  # whether the SLAM knows places again, and then corrects itself

    def __post_init__(self) -> None:
        self._require_range("speed", 0.01, 20.0)
        self._require_range("turn", -10.0, 10.0)
        self._require_range("drift", 0.0, 0.2)
        self._require_range("drift_yaw", 0.0, 0.1)


@dataclass(frozen=True, slots=True)
class _Leg:
    """A straight part of a route."""

    start: float  # s
    at: tuple[float, float]
    direction: tuple[float, float]  # of length 1
    heading: float  # rad
    turn: float  # rad from the heading before


class Route:
    """An endless walk through the rooms of a building; where it leads follows from `seed` alone.

    In every room to its middle, towards one of the walls and back, then through the door to the
    neighbour where it was least often. Times before zero are time zero.
    """

    def __init__(self, building: Building, room: int, speed: float, seed: str) -> None:
        self._building, self._speed = building, speed
        self._random = random.Random(seed)
        self._visits: dict[int, int] = {}
        self._room = room
        self._end = 0.0  # s, of the last leg
        self._at = self._beside(room)
        self._starts: list[float] = []
        self._legs: list[_Leg] = []

    def position(self, t: float) -> tuple[float, float]:
        """(x, y) m at a time in s."""
        t = max(t, 0.0)
        leg = self._leg(t)
        way = (t - leg.start) * self._speed
        return leg.at[0] + way * leg.direction[0], leg.at[1] + way * leg.direction[1]

    def heading(self, t: float) -> float:
        """rad from the x axis at a time in s."""
        t = max(t, 0.0)
        leg = self._leg(t)
        left = max(0.0, 1.0 - (t - leg.start) / TURN)  # of the turn into this leg
        return leg.heading - left * leg.turn + SWEEP * math.sin(2 * math.pi * t / SWEEP_PERIOD)

    def _leg(self, t: float) -> _Leg:
        while self._end <= t:
            self._visit(self._room)
        return self._legs[bisect.bisect_right(self._starts, t) - 1]

    def _visit(self, room: int) -> None:
        """The middle, a place beside it, the middle, and the middle of the next room."""
        self._visits[room] = self._visits.get(room, 0) + 1
        doors = self._building.neighbours(room)
        if doors:
            least = min(self._visits.get(other, 0) for other in doors)
            fresh = [other for other in doors if self._visits.get(other, 0) == least]
            self._room = self._random.choice(fresh)
        middle = self._building.centre(room)
        for place in (middle, self._beside(room), middle, self._building.centre(self._room)):
            self._go(place)

    def _beside(self, room: int) -> tuple[float, float]:
        """A place on the lines that join the middles of opposite walls; no boxes stand there."""
        config = self._building.config
        far = config.room / 2 - config.wall / 2 - CLEAR
        way = self._random.uniform(0.3, 1.0) * far * self._random.choice((-1, 1))
        x, y = self._building.centre(room)
        return (x + way, y) if self._random.random() < 0.5 else (x, y + way)

    def _go(self, to: tuple[float, float]) -> None:
        x, y = to[0] - self._at[0], to[1] - self._at[1]
        length = math.hypot(x, y)
        if length == 0.0:
            return
        heading = math.atan2(y, x)
        turn = math.remainder(heading - self._legs[-1].heading, math.tau) if self._legs else 0.0
        direction = (x / length, y / length)
        self._legs.append(_Leg(self._end, self._at, direction, heading, turn))
        self._starts.append(self._end)
        self._end += length / self._speed
        self._at = to


class Odometry:
    """The poses of one run of a SLAM: it drifts, and corrects itself where it knows a place.

    Poses are rows (x, y, z, yaw), m and rad: as with any inertial SLAM, roll and pitch do not
    drift. The first estimate is the truth.
    """

    def __init__(self, motion: MotionConfig, rng: np.random.Generator) -> None:
        self._motion, self._rng = motion, rng
        scale = np.array([motion.drift, motion.drift, motion.drift / 2, motion.drift_yaw])
        self._scale = scale
        self._bias = rng.standard_normal(4)
        self._count = 0
        self._closed = 0  # the cycle of the last closure
        self._true, self._poses = np.empty((64, 4)), np.empty((64, 4))
        self._way = np.empty(64)  # m walked up to each cycle

    @property
    def poses(self) -> Floats:
        """(cycles, 4) newest estimates."""
        return self._poses[: self._count]

    def step(self, true: Floats) -> None:
        """Go on to the true pose (4,)."""
        k, self._count = self._count, self._count + 1
        if k == len(self._way):
            self._true, self._poses = (np.tile(a, (2, 1)) for a in (self._true, self._poses))
            self._way = np.tile(self._way, 2)
        self._true[k] = true
        if k == 0:
            self._poses[0], self._way[0] = true, 0.0
            return
        step = true - self._true[k - 1]
        length = math.hypot(step[0], step[1])
        self._way[k] = self._way[k - 1] + length
        keep = math.exp(-length / MEMORY)
        fresh = math.sqrt(1 - keep * keep) * self._rng.standard_normal(4)
        self._bias = keep * self._bias + fresh
        error = length * self._scale * self._bias
        step[:2] = _turn(step[:2], self._poses[k - 1, 3] - self._true[k - 1, 3])
        self._poses[k] = self._poses[k - 1] + step + error

    def close(self) -> range:
        """Look for a place that is known, and correct the poses since the last closure.

        Gives the numbers of the cycles that moved, the newest included; none without a closure.
        """
        k, way = self._count - 1, self._way
        if not self._motion.loop_closures or way[k] - way[self._closed] < CLOSURE_LENGTH:
            return range(0)
        far = np.abs(self._true[: k + 1, :2] - self._true[k, :2]).max(axis=1) > CLOSURE_REACH
        known = np.flatnonzero(~far & (way[k] - way[: k + 1] >= CLOSURE_LENGTH))
        if len(known) == 0:
            return range(0)
        first, self._closed = self._closed, k
        self._bend(first, k, self._measured(int(known[0]), k))
        return range(first + 1, k + 1)

    def _measured(self, j: int, k: int) -> Floats:
        """Pose of cycle k as seen from the estimate of j, which was there before."""
        out: Floats = self._poses[j] + self._true[k] - self._true[j]
        turned = self._poses[j, 3] - self._true[j, 3]
        out[:2] = self._poses[j, :2] + _turn(self._true[k, :2] - self._true[j, :2], turned)
        return out

    def _bend(self, first: int, last: int, target: Floats) -> None:
        """Move cycle `last` to `target`, and those between as a pose graph would: each edge takes
        its share of the error, by its length (trajectory bending, Dubbelman and Browning 2015)."""
        poses, way = self._poses[first : last + 1], self._way[first : last + 1]
        share = (way - way[0]) / (way[-1] - way[0])
        yaw = share * (target[3] - poses[-1, 3])
        steps = np.diff(poses[:, :3], axis=0)
        steps[:, :2] = _turn(steps[:, :2].T, yaw[:-1]).T
        poses[1:, :3] = poses[0, :3] + np.cumsum(steps, axis=0)
        poses[:, 3] += yaw
        poses[:, :3] += share[:, None] * (target[:3] - poses[-1, :3])


def _turn(xy: Floats, yaw: float | Floats) -> Floats:
    """Rotate (2,) or (2, N) by an angle each."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([c * xy[0] - s * xy[1], s * xy[0] + c * xy[1]])


def matrices(poses: Floats) -> Floats:
    """(N, 4, 4) of poses (N, 4)."""
    out = np.zeros((len(poses), 4, 4))
    c, s = np.cos(poses[:, 3]), np.sin(poses[:, 3])
    out[:, 0, 0], out[:, 0, 1], out[:, 1, 0], out[:, 1, 1] = c, -s, s, c
    out[:, :3, 3] = poses[:, :3]
    out[:, 2, 2] = out[:, 3, 3] = 1.0
    return out
