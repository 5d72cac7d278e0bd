"""Which cycles of the robot's own are kept, with descriptors, to be found by by other robots.

They are sent only where somebody wants them: in a fleet that shares its frame they cost nothing.
"""

from __future__ import annotations

import numpy as np

from .config import PlacingConfig
from .model import Floats, QuantisedCycle, pose_matrix
from .payload import Described

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
