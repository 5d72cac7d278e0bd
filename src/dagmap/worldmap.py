"""The read side: an immutable picture of the fleet's map as one robot holds it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from .consensus import Consensus
from .fold import NodeColumns, Verdict
from .folded import Picture
from .model import Bools, Floats, FrameId, Int32s, Int64s, State, TransactionId, Uint8s, pose_matrix

D = TypeVar("D", bound=np.generic)
GREY = 128  # colour of nodes that no observation gave one


@dataclass(frozen=True, slots=True)
class Observation:
    """Who saw a node, and where that stands in the ledger."""

    robot: str
    transaction: TransactionId
    index: int  # of the feature in the transaction
    stamp: float  # s, of the cycle that saw it; nan where its anchor is unknown


@dataclass(frozen=True, slots=True, eq=False)
class MapDiff:
    """Indices of nodes: only in the newer map, only in the older one, in both but changed."""

    added: Int64s
    removed: Int64s
    changed: Int64s


@dataclass(frozen=True, slots=True, eq=False)
class _Source:
    """Rows of one transaction in the feature numbers of its author."""

    robot: str
    transaction: TransactionId
    nodes: Int32s
    stamps: Floats


class WorldMap:
    """Nodes of one component of frames. All arrays have one row a node and are read-only.

    positions: (N, 3) float64 metres in the component's origin frame (mean of the observations).
    hits, misses: (N,) int32, each author's say bounded; witnesses: (N,) authors that saw it.
    states: (N,) uint8, see `State`. colors: (N, 3) uint8, the mean; grey where none was seen.
    `kept` (confirmed or tentative) is what the fleet takes for real: it is the map.
    """

    def __init__(
        self,
        origin: FrameId,
        columns: NodeColumns | None,
        verdict: Verdict | None,
        sources: tuple[_Source, ...] = (),
        cell: float = 0.1,
    ) -> None:
        self.origin, self._sources, self._cell = origin, sources, cell
        if columns is None or verdict is None:
            columns, verdict = NodeColumns.empty(), Verdict.empty()
        count = np.maximum(columns.count, 1).astype(np.float64)[:, None]
        self.positions: Floats = _frozen((columns.seed + columns.offset / count) / 1000.0)
        self.colors: Uint8s = _frozen(_mean_color(columns.color, columns.color_count))
        self.seeds: Int32s = _frozen(columns.seed.copy())
        self.hits: Int32s = _frozen(verdict.hits)
        self.misses: Int32s = _frozen(verdict.misses)
        self.witnesses: Int32s = _frozen(verdict.witnesses)
        self.states: Uint8s = _frozen(verdict.states)

        self.counts: Int32s = _frozen(columns.count.copy())

    def __len__(self) -> int:
        return len(self.positions)

    def __repr__(self) -> str:
        counts = ", ".join(f"{self.count(state)} {state.name.lower()}" for state in State)
        return f"WorldMap({len(self)} nodes: {counts})"

    @property
    def kept(self) -> Bools:
        """(N,) whether a node is in the map: confirmed or tentative."""
        return np.asarray(self.states != State.REJECTED)

    def count(self, state: State) -> int:
        return int((self.states == state).sum())

    def nodes_of(self, robot: str) -> Int32s:
        """The node of each feature that a robot issued, by number; -1 where there is none."""
        mine = [source.nodes for source in self._sources if source.robot == robot]
        return np.concatenate([np.zeros(0, np.int32), *mine])

    def near(self, point: npt.ArrayLike, radius: float) -> Int64s:
        """Indices of kept nodes within `radius` m of a point (3,), the nearest first."""
        centre = np.asarray(point, np.float64)
        if centre.shape != (3,) or not radius >= 0:
            raise ValueError("near wants a point (3,) in metres and a radius of at least 0")
        index = self._grid.around(centre, radius)
        index = np.flatnonzero(self.kept) if index is None else index
        distance = np.linalg.norm(self.positions[index] - centre, axis=1)
        order = np.argsort(distance, kind="stable")
        return index[order[: int((distance <= radius).sum())]]

    def occupied(self, points: npt.ArrayLike) -> Bools:
        """(N,) whether a kept node lies in the same evidence cell as each point (N, 3) m."""
        places = np.atleast_2d(np.asarray(points, np.float64))
        if places.size == 0:
            return np.zeros(0, np.bool_)
        cells = np.floor(places / self._cell).tolist()
        return np.array([tuple(cell) in self._occupied for cell in cells], np.bool_)

    def within(self, box: tuple[npt.ArrayLike, npt.ArrayLike]) -> Int64s:
        """Indices of kept nodes in a box (lower corner (3,), upper corner (3,)), borders in."""
        low, high = (np.asarray(corner, np.float64) for corner in box)
        inside = ((self.positions >= low) & (self.positions <= high)).all(axis=1)
        return np.flatnonzero(inside & self.kept)

    def diff(self, other: WorldMap) -> MapDiff:
        """What changed from `other` (older) to this map; `removed` indexes the older one.

        Nodes are the same where their seeds are: no two of a map share one.
        """
        mine, theirs = _as_keys(self.seeds), _as_keys(other.seeds)
        _, i, j = np.intersect1d(mine, theirs, assume_unique=True, return_indices=True)
        changed = (self.positions[i] != other.positions[j]).any(axis=1)
        for name in ("states", "hits", "misses", "witnesses"):
            changed |= getattr(self, name)[i] != getattr(other, name)[j]
        return MapDiff(
            np.setdiff1d(np.arange(len(self)), i),
            np.setdiff1d(np.arange(len(other)), j),
            np.sort(i[changed]),
        )

    def provenance(self, node: int) -> tuple[Observation, ...]:
        """Every observation that a node is made of, in canonical order."""
        if not 0 <= node < len(self):
            raise IndexError(f"node {node} of a map of {len(self)}")
        return tuple(
            Observation(source.robot, source.transaction, int(i), float(source.stamps[i]))
            for source in self._sources
            for i in np.flatnonzero(source.nodes == node)
        )

    @cached_property
    def _occupied(self) -> set[tuple[float, ...]]:
        return set(map(tuple, np.floor(self.positions[self.kept] / self._cell).tolist()))

    @cached_property
    def _grid(self) -> _Grid:
        return _Grid(self.positions, np.flatnonzero(self.kept))


class _Grid:
    """Kept nodes sorted by a coarse cell, for queries that cost by what they find."""

    EDGE = 0.5  # m

    def __init__(self, positions: Floats, index: Int64s) -> None:
        self._low = (
            np.floor(positions[index].min(axis=0) / self.EDGE) if len(index) else np.zeros(3)
        )
        cells = np.floor(positions[index] / self.EDGE) - self._low
        self._size = cells.max(axis=0) + 1 if len(index) else np.ones(3)
        keys = self._key(cells)
        order = np.argsort(keys, kind="stable")
        self._keys, self._index = keys[order], index[order]

    def around(self, centre: Floats, radius: float) -> Int64s | None:
        """Indices in all cells that a ball touches; None where looking at all costs less."""
        low = np.clip(np.floor((centre - radius) / self.EDGE) - self._low, 0, self._size - 1)
        high = np.clip(np.floor((centre + radius) / self.EDGE) - self._low, -1, self._size - 1)
        if (high < low).any():
            return np.zeros(0, np.int64)
        if (high[0] - low[0] + 1) * (high[1] - low[1] + 1) > len(self._index) + 64:
            return None
        xs, ys = (np.arange(low[a], high[a] + 1) for a in (0, 1))
        columns = np.stack(np.meshgrid(xs, ys, indexing="ij"), -1).reshape(-1, 2)
        first = self._key(np.column_stack([columns, np.full(len(columns), low[2])]))
        last = self._key(np.column_stack([columns, np.full(len(columns), high[2])]))
        starts = np.searchsorted(self._keys, first, side="left")
        ends = np.searchsorted(self._keys, last, side="right")
        found = [self._index[a:b] for a, b in zip(starts, ends, strict=True) if b > a]
        return np.sort(np.concatenate([np.zeros(0, np.int64), *found]))

    def _key(self, cells: Floats) -> Floats:
        return np.asarray(
            (cells[:, 0] * self._size[1] + cells[:, 1]) * self._size[2] + cells[:, 2], np.float64
        )


def build_map(picture: Picture, cell: float) -> WorldMap:
    """Freeze one component of the fold."""
    component = picture.component
    found = None if component is None else component.nodes()
    if component is None or found is None:
        return WorldMap(picture.origin, None, None, (), cell)
    sources = []
    for contribution in picture.contributions:
        author, tx = contribution.author, contribution.transaction
        nodes = component.fold.feature_nodes(author.index)
        mine = nodes[contribution.base : contribution.base + len(contribution.xyz)]
        anchors = (author.anchors.get(cycle) for cycle in contribution.cycles.tolist())
        stamps = [np.nan if anchor is None else anchor.stamp / 1e6 for anchor in anchors]
        seen = np.repeat(np.array(stamps, np.float64), np.diff(contribution.starts))
        name = author.name or author.id.hex()
        sources.append(_Source(name, tx.id, mine.copy(), seen))
    return WorldMap(picture.origin, *found, tuple(sources), cell)


def _as_keys(seeds: Int32s) -> npt.NDArray[np.void]:
    """One comparable value a row."""
    return np.ascontiguousarray(seeds).view([("x", "i4"), ("y", "i4"), ("z", "i4")]).ravel()


def _mean_color(total: Int64s, count: Int32s) -> Uint8s:
    counted = np.maximum(count, 1)[:, None]
    mean = (2 * total.astype(np.int64) + counted) // (2 * counted)
    mean[count == 0] = GREY
    return np.asarray(mean, np.uint8)


def _frozen(array: npt.NDArray[D]) -> npt.NDArray[D]:
    array.flags.writeable = False
    return array


def newest_poses(consensus: Consensus, here: FrameId) -> dict[str, tuple[Floats, float]]:
    """Newest pose (4, 4) in a component, and its stamp in s, by robot's name."""
    found: dict[str, tuple[Floats, float]] = {}
    for author in sorted(consensus.authors.values(), key=lambda author: author.id):
        if author.anchors:
            anchor = author.anchors[max(author.anchors)]
            component, pose = consensus.placement(author.id, anchor.session)
            if component == here:
                place = pose_matrix(pose) @ pose_matrix(anchor.pose)
                name = author.name if author.name not in found else None  # names are free
                found[name or author.id.hex()] = (place, anchor.stamp / 1e6)
    return found
