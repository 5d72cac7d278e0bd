"""The two bounded queues between the network and the agent. What they drop, repair brings back."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from ..messages import Kind, kind_of, sender_of
from ..model import AuthorId, Cycle, Outgoing


@dataclass(slots=True)
class Work:
    """What the agent's thread is to do next. Cycles go before messages."""

    cycles: list[Cycle] = field(default_factory=list)
    messages: list[bytes] = field(default_factory=list)
    questions: list[Question] = field(default_factory=list)


@dataclass(slots=True)
class Question:
    """Somebody in another thread wants to know the agent's state.

    look: what makes the answer, in the agent's thread, given the runtime; None: its report.
    """

    look: Callable[[Any], Any] | None = None
    answered: threading.Event = field(default_factory=threading.Event)
    answer: Any = None


@dataclass(frozen=True, slots=True)
class Rates:
    """What may come in within a second; as much again may come at once, after silence."""

    messages: float = math.inf  # from all senders
    bytes: float = math.inf
    messages_of_one: float = math.inf
    bytes_of_one: float = math.inf
    question: int = 0  # bytes that a question counts for: those of the answer that it may cause
    senders: int = 256  # that are remembered; whoever is forgotten begins anew


@dataclass(slots=True)
class _Bucket:
    """What one sender may still send now: messages and bytes, filled up as time goes by."""

    messages: float
    bytes: float
    filled: float  # s, when

    def fill(self, messages: float, size: float, now: float) -> None:
        """By the rates of a second, and up to them."""
        passed, self.filled = now - self.filled, now
        self.messages = min(messages, self.messages + passed * messages)
        self.bytes = min(size, self.bytes + passed * size)


class Throttle:
    """Says who sends too much. Use it from one thread at a time.

    The sender is as the message names it: a hint. So the rate of all is what holds against liars;
    those of one keep an honest robot that has gone wrong from crowding out the others.
    """

    def __init__(self, rates: Rates, clock: Callable[[], float]) -> None:
        self._rates, self._clock = rates, clock
        self._all = _Bucket(rates.messages, rates.bytes, clock())
        self._of_one: OrderedDict[AuthorId, _Bucket] = OrderedDict()

    def lets(self, sender: AuthorId, data: bytes) -> bool:
        """Whether this message may come in; counts it where it may."""
        rates, now = self._rates, self._clock()
        size = len(data) + (rates.question if kind_of(data) is Kind.WANT else 0)
        one = self._of_one.setdefault(
            sender, _Bucket(rates.messages_of_one, rates.bytes_of_one, now)
        )
        self._of_one.move_to_end(sender)
        if len(self._of_one) > rates.senders:
            self._of_one.popitem(last=False)
        self._all.fill(rates.messages, rates.bytes, now)
        one.fill(rates.messages_of_one, rates.bytes_of_one, now)
        if min(self._all.messages, one.messages) < 1 or min(self._all.bytes, one.bytes) < size:
            return False
        self._all.messages -= 1
        self._all.bytes -= size
        one.messages -= 1
        one.bytes -= size
        return True


