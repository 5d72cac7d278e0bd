"""One participant G of the DAGmap network: composes everything else. Read this first.

Bytes, time and cycles come in as arguments; events and bytes go out as values. There is no clock,
socket, disk, chance or log in here or below.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from . import checkpoint as checkpoints
from .config import Config
from .consensus import Consensus
from .identity import Identity, check_certificate
from .ledger import Ledger
from .messages import Heads, Parsers, Transactions
from .model import (
    FLEET_FRAME,
    Accepted,
    AuthorId,
    Bools,
    Cycle,
    Event,
    Floats,
    Forked,
    FrameId,
    Int32s,
    Issued,
    MapChanged,
    Outgoing,
    Reason,
    Rejected,
    Revoked,
    TransactionId,
    Waiting,
    pose_matrix,
)
from .observing import Observing
from .placing import Placing
from .quantising import quantise_cycle
from .shaping import Urgency
from .steering import Steering
from .sync import Sync
from .transaction import Transaction, glance, id_of, seal
from .wire import Refusal
from .worldmap import WorldMap, build_map, newest_poses

# Why a robot refuses what an honest one may still hold: that has not heard of the proof yet.
_MAY_BE_NEWS = (Reason.FORK, Reason.REVOKED)


class Agent:
    """A robot's share in the fleet's map.

    identity: the robot's key. config: its parameters; the fleet-wide ones must be everybody's.
    Raises ConfigError where the fleet is closed and the identity has no certificate of it.
    """

    def __init__(
        self, identity: Identity, config: Config | None = None, parsers: Parsers | None = None
    ) -> None:
        self.config = config or Config()
        self._parsers = parsers or Parsers()
        self.identity = identity
        check_certificate(identity, self.config)
        self.ledger = Ledger(self.config)
        self.consensus = Consensus(self.config, identity.salt)
        self.observing = Observing(self.config, identity.author, identity.salt)
        self.sync = Sync(self.ledger, self.config, identity.author)
        self.placing = Placing(self.config, identity.author, self.observing.drift)
        self.steering = Steering(self.config, identity.author)
        self.listening = False  # to be told of its own chain first: nothing is issued meanwhile
        self._map: WorldMap | None = None
        self._map_version = -1  # of the consensus, when the map was made
        self._undone = self._applied = 0  # transactions, since the last `MapChanged`
        self._next_fold = -math.inf

    @classmethod
    def restore(
        cls,
        identity: Identity,
        config: Config | None,
        transactions: Iterable[bytes],
        parsers: Parsers | None = None,
        checkpoint: bytes | None = None,
    ) -> Agent:
        """An agent that holds these transactions (as `Accepted` gave them) and goes on.

        Its adjacency DAG and the ids of the SLAM are those of a new start: where the SLAM was
        started anew too, give its cycles a new session.
        checkpoint: what `checkpoint` gave for the first of them; not used where it does not match.
        """
        agent = cls(identity, config, parsers)
        if checkpoint is not None:
            transactions = agent._thaw(checkpoint, {id_of(data): data for data in transactions})
        for data in transactions:
            agent._through_the_door(data, again=True)
        agent.resume()
        return agent

    def resume(self) -> None:
        """Go on after all own transactions that the ledger holds by now. `restore` does it; after
        it, before the first cycle, others may have known more of them."""
        self.observing.resume(self.ledger.chain(self.identity.author).main)

    def checkpoint(self, stored: Sequence[TransactionId]) -> bytes:
        """The folded state. stored: ids of all accepted transactions, in the order of the store.

        Undo records that lie far behind it are dropped (`ledger.undo_kept`).
        """
        self.settle()
        self.consensus.drop_records()
        return checkpoints.save(self.ledger, self.consensus, self.identity, stored)

    def observe(self, cycle: Cycle, now: float) -> list[Event]:
        """Take one cycle of the local SLAM. Raises CycleError, and then nothing was taken."""
        quantised = self.observing.check(quantise_cycle(cycle))
        self.observing.withdraw(quantised)  # what the SLAM removed or moved
        self.observing.rearrange()
        # what it added: Alg. 1
        events = self.steering.insert(self.observing, quantised, now, self._settled)
        events += self._issue(now)
        self.steering.shaper.release(now)
        return events

    def receive(self, data: bytes, now: float) -> list[Event]:
        """Take any message of any robot. Foreign bytes never raise: they are `Rejected`."""
        try:
            sender, message = self._parsers.message(bytes(data), self.config)
        except Refusal as refusal:
            return [Rejected(refusal.reason, refusal.fault, refusal.detail)]
        if isinstance(message, Transactions):
            events = self._take_all(message.data)
            news = any(isinstance(event, Accepted) for event in events)
            self.steering.post(self.sync.answered(sender, message, now, news), Urgency.CONTROL)
        elif isinstance(message, Heads):
            events = []
            self.steering.post(self.sync.heard(sender, message, now), Urgency.CONTROL)
        else:
            events, room = [], self.steering.shaper.room_for_answer(sender)
            self.steering.post(self.sync.asked(sender, message, room), Urgency.ANSWER)
        self.steering.shaper.release(now)
        return events

    def take(self, data: bytes) -> list[Event]:
        """Take one transaction from elsewhere than the network, as a revocation out of a file.

        The others hear of it with the next announcement.
        """
        return self._through_the_door(bytes(data))

    def tick(self, now: float, unread: bool = False) -> list[Event]:
        """Let time pass: release what the pacing held back, fold, place, announce, repair.

        unread: whether messages have come that were not handed in yet. What is overdue may be
        among them, so it is asked for again much later.
        """
        self.observing.rearrange()
        self.steering.look(self.sync, now)
        events = self.steering.catch_up(self.observing, now, self._settled)
        events += self._issue(now)
        events += self._fold_on(now)
        self.observing.relate(*self.placing.step(self.ledger, self.consensus))
        self.steering.announce(self.sync, now, unread)
        self.steering.shaper.release(now)
        return events

    def took(self, seconds: float) -> None:
        """Say what the calls since the last time took of the processor.

        Without being told, the agent cannot keep S < T (`overhead.cycle_share`): it has no clock.
        """
        self.steering.controller.took(seconds)

    def outbox(self) -> list[Outgoing]:
        """What is to be sent now, handed over and forgotten."""
        return self.steering.shaper.take()

    def digest(self) -> bytes:
        """32 bytes over the map of all that is accepted; equal on two robots exactly when their
        maps are. Settles first."""
        self.settle()
        return self.consensus.digest()

    @property
    def settled(self) -> bool:
        """Whether all that is accepted is folded: then `map` is the map that `digest` is of."""
        return not self.consensus.pending

    def settle(self) -> None:
        """Fold to the end, however long it takes; ticks do it in bounded steps."""
        self._advance()

    @property
    def holds_back(self) -> bool:
        """Whether something that is valid still waits to be issued (the next ticks do it)."""
        return (self.observing.waiting or self.steering.shaper.waiting) and not self._silenced

    @property
    def searching(self) -> bool:
        """Whether the last tick compared keyframes: the frames may be placed anew soon."""
        return self.placing.busy

    @property
    def _silenced(self) -> bool:
        """Whether the key was used twice, or revoked: what it signs counts no more."""
        own = self.ledger.chain(self.identity.author)
        return own.cut is not None or own.revoked is not None

    @property
    def map(self) -> WorldMap:
        """The map of the robot's own component of frames, immutable.

        It is up to date but for a revision that takes longer than a tick: as long as one is under
        way (see `settled`), this is the map before it.
        """
        self._catch_up()
        if self._map is None or not self._pictured:
            picture = self.consensus.picture(self._component)
            self._map = build_map(picture, self.config.fold.cell)
            self._map_version = self.consensus.version
        return self._map

    def frame(self) -> Floats | None:
        """(4, 4) m, the SLAM frame in the fleet frame, as it drifts by now; None: not placed."""
        self._catch_up()
        placed = self.consensus.frames.get(FrameId(*self._frame))
        return None if placed is None else pose_matrix(placed[1]) @ self.observing.drift.now

    @property
    def robots(self) -> dict[str, tuple[Floats, float]]:
        """Newest pose (4, 4) in this robot's component, and its stamp in s, by robot's name."""
        self._catch_up()
        return newest_poses(self.consensus, self._component)

    @property
    def unplaced(self) -> dict[FrameId, str]:
        """SLAM frames that no links lead to from this robot's, and why: they wait, unmerged."""
        self._catch_up()
        return self.placing.why(self.consensus)

    @property
    def _component(self) -> FrameId:
        """Where this robot is; before its first cycle, where it is configured to start."""
        if FrameId(*self._frame) not in self.consensus.frames and not self.observing.cycles:
            return FLEET_FRAME if self.config.start_pose else FrameId(*self._frame)
        return self.consensus.placement(*self._frame)[0]

    @property
    def _frame(self) -> tuple[AuthorId, int]:
        return self.identity.author, self.observing.session

    def _thaw(self, checkpoint: bytes, stored: dict[TransactionId, bytes]) -> list[bytes]:
        """Take over the state of a checkpoint. Returns the transactions that it lacks."""
        found = checkpoints.load(checkpoint, self.identity, self.config, stored)
        if found is None:
            return list(stored.values())
        self.ledger, self.consensus, held = found
        self.sync = Sync(self.ledger, self.config, self.identity.author)
        self.ledger.changed.update(self.ledger.chains)  # nobody has read them in this process
        return list(stored.values())[held:]

    def _settled(self, points: Int32s) -> Bools:
        """Points (N, 3) mm in the SLAM frame that the map knows from this robot well enough."""
        repeats = self.config.issuance.repeats
        if not repeats:
            return np.zeros(len(points), np.bool_)
        return self.consensus.settled(*self._frame, points, repeats)

    def _known(self, points: Int32s) -> Bools:
        """Points (N, 3) mm in the SLAM frame where the fleet's map has a node."""
        return self.consensus.settled(*self._frame, points, 0)

    def _issue(self, now: float) -> list[Event]:
        """Section 4.2: seal what is valid and may go out, and take it through the door."""
        events: list[Event] = []
        me = self.identity.author
        quiet = self.listening or self._silenced
        allowed = None if quiet else self.steering.allowance(now)
        if allowed is None:
            return events
        base = self.ledger.features(me)
        for payload in self.observing.payloads(now, base, allowed, self._known):
            main = self.ledger.chain(me).main
            previous = main[-1].id if main else None
            tips = self.ledger.tips(me, self.config.transaction.max_references)
            lamport = self.ledger.lamport_after((*tips, *([previous] if previous else [])))
            if self.config.closed and previous is None:
                payload = replace(payload, certificate=self.identity.certificate)
            data = seal(self.identity, self.config, len(main), previous, lamport, tips, payload)
            bundles = 0 if payload.bundle is None else len(payload.bundle.cores())
            events += self._through_the_door(data)
            if id_of(data) not in self.ledger:
                break  # a Rejected event above says why; numbering on would fork the chain
            events.append(Issued(id_of(data), payload.features, bundles, len(data)))
            self.steering.controller.issued(payload.features, len(data))
            self.steering.post([(Transactions((data,)), None)], Urgency.OWN)
        return events

    def _take_all(self, items: Iterable[bytes]) -> list[Event]:
        """Those of one message. Whoever has sent one that nobody could have accepted is not
        listened to further: or a message would cost as much as a hundred."""
        events: list[Event] = []
        for item in items:
            found = self._through_the_door(item)
            events += found
            first = found[0] if found else None  # the first one is about the item itself
            if isinstance(first, Rejected) and first.reason not in _MAY_BE_NEWS:
                break
        return events

    def _through_the_door(self, data: bytes, again: bool = False) -> list[Event]:
        """The one door: own and foreign transactions alike are judged, kept and folded."""
        try:
            id_ = self._parsers.worked(data, self.config)
            if self.ledger.holds(id_):
                return []
            if self.config.closed and not again:
                author, previous = glance(data)
                if previous and not self.ledger.worth_judging(id_, author):
                    return [Waiting(id_, (previous,))]
            transaction = self._parsers.transaction(data, self.config)
        except Refusal as refusal:
            return [Rejected(refusal.reason, refusal.fault, refusal.detail)]
        outcome = self.ledger.add(transaction, again)
        events: list[Event] = []
        for author, sequence in outcome.forked:
            self.consensus.cut(author, sequence)
            events.append(Forked(author, sequence))
            proof = self.ledger.chain(author).proof or ()  # kept like what was accepted
            events += [Accepted(tx.id, tx.data) for tx in proof if tx.id not in self.ledger]
        for author, count in outcome.revoked:
            self._refold(author)
            events.append(Revoked(author, count))
        for tx in outcome.accepted:
            self._fold(tx)
            if tx.author != self.identity.author and not again:
                self.steering.controller.merged(tx.features)
            events.append(Accepted(tx.id, tx.data))
        if outcome.missing is not None:
            events.append(Waiting(transaction.id, outcome.missing))
        events += [Rejected(r.reason, r.fault, r.detail) for r in outcome.refused]
        return events

    def _fold(self, tx: Transaction) -> None:
        if tx in self.consensus or tx.payload.revocations:
            return
        if self.ledger.counts(tx):
            self.consensus.add(tx)
        else:
            tx.drop_columns()

    def _refold(self, author: AuthorId) -> None:
        """A revocation came, or counts no more: fold exactly what counts of the author now."""
        chain = self.ledger.chain(author)
        self.consensus.cut(author, chain.end)
        for tx in chain.main[: chain.end]:
            if tx not in self.consensus and self.ledger.counts(tx):
                tx.payload = tx.decode_again(self.config)
                self.consensus.add(tx)

    def _fold_on(self, now: float) -> list[Event]:
        """A tick's share of folding, where it is time for any."""
        due = now >= self._next_fold and self.consensus.pending
        events = self._advance(self.config.ledger.fold_per_tick) if due else []
        if due and self.settled:
            self._next_fold = now + self.config.ledger.fold_period
        return events

    def _advance(self, budget: int | None = None) -> list[Event]:
        """Fold on. What a revision does is told of at its end, as one change."""
        if not self.consensus.pending:
            return []
        keep = None if self._pictured else self._component
        version = self.consensus.version
        undone, applied = self.consensus.advance(budget, keep)
        self._undone, self._applied = self._undone + undone, self._applied + applied
        if self.consensus.version == version:
            return []
        event = MapChanged(self._undone, self._applied)
        self._undone = self._applied = 0
        return [event]

    def _catch_up(self) -> None:
        """Fold to the end what needs no long revision; a revision is left to the ticks."""
        while self.consensus.pending and not self.consensus.revising:
            self._advance(self.config.ledger.fold_per_tick)

    @property
    def _pictured(self) -> bool:
        """Whether the map is that of what is folded (in a revision: was, before it)."""
        consensus = self.consensus
        if self._map is None or self._map_version != consensus.version:
            return False
        return consensus.revising or self._map.origin == self._component
