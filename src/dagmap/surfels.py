"""A SLAM frame's points as surfels: small pieces of surface, and what rays have found free.

A robot whose keyframes have no descriptors is placed by the shape of what it saw (`aligning`).
Coordinates are float64 millimetres in the SLAM frame, as in `registration`: what comes of them is
a proposal that its finder signs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from .kernels.voxels import SHIFT, pass_through
from .model import Bools, Floats, Int32s, Int64s
from .registration import Working

AXES = 6  # directions that surfaces face, of a cloud, at most
FREE = 1 << (2 * AXES)  # bit of a cell that rays pass through
FACING = 1 << 10  # length of a normal in integers
MOST = 20_000  # occupied cells; where there are more, cells are larger
CELLS = 1 << 22  # of a grid
FINE = 1.25  # tolerances: edge of the smallest cells
FILLED = 12  # points around a point, in the median: else cells are larger
_LARGER = 1.25  # so much, each time
_FEW = 6  # points of a surfel at least
_SPARSE = 0.35  # of the usual number around a point: so many, too; stray points are fewer
_FLAT = 0.35  # of its extent along the surface: how thick it is at most
_RAYS = 30_000
_PASSES = 2  # rays that prove a cell free
_SHORT = 2  # cells before its end in which a ray proves nothing
_ALIGNED = np.cos(np.radians(10.0))
_APART = np.cos(np.radians(20.0))
_MINOR = 0.015  # of the surfels: fewer make no axis
_MODES, _SAMPLED = 128, 2500  # surfels that axes are looked for among
_ORIGINS = slice(10, 13)  # columns of the moments
_WIDE = 100_000  # smallest cells from the middle: what lies further away is left out
_UNIT_POINTS, _UNIT_RAYS, _UNIT_CELLS = 4000, 1000, 1 << 18
_BITS = 21  # of a key, for each axis


@dataclass(frozen=True, slots=True, eq=False)
class Surfels:
    """What a SLAM frame shows of surfaces, S of them.

    origin (3,) mm in the SLAM frame: from there everything here is counted, to keep it precise.
    points (S, 3) mm; normals (S, 3) towards the sensor; groups (S,) the keyframe that saw it first.
    axes (A, 3): directions that many face, most first. kinds (S,): 2 a + (1 where it faces against
    axis a), or -1. rarity (S,): how few face as it does at its place along that axis.
    low (3,), shape (3,): the grid; cells (C,): a bit of each kind of surfel in a cell or beside it,
    and FREE; which (C,): the surfel in a cell, or -1.
    """

    cell: float
    origin: Floats
    points: Floats
    normals: Floats
    groups: Int64s
    axes: Floats
    kinds: Int64s
    rarity: Floats
    low: Floats
    shape: Int64s
    cells: Int32s
    which: Int32s

    places: Int32s = field(init=False)  # (S, 3) the same as points, in the grid
    facings: Int32s = field(init=False)  # (S, 3) the same as normals, FACING long

    centre: Floats = field(init=False)  # (3,) of all
    radius: float = field(init=False)  # how far they lie from it, in the mean square

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre", self.points.mean(axis=0))
        object.__setattr__(self, "radius", float(np.linalg.norm(self.points.std(axis=0))))
        object.__setattr__(self, "places", self.steps(self.points))
        object.__setattr__(self, "facings", facing(self.normals))

    def __len__(self) -> int:
        return len(self.points)

    def steps(self, points: Floats) -> Int32s:
        """(N, 3) places in the grid, as the kernels want them."""
        inside = np.clip((points - self.low) / self.cell, -1e6, 1e6)
        return np.floor(inside * (1 << SHIFT)).astype(np.int32)

    def bits(self, points: Floats) -> Int32s:
        """(N,) what the cells of points (N, 3) hold; 0 outside of the grid."""
        at = self._at(points)
        return np.asarray(np.where(at < 0, 0, self.cells[at]), np.int32)

    def inside(self, points: Floats) -> Int64s:
        """Indices of the cells of those points (N, 3) that lie in the grid."""
        at = self._at(points)
        return at[at >= 0]

    def _at(self, points: Floats) -> Int64s:
        at = self.steps(points).astype(np.int64) >> SHIFT
        inside = ((at >= 0) & (at < self.shape)).all(axis=1)
        index = (at[:, 0] * self.shape[1] + at[:, 1]) * self.shape[2] + at[:, 2]
        return np.asarray(np.where(inside, index, -1), np.int64)


def facing(normals: Floats) -> Int32s:
    """(N, 3) normals as the kernels want them."""
    return np.rint(normals * FACING).astype(np.int32)


def kinds_of(normals: Floats, axes: Floats) -> Int64s:
    """(N,) the signed axis that each normal is nearest to, as in `Surfels.kinds`."""
    along = normals @ axes.T
    nearest = np.abs(along).argmax(axis=1)
    against = along[np.arange(len(normals)), nearest] < 0
    return np.asarray(2 * nearest + against, np.int64)


def survey(points: Floats, origins: Floats, groups: Int64s, fine: float) -> Working[Surfels | None]:
    """Surfels of points (N, 3) that were seen from `origins` (N, 3) in keyframes `groups` (N,).

    fine: mm, the smallest cell. None where too little is flat, or most lies too far from the rest.
    """
    cell, origin = fine, np.median(points, axis=0)
    near = np.abs(points - origin).max(axis=1) < _WIDE * fine
    if not near.any():
        return None
    points, origins, groups = points[near] - origin, origins[near] - origin, groups[near]
    while True:
        order, keys, ends = _sorted(points, cell)
        yield 1 + len(points) // 1500
        size = _extent(points, cell)
        if len(ends) <= MOST and size <= CELLS:
            ranges = yield from _neighbourhoods(keys, ends)
            count = sum((high - low) for low, high in ranges)
            usual = float(np.median(np.repeat(count, np.diff(ends, prepend=0))))
            if usual >= FILLED or len(ends) < 64:
                break
        cell *= _LARGER
    sums = yield from _moments(points[order], origins[order])
    middle, normals, flat = yield from _planes(sums, ranges, max(_FEW, _SPARSE * usual))
    first = np.concatenate([[0], ends[:-1]])
    own = sums[ends] - sums[first]
    place = own[:, 1:4] / own[:, :1]
    place += normals * ((middle - place) * normals).sum(axis=1)[:, None]
    view = own[:, _ORIGINS] / own[:, :1] - place
    normals = normals * np.where((view * normals).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    place, normals = place[flat], normals[flat]
    axes = axes_of(normals)
    yield 20
    if len(axes) == 0:
        return None
    low, shape = _box(place, cell)
    kinds, cells = kinds_of(normals, axes), int(shape.prod())
    surfels = Surfels(
        cell=cell,
        origin=origin,
        points=place,
        normals=normals,
        groups=groups[order][first][flat],
        axes=axes,
        kinds=kinds,
        rarity=_rarity(place, kinds, axes, cell),
        low=low,
        shape=shape,
        cells=np.zeros(cells, np.int32),
        which=np.full(cells, -1, np.int32),
    )
    smooth = np.repeat(flat, ends - first)
    yield from _fill(surfels, points[order], origins[order], smooth)
    return surfels


def keys_of(cells: Int64s) -> Int64s:
    """One number a cell (N, 3); neighbours along z have successive ones."""
    low = cells + (1 << (_BITS - 1)) & ((1 << _BITS) - 1)
    return np.asarray((low[:, 0] << 2 * _BITS) | (low[:, 1] << _BITS) | low[:, 2], np.int64)


def _sorted(points: Floats, cell: float) -> tuple[Int64s, Int64s, Int64s]:
    """Points by cell: their order, their keys, and where each cell ends."""
    keys = keys_of(np.floor(points / cell).astype(np.int64))
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    ends = np.append(np.flatnonzero(keys[1:] != keys[:-1]) + 1, len(keys))
    return order, keys, ends


def _extent(points: Floats, cell: float) -> float:
    low, high = _bounds(points)
    return float(np.prod((high - low) / cell + 4))


def _bounds(points: Floats) -> tuple[Floats, Floats]:
    """What nearly all points lie in: single ones far away make no large grid."""
    low, high = np.percentile(points, (0.5, 99.5), axis=0)
    margin = 0.05 * (high - low) + 1.0
    return low - margin, high + margin


def _box(points: Floats, cell: float) -> tuple[Floats, Int64s]:
    low, high = _bounds(points)
    return low - 2 * cell, np.ceil((high - low) / cell).astype(np.int64) + 4


def _neighbourhoods(keys: Int64s, ends: Int64s) -> Working[list[tuple[Int64s, Int64s]]]:
    """Of each cell the nine ranges of points in it and its neighbours."""
    own = keys[ends - 1]
    out = []
    for x in (-1, 0, 1):
        for y in (-1, 0, 1):
            row = own + (x << 2 * _BITS) + (y << _BITS)
            low = np.searchsorted(keys, row - 1, "left")
            out.append((low, np.searchsorted(keys, row + 1, "right")))
            yield 1 + len(ends) // 2500
    return out


def _moments(points: Floats, origins: Floats) -> Working[Floats]:
    """(N + 1, 13) running sums: count, x y z, xx xy xz yy yz zz, origin."""
    x, y, z = points.T
    columns = [np.ones(len(points)), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z, *origins.T]
    sums = np.zeros((len(columns), len(points) + 1))
    yield 1 + len(points) // 10_000
    for column, total in zip(columns, sums, strict=True):
        np.cumsum(column, out=total[1:])
        yield 1 + len(points) // 60_000
    return np.ascontiguousarray(sums.T)


def _planes(
    sums: Floats, ranges: list[tuple[Int64s, Int64s]], few: float
) -> Working[tuple[Floats, Floats, Bools]]:
    """Of the points around each cell: middle, normal, and whether they are flat."""
    total = np.zeros((len(ranges[0][0]), 10))
    for low, high in ranges:
        total += sums[high, :10] - sums[low, :10]
        yield 1 + len(total) // 4000
    count = total[:, :1]
    middle = total[:, 1:4] / count
    second = (total[:, 4:] / count)[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    spread = second - middle[:, :, None] * middle[:, None, :]
    lengths, normals = np.zeros((len(total), 3)), np.zeros((len(total), 3))
    for at in range(0, len(total), _UNIT_POINTS):
        values, vectors = np.linalg.eigh(spread[at : at + _UNIT_POINTS])
        lengths[at : at + _UNIT_POINTS] = values
        normals[at : at + _UNIT_POINTS] = vectors[:, :, 0]
        yield 20
    lengths = np.sqrt(np.maximum(lengths, 0.0))
    flat = (count[:, 0] >= few) & (lengths[:, 0] <= _FLAT * lengths[:, 1])
    return middle, normals, flat


def axes_of(normals: Floats) -> Floats:
    """(A, 3) directions that many normals (S, 3) have or oppose, most first."""
    left = normals[:: 1 + len(normals) // _SAMPLED]
    few = max(8.0, _MINOR * len(left))
    out: list[Floats] = []
    while len(out) < AXES and len(left) >= few:
        modes = left[:: 1 + len(left) // _MODES]
        axis = modes[(np.abs(modes @ left.T) > _ALIGNED).sum(axis=1).argmax()]
        for _ in range(3):
            near = left[np.abs(left @ axis) > _ALIGNED]
            axis = np.linalg.eigh(near.T @ near)[1][:, 2]
        if len(near) < few:
            break
        out.append(axis)
        left = left[np.abs(left @ axis) < _APART]
    return np.array(out).reshape(-1, 3)


def _rarity(points: Floats, kinds: Int64s, axes: Floats, cell: float) -> Floats:
    if len(axes) == 0:
        return np.ones(len(points))
    along = (points * axes[kinds // 2]).sum(axis=1)
    bins = np.floor(along / (2 * cell)).astype(np.int64)
    _, number, count = np.unique(bins * 2 * AXES + kinds, return_inverse=True, return_counts=True)
    return np.asarray(1.0 / np.sqrt(count[number.ravel()]))


def _fill(surfels: Surfels, points: Floats, origins: Floats, smooth: Bools) -> Working[None]:
    """Write the grid of new surfels."""
    shape = tuple(surfels.shape.tolist())
    rays = np.flatnonzero(smooth)
    rays = rays[:: 1 + len(rays) // _RAYS]
    passes = np.zeros(len(surfels.cells), np.int32)
    for at in range(0, len(rays), _UNIT_RAYS):
        part = rays[at : at + _UNIT_RAYS]
        ends = surfels.steps(origins[part]), surfels.steps(points[part])
        pass_through(*ends, surfels.shape, _SHORT, passes)
        yield 3
    ended = np.zeros(len(surfels.cells), np.int32)
    np.add.at(ended, surfels.inside(points), 1)
    yield 1 + len(points) // _UNIT_POINTS
    own = surfels._at(surfels.points)
    rows = np.flatnonzero(own >= 0)
    surfels.which[own[rows]] = rows
    np.bitwise_or.at(surfels.cells, own[rows], (1 << surfels.kinds[rows]).astype(np.int32))
    for _ in _dilate(surfels.cells.reshape(shape)):
        yield 4
    for at in range(0, len(passes), _UNIT_CELLS):
        slab = slice(at, at + _UNIT_CELLS)
        proven = (passes[slab] >= _PASSES) & (passes[slab] > 2 * ended[slab])
        surfels.cells[slab][proven & (surfels.cells[slab] == 0)] = FREE
        yield 8


def _dilate(grid: Int32s) -> Iterator[None]:
    """Spread the bits of every cell to its 26 neighbours, in slabs of some `_UNIT_CELLS`."""
    for axis in range(3):
        across = max({0, 1, 2} - {axis}, key=lambda other: grid.shape[other])
        rows = np.moveaxis(grid, (axis, across), (0, 1))
        thick = max(1, _UNIT_CELLS * rows.shape[1] // rows.size)
        for at in range(0, rows.shape[1], thick):
            slab = rows[:, at : at + thick]
            before = slab.copy()
            slab[1:] |= before[:-1]
            slab[:-1] |= before[1:]
            yield
