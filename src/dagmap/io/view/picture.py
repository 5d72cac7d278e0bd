"""A snapshot as points to draw: which nodes, in which colours, how many of them."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from ...model import Floats, Int64s, State, Uint8s
from ..projection import ELEVATION, choose_view
from .colouring import owners_of, paint
from .picking import pick
from .snapshot import Snapshot
from .thinning import Thinning

_ENOUGH = 20_000  # points that tell how a map lies


class Picture:
    """The nodes of a snapshot in the states that a person wants to see.

    names: of all robots, in the order of their colours.
    """

    def __init__(self, snapshot: Snapshot, states: Collection[State], names: Sequence[str]) -> None:
        world = snapshot.world
        self.snapshot, self._robots = snapshot, len(names)
        self._nodes = np.flatnonzero(np.isin(world.states, [int(state) for state in states]))
        self._positions = np.asarray(world.positions, np.float64)[self._nodes]
        self._thinning = Thinning(self._positions)
        self._owners = owners_of(world, names)

    def __len__(self) -> int:
        return len(self._nodes)

    def colors(self, colouring: str) -> Uint8s:
        """(N, 3) of the nodes, in the order of `positions`."""
        painted = paint(self.snapshot.world, colouring, self._owners, self._robots)
        return painted[self._nodes]

    @property
    def positions(self) -> Floats:
        """(N, 3) metres."""
        return self._positions

    def everywhere(self, budget: int) -> Int64s:
        """Rows of points all over the map."""
        return self._thinning.everywhere(budget)

    def near(self, centre: Floats, radius: float, budget: int) -> Int64s:
        """Rows of the points about a place, metres."""
        return self._thinning.near(centre, radius, budget)

    def pick(self, origin: Floats, direction: Floats) -> int | None:
        """The node of the map that a click means, thinned out or not."""
        row = pick(self._positions, origin, direction)
        return None if row is None else int(self._nodes[row])


class Stand:
    """From where a snapshot is looked at first. All (3,) in metres."""

    def __init__(self, snapshot: Snapshot) -> None:
        points = np.asarray(snapshot.world.positions, np.float64)
        kept = points[np.asarray(snapshot.world.states) != State.REJECTED]
        points = kept if len(kept) else points
        points = points[:: max(1, len(points) // _ENOUGH)]
        poses = np.concatenate([np.zeros((0, 4, 4)), *(path.poses for path in snapshot.paths)])
        self.blind = not len(poses)  # up was guessed from the points alone
        axes = choose_view(points, poses).axes
        self.up = np.cos(ELEVATION) * axes[1] + np.sin(ELEVATION) * axes[2]
        low, high = np.zeros(3), np.zeros(3)
        if len(points):
            low, high = np.percentile(points, (2, 98), axis=0)
        self.look_at = (low + high) / 2
        self.size = max(float(np.linalg.norm(high - low)), 1.0)
        self.position = self.look_at + 0.7 * self.size * axes[2]
