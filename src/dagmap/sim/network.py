"""A radio that loses, delays, repeats, queues and splits, from a seed."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable
from typing import Literal, TypeAlias

import msgspec

from ..model import ConfigError

Position: TypeAlias = tuple[float, float, float]
Where: TypeAlias = Callable[[str, float], Position]  # of a robot at a time, metres


class Link(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the network treats a message on its way to one robot. Times in s, sizes in bytes."""

    loss: float = 0.0  # probability that it never arrives
    delay: tuple[float, float] = (0.002, 0.02)  # uniform; overlapping ones arrive reordered
    tail: float = 0.0  # mean of an exponential delay on top: what bad Wi-Fi adds
    duplicate: float = 0.0  # probability that it arrives twice
    reach: float | None = None  # m: robots further apart do not hear each other
    bandwidth: float | None = None  # bytes/s that one robot can send
    queue: int = 1 << 20  # bytes that a radio holds at most, beyond one message; more is dropped

    def __post_init__(self) -> None:
        self._require(0 <= self.loss < 1, "loss", "a probability from 0 up to, not including, 1")
        low, high = self.delay
        self._require(0 <= low <= high < math.inf, "delay", "two times, the shorter first,")
        self._require(0 <= self.tail < math.inf, "tail", "a time of at least 0")
        self._require(0 <= self.duplicate <= 1, "duplicate", "a probability")
        self._require(self.reach is None or self.reach > 0, "reach", "a distance above 0")
        self._require(self.bandwidth is None or self.bandwidth > 0, "bandwidth", "above 0 bytes/s")
        self._require(self.queue >= 0, "queue", "at least 0 bytes")

    def _require(self, holds: bool, name: str, wanted: str) -> None:
        if not holds:
            raise ConfigError(f"Link: {name} = {getattr(self, name)!r}, but {wanted} is wanted")


class Partition(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """From `start` to `end` (s) these robots and all others do not hear each other.

    direction: "out": the others do not hear them; "in": they do not hear the others.
    """

    start: float
    end: float
    robots: tuple[str, ...]
    direction: Literal["both", "in", "out"] = "both"

    def __post_init__(self) -> None:
        if not 0 <= self.start <= self.end:
            raise ConfigError(
                f"Partition: start = {self.start!r}, end = {self.end!r}, but two times of at "
                "least 0 are wanted, the earlier first"
            )

    def cuts(self, sender: str, receiver: str, now: float) -> bool:
        if not self.start <= now < self.end:
            return False
        a, b = sender in self.robots, receiver in self.robots
        if self.direction == "out":
            return a and not b
        return b and not a if self.direction == "in" else a != b


class Network:
    """Says when, and whether, a message reaches whom. The caller owns the clock.

    where: position of a robot, needed where the link has a reach.
    """

    def __init__(
        self,
        link: Link,
        seed: int,
        partitions: Iterable[Partition] = (),
        where: Where | None = None,
    ) -> None:
        if link.reach is not None and where is None:
            raise ConfigError("Link: a reach is given, but nobody says where the robots are")
        self.link = link  # may be replaced at any time by a better or worse one
        self._partitions, self._where = tuple(partitions), where
        self._random = random.Random(seed)
        self._free_at: dict[str, float] = {}  # when a robot's radio has sent what it holds
        self.dropped = 0  # messages that met a full queue
        self.carried = 0  # bytes of all copies put on the air for robots in reach, lost or not

    def connects(self, sender: str, receiver: str, now: float) -> bool:
        """Whether one robot hears another."""
        return bool(self._hearing(sender, (receiver,), now))

    def _hearing(self, sender: str, receivers: Iterable[str], now: float) -> list[str]:
        """Which of them hear the sender."""
        hearing = [
            receiver
            for receiver in receivers
            if not any(partition.cuts(sender, receiver, now) for partition in self._partitions)
        ]
        reach, where = self.link.reach, self._where
        if reach is None or where is None:
            return hearing
        here = where(sender, now)
        return [name for name in hearing if math.dist(here, where(name, now)) <= reach]

    def send(
        self, sender: str, receivers: Iterable[str], size: int, now: float
    ) -> list[tuple[float, str]]:
        """(time of arrival, receiver) of every copy that arrives. A broadcast is sent once.

        Who hears it follows from when it leaves the radio, not from when it was queued.
        """
        leaves = self._transmit(sender, size, now)
        if leaves is None:
            return []
        link, chance = self.link, self._random
        copies = []
        for receiver in self._hearing(sender, receivers, leaves):
            for _ in range(1 + (link.duplicate > 0 and chance.random() < link.duplicate)):
                self.carried += size
                delay = chance.uniform(*link.delay)
                if link.tail:
                    delay += chance.expovariate(1 / link.tail)
                if link.loss == 0 or chance.random() >= link.loss:
                    copies.append((leaves + delay, receiver))
        return copies

    def _transmit(self, sender: str, size: int, now: float) -> float | None:
        """When the last byte has left the robot's radio; None where its queue is full."""
        if self.link.bandwidth is None:
            return now
        start = max(now, self._free_at.get(sender, now))
        held = (start - now) * self.link.bandwidth
        if held and held + size > self.link.queue:
            self.dropped += 1
            return None
        self._free_at[sender] = start + size / self.link.bandwidth
        return self._free_at[sender]
