"""The checkpoint beside a robot's ledger: written now and then, believed only where it fits."""

from __future__ import annotations

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
        for part in self.path.parent.glob(".checkpoint.*.part"):  # of a process that was killed
            with suppress(OSError):
                part.unlink()

    def keep(self, agent: Agent) -> None:
        """Write it anew, where enough has come since the last one."""
        waited = time.monotonic() - self._written >= _PERIOD and agent.settled
        if waited and len(agent.ledger) > _GROWTH * self._held:
            self.write(agent)

    def write(self, agent: Agent) -> None:
        """Replace it by the agent's state. Trouble is logged: the ledger is what counts."""
        self._written, self._held = time.monotonic(), len(agent.ledger)
        try:
            with atomic_write(self.path, mode=0o600) as file:
                file.write(agent.checkpoint(self._store.ids()))
        except OutputError as error:
            self._log.write("warning", "no checkpoint", reason=error)


def read_checkpoint(store: Store) -> bytes | None:
    """The checkpoint beside a ledger; None where there is none that can be read."""
    with suppress(OSError):
        return store.path.with_name("checkpoint").read_bytes()
    return None
