"""Whether a browser keeps up: told from how often it says where its camera is while that moves."""

from __future__ import annotations

SLOW = 0.15  # s between two frames: from here on a movement is jerky
_FAST = 0.04
_PAUSE = 3.0  # s: not one movement any more
_RECOVERY = 20  # frames in a row
_STRIKES = 2  # times that a browser may be slow again before it is taken for slow for good


class Pace:
    """One browser's. `slow`: draw less while its camera moves."""

    def __init__(self) -> None:
        self.slow = False
        self._last: float | None = None
        self._slow_frames = self._fast_frames = self._strikes = 0

    def moved(self, now: float) -> None:
        """The camera moved, at `now` seconds on any steady clock."""
        gap = _PAUSE if self._last is None else now - self._last
        self._last = now
        if gap >= _PAUSE:
            return
        self._slow_frames = self._slow_frames + 1 if gap > SLOW else 0
        self._fast_frames = self._fast_frames + 1 if gap < _FAST else 0
        if not self.slow and self._slow_frames >= 2:
            self.slow = True
            self._strikes += 1
        elif self.slow and self._fast_frames >= _RECOVERY and self._strikes < _STRIKES:
            self.slow = False

    def rests(self, now: float, seconds: float) -> bool:
        """Whether there was no movement for so long."""
        return self._last is None or now - self._last >= seconds
