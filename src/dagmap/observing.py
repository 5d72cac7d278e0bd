"""The robot's own side: what its SLAM hands in becomes nodes of the adjacency DAG, anchors,
retractions, and in the end the payloads of its transactions (sections 4.1 and 4.2)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from .backlog import Backlog, Seen
from .config import Config
from .graph import AdjacencyDag
from .issuance import ROOM, Allowance, Issuance, Known
from .kernels.codec import morton_order
from .kernels.columns import distinct, grown
from .kernels.geometry import apply_pose
from .keyframes import Keyframes, fill
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
from .payload import CERTAIN, Anchor, Link, Payload, Sighting
from .transaction import Transaction

Settled: TypeAlias = Callable[[Int32s], Bools]  # of points (N, 3) mm in the SLAM frame
_LEFT = -2  # node of an id whose point is left for later; -1: it has none for other reasons
_REARRANGED = 2048  # nodes that leave the DAG, or come back elsewhere, in one call
_MOST_MOVED, _MOST_RETRACTED = 1024, 16_384  # that go out in one call
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
        self._moved: list[Anchor] = []  # to be published anew
        self._retracted: list[Int64s] = []
        self._links: list[Link] = []
        self._keyframes = Keyframes(config.placing)
        self._introduced = config.closed  # there the certificate names the robot
        self._earlier: list[Issuance] = []  # of former sessions, with features held back
        self.backlog = Backlog(config.overhead.backlog)
        self._start_frame()

    def _start_frame(self) -> None:
        """A new SLAM frame has its own adjacency DAG, ids and cycles."""
        self.graph = AdjacencyDag(self._config.graph, self._salt)
        self.issuance = Issuance(self._config, self.graph)
        self._nodes: dict[int, int] = {}  # node of each id that the SLAM gave and did not remove
        self._id_of: npt.NDArray[np.uint64] = np.zeros(0, np.uint64)  # by node, where it has one
        self._leaving: list[Int64s] = []  # nodes that were removed, still in the DAG
        self._moving: list[Anchor] = []  # whose unissued nodes are still where they were
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
        ids = cycle.removed.tolist()
        if not all(map(known.__contains__, ids)):
            unknown = next(id_ for id_ in ids if id_ not in known)
            raise CycleError(
                f"{where}: removed names {unknown}, which this session has not seen or has "
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
            nodes = np.sort(np.array(list(map(self._nodes.pop, cycle.removed.tolist())), np.int64))
            self._leaving.append(nodes[nodes >= 0])  # others were thrown out of range by a move
        moved = [Anchor(self._cycle_of[s], self.session, s, pose) for s, pose in cycle.moved]
        for anchor in moved:
            self.backlog.move(anchor.cycle, anchor.pose)
        self._moved += moved
        self._moving += moved

    def rearrange(self, limit: int = _REARRANGED) -> None:
        """Do in the DAG what `withdraw` took, for about so many nodes.

        What is not done in this call stays where it is, which is only a matter of structure: should
        it go out before, then it is retracted, or its anchor has moved.
        """
        while self._leaving and limit > 0:
            nodes, rest = self._leaving[0][:limit], self._leaving[0][limit:]
            self._leaving[:1] = [rest] if len(rest) else []
            numbers = self.issuance.number[nodes]
            self._retracted.append(numbers[numbers >= 0])
            self.issuance.revalue(self.graph.withdraw(nodes))
            limit -= len(nodes)
        unissued = self.issuance.unissued() if self._moving and limit > 0 else NONE
        batch: list[tuple[Int64s, Int32s]] = []
        done = 0
        while done < len(self._moving) and limit > 0:
            anchor = self._moving[done]
            if any(anchor.cycle == moved.cycle for moved in self._moving[:done]):
                break  # moved again: the nodes have to be there first
            done += 1
            mine = self.issuance.cycle[unissued] == anchor.cycle
            if mine.any():
                batch.append((unissued[mine], anchor.pose))
                limit -= int(mine.sum())
        del self._moving[:done]
        self._reinsert(batch)

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
        self._keyframes.see(number, cycle)
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
        if seen.ids is not None and len(nodes):
            self._id_of = grown(self._id_of, int(nodes[-1]) + 1, 0)
            self._id_of[nodes] = seen.ids
        color = np.zeros((count, 3), np.uint8) if seen.colors is None else seen.colors
        colored = np.full(count, seen.colors is not None, np.bool_)
        cycle = np.full(count, seen.cycle, np.int32)
        self.issuance.add(nodes, cycle, seen.points, color, colored)
        if seen.ids is not None:
            self._nodes.update(zip(seen.ids.tolist(), nodes.tolist(), strict=True))

    def node_of(self, id_: int) -> int:
        """The node of an id that the SLAM gave; -1 where it is unknown or has left."""
        return max(self._nodes.get(id_, -1), -1)

    def relate(self, links: Iterable[Link], wanted: bool) -> None:
        """Publish links of the robot's own frames; and its described points, where `wanted`."""
        self._links.extend(links)
        self._keyframes.wanted = wanted

    @property
    def rearranging(self) -> bool:
        """Whether `rearrange` has something to do."""
        return bool(self._leaving or self._moving)

    @property
    def waiting(self) -> bool:
        """Whether something is to be sent sooner or later."""
        if self._anchors or self._moved or self._links or self._retracted or len(self.backlog):
            return True
        if self.rearranging or self._keyframes.due:
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
        anchors, self._moved = anchors + self._moved[:_MOST_MOVED], self._moved[_MOST_MOVED:]
        retracted = distinct(np.concatenate([NONE, *self._retracted]))
        self._retracted = [retracted[_MOST_RETRACTED:]] if len(retracted) > _MOST_RETRACTED else []
        retracted = retracted[:_MOST_RETRACTED]
        links, self._links = tuple(self._links), []
        described = self._keyframes.take()
        name = None if self._introduced else self._config.name or None
        self._introduced = True
        while anchors or links or name or len(retracted) or sightings or len(nodes) or described:
            room = max(allowed.room - 64 * len(links), _ANCHOR)
            mine = anchors[: room // _ANCHOR]
            room -= len(mine) * _ANCHOR
            gone = retracted[: room // _NUMBER]
            room -= len(gone) * _NUMBER
            again, sightings, room = _fill(sightings, room)
            alone = not (mine or again or len(gone) or len(nodes))
            shown, described, room = fill(described, ROOM if alone else room)
            each = _FEATURE + _PARENT * self._config.graph.n_p
            count = max(room // each, 1)
            count = min(count, self._config.issuance.features_per_transaction)
            bundle = issuance.bundle(nodes[:count], base) if len(nodes[:count]) else None
            yield Payload(name, tuple(mine), bundle, gone, again, links, described=shown)
            base += len(nodes[:count])
            anchors, retracted, nodes = anchors[len(mine) :], retracted[len(gone) :], nodes[count:]
            links, name = (), None

    def _due(self, now: float) -> bool:
        """Whether there is something to say beside features. A mere pose can wait a while."""
        if self._links or self._retracted or self._moved or self._keyframes.due:
            return True
        since = self._anchors_since
        return since is not None and now - since >= self._config.sync.announce_period

    def _enter(self, session: int) -> None:
        """A session begins: the first one at the start pose, a later one unknown or as before."""
        before = FrameId(self._author, self.session)
        if self._sessions:
            self.rearrange(1 << 40)
            self.catch_up(_nothing, len(self.backlog))
            if self.issuance.waiting:
                self._earlier.append(self.issuance)
            self._start_frame()
        self.session = session
        self._keyframes.start()
        if session in self._sessions:
            return
        here = FrameId(self._author, session)
        start = self._config.start_pose
        if not self._sessions and start:
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

    def _reinsert(self, batch: list[tuple[Int64s, Int32s]]) -> None:
        """Unissued nodes of cycles that a loop closure moved come back where they are now."""
        if not batch:
            return
        leaving = np.sort(np.concatenate([old for old, _ in batch]))
        self.issuance.revalue(self.graph.withdraw(leaving))
        for old, pose in batch:
            columns = self.issuance
            positions, inside = _carry(pose, columns.place[old])
            nodes, kept = self.graph.insert(positions[inside]), old[inside]
            columns.add(
                nodes,
                columns.cycle[kept],
                columns.place[kept],
                columns.color[kept],
                columns.colored[kept],
            )
            self._rename(old, kept, nodes)

    def _rename(self, old: Int64s, kept: Int64s, nodes: Int64s) -> None:
        """The ids of old nodes name new ones; of those that were not kept, none."""
        names = self._names(old)
        self._nodes.update(dict.fromkeys(names.values(), -1))
        self._id_of = grown(self._id_of, len(self.graph), 0)
        for before, after in zip(kept.tolist(), nodes.tolist(), strict=True):
            if before in names:
                self._nodes[names[before]] = after
                self._id_of[after] = names[before]

    def _names(self, nodes: Int64s) -> dict[int, int]:
        """The id that the SLAM gave, of those of these nodes that have one."""
        ids = self._id_of[nodes[nodes < len(self._id_of)]].tolist()
        named = zip(nodes.tolist(), ids, strict=False)
        return {node: id_ for node, id_ in named if self._nodes.get(id_) == node}


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
