"""Where a robot's SLAM believes it is: poses that drift, until a loop is closed."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..model import Floats
from .walk import MotionConfig

MEMORY = 5.0  # m along which the direction of drift stays much the same
CLOSURE_REACH = 0.8  # m: a place is known again this near
CLOSURE_LENGTH = 10.0  # m walked at least since that place, and between loop closures
_ROOM = 64  # cycles for which there is room at first


class Odometry:
    """The poses of one run of a SLAM: it drifts, and corrects itself where it knows a place.

    Poses are rows (x, y, z, yaw), m and rad: as with any inertial SLAM, roll and pitch do not
    drift. The first estimate is the truth.
    """

    def __init__(self, motion: MotionConfig, rng: np.random.Generator) -> None:
        self._motion, self._rng = motion, rng
        self._scale = motion.drift, motion.drift, motion.drift / 2, motion.drift_yaw
        self._bias: list[float] = rng.standard_normal(4).tolist()
        self._count = 0
        self._closed = 0  # the cycle of the last closure
        self._true, self._poses = np.empty((0, 4)), np.empty((0, 4))
        self._way = np.empty(0)  # m walked up to each cycle
        self._chance: list[list[float]] = []

    @property
    def poses(self) -> Floats:
        """(cycles, 4) newest estimates."""
        return self._poses[: self._count]

    def step(self, true: Sequence[float]) -> None:
        """Go on to a true pose."""
        k, self._count = self._count, self._count + 1
        if k == len(self._way):
            self._grow()
        self._true[k] = true
        if k == 0:
            self._poses[0], self._way[0] = true, 0.0
            return
        before, last = self._true[k - 1].tolist(), self._poses[k - 1].tolist()
        x, y, z, yaw = (new - old for new, old in zip(true, before, strict=True))
        length = math.hypot(x, y)
        keep = math.exp(-length / MEMORY)
        fresh = math.sqrt(1 - keep * keep)
        pairs = zip(self._bias, self._chance[k], strict=True)
        self._bias = [keep * bias + fresh * chance for bias, chance in pairs]
        c, s = math.cos(last[3] - before[3]), math.sin(last[3] - before[3])
        step = (c * x - s * y, s * x + c * y, z, yaw)
        terms = zip(last, step, self._scale, self._bias, strict=True)
        self._poses[k] = [at + go + length * scale * bias for at, go, scale, bias in terms]
        self._way[k] = self._way[k - 1] + length

    def _grow(self) -> None:
        more = max(_ROOM, self._count)
        self._true = np.concatenate([self._true, np.empty((more, 4))])
        self._poses = np.concatenate([self._poses, np.empty((more, 4))])
        self._way = np.concatenate([self._way, np.empty(more)])
        self._chance += self._rng.standard_normal((more, 4)).tolist()

    def close(self) -> range:
        """Look for a place that is known, and correct the poses since then, or the last closure.

        Gives the numbers of the cycles that moved, the newest included; none without a closure.
        """
        k, way = self._count - 1, self._way
        if not self._motion.loop_closures or way[k] - way[self._closed] < CLOSURE_LENGTH:
            return range(0)
        far = np.abs(self._true[: k + 1, :2] - self._true[k, :2]).max(axis=1) > CLOSURE_REACH
        known = np.flatnonzero(~far & (way[k] - way[: k + 1] >= CLOSURE_LENGTH))
        if len(known) == 0:
            return range(0)
        j = int(known[0])
        first, self._closed = max(j, self._closed), k  # what is not in the loop stays
        self._bend(first, k, self._measured(j, k))
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


def pose_matrix(pose: Sequence[float]) -> Floats:
    """(4, 4) of a pose x, y, z, yaw."""
    x, y, z, yaw = pose
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0, x], [s, c, 0.0, y], [0.0, 0.0, 1.0, z], [0.0, 0.0, 0.0, 1.0]])
