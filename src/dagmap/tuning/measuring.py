"""What a recording tells about its sensor, without truth: resolution and noise.

Noise is how far observations of one place scatter, measured between cycles, so errors of the poses
count as well: they part twins like noise does. Where the SLAM names its points, a repeated name is
one place. Else a point is held against the plane through the nearest points of other cycles; its
distance to that plane is the noise along the ray times the cosine between ray and normal. All of it
is judged by medians, which outliers hardly move. scipy is the extra `evaluate`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..metrics import tree_of
from ..model import Bools, Cycle, DagmapError, Floats, Int64s

MOST = 400_000  # points that are looked at; whole cycles, evenly over the recording
_LOOKED_AT = 6000  # points that are held against their neighbours
_NEIGHBOURS = (12, 24, 48, 96)  # of other cycles in a patch; more where noise blurs the plane
_CLEAR = 4.0  # a patch must be so many times as wide as its noise, or its plane is any
_FACING = 0.5  # cosine between ray and normal from which a patch shows noise along the ray
_WIDEST = 3.0  # a patch is no wider than so many times the distance of neighbours in a scan
_PAIRS = 30  # pairs or patches that a number is taken from at least
_SIGMA = 1.4826  # standard deviation of a normal distribution over the median of |x|
_BINS = 4  # of ranges


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Points of some robots, a row each. Frames: sessions are apart, robots share their first one.

    place: (N, 3) m where the SLAM has them now. ray: (N, 3) unit vectors from the sensor; reach:
    (N,) m along it. robot, cycle, frame: (N,) numbers; id: (N,), -1 where the SLAM gives none.
    """

    place: Floats
    ray: Floats
    reach: Floats
    robot: Int64s
    cycle: Int64s
    frame: Int64s
    id: Int64s

    def __len__(self) -> int:
        return len(self.place)

    def only(self, rows: npt.NDArray[Any]) -> Points:
        return Points(
            self.place[rows],
            self.ray[rows],
            self.reach[rows],
            self.robot[rows],
            self.cycle[rows],
            self.frame[rows],
            self.id[rows],
        )


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations of one observation, m, at the median range and at each of some ranges.

    along, across: of the ray; across is None where nothing tells. at: (range m, noise along it m),
    rising. power: with which the noise grows with the range. pairs: what it is taken from.
    """

    along: float
    across: float | None
    at: tuple[tuple[float, float], ...]
    power: float
    pairs: int
    method: str  # "repeated ids" or "planes"

    def within(self, reach: Floats) -> Floats:
        """m along the ray at each range."""
        at = np.array(self.at)
        return np.asarray(np.interp(reach, at[:, 0], at[:, 1]))


@dataclass(frozen=True, slots=True)
class Measured:
    """Of one or more recordings. Lengths in m, times in s."""

    robots: int
    cycles: int
    points: int
    period: float  # between two cycles, the median
    per_cycle: float  # points, the median
    ranges: tuple[float, float, float]  # 50th, 90th, 99th percentile
    in_scan: float  # from a point to the nearest of its own cycle, the median
    in_scan_90: float  # the 90th percentile
    between: float  # to the nearest of another cycle, the median
    overlap: float  # share of points with another cycle's point within twice `in_scan_90`
    noise: Noise
    between_robots: float | None  # m along the ray, of patches of other robots; None: no overlap


def measure(points: Points, period: float = 0.0) -> Measured:
    """Resolution and noise. Raises DagmapError where the cycles do not overlap."""
    spacing = _in_scan(points)
    reach = float(np.percentile(spacing, 90))
    between, overlap = _between(points, reach)
    noise = _by_ids(points) or _by_planes(points, reach)
    if noise is None:
        raise DagmapError(
            f"the cycles do not overlap enough to see noise: {overlap:.0%} of the points have a "
            "neighbour in another cycle; record a place from two sides, or for longer"
        )
    counts = np.bincount(points.cycle)
    ranges = np.percentile(points.reach, (50, 90, 99)).tolist()
    return Measured(
        robots=len(np.unique(points.robot)),
        cycles=int((counts > 0).sum()),
        points=len(points),
        period=period,
        per_cycle=float(np.median(counts[counts > 0])),
        ranges=(ranges[0], ranges[1], ranges[2]),
        in_scan=float(np.median(spacing)),
        in_scan_90=reach,
        between=between,
        overlap=overlap,
        noise=noise,
        between_robots=_between_robots(points, reach),
    )


def gather(recordings: Mapping[str, Iterable[Cycle]]) -> tuple[Points, float]:
    """All points of recordings by name, one a robot, at the newest poses of their cycles; and the
    median time between two cycles, s. Robots of one fleet share the frame of session 0.

    Raises DagmapError where a recording is empty, has no points, or all have one cycle together.
    """
    held = {name: list(cycles) for name, cycles in recordings.items()}
    for name, cycles in held.items():
        if not any(np.size(cycle.points) for cycle in cycles):
            what = "no points in any cycle" if cycles else "no cycles in it"
            raise DagmapError(f"{name}: {what}; there is nothing to tune by")
    names = ", ".join(held)
    if sum(map(len, held.values())) == 1:
        raise DagmapError(f"{names}: a single cycle; noise shows between two, record more")
    total = sum(np.size(cycle.points) // 3 for cycles in held.values() for cycle in cycles)
    every = max(1, -(-total // MOST))
    parts = [
        _rows(cycle, pose, robot, (robot << 32) + i)
        for robot, cycles in enumerate(held.values())
        for i, (cycle, pose) in enumerate(zip(cycles, _newest_poses(cycles), strict=True))
        if i % every == 0
    ]
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    columns[4] = np.unique(columns[4], return_inverse=True)[1].reshape(-1)
    gaps = [np.diff([float(c.stamp) for c in cycles]) for cycles in held.values()]
    joined = np.concatenate(gaps)
    return Points(*columns), float(np.median(joined)) if len(joined) else 0.0


def _rows(cycle: Cycle, pose: Floats, robot: int, number: int) -> tuple[npt.NDArray[Any], ...]:
    """The columns of `Points` of one cycle."""
    points = np.asarray(cycle.points, np.float64).reshape(-1, 3)
    reach = np.linalg.norm(points, axis=1)
    kept = np.isfinite(reach) & (reach > 0)
    points, reach, n = points[kept], reach[kept], int(kept.sum())
    frame = 0 if cycle.session == 0 else (1 + robot << 32) + int(cycle.session)
    ids = np.full(n, -1) if cycle.ids is None else np.asarray(cycle.ids)[kept]
    turned = points @ pose[:3, :3].T
    names = (np.full(n, robot), np.full(n, number), np.full(n, frame), ids.astype(np.int64))
    return turned + pose[:3, 3], turned / reach[:, None], reach, *names


def _newest_poses(cycles: Sequence[Cycle]) -> list[Floats]:
    """(4, 4) of each cycle, after all loop closures."""
    poses = [np.asarray(cycle.pose, np.float64) for cycle in cycles]
    row = {(int(c.session), float(c.stamp)): i for i, c in enumerate(cycles)}
    for cycle in cycles:
        if cycle.moved is not None:
            stamps, moved = cycle.moved
            for stamp, pose in zip(np.asarray(stamps).tolist(), np.asarray(moved), strict=True):
                at = row.get((int(cycle.session), float(stamp)))
                if at is not None:
                    poses[at] = np.asarray(pose, np.float64)
    return poses


def _in_scan(points: Points) -> Floats:
    """(M,) m from points to the nearest of their own cycle."""
    found = []
    starts = np.searchsorted(points.cycle, np.unique(points.cycle))
    ends = [*starts[1:].tolist(), len(points)]
    for start, end in list(zip(starts.tolist(), ends, strict=True))[:: max(1, len(starts) // 200)]:
        if end - start > 1:
            place = points.place[start:end]
            found.append(tree_of(place).query(place, 2)[0][:, 1])
    if not found:
        raise DagmapError("no cycle has two points; the resolution cannot be told")
    return np.concatenate(found)


def _sample(count: int, most: int = _LOOKED_AT) -> Int64s:
    """Rows, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def _neighbours(points: Points, rows: Int64s, k: int, key: Int64s) -> tuple[Floats, Int64s]:
    """Distances (M, k) and rows (M, k) of the nearest points of the same frame whose key differs
    from each row's; infinite and -1 where there are fewer."""
    distance, index = np.full((len(rows), k), np.inf), np.full((len(rows), k), -1)
    for frame in np.unique(points.frame[rows]):
        mine, all_ = np.flatnonzero(points.frame[rows] == frame), points.frame == frame
        members = np.flatnonzero(all_)
        tree, wanted = tree_of(points.place[members]), min(len(members), 4 * k)
        near, at = tree.query(points.place[rows[mine]], wanted)
        near, at = near.reshape(len(mine), -1), members[at.reshape(len(mine), -1)]
        other = key[at] != key[rows[mine]][:, None]
        order = np.argsort(~other, axis=1, kind="stable")[:, :k]
        picked = np.take_along_axis(other, order, 1)
        width = order.shape[1]
        distance[mine, :width] = np.where(picked, np.take_along_axis(near, order, 1), np.inf)
        index[mine, :width] = np.where(picked, np.take_along_axis(at, order, 1), -1)
    return distance, index


