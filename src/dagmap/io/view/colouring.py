"""In which colour a node is shown, by what a person wants to see."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ...model import Floats, Int64s, State, Uint8s
from ..export import MapLike, PlyMap
from ..panels import rgb, robot_colors, visible

if TYPE_CHECKING:
    from ...worldmap import WorldMap

STATE, ROBOT, RATIO, COLOUR = COLOURINGS = ("state", "robot", "hit ratio", "colour seen")
SEVERAL = "#8a2fb8"  # seen by more than one robot: the figures' colour of merged nodes
_STATES = {State.CONFIRMED: "#1d9a3c", State.TENTATIVE: "#e0a021", State.REJECTED: "#e0261b"}
_RATIOS = ("#d7301f", "#c9b458", "#2166d1")  # no hit, as many hits as misses, no miss
UNKNOWN = "#808080"


def paint(world: MapLike, colouring: str, owners: Int64s, robots: int) -> Uint8s:
    """(N, 3) colours of all nodes. owners: see `owners_of`; robots: how many have a colour."""
    if colouring == STATE:
        palette = _bytes([_STATES[state] for state in State])
        return palette[np.asarray(world.states, np.int64)]
    if colouring == ROBOT:
        palette = _bytes([*robot_colors(robots), UNKNOWN, SEVERAL])  # -2 and -1 count from the end
        return palette[owners]
    if colouring == RATIO:
        return _ramp(hit_ratio(world))
    return np.asarray(np.rint(255 * visible(world.colors)), np.uint8)


def legend(colouring: str, names: Sequence[str]) -> list[tuple[str, str]]:
    """(name, "#rrggbb") of what the colours mean."""
    if colouring == STATE:
        return [(state.name.lower(), _STATES[state]) for state in State]
    if colouring == ROBOT:
        colors = robot_colors(len(names))
        return [*zip(names, colors, strict=True), ("several robots", SEVERAL)]
    if colouring == RATIO:
        return list(zip(("misses only", "half and half", "hits only"), _RATIOS, strict=True))
    return []


def owners_of(world: WorldMap | PlyMap, names: Sequence[str]) -> Int64s:
    """(N,) which of the robots alone has seen a node; -1: several have, -2: nobody knows."""
    owners = np.full(len(world.positions), -2, np.int64)
    if not isinstance(world, PlyMap):
        for i, name in enumerate(names):
            nodes = world.nodes_of(name)
            owners[nodes[nodes >= 0]] = i
    owners[np.asarray(world.witnesses, np.int64) > 1] = -1
    return owners


def hit_ratio(world: MapLike) -> Floats:
    """(N,) hits of hits and misses, from 0 to 1; 0 where there are neither."""
    hits, misses = (np.asarray(column, np.float64) for column in (world.hits, world.misses))
    return np.asarray(hits / np.maximum(hits + misses, 1), np.float64)


def _ramp(ratio: Floats) -> Uint8s:
    stops = rgb(_RATIOS)
    channels = [np.interp(ratio, (0.0, 0.5, 1.0), stops[:, i]) for i in range(3)]
    return np.asarray(np.rint(255 * np.stack(channels, axis=1)), np.uint8)


def _bytes(colors: Sequence[str]) -> Uint8s:
    return np.asarray(np.rint(255 * rgb(colors)), np.uint8)
