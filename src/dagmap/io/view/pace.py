"""Whether a browser keeps up: told from how often it says where its camera is while that moves.

A browser is taken for one that draws in software until it has shown that it is fast: one that must
turn too many points at once would not even get round to saying so.
"""

from __future__ import annotations

SLOW = 0.15  # s between two frames: from here on a movement is jerky
_FAST = 0.04
_PAUSE = 5.0  # s: not one movement any more
_PROOF = 15  # fast frames in a row
_UNKNOWN = 0.4  # s that a frame takes until it is known
_FADE = 0.7  # a frame later a slow one counts so much
ARRIVAL = 2.0  # s that a browser has for the first picture before the ledger is read
PATIENCE = 20.0  # s until it is read though no browser has come
_CHANCES = 2  # times that a browser may prove itself


class Pace:
    """One browser's. `slow`: draw less, and much less while its camera moves."""

    def __init__(self) -> None:
        self.slow = True
        self._last: float | None = None
        self._gap = _UNKNOWN  # s between its last frames, slow ones above all
        self._slow_frames = self._fast_frames = self._proofs = 0

    def moved(self, now: float) -> None:
        """The camera moved, at `now` seconds on any steady clock."""
        gap = _PAUSE if self._last is None else now - self._last
        self._last = now
        if gap >= _PAUSE:
            return
        self._gap = max(gap, _FADE * self._gap)
        self._slow_frames = self._slow_frames + 1 if gap > SLOW else 0
        self._fast_frames = self._fast_frames + 1 if gap < _FAST else 0
        if self.slow and self._fast_frames >= _PROOF and self._proofs < _CHANCES:
            self.slow = False
            self._proofs += 1
        elif self._slow_frames >= 2:
            self.slow = True

    def rests(self, now: float, seconds: float) -> bool:
        """Whether there was no movement for so long; of a slow browser, for three frames too.

        A browser that is at work on one slow frame cannot say that it moves.
        """
        return self._last is None or now - self._last >= max(seconds, 3 * self._gap)


class Headstart:
    """What a first picture gets before the ledger is read, which would hold up the browsers: both
    want the interpreter, and maybe the same processor. Times are seconds on any steady clock."""

    def __init__(self) -> None:
        self._shown: float | None = None
        self._came: float | None = None

    def shown(self, now: float) -> None:
        """There is a picture."""
        self._shown = now

    def came(self, now: float) -> None:
        """A browser did."""
        self._came = now if self._came is None else self._came

    def is_over(self, now: float) -> bool:
        """Whether the ledger may be read. Where there is no picture before, at once."""
        if self._shown is None:
            return True
        if self._came is None:
            return now >= self._shown + PATIENCE
        return now >= max(self._shown, self._came) + ARRIVAL
