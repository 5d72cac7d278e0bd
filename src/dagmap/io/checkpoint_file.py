"""The checkpoint beside a robot's ledger: written now and then, believed only where it fits."""

from __future__ import annotations

import threading
import time
from contextlib import suppress

from ..agent import Agent
from ..model import OutputError
from .export import atomic_write
from .log import Log
from .store import Store

_GROWTH = 1.1  # times as many transactions as in the last one, and another is worth its time
_PERIOD = 60.0  # s between two at least


class CheckpointFile:
    """`checkpoint` in the data folder. Losing it costs time at the next start, nothing else."""

    def __init__(self, store: Store, log: Log) -> None:
        self.path = store.path.with_name("checkpoint")
        self._store, self._log = store, log
        self._held = 0  # transactions in the last one
        self._written = time.monotonic()
        self._writer = threading.Thread()  # of the last one
        for part in self.path.parent.glob(".checkpoint.*.part"):  # of a process that was killed
            with suppress(OSError):
                part.unlink()

    def keep(self, agent: Agent) -> None:
        """Begin to write it anew, where enough has come since the last one. Does not wait for the
        disk: that takes many times as long as a cycle of the SLAM."""
        waited = time.monotonic() - self._written >= _PERIOD and agent.settled
        if waited and len(agent.ledger) > _GROWTH * self._held and not self._writer.is_alive():
            self._begin(agent)

    def write(self, agent: Agent) -> None:
        """Replace it by the agent's state. Trouble is logged: the ledger is what counts."""
        if self._writer.ident is not None:
            self._writer.join()
        self._begin(agent)
        self._writer.join()

    def _begin(self, agent: Agent) -> None:
        self._written, self._held = time.monotonic(), len(agent.ledger)
        state = agent.checkpoint(self._store.ids())
        name = "dagmap checkpoint"
        self._writer = threading.Thread(target=self._put, args=(state,), name=name)
        self._writer.start()

    def _put(self, state: bytes) -> None:
        try:
            with atomic_write(self.path, mode=0o600) as file:
                file.write(state)
        except OutputError as error:
            self._log.write("warning", "no checkpoint", reason=error)


def read_checkpoint(store: Store) -> bytes | None:
    """The checkpoint beside a ledger; None where there is none that can be read."""
    with suppress(OSError):
        return store.path.with_name("checkpoint").read_bytes()
    return None
