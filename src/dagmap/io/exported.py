"""A map as a table that file formats can hold: one row a node, chosen by who saw it and when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..model import Bools, Floats, OutputError, State, Uint8s

# The columns that a table may have beside position and colour, in the order in which formats
# write them.
FIELDS: dict[str, np.dtype[Any]] = {
    "state": np.dtype("u1"),
    "hits": np.dtype("<u4"),
    "misses": np.dtype("<u4"),
    "witnesses": np.dtype("<u2"),
    "robot": np.dtype("<u2"),  # who saw it first: a number into `robots`
    "stamp": np.dtype("<f8"),  # s, when it was last seen
}


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Who saw which node, when, and from where. One row each; frames as the table's.

    node: (M,) row of the table. robot: (M,) number into `robots`. stamp: (M,) s.
    sensor: (M, 3) m, NaN where only the cycle is known (a feature that was seen again).
    """

    node: npt.NDArray[np.int64]
    robot: npt.NDArray[np.int64]
    stamp: Floats
    sensor: Floats

    def only(self, rows: Bools) -> Observations:
        return Observations(self.node[rows], self.robot[rows], self.stamp[rows], self.sensor[rows])


@dataclass(frozen=True, slots=True, eq=False)
class MapTable:
    """Nodes of a map. positions (N, 3) m; colors (N, 3) uint8; fields: columns (N,) of `FIELDS`.

    robots: names by number. observations: None where the input is a mere `map.ply`.
    """

    positions: Floats
    colors: Uint8s
    fields: dict[str, npt.NDArray[Any]]
    robots: tuple[str, ...] = ()
    observations: Observations | None = None

    def __len__(self) -> int:
        return len(self.positions)

    def rays(self) -> tuple[Floats, Floats]:
        """Where sensors were (M, 3) and what they saw from there (M, 3), m."""
        seen = self.observations
        if seen is None:
            return np.zeros((0, 3)), np.zeros((0, 3))
        known = np.isfinite(seen.sensor[:, 0])
        return seen.sensor[known], self.positions[seen.node[known]]


@dataclass(frozen=True, slots=True)
class Filter:
    """Which nodes are wanted. None: whatever they are.

    robots and times belong together: a node stays where one of these robots saw it within them.
    box: lower and upper corner in m, borders in. since, until: s, both in.
    """

    states: tuple[State, ...] = (State.CONFIRMED, State.TENTATIVE)
    robots: tuple[str, ...] = ()
    box: tuple[float, ...] | None = None
    since: float | None = None
    until: float | None = None

    def __post_init__(self) -> None:
        box = self.box
        if box is not None and not all(a <= b for a, b in zip(box[:3], box[3:], strict=True)):
            raise OutputError(
                f"--box {' '.join(map(str, box))}: the lower corner is wanted first, then the upper"
            )
        if self.since is not None and self.until is not None and self.since > self.until:
            raise OutputError(f"--since {self.since} lies after --until {self.until}; swap them")

    @property
    def by_observation(self) -> bool:
        return bool(self.robots) or self.since is not None or self.until is not None


def choose(table: MapTable, wanted: Filter) -> MapTable:
    """The nodes that pass. Raises OutputError where the table cannot tell, or a robot is unknown.

    `stamp` is that of the last observation which passed; rays are those of such observations.
    """
    keep = np.isin(table.fields["state"], [int(state) for state in wanted.states])
    if wanted.box is not None:
        low, high = np.array(wanted.box[:3]), np.array(wanted.box[3:])
        keep &= ((table.positions >= low) & (table.positions <= high)).all(axis=1)
    seen = table.observations
    fields = table.fields
    if wanted.by_observation:
        seen = _passing(table, wanted)
        keep &= np.bincount(seen.node, minlength=len(table)) > 0
        fields = {**fields, "stamp": last_seen(seen, len(table))}
    if seen is not None:
        number = np.cumsum(keep) - 1
        seen = seen.only(keep[seen.node])
        seen = replace(seen, node=number[seen.node])
    return MapTable(
        table.positions[keep],
        table.colors[keep],
        {name: column[keep] for name, column in fields.items()},
        table.robots,
        seen,
    )


def last_seen(seen: Observations, count: int) -> Floats:
    """(count,) s, the newest stamp of each node; NaN where it has none."""
    out = np.full(count, -np.inf)
    np.maximum.at(out, seen.node, np.nan_to_num(seen.stamp, nan=-np.inf))
    out[np.isinf(out)] = np.nan
    return out


def _passing(table: MapTable, wanted: Filter) -> Observations:
    seen = table.observations
    if seen is None:
        raise OutputError(
            "a map.ply does not say who saw a node, or when; give the folder that `dagmap replay` "
            "wrote, or a ledger, to choose by --robot, --since or --until"
        )
    rows = np.ones(len(seen.node), np.bool_)
    if wanted.robots:
        rows &= np.isin(seen.robot, _numbers(table.robots, wanted.robots))
    if wanted.since is not None:
        rows &= seen.stamp >= wanted.since
    if wanted.until is not None:
        rows &= seen.stamp <= wanted.until
    return seen.only(rows)


def _numbers(robots: Sequence[str], wanted: Sequence[str]) -> list[int]:
    unknown = [name for name in wanted if name not in robots]
    if unknown:
        raise OutputError(
            f"--robot {unknown[0]}: the map knows no robot of this name; there are "
            f"{', '.join(robots) or 'none'}"
        )
    return [i for i, name in enumerate(robots) if name in wanted]