def _between(points: Points, reach: float) -> tuple[float, float]:
    """m to the nearest point of another cycle, the median; share with one within twice `reach`."""
    near = _neighbours(points, _sample(len(points)), 1, points.cycle)[0][:, 0]
    inside = near <= 2 * reach
    return float(np.median(near[inside])) if inside.any() else float("inf"), float(inside.mean())


def _by_ids(points: Points) -> Noise | None:
    """From points that the SLAM has named again; None where it has not."""
    named = np.flatnonzero(points.id >= 0)
    keys = (points.id[named], points.frame[named], points.robot[named])
    named = named[np.lexsort((points.cycle[named], *keys))]
    same = np.ones(max(0, len(named) - 1), np.bool_)
    for column in (points.id, points.frame, points.robot):
        same &= column[named[1:]] == column[named[:-1]]
    first, second = named[:-1][same], named[1:][same]
    if len(first) < _PAIRS:
        return None
    ray = points.ray[first] + points.ray[second]
    ray /= np.maximum(np.linalg.norm(ray, axis=1), 1e-9)[:, None]
    apart = points.place[second] - points.place[first]
    along = (apart * ray).sum(axis=1)
    across = np.linalg.norm(apart - along[:, None] * ray, axis=1)
    reach = (points.reach[first] + points.reach[second]) / 2
    # A pair has twice the variance of one; of two components across the median is 1.1774 sigma.
    sideways = float(np.median(across)) / 1.1774 / np.sqrt(2)
    return _noise(along / np.sqrt(2), reach, sideways, "repeated ids")


