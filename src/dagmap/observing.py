"""The robot's own side: what its SLAM hands in becomes nodes of the adjacency DAG, anchors,
retractions, and in the end the payloads of its transactions (sections 4.1 and 4.2)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from .backlog import Backlog, Seen
from .config import Config
from .graph import AdjacencyDag
from .issuance import Allowance, Issuance, Known
from .kernels.codec import morton_order
from .kernels.geometry import apply_pose
from .model import (
    FLEET_FRAME,
    AuthorId,
    Bools,
    CycleError,
    FrameId,
    Int32s,
    Int64s,
    QuantisedCycle,
    quantise_pose,
)
from .payload import Anchor, Link, Payload, Sighting
from .transaction import Transaction

Settled: TypeAlias = Callable[[Int32s], Bools]  # of points (N, 3) mm in the SLAM frame
CERTAIN = (1 << 31) - 1  # inliers of a link that was configured, not measured
_LEFT = -2  # node of an id whose point is left for later; -1: it has none for other reasons
# Bytes that each costs at most in a transaction
_FEATURE, _PARENT, _ANCHOR, _NUMBER, _SIGHTING = 22, 6, 48, 6, 16
NONE = np.zeros(0, np.int64)


class Observing:
    """One robot's SLAM as DAGmap sees it. `check` first: what follows cannot fail."""

    def __init__(self, config: Config, author: AuthorId, salt: int) -> None:
        self._config, self._author, self._salt = config, author, salt
        self.session = 0
        self.observed = 0  # points handed in
        self.cycles = 0  # cycles of the author so far; the next one gets this number
        self._sessions: dict[int, int] = {}  # last stamp of each session
        self._anchors: list[Anchor] = []  # to be published
        self._anchors_since: float | None = None  # `now` at the first of them
        self._moved = False
        self._retracted: list[Int64s] = []
        self._links: list[Link] = []
        self._introduced = config.closed  # there the certificate names the robot
        self._earlier: list[Issuance] = []  # of former sessions, with features held back
        self.backlog = Backlog(config.overhead.backlog)
        self._start_frame()

    def _start_frame(self) -> None:
        """A new SLAM frame has its own adjacency DAG, ids and cycles."""
        self.graph = AdjacencyDag(self._config.graph, self._salt)
        self.issuance = Issuance(self._config, self.graph)
        self._nodes: dict[int, int] = {}  # node of each id that the SLAM gave and did not remove
        self._cycle_of: dict[int, int] = {}  # cycle number of a stamp

    def resume(self, chain: Sequence[Transaction]) -> None:
        """Go on after the robot's own transactions of an earlier run."""
        for tx in chain:
            self._introduced = True
            for anchor in tx.payload.anchors:
                self.cycles = max(self.cycles, anchor.cycle + 1)
                last = self._sessions.get(anchor.session, anchor.stamp)
                self._sessions[anchor.session] = max(last, anchor.stamp)
                if anchor.session != self.session:
                    self._cycle_of = {}
                self.session = anchor.session
                self._cycle_of[anchor.stamp] = anchor.cycle

    def check(self, cycle: QuantisedCycle) -> QuantisedCycle:
        """What only this robot's history can tell. Raises CycleError; changes nothing."""
        where = f"cycle at {cycle.stamp / 1e6:.6f} s"
        last = self._sessions.get(cycle.session)
        if last is not None and cycle.stamp <= last:
            raise CycleError(
                f"{where}: stamps must rise, the last one of session {cycle.session} was "
                f"{last / 1e6:.6f} s; hand cycles in by time, or start a new session"
            )
        fresh = cycle.session != self.session
        known = {} if fresh else self._nodes
        for id_ in cycle.removed.tolist():
            if id_ not in known:
                raise CycleError(
                    f"{where}: removed names {id_}, which this session has not seen or has "
                    "removed before; name ids once, after their point"
                )
        cycles = {} if fresh else self._cycle_of
        for stamp, _ in cycle.moved:
            if stamp not in cycles:
                raise CycleError(
                    f"{where}: moved names a cycle at {stamp / 1e6:.6f} s, which this session "
                    "has not seen; give the exact stamps of earlier cycles"
                )
        _, inside = _carry(cycle.pose, cycle.points)
        if not inside.all():
            row = int(np.flatnonzero(~inside)[0])
            raise CycleError(f"{where}: the pose carries points row {row} beyond 2^29 mm; drop it")
        return cycle

    def withdraw(self, cycle: QuantisedCycle) -> None:
        """What the SLAM removed leaves; what it moved is put where it is now."""
        if cycle.session != self.session or not self._sessions:
            self._enter(cycle.session)
        if len(cycle.removed):
            ids = cycle.removed.tolist()
            nodes = np.sort(np.array([self._nodes.pop(id_) for id_ in ids], np.int64))
            nodes = nodes[nodes >= 0]  # others were thrown out of range by a move
            numbers = self.issuance.number[nodes]
            self._retracted.append(numbers[numbers >= 0])
            self.issuance.revalue(self.graph.withdraw(nodes))
        names = {node: id_ for id_, node in self._nodes.items() if node >= 0} if cycle.moved else {}
        for stamp, pose in cycle.moved:
            self._move(self._cycle_of[stamp], stamp, pose, names)

    def insert(
        self, cycle: QuantisedCycle, now: float, settled: Settled, limit: int | None = None
    ) -> None:
        """Algorithm 1 for every new feature of the cycle, in the order of a Z curve.

        settled: tells which points the map knows well enough; these are left out.
        limit: how many are inserted now; the others are left for later (`catch_up`).
        """
        number, self.cycles = self.cycles, self.cycles + 1
        self._sessions[cycle.session] = cycle.stamp
        self._cycle_of[cycle.stamp] = number
        self._publish(Anchor(number, cycle.session, cycle.stamp, cycle.pose), now)
        self.issuance.begin(now)
        self.observed += len(cycle.points)
        order = morton_order(cycle.points)
        if cycle.ids is not None:
            order = self._first_seen(cycle.ids, order, number)
        seen = Seen(number, cycle.pose, cycle.points, cycle.ids, cycle.colors).rows(order)
        if limit is not None and len(order) > limit:
            seen, rest = seen.split(limit)
            if rest.ids is not None:
                self._nodes.update(dict.fromkeys(rest.ids.tolist(), _LEFT))
            self.backlog.add(rest)
        self._append(seen, settled)

    def catch_up(self, settled: Settled, limit: int) -> int:
        """Insert what was left for later, `limit` points at most. Returns how many were looked at.

        What the SLAM has removed meanwhile, or seen again and inserted, is left out.
        """
        looked = 0
        for seen in self.backlog.take(limit):
            looked += len(seen.points)
            if seen.ids is not None:
                still = [self._nodes.get(id_) == _LEFT for id_ in seen.ids.tolist()]
                seen = seen.rows(np.array(still, np.bool_))
            self._append(seen, settled)
        return looked

    def _append(self, seen: Seen, settled: Settled) -> None:
        positions, inside = _carry(seen.pose, seen.points)
        fresh = inside & ~settled(positions)
        if seen.ids is not None:
            self._nodes.update(dict.fromkeys(seen.ids[~fresh].tolist(), -1))
        seen = seen.rows(fresh)
        count = len(seen.points)
        nodes = self.graph.insert(positions[fresh])
        color = np.zeros((count, 3), np.uint8) if seen.colors is None else seen.colors
        colored = np.full(count, seen.colors is not None, np.bool_)
        cycle = np.full(count, seen.cycle, np.int32)
        self.issuance.add(nodes, cycle, seen.points, color, colored)
        if seen.ids is not None:
            self._nodes.update(zip(seen.ids.tolist(), nodes.tolist(), strict=True))

    def node_of(self, id_: int) -> int:
        """The node of an id that the SLAM gave; -1 where it is unknown or has left."""
        return max(self._nodes.get(id_, -1), -1)

    @property
    def waiting(self) -> bool:
        """Whether something is to be sent sooner or later."""
        if self._anchors or self._links or self._retracted or len(self.backlog):
            return True
        return any(issuance.waiting for issuance in (*self._earlier, self.issuance))

    def payloads(
        self, now: float, base: int, allowed: Allowance, known: Known
    ) -> Iterator[Payload]:
        """What goes out now, cut so that each payload fits into a transaction.

        known: tells which places the fleet's map has.
        """
        while self._earlier and not self._earlier[0].waiting:
            self._earlier.pop(0)
        issuance = self._earlier[0] if self._earlier else self.issuance
        batch = issuance.batch(now, allowed, known)
        if batch is None and not self._due(now):
            return
        nodes = NONE if batch is None else batch.nodes
        sightings = [] if batch is None else list(batch.sightings)
        anchors, self._anchors, self._anchors_since = self._anchors, [], None
        retracted = np.unique(np.concatenate([NONE, *self._retracted]))
        links, self._links = tuple(self._links), []
        self._retracted, self._moved = [], False
        name = None if self._introduced else self._config.name or None
        self._introduced = True
        while anchors or links or name or len(retracted) or sightings or len(nodes):
            room = max(allowed.room - 64 * len(links), _ANCHOR)
            mine = anchors[: room // _ANCHOR]
            room -= len(mine) * _ANCHOR
            gone = retracted[: room // _NUMBER]
            room -= len(gone) * _NUMBER
            again, sightings, room = _fill(sightings, room)
            each = _FEATURE + _PARENT * self._config.graph.n_p
            count = max(room // each, 1)
            count = min(count, self._config.issuance.features_per_transaction)
            bundle = issuance.bundle(nodes[:count], base) if len(nodes[:count]) else None
            yield Payload(name, tuple(mine), bundle, gone, again, links)
            base += len(nodes[:count])
            anchors, retracted, nodes = anchors[len(mine) :], retracted[len(gone) :], nodes[count:]
            links, name = (), None

    def _due(self, now: float) -> bool:
        """Whether there is something to say beside features. A mere pose can wait a while."""
        if self._links or self._retracted or self._moved:
            return True
        since = self._anchors_since
        return since is not None and now - since >= self._config.sync.announce_period

    def _enter(self, session: int) -> None:
        """A session begins: the first one at the start pose, a later one unknown or as before."""
        before = FrameId(self._author, self.session)
        if self._sessions:
            self.catch_up(_nothing, len(self.backlog))
            if self.issuance.waiting:
                self._earlier.append(self.issuance)
            self._start_frame()
        self.session = session
        if session in self._sessions:
            return
        here = FrameId(self._author, session)
        start = self._config.start_pose
        if not self._sessions and start is not None:
            self._links.append(Link(here, FLEET_FRAME, quantise_pose(start), CERTAIN))
        elif self._sessions and self._config.same_origin:
            self._links.append(Link(here, before, quantise_pose(np.eye(4)), CERTAIN))

    def _publish(self, anchor: Anchor, now: float | None = None) -> None:
        self._anchors.append(anchor)
        if self._anchors_since is None:
            self._anchors_since = now

    def _first_seen(self, ids: npt.NDArray[np.uint64], order: Int64s, cycle: int) -> Int64s:
        """The rows whose id is new, once each; the others are seen again."""
        new, again = [], []
        met: set[int] = set()
        for row, id_ in zip(order.tolist(), ids[order].tolist(), strict=True):
            if id_ in met:
                continue
            met.add(id_)
            node = self._nodes.get(id_)
            if node is None or node < 0:
                new.append(row)
            else:
                again.append(node)
        if again:
            self.issuance.see_again(np.array(again, np.int64), cycle)
        return np.array(new, np.int64)

    def _move(self, cycle: int, stamp: int, pose: Int32s, names: dict[int, int]) -> None:
        """A loop closure moved a cycle: its anchor is published anew, not its points.

        Those not issued yet leave the DAG and come back where they are now.
        """
        self._publish(Anchor(cycle, self.session, stamp, pose))
        self._moved = True
        self.backlog.move(cycle, pose)
        old = self.issuance.unissued_of(cycle)
        if len(old) == 0:
            return
        self.issuance.revalue(self.graph.withdraw(old))
        positions, inside = _carry(pose, self.issuance.place[old])
        nodes = self.graph.insert(positions[inside])
        kept = old[inside]
        columns = self.issuance
        columns.add(
            nodes,
            columns.cycle[kept],
            columns.place[kept],
            columns.color[kept],
            columns.colored[kept],
        )
        for node in old.tolist():
            if node in names:
                self._nodes[names[node]] = -1
        for before, after in zip(kept.tolist(), nodes.tolist(), strict=True):
            if before in names:
                self._nodes[names[before]] = after


def _nothing(points: Int32s) -> Bools:
    return np.zeros(len(points), np.bool_)


def _carry(pose: Int32s, points: Int32s) -> tuple[Int32s, Bools]:
    """Points through a pose, and which of them stay within range."""
    out, inside = np.empty_like(points), np.ones(len(points), np.bool_)
    apply_pose(pose, points, out, inside)
    return out, inside


def _fill(sightings: list[Sighting], room: int) -> tuple[tuple[Sighting, ...], list[Sighting], int]:
    """As many sightings as fit into `room` bytes; those left; the room left."""
    taken: list[Sighting] = []
    left = list(sightings)
    while left and room >= _SIGHTING + _NUMBER:
        count = (room - _SIGHTING) // _NUMBER
        first = left.pop(0)
        taken.append(replace(first, numbers=first.numbers[:count]))
        room -= _SIGHTING + _NUMBER * len(taken[-1].numbers)
        if count < len(first.numbers):
            left.insert(0, replace(first, numbers=first.numbers[count:]))
    return tuple(taken), left, room
