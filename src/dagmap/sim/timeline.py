"""What happened in a run, one line an event: the same seed gives the same bytes."""

from __future__ import annotations

from collections.abc import Callable

from ..model import Accepted, Forked, Issued, MapChanged, Overloaded, Rejected, Revoked, Waiting
from .robot import Crashed, Happening, Observed, Received, Restarted, Robot


class Timeline:
    """Collects lines `seconds robot what`, or hands each to `sink` as it comes.

    How far a fold has come (`MapChanged`) is left out: it follows from the rest, and reading a map
    early changes it.
    """

    def __init__(self, now: Callable[[], float], sink: Callable[[str], None] | None = None) -> None:
        self.lines: list[str] = []
        self._now, self._sink = now, sink or self.lines.append

    def __call__(self, robot: Robot, happening: Happening) -> None:
        text = _text(happening)
        if text is not None:
            self._sink(f"{self._now():.6f} {robot.name} {text}")


def _text(happening: Happening) -> str | None:
    match happening:
        case Received(size):
            return f"receives {size} B"
        case Accepted(id_):
            return f"accepts {_short(id_)}"
        case Issued(id_, features, _, size):
            return f"issues {_short(id_)} with {features} features in {size} B"
        case Observed(points):
            return f"observes {points} points"
        case Waiting(id_, missing):
            return f"keeps {_short(id_)} until {' '.join(map(_short, missing))}"
        case Rejected(reason, fault, detail):
            whose = "nobody known" if fault is None else fault.hex()
            return f"refuses {whose}: {reason.value} {detail}".rstrip()
        case Forked(author, sequence):
            return f"proves a fork of {author.hex()} at {sequence}"
        case Revoked(author, count):
            return f"counts {'all' if count is None else count} of {author.hex()} from now on"
        case Overloaded() | Crashed() | Restarted():
            return _fate(happening)
        case MapChanged():
            return None


def _fate(happening: Overloaded | Crashed | Restarted) -> str:
    match happening:
        case Overloaded(load, features, waiting):
            many = "all" if features is None else features
            return f"inserts {many} a cycle at {load:.2f} of its time, {waiting} wait"
        case Crashed(moment):
            return f"crashes {moment}"
        case Restarted(transactions):
            return f"restarts with {transactions} transactions"


def _short(id_: bytes) -> str:
    return id_[:6].hex()
