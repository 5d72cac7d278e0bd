"""Which node a click means, and what the ledger says of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...config import FoldConfig
from ...model import Floats, State

if TYPE_CHECKING:
    from ...worldmap import Observation, WorldMap

ANGLE = 0.012  # radians about the ray in which a click finds a point


def pick(points: Floats, origin: Floats, direction: Floats, angle: float = ANGLE) -> int | None:
    """The row of `points` (N, 3) that a ray from `origin` (3,) along `direction` (3,) means.

    Of those within `angle` of the ray, what is in front counts more than what is well hit: a point
    that another one hides is not seen. None where there is no point.
    """
    ray = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    to = np.asarray(points, np.float64) - origin
    depth = to @ ray
    away = np.sqrt(np.maximum((to * to).sum(axis=1) - depth * depth, 0.0))
    hit = np.flatnonzero((depth > 0) & (away <= angle * depth))
    if not len(hit):
        return None
    front = hit[depth[hit] <= 1.05 * depth[hit].min()]
    return int(front[np.argmin(away[front] / depth[front])])


def reason(world: WorldMap, node: int, fold: FoldConfig) -> str:
    """Why a node is in the state that it is in."""
    hits, misses = int(world.hits[node]), int(world.misses[node])
    robots, state = int(world.witnesses[node]), world.states[node]
    votes = f"{_count(hits, 'hit')} against {_count(misses, 'miss', 'misses')}"
    if state == State.REJECTED:
        return f"not kept: {votes}, more than half of all must be hits"
    if state == State.CONFIRMED:
        return f"kept: {votes}, seen by {_count(robots, 'robot')} ({fold.witnesses} are enough)"
    return (
        f"kept for now: {votes}, but seen by {_count(robots, 'robot')} of the {fold.witnesses} "
        "that confirm a node"
    )


def sightings(world: WorldMap, node: int) -> list[tuple[str, list[Observation]]]:
    """The observations that a node is made of, by robot, each robot's first one first."""
    found: dict[str, list[Observation]] = {}
    for observation in world.provenance(node):
        found.setdefault(observation.robot, []).append(observation)
    for each in found.values():
        each.sort(key=lambda observation: observation.stamp)
    return sorted(found.items())


def _count(number: int, one: str, many: str = "") -> str:
    return f"{number} {one if number == 1 else many or one + 's'}"
