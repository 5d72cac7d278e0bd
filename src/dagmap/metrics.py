"""How good a map is, measured against a reference: pure functions over clouds of points in metres.

All clouds are thinned first, so that a place counts once, however often it was seen. scipy is the
extra `evaluate`, imported only when something is measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .model import DagmapError, Floats, Int64s

PITCH = 0.025  # m: what clouds are thinned to
THRESHOLDS = (0.02, 0.05, 0.10)  # m
_ENTROPY_RADIUS = 0.3  # m, as Razlaw et al. (2015)
_ENTROPY_NEIGHBOURS = 5  # fewer say nothing of a surface
_ENTROPY_FLOOR = 1e-6  # m^2 (1 mm squared): a plane without any noise would have -infinity
_PATCH_RADIUS = 0.15  # m
_PATCH_POINTS = 10  # of map and of reference in a patch
_PATCH_FLAT = 0.015  # m, RMS from its plane up to which the reference is one wall
_PATCHES = 2000  # looked at, evenly spread over the map
_WALL_GAP = 0.03  # m between two walls at least
_WALL_SHARE = 0.2  # of the points that the lesser of two walls has
_WALL_RATIO = 4.0  # gap to spread; halves of a uniform slab have 3.5, of one Gaussian 2.6


@dataclass(frozen=True, slots=True)
class Distances:
    """Of each point of one cloud to the nearest of another, m."""

    mean: float
    rmse: float
    p95: float


@dataclass(frozen=True, slots=True)
class AtThreshold:
    """Shares of points that have a counterpart within a threshold in m."""

    threshold: float
    precision: float  # of the estimate, in the reference
    recall: float  # of the recall reference, in the estimate
    f_score: float  # harmonic mean of the two; 0 where both are


@dataclass(frozen=True, slots=True)
class Score:
    """What `score` measures. Lengths in m; the counts are of thinned points."""

    points: int
    reference_points: int
    recall_points: int
    accuracy: Distances  # estimate to reference
    completeness: Distances  # recall reference to estimate
    at: tuple[AtThreshold, ...]
    chamfer_l1: float  # half the sum of the two means, as in occupancy networks (2019)
    chamfer_l2: float  # m^2, sum of the two means of squares, as in Fan et al. (2017)
    mean_map_entropy: float | None  # of the estimate alone; None where it is too sparse
    double_walls: float | None  # share of patches; None where no flat patch can be judged

    def f_score(self, threshold: float) -> float:
        """F-score at one of the thresholds measured. Raises KeyError for others."""
        return {row.threshold: row.f_score for row in self.at}[threshold]


def score(
    estimate: npt.ArrayLike,
    reference: npt.ArrayLike,
    recall_reference: npt.ArrayLike | None = None,
    thresholds: Sequence[float] = THRESHOLDS,
    pitch: float = PITCH,
) -> Score:
    """Measure a map (N, 3) m against a reference (M, 3) m, in one frame.

    recall_reference: what the map should hold, where that is less than the whole reference (a
        sensor sees a part of it); default: the reference.
    Raises DagmapError where a cloud is empty, not (N, 3), not finite, or scipy is missing.
    """
    cloud = thin(check_cloud(estimate, "the map"), pitch)
    precise = thin(check_cloud(reference, "the reference"), pitch)
    recalled = precise
    if recall_reference is not None:
        recalled = thin(check_cloud(recall_reference, "the recall reference"), pitch)
    there, back = nearest(cloud, precise), nearest(recalled, cloud)
    return Score(
        len(cloud),
        len(precise),
        len(recalled),
        _distances(there),
        _distances(back),
        tuple(_at(threshold, there, back) for threshold in thresholds),
        float(there.mean() + back.mean()) / 2,
        float((there**2).mean() + (back**2).mean()),
        mean_map_entropy(cloud),
        double_walls(cloud, precise),
    )


def check_cloud(cloud: npt.ArrayLike, what: str) -> Floats:
    """The points (N, 3) as float64. Raises DagmapError that names `what` where there are none."""
    points = np.asarray(cloud, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise DagmapError(f"{what}: shape {points.shape}; points (N, 3) in metres are wanted")
    if len(points) == 0:
        raise DagmapError(f"{what}: no points in it; there is nothing to measure")
    bad: Int64s = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise DagmapError(
            f"{what}: point {bad[0]} (and {len(bad) - 1} more) is not finite; drop such points"
        )
    return points


def thin(points: Floats, pitch: float = PITCH) -> Floats:
    """The first point of each cube of `pitch` m, in the order of the cubes."""
    _, first = np.unique(np.floor(points / pitch).astype(np.int64), axis=0, return_index=True)
    return np.asarray(points[first], np.float64)


def nearest(points: Floats, cloud: Floats) -> Floats:
    """(N,) m from each point to the nearest of a cloud that is not empty."""
    return np.asarray(tree_of(cloud).query(points)[0], np.float64)


def mean_map_entropy(points: Floats) -> float | None:
    """Crispness of a cloud without a reference: the lower, the crisper (Razlaw et al., 2015).

    Mean over the points of ln |2 pi e S| / 2, S the covariance of what lies within 30 cm. No
    eigenvalue of S counts for less than a square millimetre.
    """
    near = tree_of(points).query_ball_point(points, _ENTROPY_RADIUS, return_sorted=True)
    values = [
        np.linalg.eigvalsh(np.cov(points[index].T))
        for index in near
        if len(index) > _ENTROPY_NEIGHBOURS
    ]
    if not values:
        return None
    spread = np.maximum(np.array(values), _ENTROPY_FLOOR)
    return float(0.5 * np.log(2 * np.pi * np.e * spread).sum(axis=1).mean())


def double_walls(points: Floats, reference: Floats) -> float | None:
    """Share of the reference's flat patches where the map shows two walls instead of one.

    A patch is a ball of 15 cm around a point of the map, with at least ten points of either cloud,
    where the reference lies within 1.5 cm (RMS) of a plane. The map has two walls there if its
    points, split in two along the plane's normal, are at least 3 cm apart, each part has a fifth
    of them, and the gap is four times their spread about the two means.
    """
    step = -(-len(points) // _PATCHES)
    centres = points[::step]
    mine = tree_of(points).query_ball_point(centres, _PATCH_RADIUS, return_sorted=True)
    theirs = tree_of(reference).query_ball_point(centres, _PATCH_RADIUS, return_sorted=True)
    judged = [
        _is_double(points[a], reference[b])
        for a, b in zip(mine, theirs, strict=True)
        if min(len(a), len(b)) >= _PATCH_POINTS
    ]
    found = [double for double in judged if double is not None]
    return float(np.mean(found)) if found else None


def _is_double(patch: Floats, wall: Floats) -> bool | None:
    """Whether a patch shows two walls; None where the reference is not flat there."""
    centre = wall.mean(axis=0)
    spread, axes = np.linalg.eigh(np.cov((wall - centre).T))
    if spread[0] > _PATCH_FLAT**2 or spread[1] < _PATCH_FLAT**2:  # neither a line nor a heap
        return None
    along = np.sort((patch - centre) @ axes[:, 0])
    sums, squares = np.cumsum(along), np.cumsum(along**2)
    n = len(along)
    low = np.arange(1, n)
    left, right = sums[:-1] / low, (sums[-1] - sums[:-1]) / (n - low)
    within = squares[-1] - low * left**2 - (n - low) * right**2  # sum of squares about the means
    best = int(np.argmin(within))
    gap = right[best] - left[best]
    lesser = min(low[best], n - low[best]) / n
    about = np.sqrt(max(within[best], 0.0) / n)
    return bool(gap >= _WALL_GAP and lesser >= _WALL_SHARE and gap >= _WALL_RATIO * about)


def _at(threshold: float, there: Floats, back: Floats) -> AtThreshold:
    precision, recall = float((there <= threshold).mean()), float((back <= threshold).mean())
    total = precision + recall
    f_score = 2 * precision * recall / total if total > 0 else 0.0
    return AtThreshold(threshold, precision, recall, f_score)


def _distances(found: Floats) -> Distances:
    rmse = float(np.sqrt((found**2).mean()))
    return Distances(float(found.mean()), rmse, float(np.percentile(found, 95)))


def tree_of(points: Floats) -> Any:
    try:
        from scipy.spatial import cKDTree
    except ImportError:
        raise DagmapError(
            "measuring needs scipy, which is not installed; pip install 'dagmap[evaluate]'"
        ) from None
    return cKDTree(points)
