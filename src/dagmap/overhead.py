"""Section 5: what DAGmap costs, and what keeps it within its limits.

The core has no clock, so durations come in: whoever drives the agent says what its calls took. What
is decided here decides nothing that others depend on, so it may use floating point.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from .config import Config
from .equations import Model, Size, Work
from .link import Traffic
from .model import AuthorId, Event, Overloaded
from .sync import Peer

_AIM = 0.8  # of a limit: where a cut aims, so that the next cycle does not need another
_GIVE_BACK = 1.25  # by which a lever is given back a cycle
_CALM = _AIM / _GIVE_BACK  # of a limit: below it that fits, since S grows no faster than the work
_REST = 20  # calm cycles in a row before anything is given back
_SURE = 2  # cycles over the limit in a row before anything is cut: one may be a hiccup
_TRIES = 2  # cuts of N'_f before features per cycle are cut
_FEWEST = 64  # features a cycle that are always let through
_PASS = 3e-7  # s a node that a change of N_c costs: it looks at all of them
_SIZE = 12.0  # bytes of a feature on the wire, until they were measured


class Controller:
    """Keeps S < T (Eq. 2) and the traffic under C_Th (Eq. 6), as far as limits are configured.

    S, against the cycle time: N_c first, then N'_f, and the features that a cycle inserts last.
    Traffic: the robot's share of C_Th, or less where the echoed tokens say that the link is slow.
    Each is cut soon, and given back once there has long been room for what that will cost.
    """

    def __init__(self, config: Config) -> None:
        self._config, self._limits = config, config.overhead
        self.work = Work()  # in all; the agent counts
        self.model = Model()
        self.period: float | None = None  # s, T: between the last two cycles
        self.load = 0.0  # S / T of the last cycle
        self.n_c = config.graph.n_c
        self.n_f: int | None = None  # N'_f: features that a cycle may send; None: any number
        self.features: int | None = None  # that a cycle may insert
        self.rate: float | None = None  # bytes/s that may be sent
        self._spent = 0.0
        self._before = Work()
        self._cycle_at: float | None = None
        self._calm = self._over = self._tries = self._dropped = 0
        self._size = _SIZE
        self._traffic = Traffic(config)
        if self._limits.caps_bytes:
            self.rate = self._traffic.rate

    def took(self, seconds: float) -> None:
        """What the agent's calls since the last time took of the processor."""
        self._spent += seconds

    def cycle(self, now: float, nodes: int, waiting: int, dropped: int) -> list[Event]:
        """A cycle begins, and so the one before is over.

        nodes: n(U) of the robot's graph. waiting: points left for later; dropped: for want of
        room, so far.
        """
        last, self._cycle_at = self._cycle_at, now
        if last is None or now <= last:
            return []
        self.period = now - last
        return self._close(self.period, nodes, waiting, dropped)

    def overdue(self, now: float) -> bool:
        """Whether the SLAM has paused, so that what waits may use the time of its cycles."""
        if self.period is None or self._cycle_at is None:
            return False
        bound = self.features is not None or self.n_f is not None
        return bound and now - self._cycle_at >= 1.5 * self.period

    def idle(self, now: float, nodes: int, waiting: int, dropped: int) -> list[Event]:
        """A cycle without a SLAM: see `overdue`."""
        self._cycle_at = now
        return self._close(1.5 * (self.period or 1.0), nodes, waiting, dropped)

    def issued(self, features: int, size: int) -> None:
        """An own transaction: so the bytes that a feature takes are known."""
        self.work.sent += features
        self.work.bundles += 1
        if features >= _FEWEST:
            self._size += 0.25 * (size / features - self._size)

    def merged(self, features: int) -> None:
        """A transaction of another robot."""
        self.work.merged += features
        self.work.merges += 1

    def sendable(self, room: int | None) -> int | None:
        """Features that may be sent now, with so many bytes; None: any number."""
        left = None
        if self.n_f is not None:
            left = max(0, self.n_f - (self.work.sent - self._before.sent))
        if room is None:
            return left
        fits = int(room / self._size)
        return fits if left is None else min(fits, left)

    def per_bundle(self, most: int) -> int:
        """N'_f as a bundle feels it: what is beyond is cut, the furthest first."""
        found = [most] if self.n_f is None else [most, self.n_f]
        if self.rate is not None and self.period is not None:  # Eq. (6)
            found.append(int(self.rate * self.period / self._size))
        return max(1, min(found))

    def looks(self, now: float, sent: int) -> bool:
        """Whether it is time to look at the network. sent: bytes let out so far."""
        if not self._limits.caps_bytes:
            return False
        self._traffic.sent(now, sent)
        return self._traffic.due(now)

    def look(self, now: float, peers: Mapping[AuthorId, Peer], delay: float | None) -> None:
        """Look at the network: who is there, and how long messages take, s one way."""
        self.rate = self._traffic.look(now, peers, delay, self.period)

    @property
    def most(self) -> float:
        """bytes/s that no five seconds may exceed, so that those of all robots keep to C_Th."""
        return self._traffic.most

    def announced(self, now: float, token: int, sent: int) -> None:
        """An announcement goes out now, after so many bytes."""
        if self._limits.caps_bytes:
            self._traffic.announced(now, token, sent)

    def _close(self, period: float, nodes: int, waiting: int, dropped: int) -> list[Event]:
        spent, self._spent = self._spent, 0.0
        done, self._before = self.work.since(self._before), replace(self.work)
        self.load = spent / period
        if spent > 0:
            self.model.add(done, Size(nodes, self.n_c), spent)
        share = self._limits.cycle_share
        if share is None:
            return []
        before = self.features
        self._over = self._over + 1 if self.load > share else 0
        if self._over >= _SURE:
            self._cut(self.load / share, done, nodes * _PASS < 0.1 * period)
        if self._over:
            self._calm = 0
        else:
            self._calm = self._calm + 1 if self.load < _CALM * share else 0
            if self._calm > _REST:
                self._give_back(waiting, done)
        lost, self._dropped = dropped - self._dropped, dropped
        less = self.features is not None and (before is None or self.features < before)
        if less or lost or (before is not None and self.features is None):
            return [Overloaded(self.load, self.features, waiting, lost)]
        return []

    def _cut(self, over: float, done: Work, affordable: bool) -> None:
        """The next lever. over: S as a multiple of its limit; affordable: a change of N_c."""
        if self.n_c < self._config.graph.n_c_max and affordable:
            self.n_c = min(2 * self.n_c, self._config.graph.n_c_max)
        elif self._tries < _TRIES and done.sent > _FEWEST:
            self._tries += 1
            self.n_f = max(_FEWEST, int(done.sent * _AIM / over))
        else:
            fewer = max(_FEWEST, int(done.inserted * _AIM / over))
            self.features = fewer if self.features is None else min(fewer, self.features)

    def _give_back(self, waiting: int, done: Work) -> None:
        """The last lever first, and each only as far as it still holds something back."""
        if self.features is not None:
            free = waiting == 0 and done.inserted < self.features
            self.features = None if free else int(_GIVE_BACK * self.features) + 1
        elif self.n_f is not None:
            free = done.sent < self.n_f
            self.n_f = None if free else int(_GIVE_BACK * self.n_f) + 1
            self._tries = 0 if free else self._tries
        elif self.n_c > self._config.graph.n_c:
            self.n_c, self._calm, self._tries = self.n_c - 1, 0, 0
