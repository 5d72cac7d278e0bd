"""Section 4.1, withdrawal: what a SLAM removes or moves, done in the adjacency DAG bit by bit."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .issuance import Issuance
from .kernels.columns import grown
from .kernels.geometry import carry
from .model import Bools, Int32s, Int64s
from .naming import UNKNOWN, Naming

LEFT = -2  # names a point that is left for later; -1: its point has no node for other reasons
# What a node costs that leaves the DAG, in units of about 6 microseconds: one that was issued keeps
# its place; of one that was not, the children choose anew; one that moves is inserted again too.
_LEAVES, _MOVES, _LOOKED_AT = 2, 3, 8  # the last for each run of nodes of a cycle that is moved
NONE = np.zeros(0, np.int64)
Ids = npt.NDArray[np.uint64]


class Rearranging:
    """Which nodes the ids and the cycles of one SLAM frame stand for, and what becomes of them."""

    def __init__(self, issuance: Issuance, salt: int) -> None:
        self._issuance, self._graph = issuance, issuance.graph
        self._nodes = Naming(salt)  # of each id that the SLAM gave and did not remove
        self._id_of: Ids = np.zeros(0, np.uint64)  # by node, where it has one
        self._of_cycle: dict[int, list[tuple[int, int]]] = {}  # runs of nodes, first and end
        self._leaving: list[Int64s] = []  # nodes that were removed, still in the DAG
        self._moving: dict[int, tuple[Int32s, list[tuple[int, int]]]] = {}  # pose, runs still there

    @property
    def busy(self) -> bool:
        """Whether `step` has something to do."""
        return bool(self._leaving or self._moving)

    def nodes(self, ids: Ids) -> Int64s:
        """(N,) node of each id; negative where it has none, UNKNOWN where the id names nothing."""
        return self._nodes.get(ids)

    def unknown(self, ids: Ids) -> Ids:
        """Those of the ids that were never given, or removed since."""
        return np.asarray(ids[self._nodes.get(ids) == UNKNOWN])

    def leave(self, ids: Ids) -> None:
        """The points of these are left for later."""
        self._nodes.put(ids, np.full(len(ids), LEFT))

    def entered(self, cycle: int, ids: Ids | None, fresh: Bools, nodes: Int64s) -> None:
        """Points of a cycle have become nodes, those that are `fresh` (N,); the others did not."""
        self._run(cycle, nodes)
        if ids is None:
            return
        self._nodes.put(ids[~fresh], np.full(int((~fresh).sum()), -1))
        self._name(ids[fresh], nodes)

    def remove(self, ids: Ids) -> None:
        """The SLAM takes these points back."""
        nodes = np.sort(self._nodes.take(ids))
        nodes = nodes[np.searchsorted(nodes, 0) :]  # others were thrown out of range by a move
        self._leaving += [nodes] if len(nodes) else []

    def move(self, cycle: int, pose: Int32s) -> None:
        """The nodes of a cycle that are not issued belong where it lies now."""
        _, runs = self._moving.pop(cycle, (pose, []))
        runs = runs + self._of_cycle.pop(cycle, [])
        if runs:
            self._moving[cycle] = (pose, runs)

    def step(self, limit: int) -> Int64s:
        """Rearrange for about so many units. Returns the numbers of issued nodes that have left.

        What is not done in this call stays where it is, which is only a matter of structure: should
        it go out before, then it is retracted, or its anchor has moved.
        """
        retracted = [NONE]
        while self._leaving and limit > 0:
            numbers = self._issuance.number[self._leaving[0][:limit]]
            cost = np.cumsum(np.where(numbers >= 0, 1, _LEAVES))
            count = int(np.searchsorted(cost, limit, side="right"))
            nodes, rest = self._leaving[0][:count], self._leaving[0][count:]
            self._leaving[:1] = [rest] if len(rest) else []
            retracted.append(numbers[:count][numbers[:count] >= 0])
            self._issuance.revalue(self._graph.withdraw(nodes))
            limit -= int(cost[-1])
        while self._moving and limit > 0:
            limit -= self._move_on(limit)
        return np.concatenate(retracted)

    def _move_on(self, limit: int) -> int:
        """Move a part of the cycle that is first in the queue. Returns what it costs."""
        cycle, (pose, runs) = next(iter(self._moving.items()))
        first, end = runs.pop()
        stop = min(end, first + max(limit // _MOVES, 1))
        if stop < end:
            runs.append((stop, end))
        if not runs:
            del self._moving[cycle]
        rows = np.arange(first, stop, dtype=np.int64)
        rows = rows[self._graph.open(rows)]
        if len(rows):
            self._issuance.revalue(self._graph.withdraw(rows))
            self._insert_again(cycle, pose, rows)
        return _LOOKED_AT + _MOVES * len(rows)

    def _insert_again(self, cycle: int, pose: Int32s, rows: Int64s) -> None:
        """Nodes that have left the DAG come back where their cycle is now."""
        columns = self._issuance
        positions, inside = carry(pose, columns.place[rows])
        nodes, kept = self._graph.insert(positions[inside]), rows[inside]
        columns.add(
            nodes,
            columns.cycle[kept],
            columns.place[kept],
            columns.color[kept],
            columns.colored[kept],
        )
        self._run(cycle, nodes)
        named = rows[rows < len(self._id_of)]
        named = named[self._nodes.get(self._id_of[named]) == named]
        self._nodes.put(self._id_of[named], np.full(len(named), -1))
        which = np.isin(kept, named)
        self._name(self._id_of[kept[which]], nodes[which])

    def _run(self, cycle: int, nodes: Int64s) -> None:
        if len(nodes):
            self._of_cycle.setdefault(cycle, []).append((int(nodes[0]), int(nodes[-1]) + 1))

    def _name(self, ids: Ids, nodes: Int64s) -> None:
        """From now on these ids are those of these nodes, which ascend."""
        self._nodes.put(ids, nodes)
        if len(nodes):
            self._id_of = grown(self._id_of, int(nodes[-1]) + 1, 0)
            self._id_of[nodes] = ids
