"""Which cycles of the robot's own are kept, with descriptors, to be found by other robots; and
keyframes as they were published, where the newest poses of their anchors put them.

They are sent only where somebody wants them: in a fleet that shares its frame they cost nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .config import PlacingConfig
from .kernels.geometry import compose
from .model import QUATERNION_ONE, AuthorId, Floats, Int32s, Uint8s, pose_matrix
from .payload import Described
from .quantising import QuantisedCycle
from .registration import Views

RECORD = 44  # bytes of a described point on the wire
_HEAD = 12  # bytes of a record beside its points, at most


class Keyframes:
    """One robot's keyframes. `wanted` says whether they are to be sent."""

    def __init__(self, config: PlacingConfig) -> None:
        self._config = config
        self.wanted = False
        self._held: list[Described] = []  # not sent yet
        self.start()

    def start(self) -> None:
        """A new session of the SLAM has keyframes of its own."""
        self._poses: list[Floats] = []  # (4, 4) of all keyframes of the session

    def see(self, number: int, cycle: QuantisedCycle) -> None:
        """Keep a cycle with descriptors if none was taken near its pose."""
        if cycle.descriptors is None or len(cycle.points) < 3:
            return
        pose = pose_matrix(cycle.pose)
        if len(self._poses) >= self._config.keyframes or not self._new(pose):
            return
        self._poses.append(pose)
        most = self._config.points
        self._held.append(Described(number, cycle.points[:most], cycle.descriptors[:most]))

    def _new(self, pose: Floats) -> bool:
        if not self._poses:
            return True
        poses = np.array(self._poses)
        away = np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1)
        cosine = (np.einsum("kij,ij->k", poses[:, :3, :3], pose[:3, :3]) - 1) / 2
        turned = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        config = self._config
        near = (away < config.keyframe_distance) & (turned < config.keyframe_turn)
        return not near.any()

    @property
    def due(self) -> bool:
        return self.wanted and bool(self._held)

    def take(self) -> list[Described]:
        """What is to be sent now, handed over."""
        if not self.wanted:
            return []
        out, self._held = self._held, []
        return out


def fill(
    described: list[Described], room: int
) -> tuple[tuple[Described, ...], list[Described], int]:
    """As many keyframes as fit into `room` bytes; those left; the room left."""
    count = 0
    for keyframe in described:
        size = _HEAD + RECORD * len(keyframe.position)
        if size > room:
            break
        room -= size
        count += 1
    return tuple(described[:count]), described[count:], room


@dataclass(slots=True, eq=False)
class Keyframe:
    """A published keyframe, carried into its SLAM frame by the newest pose of its anchor."""

    author: AuthorId
    described: Described
    pose: Int32s  # (7,) of the anchor
    place: Floats = field(init=False)  # (4, 4) mm
    points: Floats = field(init=False)  # (N, 3) mm in the SLAM frame
    depth: float = field(init=False)  # mm, median distance of a point from the sensor
    judged: Floats = field(init=False)  # where it was when proposals were last to be judged anew

    def __post_init__(self) -> None:
        self.depth = float(np.median(np.linalg.norm(self.described.position, axis=1)))
        self.move(self.pose)
        self.judged = self.place

    def move(self, pose: Int32s) -> None:
        self.pose, self.place = pose, pose_matrix(pose)
        self.place[:3, 3] *= 1000.0
        turned = self.described.position @ self.place[:3, :3].T
        self.points = np.asarray(turned + self.place[:3, 3])

    def went_beyond(self, reach: float) -> bool:
        """Whether its points moved by more, mm, since this was last so."""
        change = np.abs(self.place - self.judged)[:3] * (self.depth, self.depth, self.depth, 1.0)
        if change.max() <= reach:
            return False
        self.judged = self.place
        return True

    @property
    def descriptors(self) -> Uint8s:
        return self.described.descriptors


def views(keyframes: list[Keyframe]) -> Views:
    """Keyframes of one SLAM frame, in the form that judging takes."""
    return Views(
        np.array([keyframe.place for keyframe in keyframes]),
        [keyframe.points for keyframe in keyframes],
        [keyframe.descriptors for keyframe in keyframes],
        float(np.median([keyframe.depth for keyframe in keyframes])) if keyframes else 0.0,
    )


def matrix_of(pose: Int32s) -> Floats:
    """(4, 4) mm of a (7,) pose, whose quaternion may be off by a thousandth."""
    still = np.array((QUATERNION_ONE, 0, 0, 0, 0, 0, 0), np.int32)
    out = pose_matrix(compose(pose, still))
    out[:3, 3] *= 1000.0
    return out