def _by_planes(points: Points, reach: float) -> Noise | None:
    found = patches(points, points.cycle, reach)
    if found is None:
        return None
    facing, ranges = found.facing, points.reach[found.rows]
    across = _across(found.off[found.flat], found.cosine[found.flat])
    return _noise(found.along[facing], ranges[facing], across, "planes")


def _between_robots(points: Points, reach: float) -> float | None:
    if len(np.unique(points.robot[points.frame == 0])) < 2:
        return None
    found = patches(points, points.robot, reach)
    return None if found is None else _sigma(found.along[found.facing])


class Patches(NamedTuple):
    """Points, a row each, against the plane through their neighbours.

    rows: (M,) of `Points`. off: (M,) m from the plane, as many as one observation is off. cosine:
    (M,) between ray and normal. rough: (M,) how far the neighbours are
    off their plane, over the median of patches at that range.
    """

    rows: Int64s
    off: Floats
    cosine: Floats
    rough: Floats

    @property
    def facing(self) -> Bools:
        """(M,) whether a patch shows noise along the ray: it faces the sensor, and is no corner."""
        return np.asarray((self.cosine > _FACING) & self.flat)

    @property
    def flat(self) -> Bools:
        """(M,) whether a patch is no rougher than most. The point itself has no part in that."""
        return np.asarray(self.rough <= 1.0)

    @property
    def along(self) -> Floats:
        """(M,) m along the ray, where `facing`."""
        return np.asarray(self.off / np.maximum(self.cosine, _FACING))


