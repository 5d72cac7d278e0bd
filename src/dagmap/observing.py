"""The robot's own side: what its SLAM hands in becomes nodes of the adjacency DAG, anchors,
retractions, and in the end the payloads of its transactions (sections 4.1 and 4.2)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from .backlog import Backlog, Seen
from .config import Config
from .drift import Drift
from .graph import AdjacencyDag
from .issuance import ROOM, Allowance, Issuance, Known
from .kernels.codec import morton_order
from .kernels.columns import distinct
from .kernels.geometry import carry
from .keyframes import Keyframes, fill
from .model import (
    FLEET_FRAME,
    AuthorId,
    Bools,
    CycleError,
    FrameId,
    Int32s,
    Int64s,
    quantise_pose,
)
from .payload import CERTAIN, Anchor, Link, Payload, Sighting
from .quantising import QuantisedCycle
from .rearranging import LEFT, Rearranging
from .transaction import Transaction

Settled: TypeAlias = Callable[[Int32s], Bools]  # of points (N, 3) mm in the SLAM frame
REARRANGED = 2048  # units in which nodes leave the DAG, or come back elsewhere, in one call
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
        self._entered: int | None = None  # the session that goes on, if it began in this run
        self._retracted: list[Int64s] = []
        self._links: list[Link] = []
        self._keyframes = Keyframes(config.placing)
        self.drift = Drift(config.placing)
        self._introduced = config.closed  # there the certificate names the robot
        self._earlier: list[Issuance] = []  # of former sessions, with features held back
        self.backlog = Backlog(config.overhead.backlog)
        self._start_frame()

    def _start_frame(self) -> None:
        """A new SLAM frame has its own adjacency DAG, ids and cycles."""
        self.graph = AdjacencyDag(self._config.graph, self._salt)
        self.issuance = Issuance(self._config, self.graph)
        self._arrangement = Rearranging(self.issuance, self._salt)
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
        if self.drift.rate and last is not None and cycle.session != self._entered:
            raise CycleError(
                f"{where}: session {cycle.session} was begun before a restart or another session, "
                "and where its SLAM had drifted to is not known any more ([placing] drift); "
                "start a new session"
            )
        unknown = cycle.removed if fresh else self._arrangement.unknown(cycle.removed)
        if len(unknown):
            raise CycleError(
                f"{where}: removed names {unknown[0]}, which this session has not seen or has "
                "removed before; name ids once, after their point"
            )
        cycles = {} if fresh else self._cycle_of
        for stamp, _ in cycle.moved:
            if stamp not in cycles:
                raise CycleError(
                    f"{where}: moved names a cycle at {stamp / 1e6:.6f} s, which this session "
                    "has not seen; give the exact stamps of earlier cycles"
                )
        _, inside = carry(cycle.pose, cycle.points)
        if not inside.all():
            row = int(np.flatnonzero(~inside)[0])
            raise CycleError(f"{where}: the pose carries points row {row} beyond 2^29 mm; drop it")
        return cycle

    def withdraw(self, cycle: QuantisedCycle) -> None:
        """What the SLAM removed leaves; what it moved is put where it is now."""
        if cycle.session != self.session or not self._sessions:
            self._enter(cycle.session)
        if len(cycle.removed):
            self._arrangement.remove(cycle.removed)
        moved = [Anchor(self._cycle_of[s], self.session, s, pose) for s, pose in cycle.moved]
        self._lay(self.drift.follow(moved))

    def _lay(self, anchors: list[Anchor]) -> None:
        """Earlier cycles lie elsewhere from now on."""
        for anchor in anchors:
            self.backlog.move(anchor.cycle, anchor.pose)
            self._arrangement.move(anchor.cycle, anchor.pose)
        self._moved += anchors

    def rearrange(self, limit: int = REARRANGED) -> None:
        """Do in the DAG what `withdraw` took, for about so many units (see `rearranging`)."""
        numbers = self._arrangement.step(limit)
        if len(numbers):
            self._retracted.append(numbers)

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
        anchor = self.drift.enter(Anchor(number, cycle.session, cycle.stamp, cycle.pose))
        cycle = replace(cycle, pose=anchor.pose)
        self._publish(anchor, now)
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
                self._arrangement.leave(rest.ids)
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
                seen = seen.rows(self._arrangement.nodes(seen.ids) == LEFT)
            self._append(seen, settled)
        return looked

    def _append(self, seen: Seen, settled: Settled) -> None:
        positions, inside = carry(seen.pose, seen.points)
        fresh = inside & ~settled(positions)
        ids, seen = seen.ids, seen.rows(fresh)
        count = len(seen.points)
        nodes = self.graph.insert(positions[fresh])
        color = np.zeros((count, 3), np.uint8) if seen.colors is None else seen.colors
        colored = np.full(count, seen.colors is not None, np.bool_)
        cycle = np.full(count, seen.cycle, np.int32)
        self.issuance.add(nodes, cycle, seen.points, color, colored)
        self._arrangement.entered(seen.cycle, ids, fresh, nodes)

    def node_of(self, id_: int) -> int:
        """The node of an id that the SLAM gave; -1 where it is unknown or has left."""
        return max(int(self._arrangement.nodes(np.array([id_], np.uint64))[0]), -1)

    def relate(self, links: Iterable[Link], wanted: bool) -> None:
        """Publish links of the robot's own frames, and what is known of its drift; and its
        described points, where `wanted`."""
        self._links.extend(links)
        self._lay(self.drift.take())
        self._keyframes.wanted = wanted

    @property
    def rearranging(self) -> bool:
        """Whether `rearrange` has something to do."""
        return self._arrangement.busy

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
            while (
                more := self.drift.take()
            ):  # what was found of the old session holds for all of it
                self._lay(more)
            self.rearrange(1 << 40)
            self.catch_up(_nothing, len(self.backlog))
            if self.issuance.waiting:
                self._earlier.append(self.issuance)
            self._start_frame()
        self.session = self._entered = session
        self._keyframes.start()
        self.drift.start(session)
        if session in self._sessions:
            return
        here = FrameId(self._author, session)
        start = self._config.start_pose
        if not self._sessions and start:
            certain = CERTAIN - math.ceil(1000 * self._config.start_sigma)
            self._links.append(Link(here, FLEET_FRAME, quantise_pose(start), certain))
        elif self._sessions and self._config.same_origin:
            self._links.append(Link(here, before, quantise_pose(np.eye(4)), CERTAIN))

    def _publish(self, anchor: Anchor, now: float | None = None) -> None:
        self._anchors.append(anchor)
        if self._anchors_since is None:
            self._anchors_since = now

    def _first_seen(self, ids: npt.NDArray[np.uint64], order: Int64s, cycle: int) -> Int64s:
        """The rows whose id is new, once each; the others are seen again."""
        _, first = np.unique(ids[order], return_index=True)
        first = np.sort(first)
        nodes = self._arrangement.nodes(ids[order[first]])
        if (nodes >= 0).any():
            self.issuance.see_again(nodes[nodes >= 0], cycle)
        return order[first[nodes < 0]]


def _nothing(points: Int32s) -> Bools:
    return np.zeros(len(points), np.bool_)


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
