"""Poses over time: trajectories, and the tree of frames that tf tells."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from ...model import Floats, RecordingError

SLACK = 0.020 + 1e-9  # s: stamps no further apart are of one moment
_GAP = 1.0  # s: over longer ones nothing is interpolated
_MOST_FRAMES = 100  # between a sensor and the fixed frame
_FIXED = ("map", "odom", "world", "earth")  # what stands still is called so, by REP 105


def matrix(translation: Floats, quaternion: Floats) -> Floats | None:
    """(4, 4) from (3,) m and (4,) x y z w; None where they are no pose."""
    with np.errstate(over="ignore", invalid="ignore"):
        length = float(np.linalg.norm(quaternion))
    if not 0.9 < length < 1.1 or not np.isfinite(translation).all():
        return None
    x, y, z, w = quaternion / length
    pose = np.eye(4)
    pose[:3, 3] = translation
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return pose


def inverse(pose: Floats) -> Floats:
    """Of a rigid (4, 4)."""
    out = np.eye(4)
    out[:3, :3] = pose[:3, :3].T
    out[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return out


def between(a: Floats, b: Floats, share: float) -> Floats:
    """The pose at a share of the way from a to b: straight, turning at one rate."""
    turn = a[:3, :3].T @ b[:3, :3]
    angle = float(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    out = a.copy()
    out[:3, 3] = (1 - share) * a[:3, 3] + share * b[:3, 3]
    if angle > np.pi - 1e-3:  # the axis cannot be told: the nearer one of the two
        out[:3, :3] = a[:3, :3] if share < 0.5 else b[:3, :3]
    elif angle > 1e-9:
        axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        x, y, z = axis / (2 * np.sin(angle))
        k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        part = share * angle
        out[:3, :3] = a[:3, :3] @ (np.eye(3) + np.sin(part) * k + (1 - np.cos(part)) * k @ k)
    return out


@dataclass(slots=True)
class Trajectory:
    """Poses by stamp. They may be added in any order; of two with one stamp the later counts."""

    _rows: dict[float, Floats] = field(default_factory=dict)
    _stamps: Floats | None = None

    def add(self, stamp: float, pose: Floats) -> None:
        self._rows[stamp] = pose
        self._stamps = None

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def newest(self) -> float:
        """The last stamp; -inf where there is none."""
        return max(self._rows, default=-np.inf)

    def forget(self, before: float, kept: float = np.inf) -> None:
        """Let go of what is older than that, and than `kept` s before the one that came last."""
        if not self._rows:
            return
        before = max(before, next(reversed(self._rows)) - kept)
        self._rows = {stamp: pose for stamp, pose in self._rows.items() if stamp >= before}
        self._stamps = None

    def all(self) -> tuple[Floats, Floats]:
        """Rising stamps (M,) and poses (M, 4, 4)."""
        stamps = sorted(self._rows)
        return np.array(stamps), np.array([self._rows[stamp] for stamp in stamps])

    def at(self, stamp: float) -> Floats | None:
        """(4, 4) interpolated; the nearest one within 20 ms where there is no pair; else None."""
        if not self._rows:
            return None
        if self._stamps is None:
            self._stamps = np.array(sorted(self._rows))
        i = int(np.searchsorted(self._stamps, stamp))
        around = self._stamps[max(i - 1, 0) : i + 1].tolist()
        if len(around) == 2 and around[0] < stamp <= around[1] and around[1] - around[0] <= _GAP:
            a, b = around
            return between(self._rows[a], self._rows[b], (stamp - a) / (b - a))
        nearest = min(around, key=lambda s: abs(s - stamp))
        return self._rows[nearest] if abs(nearest - stamp) <= SLACK else None


@dataclass(slots=True)
class FrameTree:
    """tf: every frame has one parent, and a pose in it that may change with time."""

    _parents: dict[str, str] = field(default_factory=dict)
    _moving: dict[str, Trajectory] = field(default_factory=dict)
    _still: dict[str, Floats] = field(default_factory=dict)

    def add(self, parent: str, child: str, stamp: float | None, pose: Floats) -> None:
        """stamp: None for what never moves. What was told of another parent counts no more."""
        if self._parents.get(child, parent) != parent:
            self._moving.pop(child, None)
            self._still.pop(child, None)
        self._parents[child] = parent
        if stamp is None:
            self._still[child] = pose
        else:
            self._moving.setdefault(child, Trajectory()).add(stamp, pose)

    def __len__(self) -> int:
        return len(self._parents)

    def knows(self, frame: str) -> bool:
        """Whether a frame has a parent."""
        return frame in self._parents

    @property
    def still(self) -> list[tuple[str, str, float, Floats]]:
        """What never moves, as (parent, child, 0, pose)."""
        return [(self._parents[child], child, 0.0, pose) for child, pose in self._still.items()]

    def above(self, frame: str) -> list[str]:
        """The frame, its parent, and so on up to the root."""
        chain = [frame]
        while chain[-1] in self._parents and len(chain) < _MOST_FRAMES:
            chain.append(self._parents[chain[-1]])
        return chain

    def reached(self, target: str, frame: str) -> float:
        """Up to when the tree tells where `frame` is in `target`; inf where it never moves."""
        chains = self.above(target), self.above(frame)
        apart = set(chains[0]) ^ set(chains[1])  # what both have above them does not count
        moving = (self._moving[child] for child in apart if child in self._moving)
        return min((each.newest for each in moving), default=np.inf)

    def forget(self, before: float, kept: float = np.inf) -> None:
        """Let go of poses that are older, as `Trajectory` does."""
        for trajectory in self._moving.values():
            trajectory.forget(before, kept)

    def connects(self, target: str, frame: str) -> bool:
        return bool(set(self.above(target)) & set(self.above(frame)))

    def pose(self, target: str, frame: str, stamp: float) -> Floats | None:
        """(4, 4) of `frame` in `target`; None where the tree does not tell, or not for then."""
        common = next((f for f in self.above(target) if f in self.above(frame)), None)
        if common is None:
            return None
        down, up = self._up_to(common, frame, stamp), self._up_to(common, target, stamp)
        return None if down is None or up is None else inverse(up) @ down

    def _up_to(self, ancestor: str, frame: str, stamp: float) -> Floats | None:
        pose = np.eye(4)
        chain = self.above(frame)
        for child, _ in pairwise(chain[: chain.index(ancestor) + 1]):
            step = self._still.get(child)
            if step is None:
                step = self._moving[child].at(stamp)
            if step is None:
                return None
            pose = step @ pose
        return pose


class SensorPoses:
    """Where a sensor was: odometry (or another pose), with tf between its frame and the sensor's;
    or tf alone.

    where: what errors name. topic: of the poses; empty: tf alone. fixed: the frame that stands
    still, where tf has several. same_frame: poses are the sensor's, whatever frames are called.
    """

    def __init__(self, where: str, topic: str, fixed: str | None, same_frame: bool) -> None:
        self._where, self.topic = where, topic
        self._named, self._same_frame = fixed, same_frame
        self.trajectory, self.tree, self._child = Trajectory(), FrameTree(), ""
        self.held = ""  # the fixed frame while tf leads to it, whatever is told to be above it

    def add_pose(self, child: str, stamp: float, pose: Floats) -> None:
        """A pose of the topic. child: what it is the pose of, "" where it does not say."""
        self._child = child
        self.trajectory.add(stamp, pose)

    def add_frames(self, found: Iterable[tuple[str, str, float, Floats]], still: bool) -> None:
        """(parent, child, stamp, pose) of tf. still: they never move."""
        for parent, child, stamp, pose in found:
            self.tree.add(parent, child, None if still else stamp, pose)

    @property
    def known(self) -> bool:
        return bool(len(self.trajectory)) or bool(len(self.tree) and not self.topic)

    def check(self, frame: str) -> str:
        """What the poses are, in words. Raises RecordingError where they do not fit a frame."""
        if self.topic:
            if self._same(frame):
                return f"poses of {self.topic}"
            if self.tree.connects(self._child, frame):
                return f"poses of {self.topic}, tf from {self._child} to {frame}"
            raise RecordingError(
                f"{self._where}: {self.topic} tells where {self._child!r} is, and no tf leads "
                f"from there to {frame!r}, the sensor's frame; record /tf_static too, or say "
                "--same-frame if the poses are the sensor's"
            )
        return f"poses by tf: {frame} in {self.fixed(frame)}"

    def notes(self, frame: str) -> tuple[str, ...]:
        """What `check` says, and what is only assumed of it. Raises RecordingError as that does."""
        return tuple(said for said in (self.check(frame), self.assumed) if said)

    @property
    def assumed(self) -> str:
        """That poses without the name of a frame count as the sensor's; empty where it is known."""
        if not self.topic or self._same_frame or self._child or not len(self.trajectory):
            return ""
        return (
            f"{self.topic} does not say what it is the pose of (no child_frame_id), and is taken "
            "for the sensor's; if it is so, say --same-frame (same_frame = true in a robot's "
            'file); if not, use tf (--topic /tf, or odometry = "" in [ros]) or an odometry that '
            "names its child_frame_id"
        )

    def at(self, stamp: float, frame: str) -> Floats | None:
        """(4, 4) of the sensor at a moment; None where it is not known."""
        if not self.topic:
            return self.tree.pose(self.fixed(frame), frame, stamp)
        pose = self.trajectory.at(stamp)
        if pose is None or self._same(frame):
            return pose
        mounted = self.tree.pose(self._child, frame, stamp)
        return None if mounted is None else pose @ mounted

    def reached(self, frame: str) -> float:
        """Up to which stamp it is known where the sensor was."""
        if not self.topic:
            return self.tree.reached(self.fixed(frame), frame)
        if self._same(frame):
            return self.trajectory.newest
        return min(self.trajectory.newest, self.tree.reached(self._child, frame))

    def _same(self, frame: str) -> bool:
        return self._same_frame or self._child in ("", frame)

    def fixed(self, frame: str) -> str:
        """The frame that stands still. Raises RecordingError where none leads to the sensor's."""
        above = self.tree.above(frame)
        if self._named is not None:
            named = self._named.lstrip("/")
            if named not in above:
                raise RecordingError(
                    f"{self._where}: no tf leads from {self._named!r} to {frame!r}; above it are "
                    f"{', '.join(above)}"
                )
            return named
        if len(above) == 1:
            raise RecordingError(
                f"{self._where}: no tf leads to {frame!r}, the sensor's frame; record /tf and "
                "/tf_static too, or name a topic with poses by --topic"
            )
        if self.held in above:
            return self.held
        return next((name for name in _FIXED if name in above), above[-1])


def nearest(rising: Floats, stamps: Floats) -> list[int]:
    """Index of the nearest of some rising stamps, the earlier one of two as near."""
    right = np.minimum(np.searchsorted(rising, stamps), len(rising) - 1)
    left = np.maximum(right - 1, 0)
    later = np.abs(rising[right] - stamps) < np.abs(rising[left] - stamps)
    return [int(i) for i in np.where(later, right, left)]
