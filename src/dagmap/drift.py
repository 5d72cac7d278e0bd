"""The robot's own poses where its SLAM drifts: as the SLAM says them, and as they are published.

At some keyframes it was found how far the SLAM is off there (`bending`). What lies between two of
them is carried by both, by how near it is to each; what comes after the last one, by that one.
"""

from __future__ import annotations

from bisect import bisect
from collections import deque
from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from .config import PlacingConfig
from .keyframes import matrix_of
from .model import LIMIT_MM, Floats, Int32s, quantise_pose
from .payload import Anchor

MOVED_MM = 5.0  # an anchor that moves by less, or
TURNED = 0.0015  # rad turns by less, is not published again
AT_ONCE = 100  # cycles that are carried in a tick: a few ms


class Bend(NamedTuple):
    """A keyframe that the SLAM has elsewhere than it is."""

    cycle: int
    motion: Floats  # (4, 4) mm in the SLAM frame, from where the SLAM has it to where it is


class Drift:
    """What is known of the drift in the newest session of the robot's SLAM."""

    def __init__(self, config: PlacingConfig) -> None:
        self.rate = config.drift
        self.version = 0  # of the bends
        self.start(0)

    def start(self, session: int) -> None:
        """A session begins, where nothing is known yet."""
        self.session = session
        self._said: dict[int, Anchor] = {}  # by the SLAM
        self._bent: dict[int, Anchor] = {}  # of these, as published, where that is elsewhere
        self._due: deque[int] = deque()  # cycles that are to be carried anew
        self.bends: tuple[Bend, ...] = ()
        self._at: list[int] = []  # the cycles of the bends
        self.version += 1

    def enter(self, said: Anchor) -> Anchor:
        """A new cycle lies where the last keyframe says."""
        if not self.rate:
            return said
        self._said[said.cycle] = said
        anchor = self._carried(said)
        if anchor is not said:
            self._bent[said.cycle] = anchor
        return anchor

    def follow(self, moved: list[Anchor]) -> list[Anchor]:
        """The SLAM corrects itself, so what was found before is void. What is to be published."""
        if not self.rate or not moved:
            return moved
        self._said |= {anchor.cycle: anchor for anchor in moved}
        back = self._bent.keys() - {anchor.cycle for anchor in moved}
        self._bent, self.bends = {}, ()
        self._due.clear()
        self.version += 1
        return moved + [self._said[cycle] for cycle in sorted(back)]

    def bend(self, bends: Iterable[Bend]) -> None:
        """From now on this is known. `take` gives what it moves, a little in every tick."""
        self.bends = tuple(bends)
        self._at = [bend.cycle for bend in self.bends]
        self._due = deque(self._said)
        self.version += 1

    def take(self) -> list[Anchor]:
        """What is to be published anew, handed over."""
        out = []
        for _ in range(min(len(self._due), AT_ONCE)):
            said = self._said[self._due.popleft()]
            anchor, before = self._carried(said), self._bent.get(said.cycle, said)
            if _apart(matrix_of(anchor.pose), matrix_of(before.pose)):
                self._bent[said.cycle] = anchor
                out.append(anchor)
        return out

    def said(self, cycle: int) -> Floats | None:
        """(4, 4) mm where the SLAM has a cycle of the session."""
        said = self._said.get(cycle)
        return None if said is None else matrix_of(said.pose)

    def at(self, cycle: int) -> Floats:
        """(4, 4) mm what carries a cycle from where the SLAM has it to where it is."""
        if not self.bends:
            return np.eye(4)
        after = bisect(self._at, cycle)
        one = self.bends[max(after - 1, 0)]
        other = self.bends[min(after, len(self.bends) - 1)]
        if one is other:
            return one.motion
        return _between(one.motion, other.motion, (cycle - one.cycle) / (other.cycle - one.cycle))

    @property
    def now(self) -> Floats:
        """(4, 4) m the same for the next cycle."""
        out = self.bends[-1].motion.copy() if self.bends else np.eye(4)
        out[:3, 3] /= 1000.0
        return out

    def _carried(self, said: Anchor) -> Anchor:
        if not self.bends:
            return said
        place = self.at(said.cycle) @ matrix_of(said.pose)
        if np.abs(place[:3, 3]).max() >= LIMIT_MM:
            return said
        return replace(said, pose=_quantised(place))


def _between(one: Floats, other: Floats, share: float) -> Floats:
    """(4, 4) of two motions that differ little, at a share of the way from the one to the other."""
    out = (1 - share) * one + share * other
    u, _, vt = np.linalg.svd(out[:3, :3])
    out[:3, :3] = u @ vt
    return np.asarray(out)


def _apart(one: Floats, other: Floats) -> bool:
    change = np.abs(one - other)
    return bool(change[:3, 3].max() > MOVED_MM or change[:3, :3].max() > TURNED)


def _quantised(place: Floats) -> Int32s:
    metres = place.copy()
    metres[:3, 3] /= 1000.0
    return quantise_pose(metres)
