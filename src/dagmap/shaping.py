"""Section 5.2: what a robot sends goes out evenly, and never more than it may.

Everything that leaves the agent counts: announcements, questions, own transactions, answers. Two
buckets fill with the rate: one for what the robot itself says, one for answers, which repeat what
somebody has already. Answers get what the robot leaves, a quarter where both have something.
"""

from __future__ import annotations

from collections import deque
from enum import IntEnum

from .model import AuthorId, Outgoing

WINDOW = 5.0  # s: over any such span the cap holds to the byte
_DEPTH = 0.5  # s that a bucket saves up
_LEAST = 2048.0  # bytes that it saves up at least, or envelopes would be most of the traffic
_ANSWERS = 0.25  # share of the rate for answers while the robot has something to say itself
_CONTROL = 64  # messages: of more questions the oldest are dropped, to be asked again
_ANNOUNCED = 0.25  # share of the rate that announcements take at most; others are left out


class Urgency(IntEnum):
    """In which order what waits goes out."""

    CONTROL = 0  # announcements, questions
    OWN = 1  # transactions that nobody has yet
    ANSWER = 2


class Shaper:
    """The way out. Without a rate everything passes at once.

    cap: bytes/s that no span of `WINDOW` seconds exceeds; the rate may be less. Both may change.
    """

    def __init__(self, cap: float = float("inf")) -> None:
        self.rate: float | None = None  # bytes/s
        self.cap = cap
        self.sent = 0  # bytes let out so far
        self._out: list[Outgoing] = []
        self._queues: tuple[deque[Outgoing], ...] = tuple(deque() for _ in Urgency)
        self._own = self._answers = 0.0  # bytes saved up; below 0: owed
        self._last: float | None = None
        self._announced = float("-inf")
        self._held_since = float("inf")  # that the cap alone has held back an answer
        self._window: deque[tuple[float, int]] = deque()  # what went out lately
        self._recent = 0  # bytes in it

    def put(self, out: Outgoing, urgency: Urgency) -> None:
        """Take what is to be sent."""
        if self.rate is None:
            self._let_out(out)
            return
        queue = self._queues[urgency]
        if urgency is Urgency.CONTROL and len(queue) == _CONTROL:
            queue.popleft()
        queue.append(out)

    def announce(self, outs: list[Outgoing], now: float) -> bool:
        """Take the messages of an announcement, unless they would take too much of the rate.

        Returns whether they go out. One left out does no harm: the next one says more.
        """
        size = sum(len(out.data) for out in outs)
        if self.rate is not None and (
            self._starves(now) or now - self._announced < size / (_ANNOUNCED * self.rate)
        ):
            return False
        self._announced = now
        for out in outs:
            self.put(out, Urgency.CONTROL)
        return True

    def release(self, now: float) -> None:
        """Let out what may go out by now, the urgent first."""
        self._fill(now)
        control, own, answers = self._queues
        if not self._starves(now):
            self._own = self._drain(control, self._own, -self._depth, now)
        self._answers = self._drain(answers, self._answers, 0.0, now)
        self._held_since = min(self._held_since, now) if self._yields else float("inf")
        if not self._yields:
            self._own = self._drain(own, self._own, 0.0, now)

    def take(self) -> list[Outgoing]:
        """What has been let out, handed over and forgotten."""
        out, self._out = self._out, []
        return out

    @property
    def waiting(self) -> bool:
        """Whether something was sealed that has not been let out."""
        return any(self._queues)

    def room(self, now: float) -> int | None:
        """Bytes that a new transaction may have now; None: any number."""
        if self.rate is None:
            return None
        self._fill(now)
        if self._queues[Urgency.OWN] or self._own < self._depth / 2 or self._yields:
            return 0
        return int(max(0.0, min(self._own, self._most - self._recent)))

    def room_for_answer(self, to: AuthorId) -> int | None:
        """Bytes that an answer may have; one at a time waits for each who asks."""
        if self.rate is None:
            return None
        queue = self._queues[Urgency.ANSWER]
        if any(out.to == to for out in queue):
            return 0
        return max(0, int(self._depth) - sum(len(out.data) for out in queue))

    @property
    def _most(self) -> float:
        """Bytes in a window."""
        return WINDOW * self.cap

    @property
    def _yields(self) -> bool:
        """Whether it is an answer's turn that the cap alone holds back."""
        return bool(self._queues[Urgency.ANSWER]) and self._answers > 0

    def _starves(self, now: float) -> bool:
        """Whether an answer is so large that it goes out only once nothing else has for long."""
        return now - self._held_since >= WINDOW

    @property
    def _depth(self) -> float:
        return 0.0 if self.rate is None else max(_DEPTH * self.rate, _LEAST)

    def _fill(self, now: float) -> None:
        if self.rate is None:
            for queue in self._queues:
                while queue:
                    self._let_out(queue.popleft())
            return
        came = 0.0 if self._last is None else max(0.0, now - self._last) * self.rate
        self._last, depth = now, self._depth
        while self._window and self._window[0][0] <= now - WINDOW:
            self._recent -= self._window.popleft()[1]
        answers = _ANSWERS * came if self._queues[Urgency.ANSWER] else 0.0
        self._own += came - answers
        self._answers = min(self._answers + answers + max(0.0, self._own - depth), depth)
        self._own = min(self._own, depth)

    def _drain(self, queue: deque[Outgoing], tokens: float, least: float, now: float) -> float:
        """Let out from a queue while more than `least` tokens are left. Returns those left."""
        while queue and tokens > least:
            size = len(queue[0].data)
            if self._recent and self._recent + size > self._most:
                break
            tokens -= size
            self._window.append((now, size))
            self._recent += size
            self._let_out(queue.popleft())
        return tokens

    def _let_out(self, out: Outgoing) -> None:
        self.sent += len(out.data)
        self._out.append(out)
