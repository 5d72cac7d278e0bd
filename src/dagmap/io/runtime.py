"""The thread that owns an agent: time and bytes in, the ledger and the network out.

One step: what came in goes through the agent, what it accepted goes to the disk in one SQLite
transaction, and only then does anybody hear of it. Nothing in a step waits for the network.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Literal, Protocol

from ..agent import Agent
from ..messages import Kind, kind_of
from ..model import (
    Accepted,
    AuthorId,
    Cycle,
    CycleError,
    DagmapError,
    Event,
    Forked,
    Issued,
    Outgoing,
    Overloaded,
    Reason,
    Rejected,
    Revoked,
    TransactionId,
)
from .log import Log
from .queues import Inbox, Question

TICK = 0.05  # s between the ticks of an agent, where nothing comes in
_READING = 0.03  # s after which no further message is read in a step
_SOON = 0.05  # s from what came in to the tick that folds it, together with what comes meanwhile
_STATE_PERIOD = 5.0  # s between two lines of the log that say how it stands
_FETCH = 10  # retry periods that what others promise of the own chain gets to arrive
_LOOK_PERIOD = 1.0  # s between two looks for transactions that a person brings


class Ledger(Protocol):
    """What keeps transactions: `Store` does."""

    def append_many(self, transactions: Iterable[tuple[TransactionId, bytes]]) -> None: ...


class Network(Protocol):
    """What carries messages: `Transport` does."""

    @property
    def here(self) -> frozenset[AuthorId]: ...
    @property
    def waiting_bytes(self) -> int: ...
    def send(self, messages: Iterable[Outgoing]) -> None: ...


class Slam(Protocol):
    """What hands cycles to the inbox: `Player` does."""

    error: DagmapError | None

    @property
    def over(self) -> bool: ...


@dataclass(slots=True)
class Counts:
    """What happened since the start. Written by the agent's thread, read by any."""

    cycles: int = 0
    points: int = 0  # that the SLAM handed in
    features: int = 0  # that went out in own transactions
    issued: int = 0  # own transactions
    stored: int = 0  # transactions of all authors
    observe_s: float = 0.0  # spent in `Agent.observe`, in all
    observe_max_s: float = 0.0
    refused: Counter[Reason] = field(default_factory=Counter)


