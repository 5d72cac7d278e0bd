"""Where every SLAM frame lies in the fleet: the same on every robot, from the links alone.

Per connected component the origin is the frame of the lowest author id (the fleet's own frame has
author zero); the spanning tree takes the links with the most inliers first, then the lowest ids.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from .kernels.geometry import compose, invert
from .model import FLEET_FRAME, FrameId, Int32s
from .payload import Link

IDENTITY_POSE = (1 << 30, 0, 0, 0, 0, 0, 0)


def place_frames(links: Iterable[Link]) -> dict[FrameId, tuple[FrameId, Int32s]]:
    """For every linked frame: (origin of its component, (7,) pose of the frame in the origin)."""
    neighbours: dict[FrameId, list[tuple[FrameId, Int32s]]] = {}
    for link in _spanning_tree(links):
        neighbours.setdefault(link.source, []).append((link.target, link.pose))
        neighbours.setdefault(link.target, []).append((link.source, invert(link.pose)))
    placed: dict[FrameId, tuple[FrameId, Int32s]] = {}
    for origin in sorted(neighbours):
        if origin not in placed:
            _place_component(origin, neighbours, placed)
    return placed


def _spanning_tree(links: Iterable[Link]) -> list[Link]:
    """Kruskal over the links, best first."""
    leader: dict[FrameId, FrameId] = {}

    def find(frame: FrameId) -> FrameId:
        while (above := leader.get(frame, frame)) != frame:
            frame = above
        return frame

    def merit(link: Link) -> tuple[bool, int, FrameId, FrameId, bytes]:
        configured = link.target == FLEET_FRAME  # a robot's word on its own start comes first
        return (not configured, -link.inliers, link.source, link.target, link.pose.tobytes())

    tree = []
    for link in sorted(links, key=merit):
        a, b = find(link.source), find(link.target)
        if a != b:
            leader[max(a, b)] = min(a, b)
            tree.append(link)
    return tree


def _place_component(
    origin: FrameId,
    neighbours: dict[FrameId, list[tuple[FrameId, Int32s]]],
    placed: dict[FrameId, tuple[FrameId, Int32s]],
) -> None:
    """Walk the tree from its origin. `pose` of an edge (frame, other) carries frame into other."""
    placed[origin] = (origin, np.array(IDENTITY_POSE, np.int32))
    queue = [origin]
    for frame in queue:
        for other, pose in neighbours[frame]:
            if other not in placed:
                # pose carries `frame` into `other`; the way back leads to the origin
                placed[other] = (origin, compose(placed[frame][1], invert(pose)))
                queue.append(other)
