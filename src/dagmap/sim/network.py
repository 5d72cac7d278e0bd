"""A network that loses, delays and reorders, from a seed."""

from __future__ import annotations

import heapq
import random
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Link:
    """How the network treats a message on its way to one robot."""

    loss: float = 0.0  # probability that it never arrives
    delay: tuple[float, float] = (0.002, 0.02)  # s, uniform; overlapping ones arrive reordered

    def __post_init__(self) -> None:
        if not 0 <= self.loss < 1:
            raise ValueError(f"loss {self.loss}: a probability from 0 up to, not including, 1")
        if not 0 <= self.delay[0] <= self.delay[1]:
            raise ValueError(f"delay {self.delay}: two times in s, the shorter first")


class Network:
    """Carries bytes between named robots on a clock that the caller owns."""

    def __init__(self, link: Link, seed: int) -> None:
        self._link = link
        self._random = random.Random(seed)
        self._flight: list[tuple[float, int, str, bytes]] = []
        self._sent = 0

    def __len__(self) -> int:
        return len(self._flight)

    @property
    def next_arrival(self) -> float | None:
        return self._flight[0][0] if self._flight else None

    def send(self, to: str, data: bytes, now: float) -> None:
        """Put one message for one robot on its way, or lose it."""
        delay = self._random.uniform(*self._link.delay)
        if self._random.random() >= self._link.loss:
            self._sent += 1
            heapq.heappush(self._flight, (now + delay, self._sent, to, data))

    def arrivals(self, now: float) -> list[tuple[str, bytes]]:
        """What has arrived by now, in order of arrival."""
        out = []
        while self._flight and self._flight[0][0] <= now:
            _, _, to, data = heapq.heappop(self._flight)
            out.append((to, data))
        return out