class Runtime:
    """Drives one agent. `run` returns once it is told to stop or has nothing more to wait for."""

    def __init__(
        self,
        agent: Agent,
        store: Ledger,
        network: Network,
        inbox: Inbox,
        log: Log,
        report: Callable[[Runtime], dict[str, object]],
        keep: Callable[[Agent], None] = lambda agent: None,
        brought: Callable[[], Iterable[bytes]] = lambda: (),
    ) -> None:
        """report: the answer to a question that somebody puts into the inbox.

        keep: called now and then, to keep what makes the next start faster.
        brought: transactions that came another way than over the network, since the last call.
        """
        self.agent, self.network, self.inbox = agent, network, inbox
        self._store, self._log, self._report, self._keep_state = store, log, report, keep
        self.counts = Counts()
        self.started = time.monotonic()
        self._brought = brought
        self._next_tick = self._next_state = self._next_look = self.started
        self._tick_took = 0.0
        self._unfolded: list[TransactionId] = []  # for `_trace` only
        self._last_news = 0.0  # on the agent's clock
        self._stopping = False

    @property
    def now(self) -> float:
        """The agent's clock: seconds since the start, which no one sets back."""
        return time.monotonic() - self.started

    def stop(self) -> None:
        """Finish the step and return from `run`. To be called from a signal handler, too."""
        self._stopping = True

    def listen(self, seconds: float) -> None:
        """Before its chain is gone on with, hear from those in reach whether it was longer.

        seconds: to wait for anybody; what is promised of the own chain gets more to arrive.
        """
        me, ledger, sync = self.agent.identity.author, self.agent.ledger, self.agent.sync
        before, begun = len(ledger.chain(me).main), self.now
        if not before:
            return
        self.agent.listening = True  # a number that is used up must not be signed again
        fetched = begun + seconds + _FETCH * self.agent.config.sync.retry_period
        while not self._stopping and (
            (sync.promised(me) and self.now < fetched)
            or (not self._heard_all(begun) and self.now < begun + seconds)
        ):
            self._step()
        self.agent.listening = False
        self.agent.resume()
        if found := len(ledger.chain(me).main) - before:
            meaning = "the ledger was an older copy; the others knew what it lacked"
            self._log.write("warning", "own transactions found", count=found, meaning=meaning)

    def run(self, slam: Slam | None = None, until_agreed: float | None = None) -> None:
        """Work until stopped.

        slam: where cycles come from; None: from nowhere, the robot only listens.
        until_agreed: return as well once the SLAM is over and everybody in reach has announced
            itself, but asked and told nothing new for so many seconds. None: go on and serve.
        Raises StoreError (nothing that is not stored was sent) and what the SLAM raised.
        """
        while not self._stopping:
            self._step()
            if slam is not None and slam.error is not None:
                raise slam.error
            if (
                until_agreed is not None
                and (slam is None or slam.over)
                and self._quiet(until_agreed)
            ):
                return

    def _step(self) -> None:
        work = self.inbox.take(self._next_tick - time.monotonic())
        begun, used = time.monotonic_ns(), time.thread_time()
        events = [event for cycle in work.cycles for event in self._observe(cycle)]
        read = self._read(work.messages, events)
        if time.monotonic() >= self._next_look:
            events += [event for data in self._brought() for event in self.agent.take(data)]
            self._next_look = time.monotonic() + _LOOK_PERIOD
        if (before := time.monotonic()) >= self._next_tick:
            events += self.agent.tick(self.now, self.inbox.unread)
            after = time.monotonic()
            pause = TICK if self.agent.settled else min(max(_SOON, after - before), TICK)
            self._tick_took, self._next_tick = after - before, after + pause
        elif any(isinstance(event, Accepted) for event in events):
            soon = max(_SOON, self._tick_took)  # folding takes half of the time at most
            self._next_tick = min(self._next_tick, before + soon)
        self.agent.took(time.thread_time() - used)
        self._keep(events)
        self._trace(begun, events)
        out = self.agent.outbox()
        self.network.send(out)
        if any(_is_news(data) for data in (*read, *(each.data for each in out))):
            self._last_news = self.now
        self._note(events)
        for question in work.questions:
            self._answer(question)

    def _read(self, messages: list[bytes], events: list[Event]) -> list[bytes]:
        """Hand in messages, and return which; what would take too long waits behind a cycle."""
        until = time.monotonic() + _READING
        for count, data in enumerate(messages, 1):
            events += self.agent.receive(data, self.now)
            if time.monotonic() >= until:
                self.inbox.put_back(messages[count:])
                return messages[:count]
        return messages

    def _observe(self, cycle: Cycle) -> list[Event]:
        started, before = time.perf_counter(), self.agent.observing.observed
        try:
            events = self.agent.observe(cycle, self.now)
        except CycleError as error:  # one bad cycle of a SLAM is no reason to stop mapping
            self._log.seldom("warning", "cycle refused", "cycle", reason=error)
            return []
        took = time.perf_counter() - started
        self.counts.cycles += 1
        self.counts.points += self.agent.observing.observed - before
        self.counts.observe_s += took
        self.counts.observe_max_s = max(self.counts.observe_max_s, took)
        self._log.write("debug", "observed", stamp=float(cycle.stamp), ms=1000 * took)
        return events

    def _keep(self, events: list[Event]) -> None:
        """A transaction is on the disk before anyone is told of it; one commit for the step."""
        accepted = [(event.id, event.data) for event in events if isinstance(event, Accepted)]
        if accepted:
            self._store.append_many(accepted)
            self.counts.stored += len(accepted)

    def _trace(self, begun: int, events: list[Event]) -> None:
        """For measurements: what was sealed and what is folded by now, on the machine's clock."""
        if not self._log.shows("debug"):
            return
        self._unfolded += [event.id for event in events if isinstance(event, Accepted)]
        sealed = [event.id for event in events if isinstance(event, Issued)]
        folded = self._unfolded if self.agent.settled else []
        if sealed or folded:
            self._log.write(
                "debug",
                "step",
                begun_ns=begun,
                ended_ns=time.monotonic_ns(),
                sealed=",".join(id_.hex()[:16] for id_ in sealed),
                folded=",".join(id_.hex()[:16] for id_ in folded),
                transactions=len(self.agent.ledger),
            )
        if folded:
            self._unfolded = []

    def _note(self, events: list[Event]) -> None:
        """Count, and say what a person should know."""
        for event in events:
            if isinstance(event, Issued):
                self.counts.issued += 1
                self.counts.features += event.features
            elif isinstance(event, Rejected):
                self._note_refusal(event)
            elif isinstance(event, Overloaded):
                self._note_overload(event)
            elif isinstance(event, Forked):
                self._note_fork(event)
            elif isinstance(event, Revoked):
                self._note_revocation(event)
        if time.monotonic() >= self._next_state:
            self._next_state = time.monotonic() + _STATE_PERIOD
            self._log.write("info", "state", **self._state())
            self._keep_state(self.agent)

    def _note_overload(self, event: Overloaded) -> None:
        level: Literal["warning", "info"] = "info" if event.features is None else "warning"
        self._log.write(
            level,
            "overloaded" if level == "warning" else "no longer overloaded",
            load=round(event.load, 3),
            features_per_cycle="all" if event.features is None else event.features,
            points_left_for_later=event.waiting,
            points_dropped=event.dropped,
        )

    def _note_fork(self, event: Forked) -> None:
        where = {"author": event.author.hex(), "sequence": event.sequence}
        if event.author == self.agent.identity.author:
            consequence = "this robot issues nothing more; give it a new data folder"
            self._log.write("error", "own key was used twice", **where, consequence=consequence)
            return
        consequence = "nothing of this author from there on counts"
        # Seldom: in an open fleet anybody can be as many authors as he likes, and fork them all.
        self._log.seldom("warning", "fork proven", "fork", **where, consequence=consequence)

    def _note_revocation(self, event: Revoked) -> None:
        mine, lifted = event.author == self.agent.identity.author, event.count is None
        if lifted:
            consequence = "the fleet key was used twice: this revocation counts no more"
        elif mine:
            consequence = "this robot issues nothing more; enroll it anew to go on"
        else:
            consequence = "nothing of this author from there on counts"
        self._log.write(
            "error" if mine or lifted else "warning",
            "revoked",
            author=event.author.hex(),
            count=event.count,
            consequence=consequence,
        )

    def _note_refusal(self, event: Rejected) -> None:
        self.counts.refused[event.reason] += 1
        whose = "unknown" if event.fault is None else event.fault.hex()
        remedy = {}
        if event.reason is Reason.PARAMETERS:
            remedy["remedy"] = (
                "that robot computes another map; make [fold], [transaction], graph.n_p and "
                "graph.n_c_max equal on all robots of the fleet"
            )
        self._log.seldom(
            "warning",
            "refused",
            event.reason.name,
            reason=event.reason.value,
            detail=event.detail or "none",
            whose=whose,
            **remedy,
        )

    def _state(self) -> dict[str, object]:
        """What the line of the log says."""
        return {
            "cycles": self.counts.cycles,
            "transactions": len(self.agent.ledger),
            "issued": self.counts.issued,
            "waiting": len(self.agent.ledger.missing()),
            "robots": len(self.network.here),
            "unsent_bytes": self.network.waiting_bytes,
            "refused": self.counts.refused.total(),
        }

    def _quiet(self, seconds: float) -> bool:
        """Whether all is said here, and the others were heard since the last news."""
        if self.agent.holds_back or self.network.waiting_bytes:
            return False
        last, here = self._last_news, self.network.here
        return (not here or self._heard_all(last)) and self.now - last >= seconds

    def _heard_all(self, since: float) -> bool:
        """Whether somebody is in reach, and all of them have announced themselves since."""
        peers, here = self.agent.sync.peers, self.network.here
        return bool(here) and all(who in peers and peers[who].heard > since for who in here)

    def _answer(self, question: Question) -> None:
        question.answer = (question.look or self._report)(self)
        question.answered.set()


def _is_news(data: bytes) -> bool:
    """Whether a message tells or asks for transactions."""
    return kind_of(data) in (Kind.TRANSACTIONS, Kind.WANT)