def patches(points: Points, key: Int64s, reach: float) -> Patches | None:
    """Some points against their neighbours of another key (cycle or robot).

    reach: m, how far apart neighbours in a scan are. None where fewer than `_PAIRS` have enough
    neighbours within some of that.
    """
    rows, best = _sample(len(points)), None
    for k in _NEIGHBOURS:
        distance, index = _neighbours(points, rows, k, key)
        whole = distance[:, -1] <= _WIDEST * reach
        if whole.sum() < _PAIRS:
            break
        off, cosine, rough = _against_planes(points, rows[whole], index[whole])
        rough /= _usual(rough, points.reach[rows[whole]])
        found = Patches(rows[whole], off, cosine, rough)
        if found.facing.sum() < _PAIRS:
            break
        best, width = found, float(np.median(distance[whole, -1]))
        if width > _CLEAR * _sigma(found.along[found.facing]):
            break
    return best


def _usual(rough: Floats, reach: Floats) -> Floats:
    """(M,) m, the median over patches at about the range of each."""
    edges = np.unique(np.percentile(reach, np.linspace(0, 100, 2 * _BINS + 1)))
    bins = np.searchsorted(edges[1:-1], reach)
    medians = [np.median(rough[bins == b]) if (bins == b).any() else 1.0 for b in range(len(edges))]
    return np.asarray(np.maximum(np.array(medians)[bins], 1e-9))


def _against_planes(points: Points, rows: Int64s, index: Int64s) -> tuple[Floats, ...]:
    patch = points.place[index]
    centre = patch.mean(axis=1)
    spread = patch - centre[:, None]
    moments = np.einsum("nki,nkj->nij", spread, spread)
    values, axes = np.linalg.eigh(moments)
    normal = axes[:, :, 0]
    away = points.place[rows] - centre
    off = (away * normal).sum(axis=1)
    # What the plane itself is off, where the point is: as of any regression with k points.
    k = index.shape[1]
    sideways = np.einsum("ni,nij->nj", away, axes[:, :, 1:])
    leverage = (sideways**2 / np.maximum(values[:, 1:], 1e-12)).sum(axis=1)
    cosine = np.abs((points.ray[rows] * normal).sum(axis=1))
    rough = np.sqrt(np.maximum(values[:, 0], 0.0) / k)
    return off / np.sqrt(1 + 1 / k + leverage), cosine, rough


def _across(off: Floats, cosine: Floats) -> float | None:
    """m across the ray: variances against cos^2, along at one end and across at the other."""
    edges, rows = np.linspace(0, 1, 5), []
    for low, high in pairwise(edges.tolist()):
        inside = (cosine**2 >= low) & (cosine**2 <= high)
        if inside.sum() >= _PAIRS:
            rows.append((float(np.mean(cosine[inside] ** 2)), _sigma(off[inside]) ** 2))
    if len(rows) < 2 or rows[0][0] > 0.3:
        return None
    part, variance = np.array(rows).T
    _, base = np.polyfit(part, variance, 1)
    return float(np.sqrt(max(base, 0.0)))


def _noise(along: Floats, reach: Floats, across: float | None, method: str) -> Noise | None:
    if len(along) < _PAIRS:
        return None
    edges = np.percentile(reach, np.linspace(0, 100, _BINS + 1))
    at = []
    for low, high in pairwise(edges.tolist()):
        inside = (reach >= low) & (reach <= high)
        if inside.sum() >= _PAIRS // 2:
            at.append((float(np.median(reach[inside])), _sigma(along[inside])))
    x, y = np.log(np.maximum(np.array(at), 1e-6)).T if len(at) > 1 else (np.zeros(2), np.zeros(2))
    power = float(np.polyfit(x, y, 1)[0]) if np.ptp(x) > 0.2 else 0.0
    return Noise(_sigma(along), across, tuple(at), power, len(along), method)


def _sigma(values: Floats) -> float:
    """Standard deviation of what is not an outlier."""
    return float(_SIGMA * np.median(np.abs(values)))
