"""Where the view gets its ledger from: a run's folder or a running fleet. What both have."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from ...config import Config
from .snapshot import Snapshot

Progress = Callable[[float], None]  # of a share from 0 to 1


@dataclass(frozen=True, slots=True)
class Standing:
    """How one robot stands to the map that is shown. agrees: None where nothing is known."""

    robot: str
    digest: str  # hexadecimal, or what is said instead
    agrees: bool | None
    detail: str


class Source(Protocol):
    """A ledger to look at. To be used from one thread, but for `close`."""

    @property
    def config(self) -> Config:
        """The parameters that the ledger is folded with."""

    title: str
    live: bool  # whether there may be news

    @property
    def count(self) -> int:
        """Transactions of the latest snapshot: up to here `at` can go."""

    def first(self) -> Snapshot | None:
        """What can be shown before anything is folded."""

    def latest(self, progress: Progress) -> Snapshot:
        """Everything that is known by now."""

    def at(self, count: int, progress: Progress) -> Snapshot:
        """The map after the first `count` transactions of the latest snapshot."""

    def standings(self) -> Sequence[Standing]:
        """Of all robots, as of the latest snapshot."""

    def remark(self) -> str:
        """What else a person should know; mostly nothing."""

    def close(self) -> None:
        """Let go of it."""
