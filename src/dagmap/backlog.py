"""Points of the SLAM that wait to be inserted until the robot has the time (section 5)."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from .model import Int32s, Int64s, Uint8s


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Points of one cycle, in the order in which they are to be inserted."""

    cycle: int  # number
    pose: Int32s  # (7,) of the sensor in the SLAM frame
    points: Int32s  # (N, 3) mm, sensor frame
    ids: npt.NDArray[np.uint64] | None
    colors: Uint8s | None

    def rows(self, rows: Int64s | slice | npt.NDArray[np.bool_]) -> Seen:
        """Some of them."""
        ids = None if self.ids is None else self.ids[rows]
        colors = None if self.colors is None else self.colors[rows]
        return replace(self, points=self.points[rows], ids=ids, colors=colors)

    def split(self, count: int) -> tuple[Seen, Seen]:
        """`count` of them, spread over all, and the others."""
        chosen = np.zeros(len(self.points), np.bool_)
        chosen[np.arange(count) * len(self.points) // max(count, 1)] = True
        return self.rows(chosen), self.rows(~chosen)


class Backlog:
    """First in, first out; `room` points at most, the oldest make way."""

    def __init__(self, room: int) -> None:
        self._room = room
        self._parts: deque[Seen] = deque()
        self._size = 0
        self.dropped = 0  # points, in all

    def __len__(self) -> int:
        return self._size

    def add(self, seen: Seen) -> None:
        """Leave these for later."""
        self._parts.append(seen)
        self._size += len(seen.points)
        if self._size > self._room:
            self.dropped += sum(len(part.points) for part in self.take(self._size - self._room))

    def take(self, count: int) -> list[Seen]:
        """The oldest, `count` points at most."""
        taken = []
        while self._parts and count > 0:
            part = self._parts.popleft()
            if len(part.points) > count:
                part, rest = part.split(count)
                self._parts.appendleft(rest)
            taken.append(part)
            count -= len(part.points)
            self._size -= len(part.points)
        return taken

    def move(self, cycle: int, pose: Int32s) -> None:
        """A loop closure moved a cycle: what waits of it will be inserted where it is now."""
        for i, part in enumerate(self._parts):
            if part.cycle == cycle:
                self._parts[i] = replace(part, pose=pose)
