"""Plays a recording to the agent as its SLAM would have put it out: at its pace."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace

from ..model import DagmapError
from .queues import Inbox
from .sources import Source


class Player:
    """Hands the cycles of a source to the inbox, each when it is due.

    speed: times the recorded pace. session: added to the sessions of the recording, so that a SLAM
        that starts again has a frame and ids of its own. ready: whether the first cycle may go.
    An agent that does not keep up slows the recording down; no cycle is left out.
    """

    def __init__(
        self,
        source: Source,
        inbox: Inbox,
        speed: float = 1.0,
        session: int = 0,
        ready: Callable[[], bool] = lambda: True,
    ) -> None:
        self._source, self._inbox = source, inbox
        self._speed, self._session, self._ready = speed, session, ready
        self._stopped, self._over = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="dagmap source", daemon=True)
        self.error: DagmapError | None = None

    def start(self) -> None:
        """Begin, in a thread of its own."""
        self._thread.start()

    @property
    def over(self) -> bool:
        """Whether all cycles were handed over, or an error ended it."""
        return self._over.is_set()

    def _run(self) -> None:
        try:
            self._play()
        except DagmapError as error:
            self.error = error
        finally:
            self._over.set()

    def stop(self) -> None:
        """Hand over no more cycles; wait until the thread has ended."""
        self._stopped.set()
        self._inbox.close()
        if self._thread.is_alive():
            self._thread.join()

    def _play(self) -> None:
        while not self._ready():
            if self._stopped.wait(0.02):
                return
        started, first = time.monotonic(), 0.0
        for i, cycle in enumerate(self._source):
            first = cycle.stamp if i == 0 else first
            due = started + (cycle.stamp - first) / self._speed
            if self._stopped.wait(max(0.0, due - time.monotonic())):
                return
            if not self._inbox.put_cycle(replace(cycle, session=cycle.session + self._session)):
                return
