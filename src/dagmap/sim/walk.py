"""How robots and people move."""

from __future__ import annotations

import bisect
import math
import random
from dataclasses import dataclass
from typing import Literal

from ..config import _Checked
from .building import Building

SWEEP, SWEEP_PERIOD = 0.8, 7.0  # rad, s: who walks looks to the left and to the right
TURN = 1.0  # s in which a walker turns into a new direction, while it walks
CLEAR = 0.5  # m between walls and whoever walks


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
