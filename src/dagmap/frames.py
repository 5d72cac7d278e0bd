"""Where every SLAM frame lies in the fleet: the same on every robot, from the links alone.

Per connected component the origin is the frame of the lowest author id (the fleet's own frame has
author zero) that does not lie there by its own word alone. The spanning tree takes links by their
standing, then those with the most inliers, then the lowest ids:
  1. a robot's word on where its frame lies in the fleet's own;
  2. an author's links between frames of its own;
  3. links that both ends have published, alike: neither end can be placed by another's word; but
     not where they move a frame further than its configured start may be off;
  4. a robot's word on where its frame lies about in the fleet's own, the least uncertain first;
  5. what only one end says, where that end stands alone: it places itself, and nobody else. It is
     a guest there: it is never the origin, and binds its host to nothing.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from .kernels.geometry import compose, invert
from .model import FLEET_FRAME, QUATERNION_ONE, FrameId, Int32s
from .payload import CERTAIN, Link

IDENTITY_POSE = (1 << 30, 0, 0, 0, 0, 0, 0)
ALIKE_MM = 300  # two ends' links agree within so much, and
FAR_OFF = 3  # standard deviations of two configured starts, beside that
ALIKE_W = round(QUATERNION_ONE * 0.99966)  # cosine of half the angle: 3 degrees
Placed = dict[FrameId, tuple[FrameId, Int32s]]


class Standing(IntEnum):
    """What a link rests on, the best first."""

    CONFIGURED = 0
    OWN = 1
    MUTUAL = 2
    ROUGH = 3
    CLAIMED = 4


@dataclass(frozen=True, slots=True, eq=False)
class _Edge:
    standing: Standing
    inliers: int
    link: Link

    @property
    def merit(self) -> tuple[int, int, FrameId, FrameId, bytes]:
        link = self.link
        return (self.standing, -self.inliers, link.source, link.target, link.pose.tobytes())


def place_frames(links: Iterable[Link]) -> Placed:
    """For every linked frame: (origin of its component, (7,) pose of the frame in the origin).

    Each link is its source's author's; a link of 0 inliers is none.
    """
    neighbours: dict[FrameId, list[tuple[FrameId, Int32s]]] = {}
    tree, guests = _spanning_tree(_edges(links))
    for link in tree:
        neighbours.setdefault(link.source, []).append((link.target, link.pose))
        neighbours.setdefault(link.target, []).append((link.source, invert(link.pose)))
    placed: Placed = {}
    for origin in sorted(neighbours, key=lambda frame: (frame in guests, frame)):
        if origin not in placed:
            _place_component(origin, neighbours, placed)
    return placed


def contradicted(links: Iterable[Link], placed: Placed) -> list[Link]:
    """Links of both ends' that the frames as placed do not bear out: some chain is wrong."""
    out = []
    for edge in _edges(links):
        link = edge.link
        ends = placed.get(link.source), placed.get(link.target)
        if edge.standing != Standing.MUTUAL or ends[0] is None or ends[1] is None:
            continue
        if ends[0][0] == ends[1][0]:
            chain = compose(invert(ends[1][1]), ends[0][1])
            if not alike(chain, link.pose):
                out.append(link)
    return out


def alike(one: Int32s, other: Int32s) -> bool:
    """Whether two poses (7,) are one measurement: within 300 mm and 3 degrees."""
    turn = compose(invert(one), other)
    apart = one[4:].astype(np.int64) - other[4:].astype(np.int64)
    return abs(int(turn[0])) >= ALIKE_W and int((apart * apart).sum()) <= ALIKE_MM * ALIKE_MM


def rough(link: Link) -> bool:
    """Whether a link is a start pose that was configured with a standard deviation."""
    return link.target == FLEET_FRAME and link.inliers < CERTAIN


def _edges(links: Iterable[Link]) -> list[_Edge]:
    """Links by what they rest on. Of two ends that agree the lower author's pose counts."""
    known: dict[tuple[FrameId, FrameId], Link] = {}
    for link in sorted(links, key=_bytes):
        if link.inliers and link.source != link.target:
            known[link.source, link.target] = link
    starts = {link.source: link for link in known.values() if link.target == FLEET_FRAME}
    out = []
    for (source, target), link in known.items():
        back = known.get((target, source))
        if target == FLEET_FRAME:
            standing = Standing.ROUGH if rough(link) else Standing.CONFIGURED
            out.append(_Edge(standing, link.inliers, link))
        elif source.author == target.author:
            out.append(_Edge(Standing.OWN, link.inliers, link))
        elif back is None or not alike(link.pose, invert(back.pose)):
            out.append(_Edge(Standing.CLAIMED, link.inliers, link))
        elif source < target and _near_starts(link, starts.get(source), starts.get(target)):
            out.append(_Edge(Standing.MUTUAL, min(link.inliers, back.inliers), link))
    return out


def _near_starts(link: Link, one: Link | None, other: Link | None) -> bool:
    """Whether a link agrees with the configured starts of both its ends, if they have one."""
    if one is None or other is None:
        return True
    off = compose(other.pose, link.pose)[4:].astype(np.int64) - one.pose[4:]
    reach = ALIKE_MM + FAR_OFF * (2 * CERTAIN - one.inliers - other.inliers)
    return int(abs(off).max()) <= reach


def _bytes(link: Link) -> tuple[FrameId, FrameId, int, bytes]:
    return (link.source, link.target, link.inliers, link.pose.tobytes())


def _spanning_tree(edges: list[_Edge]) -> tuple[list[Link], set[FrameId]]:
    """Kruskal over the links, best first; and the frames that lie there by a claim of theirs."""
    together: dict[FrameId, set[FrameId]] = {}  # of each frame: those joined with it, itself too
    guests: set[FrameId] = set()
    tree = []
    for edge in sorted(edges, key=lambda edge: edge.merit):
        source, target = edge.link.source, edge.link.target
        a, b = together.setdefault(source, {source}), together.setdefault(target, {target})
        if a is b:
            continue
        if edge.standing == Standing.CLAIMED:
            if source in guests or any(f.author != source.author for f in a - guests):
                continue
            guests |= a
        less, more = (a, b) if len(a) < len(b) else (b, a)
        more |= less
        together.update(dict.fromkeys(less, more))
        tree.append(edge.link)
    return tree, guests


def _place_component(
    origin: FrameId,
    neighbours: dict[FrameId, list[tuple[FrameId, Int32s]]],
    placed: Placed,
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