class Inbox:
    """What comes in for the agent: messages, cycles, questions. Any thread puts, one takes.

    most, most_of_one: bytes of messages that wait, in all and of one sender (as the message names
        it: a hint, so the first bound is what holds against liars), and HELD more for each. What
        exceeds them is dropped.
    rates: how fast messages may come; what comes faster is dropped, too.
    at_once: messages that are taken at a time, so that a cycle never waits behind many.
    """

    HELD = 64  # bytes of memory that a message takes beside its own

    def __init__(
        self,
        most: int,
        most_of_one: int,
        rates: Rates | None = None,
        clock: Callable[[], float] = time.monotonic,
        at_once: int = 16,
    ) -> None:
        self._at_once = at_once
        self._most, self._most_of_one = most, most_of_one
        self._throttle = Throttle(rates or Rates(), clock)
        self._change = threading.Condition()
        self._work = Work()
        self._messages: deque[bytes] = deque()
        self._size = 0
        self._size_of: Counter[AuthorId] = Counter()
        self._closed = False
        self.dropped = 0

    def put_message(self, data: bytes) -> bool:
        """Keep a message, or drop it where it would exceed a bound."""
        sender, size = sender_of(data), len(data) + self.HELD
        with self._change:
            full = self._size + size > self._most
            full = full or self._size_of[sender] + size > self._most_of_one
            if full or not self._throttle.lets(sender, data):
                self.dropped += 1
                return False
            self._size += size
            self._size_of[sender] += size
            self._messages.append(data)
            self._change.notify_all()
            return True

    def put_back(self, messages: Iterable[bytes]) -> None:
        """What was taken and not looked at is taken first again."""
        with self._change:
            for data in reversed(list(messages)):
                size = len(data) + self.HELD
                self._size += size
                self._size_of[sender_of(data)] += size
                self._messages.appendleft(data)

    def drop(self) -> None:
        """Count a message that never came this far."""
        with self._change:
            self.dropped += 1

    @property
    def unread(self) -> bool:
        """Whether messages wait."""
        return bool(self._messages)

    def put_cycle(self, cycle: Cycle) -> bool:
        """Hand in a cycle. Waits while one is not taken yet: for the agent, never for the network.

        False: the inbox is closed and the cycle was not taken.
        """
        with self._change:
            self._change.wait_for(lambda: self._closed or not self._work.cycles)
            if not self._closed:
                self._work.cycles.append(cycle)
                self._change.notify_all()
            return not self._closed

    def put_question(self, question: Question) -> None:
        with self._change:
            self._work.questions.append(question)
            self._change.notify_all()

    def take(self, patience: float) -> Work:
        """What there is to do, after at most `patience` seconds of waiting for something."""
        with self._change:
            self._change.wait_for(self._something, max(0.0, patience))
            work, self._work = self._work, Work()
            while self._messages and len(work.messages) < self._at_once:
                data = self._messages.popleft()
                sender, size = sender_of(data), len(data) + self.HELD
                self._size -= size
                self._size_of[sender] -= size
                if not self._size_of[sender]:
                    del self._size_of[sender]
                work.messages.append(data)
            self._change.notify_all()
            return work

    def close(self) -> None:
        """Let go of a thread that waits in `put_cycle`."""
        with self._change:
            self._closed = True
            self._change.notify_all()

    def _something(self) -> bool:
        return bool(self._messages or self._work.cycles or self._work.questions)


class SendQueue:
    """What the agent has to say, until the network has taken it. Putting never waits.

    Where more than `most` bytes wait, the oldest announcement leaves first: the next one says the
    same and more. Then the oldest message, which whoever lacks it asks for again.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._change = threading.Condition()
        self._queue: OrderedDict[int, Outgoing] = OrderedDict()  # by a number that only rises
        self._heads: deque[int] = deque()  # of the announcements among them
        self._number = 0
        self._size = 0
        self._closed = False
        self.dropped = 0

    def put(self, messages: Iterable[Outgoing]) -> None:
        with self._change:
            for out in messages:
                self._queue[self._number] = out
                if kind_of(out.data) is Kind.HEADS:
                    self._heads.append(self._number)
                self._number += 1
                self._size += len(out.data)
            while self._size > self._most:
                self._drop()
            self._change.notify_all()

    def take(self) -> Outgoing | None:
        """The next message; waits for one. None: closed, and nothing is left."""
        with self._change:
            self._change.wait_for(lambda: self._closed or bool(self._queue))
            if not self._queue:
                return None
            number, out = self._queue.popitem(last=False)
            if self._heads and self._heads[0] == number:
                self._heads.popleft()
            self._size -= len(out.data)
            return out

    def close(self) -> None:
        """Nothing more will be put; `take` gives what is left, then None."""
        with self._change:
            self._closed = True
            self._change.notify_all()

    @property
    def size(self) -> int:
        """Bytes that wait."""
        return self._size

    def _drop(self) -> None:
        number = self._heads.popleft() if self._heads else next(iter(self._queue))
        self._size -= len(self._queue.pop(number).data)
        self.dropped += 1
