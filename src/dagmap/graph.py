"""Section 4.1: the adjacency DAG of one robot, from its own features only.

The paper also appends received nodes; here they stay in the fold (section 4.3), or the map would
depend on the order of arrival.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import numpy.typing as npt

from .config import GraphConfig
from .kernels import ascendants, insertion, lattice
from .model import LIMIT_MM, Bools, CycleError, Int32s, Int64s

Number = TypeVar("Number", bound=np.generic)
_FIRST_ROWS = 512  # more than one call of a kernel needs for one node
_MOST = (1 << 28) - 1  # children are named by 8 * id + place in int32


class AdjacencyDag:
    """Features that prove themselves by their neighbours (Section 4.1, Alg. 1).

    Positions are int32 millimetres in the robot's SLAM frame. Ids are 0, 1, 2, ... in order of
    insertion and never used again. A feature that was withdrawn before it was issued leaves the
    graph: no parents, no children, validity 0; one that was issued keeps its place and only leaves
    the terminals. Ids that are unknown, or withdrawn where that matters, raise CycleError (a
    ValueError), and nothing is changed. The methods that read take ids, or None for all.

    config: n_p, n_c, n_c_max, pitch and reach of the graph.
    salt: secret of up to 62 bits that keeps others from crafting points that collide in the hash
        table; no result depends on it.
    """

    def __init__(self, config: GraphConfig, salt: int = 0) -> None:
        self._config = config
        numbers = np.zeros(lattice.NUMBERS + lattice.SCRATCH, np.int64)
        numbers[lattice.FREE] = -1
        numbers[lattice.PITCH] = config.pitch_mm
        numbers[lattice.REACH2] = 1 << 62 if config.reach_mm < 0 else config.reach_mm**2
        numbers[lattice.N_C] = config.n_c
        numbers[lattice.TOP] = (config.pitch_mm - 1).bit_length()
        numbers[lattice.SALT] = salt & ((1 << 62) - 1)
        self._numbers: Int64s = numbers
        self._nodes: Int32s = np.empty((0, lattice.PARENTS + 2 * config.n_p), np.int32)
        self._validity: Int64s = np.empty(0, np.int64)
        self._pool: Int32s = np.empty((0, lattice.POOL_COLUMNS), np.int32)
        self._table: Int32s = np.full(1, -1, np.int32)
        self._best: Int64s = np.zeros((config.n_p, lattice.BEST_COLUMNS), np.int64)

    def __len__(self) -> int:
        """Features ever inserted."""
        return int(self._numbers[lattice.NODES])

    def insert(self, points_mm: npt.ArrayLike) -> Int64s:
        """Insert points (N, 3), whole mm within +-2^29, one after the other. Returns their ids.

        Each gets the N_p nearest terminals within reach as parents: features before lattice
        nodes, lower ids first, lattice nodes by (x, y, z) where distances are equal.
        """
        points = _checked_points(points_mm)
        first = len(self)
        stop = first + len(points)
        if stop > _MOST:
            raise CycleError(f"{stop} features; a graph holds {_MOST} at most")
        self._reserve(stop)
        fresh = self._nodes[first:stop]
        fresh[:, :3] = points
        fresh[:, 3:] = -1
        fresh[:, [lattice.CHILDREN, lattice.FLAGS]] = 0
        while insertion.insert(*self._arrays(), stop) < stop:
            self._grow_pool()
        return np.arange(first, stop, dtype=np.int64)

    def withdraw(self, ids: npt.ArrayLike) -> Int64s:
        """Withdraw features that are alive, in ascending order. Returns ids of changed validity.

        An unissued one leaves: its parents are open again, and each of its children, lower ids
        first, puts the nearest older terminal (or lattice node) that is not yet its parent in its
        place. An issued one stays and leaves the terminals. The ids returned ascend and are of
        features that are still in the graph.
        """
        leaving = np.sort(self._rows(ids))
        self._check_alive(leaving, "withdrawn again")
        if len(leaving) > 1 and (leaving[1:] == leaving[:-1]).any():
            raise CycleError("an id is withdrawn twice in one call")
        touched, done, count = np.empty(len(self), np.int64), 0, 0
        while done < len(leaving):
            state = self._arrays()
            done, count = insertion.withdraw(*state, leaving, done, touched, count)
            if done < len(leaving):
                self._grow_pool()
        return self._revalidate(touched, count)

    def mark_issued(self, ids: npt.ArrayLike) -> Int64s:
        """Mark features as sent. Returns the ids whose validity changes by it, ascending.

        `inherit`: none does. `reset`: from now on these count as 1, like a lattice node.
        """
        rows = np.unique(self._rows(ids))
        self._check_alive(rows, "issued")
        rows = rows[~self.issued(rows)]
        self._nodes[rows, lattice.FLAGS] |= lattice.ISSUED
        return self._recount(rows)

    def bundle(self, core: int, limit: int) -> tuple[Int64s, Int64s]:
        """A core and its ascendants that are not issued, at most `limit` of them (Section 4.2).

        Kept are those with the fewest hops from the core, then the nearest, then lower ids;
        issued nodes are not walked through, so an issued core gives nothing. Returns the ids kept
        and the frontier: those cut that are a parent of a kept one. Both ascend.
        """
        row = int(self._rows([core])[0])
        if limit < 1:
            raise CycleError(f"a bundle of at most {limit} features; at least 1 is wanted")
        if self._nodes[row, lattice.FLAGS] & lattice.ISSUED:
            return np.empty(0, np.int64), np.empty(0, np.int64)
        self._check_alive(np.array([row]), "a core")
        kept = generation = np.array([row], np.int64)
        while True:
            fresh = np.setdiff1d(self._open_parents(generation), kept)
            room = limit - len(kept)
            if len(fresh) > room:
                away = self._nodes[fresh, :3].astype(np.int64) - self._nodes[row, :3]
                fresh = fresh[np.argsort((away * away).sum(axis=1), kind="stable")][:room]
            kept, generation = np.concatenate([kept, fresh]), fresh
            if len(fresh) == 0 or len(kept) == limit:
                return np.sort(kept), np.setdiff1d(self._open_parents(kept), kept)

    def take(
        self, cores: npt.ArrayLike, per_bundle: int, total: int
    ) -> tuple[Int64s, Int64s, int, Int64s]:
        """Mark the bundles of these cores as issued, one after the other, disjoint.

        Each holds at most `per_bundle` features, all together at most `total`. Returns the ids
        taken, the frontiers (see `bundle`; some may have been taken since), how many cores were
        looked at, and the ids whose validity changes by it. All ascend.
        """
        rows, n_p = self._rows(cores), self._config.n_p
        self._check_alive(rows, "a core")
        left, done = min(total, len(self) + 1), 0
        out = np.empty(left + n_p + 1, np.int64)  # the bundle that does not fit is seen so far
        taken, frontiers = [out[:0]], [out[:0]]
        while done < len(rows) and left > 0:
            done, count = ascendants.gather(self._nodes, n_p, rows, done, per_bundle, left, out)
            taken.append(out[:count].copy())
            left -= count
            if done < len(rows) and left > 0:  # this one does not fit whole
                kept, frontier = self.bundle(int(rows[done]), min(per_bundle, left))
                self._nodes[kept, lattice.FLAGS] |= lattice.ISSUED
                taken.append(kept)
                frontiers.append(frontier)
                left, done = left - len(kept), done + 1
        ids = np.sort(np.concatenate(taken))
        return ids, np.unique(np.concatenate(frontiers)), int(done), self._recount(ids)

    @property
    def n_c(self) -> int:
        """N_c: a node with fewer children is a terminal. Setting it costs one pass over all."""
        return int(self._numbers[lattice.N_C])

    @n_c.setter
    def n_c(self, value: int) -> None:
        low, high = self._config.n_p, self._config.n_c_max
        if not low <= value <= high:
            raise CycleError(f"n_c = {value}; n_p = {low} to n_c_max = {high} is wanted")
        if value == self.n_c:
            return
        self._numbers[lattice.N_C] = value
        self._close_all()
        ids, done = self.terminals(), 0
        while done < len(ids):
            done = int(
                insertion.reopen(self._nodes, self._pool, self._table, self._numbers, ids, done)
            )
            if done < len(ids):
                self._grow_pool()

    def terminals(self) -> Int64s:
        """Features in E, ascending: alive and with fewer than N_c children."""
        few = self._nodes[: len(self), lattice.CHILDREN] < self.n_c
        return np.flatnonzero(few & self.alive())

    def parents(self, ids: npt.ArrayLike | None = None) -> Int64s:
        """(N, n_p) ids of the parents; -1: a lattice node, or none.

        In order of choice, nearest first; what replaces a parent that has left is in its place.
        """
        return np.maximum(self._parents_of(self._rows(ids)), -1).astype(np.int64)

    def parents_taken(self, ids: npt.ArrayLike | None = None) -> Int64s:
        """(N,) number of parents, lattice nodes included."""
        return np.asarray((self._parents_of(self._rows(ids)) != -1).sum(axis=1), np.int64)

    def validity(self, ids: npt.ArrayLike | None = None) -> Int64s:
        """(N,) v of Eq. (1), saturating at the largest int64; 0 for a feature that has left."""
        values: Int64s = self._validity[self._rows(ids)]
        return values

    def positions(self, ids: npt.ArrayLike | None = None) -> Int32s:
        """(N, 3) mm in the robot's SLAM frame."""
        return self._nodes[self._rows(ids), :3]

    def children_count(self, ids: npt.ArrayLike | None = None) -> Int64s:
        """(N,) number of children."""
        return np.asarray(self._nodes[self._rows(ids), lattice.CHILDREN], np.int64)

    def alive(self, ids: npt.ArrayLike | None = None) -> Bools:
        """(N,) not withdrawn."""
        return ~self._flagged(ids, lattice.WITHDRAWN)

    def issued(self, ids: npt.ArrayLike | None = None) -> Bools:
        """(N,) marked as issued."""
        return self._flagged(ids, lattice.ISSUED)

    def open(self, ids: npt.ArrayLike | None = None) -> Bools:
        """(N,) neither withdrawn nor issued: what may still go out."""
        return ~self._flagged(ids, lattice.WITHDRAWN | lattice.ISSUED)

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays, lattice and spare room included."""
        return sum(array.nbytes for array in self._arrays())

    def _arrays(self) -> tuple[Int32s, Int64s, Int32s, Int32s, Int64s, Int64s]:
        """What the kernels work on."""
        return self._nodes, self._validity, self._pool, self._table, self._best, self._numbers

    def _rows(self, ids: npt.ArrayLike | None) -> Int64s:
        """Checked ids as an index."""
        if ids is None:
            return np.arange(len(self), dtype=np.int64)
        rows = np.asarray(ids)
        if rows.size == 0:
            return np.empty(0, np.int64)
        if rows.ndim != 1 or rows.dtype.kind not in "iu":
            raise CycleError(
                f"ids are {rows.dtype} {rows.shape}; a list of whole numbers is wanted"
            )
        low, high = int(rows.min()), int(rows.max())
        if low < 0 or high >= len(self):
            unknown = low if low < 0 else high
            raise CycleError(f"feature {unknown} is unknown; ids are 0 to {len(self) - 1}")
        return rows.astype(np.int64)

    def _flagged(self, ids: npt.ArrayLike | None, flag: int) -> Bools:
        flags: Int32s = self._nodes[self._rows(ids), lattice.FLAGS]
        return (flags & flag).astype(np.bool_)

    def _parents_of(self, rows: Int64s) -> Int32s:
        """(N, n_p) as stored: lattice nodes have names below -1."""
        return self._nodes[rows, lattice.PARENTS : lattice.PARENTS + self._config.n_p]

    def _check_alive(self, rows: Int64s, wanted: str) -> None:
        dead = rows[~self.alive(rows)]
        if len(dead):
            raise CycleError(f"feature {dead[0]} has been withdrawn and cannot be {wanted}")

    def _open_parents(self, rows: Int64s) -> Int64s:
        """Parents that are not issued, each once, ascending."""
        parents = np.unique(self._parents_of(rows)).astype(np.int64)
        parents = parents[parents >= 0]
        return parents[~self.issued(parents)]

    def _recount(self, rows: Int64s) -> Int64s:
        """What follows for the validity when these have been issued."""
        if self._config.issued_validity == "inherit":
            return np.empty(0, np.int64)
        self._nodes[rows, lattice.FLAGS] |= lattice.MARKED
        touched = np.empty(len(self), np.int64)
        touched[: len(rows)] = rows
        return self._revalidate(touched, len(rows))

    def _revalidate(self, touched: Int64s, count: int) -> Int64s:
        """Eq. (1) anew for the marked `touched[:count]` and what is below them."""
        if count == 0:
            return np.empty(0, np.int64)
        heap = np.empty(len(self), np.int64)  # the pages that are not used cost nothing
        reset = self._config.issued_validity == "reset"
        count = ascendants.revalidate(
            self._nodes, self._validity, self._config.n_p, reset, touched, count, heap
        )
        return touched[:count].copy()

    def _close_all(self) -> None:
        """Empty all cells of their terminals and free the records of their trees."""
        rows = self._pool[: int(self._numbers[lattice.POOLED])]
        rows[:, lattice.LINK] = -1
        rows[:, lattice.COUNT] = 0
        free = np.flatnonzero(rows[:, lattice.LEAST] < 0)[::8]
        rows[free, lattice.X] = np.append(free[1:], -1)[: len(free)]
        self._numbers[lattice.FREE] = free[0] if len(free) else -1

    def _reserve(self, count: int) -> None:
        """Make room for so many nodes in all."""
        if count > len(self._nodes):
            rows = max(count, len(self._nodes) * 5 // 4)
            self._nodes = _grown(self._nodes, rows)
            self._validity = _grown(self._validity, rows)

    def _grow_pool(self) -> None:
        """More rows for cells and trees, and a table that stays at most half full."""
        held = len(self._pool)
        self._pool = _grown(self._pool, held * 5 // 4 + _FIRST_ROWS)
        self._pool[held:] = 0
        self._pool[held:, lattice.LINK] = -1
        if len(self._table) < 2 * len(self._pool):
            slots = 1 << (4 * len(self._pool) - 1).bit_length() - 1
            self._table = np.full(slots, -1, np.int32)
            lattice.rehash(self._pool, self._table, self._numbers)


def _grown(array: npt.NDArray[Number], size: int) -> npt.NDArray[Number]:
    out = np.empty((size, *array.shape[1:]), array.dtype)
    out[: len(array)] = array
    return out


def _checked_points(points_mm: npt.ArrayLike) -> Int32s:
    points = np.asarray(points_mm)
    if points.size == 0:
        return np.empty((0, 3), np.int32)
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "iu":
        raise CycleError(
            f"points are {points.dtype} {points.shape}; (N, 3) whole millimetres are wanted"
        )
    if int(points.min()) < -LIMIT_MM or int(points.max()) > LIMIT_MM:
        raise CycleError(f"points beyond +-{LIMIT_MM} mm; drop them")
    return np.ascontiguousarray(points, np.int32)
