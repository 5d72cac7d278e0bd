"""Whether merged positions are nearer to the truth than the single observations that went in.

Every point gets depth noise of a Kinect along its ray, sigma = 1.2 mm + 1.9 mm (z / m - 0.4)^2
(Nguyen, Izadi and Lovell, 3DIMPVT 2012), beside what the recording itself has; then a share of all
is displaced. Looked at are observations that were not displaced, in nodes that the map shows and
that have at least so many. Each is compared with its node, so places and weights are equal:
  point: an observation is off by its distance to where it was before the noise; its node by its
    distance to the mean of those places, of all its observations that were not displaced;
  surface: off by the distance to the plane through the cloud of all depth pictures, where that is
    flat. The recording's own noise is in this one.
A displaced observation that is taken into a node draws it away, which counts. Below 1 a ratio says
that merging helps; without any other error than noise it would be near 1 / sqrt(observations).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

import office
from dagmap import Agent, Identity
from office import Frame, Points, Walk

LEAST = (2, 3, 5)  # observations of a node
SHARES = (0.0, 0.2, 0.4)  # displaced
_REACH, _NEIGHBOURS, _FLAT = 0.075, 12, 0.01  # m around, points within, m RMS off their plane
_SAME = 0.004  # m that rounding moves a point at most


def measure(walk: Walk, listen: Callable[[Walk], Agent], seeds: int) -> list[dict[str, Any]]:
    """listen: the agent that holds the map of a walk. One row a share and number of observations:
    mm off, of the observations and of their nodes, and the ratios; the median of the seeds."""
    rows = []
    for share in SHARES:
        found = []
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            changed = office.displaced(noisy(walk, rng), share, rng)
            found.append(_one(walk, changed, listen(changed)))
        for least in LEAST:
            mine = [seed[least] for seed in found]
            medians = {key: round(float(np.median([m[key] for m in mine])), 3) for key in mine[0]}
            rows.append({"displaced": share, "observations": least, **medians})
    return rows


def noisy(walk: Walk, rng: np.random.Generator) -> Walk:
    def change(_: int, frame: Frame) -> Frame:
        z = frame.points[:, 2]
        off = rng.normal(0, 1, len(z)) * (0.0012 + 0.0019 * (z - 0.4) ** 2)
        return replace(frame, points=frame.points * (1 + off / z)[:, None], descriptors=None)

    return walk.map(change)


def _one(walk: Walk, changed: Walk, agent: Agent) -> dict[int, dict[str, float]]:
    world = agent.map
    node, seen, true = _observations(walk, changed, agent)
    count = np.bincount(_nodes(agent), minlength=len(world.positions))
    good = world.kept[node]
    node, seen, true = node[good], seen[good], true[good]
    mine = np.maximum(np.bincount(node, minlength=len(count)), 1)[:, None]
    centre = np.stack([np.bincount(node, t, len(count)) for t in true.T], axis=1) / mine
    off = {
        "point": (_lengths(seen - true), _lengths(world.positions - centre)[node]),
        "surface": (_off_surface(walk, seen), _off_surface(walk, world.positions)[node]),
    }
    return {least: _compared(off, count[node] >= least) for least in LEAST}


def _nodes(agent: Agent) -> npt.NDArray[np.int64]:
    """The node of every observation, whatever became of its point."""
    fold = next(c.fold for c in agent.consensus.folded.components.values() if len(c.fold))
    authors = agent.consensus.authors.values()
    nodes = np.concatenate([fold.feature_nodes(author.index) for author in authors])
    return nodes[nodes >= 0].astype(np.int64)


def _observations(
    walk: Walk, changed: Walk, agent: Agent
) -> tuple[npt.NDArray[np.int64], Points, Points]:
    """Node, place as handed in, and true place, of the observations that were not displaced."""
    fold = next(c.fold for c in agent.consensus.folded.components.values() if len(c.fold))
    robots = {Identity.from_seed(bytes([1 + i]) * 32).author: i for i in range(len(walk.robots))}
    handed = [np.concatenate([f.placed for f in robot]) for robot in changed.robots]
    false = [np.concatenate([f.false for f in robot]) for robot in changed.robots]
    truth = [np.concatenate([f.placed for f in robot]) for robot in walk.robots]
    trees, found = [cKDTree(points) for points in handed], []
    for contribution in agent.consensus.contributions():
        robot, first = robots[contribution.author.id], contribution.base
        nodes = fold.feature_nodes(contribution.author.index)
        nodes = nodes[first : first + len(contribution.xyz)]
        away, at = trees[robot].query(contribution.xyz / 1000.0)
        sure = (nodes >= 0) & (away <= _SAME) & ~false[robot][at]
        found.append((nodes[sure], handed[robot][at[sure]], truth[robot][at[sure]]))
    node, seen, true = (np.concatenate(column) for column in zip(*found, strict=True))
    return node.astype(np.int64), seen, true


def _off_surface(walk: Walk, points: Points) -> Points:
    """(N,) m to the plane through the cloud around, NaN where it is not flat there."""
    tree, out = cKDTree(walk.dense), np.full(len(points), np.nan)
    for i, rows in enumerate(tree.query_ball_point(points, _REACH)):
        if len(rows) >= _NEIGHBOURS:
            around = walk.dense[rows] - walk.dense[rows].mean(axis=0)
            values, axes = np.linalg.eigh(around.T @ around)
            if values[0] <= _FLAT**2 * len(rows):
                out[i] = abs((points[i] - walk.dense[rows].mean(axis=0)) @ axes[:, 0])
    return out


def _lengths(vectors: Points) -> Points:
    return np.asarray(np.linalg.norm(vectors, axis=1))


def _compared(off: dict[str, tuple[Points, Points]], chosen: Points) -> dict[str, float]:
    out: dict[str, float] = {}
    for name, pair in off.items():
        known = chosen & np.isfinite(pair[0]) & np.isfinite(pair[1])
        single, merged = (1000 * values[known] for values in pair)
        out[f"{name}_compared"] = int(known.sum())
        for how, of in (("mean", np.mean), ("rms", lambda v: np.sqrt(np.mean(v**2)))):
            out[f"{name}_{how}_single_mm"] = float(of(single))
            out[f"{name}_{how}_merged_mm"] = float(of(merged))
            out[f"{name}_{how}_ratio"] = float(of(merged) / of(single))
    return out
