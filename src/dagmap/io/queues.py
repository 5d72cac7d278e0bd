"""The two bounded queues between the network and the agent. What they drop, repair brings back."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field

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
    """Somebody in another thread wants to know the agent's state."""

    answered: threading.Event = field(default_factory=threading.Event)
    answer: dict[str, object] | None = None


class Inbox:
    """What comes in for the agent: messages, cycles, questions. Any thread puts, one takes.

    most, most_of_one: bytes of messages that wait, in all and of one sender (as the message names
        it: a hint, so the first bound is what holds against liars). What exceeds them is dropped.
    """

    MESSAGES = 16  # taken at once, so that a cycle never waits behind many

    def __init__(self, most: int, most_of_one: int) -> None:
        self._most, self._most_of_one = most, most_of_one
        self._change = threading.Condition()
        self._work = Work()
        self._messages: deque[bytes] = deque()
        self._size = 0
        self._size_of: Counter[AuthorId] = Counter()
        self._closed = False
        self.dropped = 0

    def put_message(self, data: bytes) -> bool:
        """Keep a message, or drop it where it would exceed a bound."""
        sender = sender_of(data)
        with self._change:
            full = self._size + len(data) > self._most
            if full or self._size_of[sender] + len(data) > self._most_of_one:
                self.dropped += 1
                return False
            self._size += len(data)
            self._size_of[sender] += len(data)
            self._messages.append(data)
            self._change.notify_all()
            return True

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
            while self._messages and len(work.messages) < self.MESSAGES:
                data = self._messages.popleft()
                sender = sender_of(data)
                self._size -= len(data)
                self._size_of[sender] -= len(data)
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
        self._queue: deque[Outgoing] = deque()
        self._size = 0
        self._closed = False
        self.dropped = 0

    def put(self, messages: Iterable[Outgoing]) -> None:
        with self._change:
            for out in messages:
                self._queue.append(out)
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
            out = self._queue.popleft()
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
        heads = (i for i, out in enumerate(self._queue) if kind_of(out.data) == Kind.HEADS)
        place = next(heads, 0)
        self._size -= len(self._queue[place].data)
        del self._queue[place]
        self.dropped += 1
