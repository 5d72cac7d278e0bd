"""A log for people and programs: one line an event, `time=... level=... event=... key=value`."""

from __future__ import annotations

import json
import threading
import time
from collections import OrderedDict
from datetime import datetime, timezone
from typing import Literal, TextIO

Level = Literal["debug", "info", "warning", "error"]
_ORDER = {"debug": 0, "info": 1, "warning": 2, "error": 3}
_PLAIN = frozenset("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_-+.,:/%()[]")
_SELDOM = 10.0  # s between two lines of one kind
_KINDS = 256  # of lines that are remembered: what outsiders cause must be bounded


class Log:
    """Writes lines to a stream, from any thread. A stream that is gone is no reason to stop."""

    def __init__(self, stream: TextIO, level: Level = "info") -> None:
        self._stream, self._least = stream, _ORDER[level]
        self._lock = threading.Lock()
        self._last: OrderedDict[str, tuple[float, int]] = OrderedDict()  # (when, unsaid since)

    def shows(self, level: Level) -> bool:
        """Whether lines of this level are written."""
        return _ORDER[level] >= self._least

    def write(self, level: Level, event: str, **fields: object) -> None:
        """One line. Values are made text; what is not plain is quoted as JSON does it."""
        if not self.shows(level):
            return
        stamp = datetime.now(timezone.utc).isoformat(timespec="milliseconds")
        head: dict[str, object] = {"time": stamp, "level": level, "event": event}
        line = " ".join(f"{key}={_text(value)}" for key, value in (head | fields).items())
        with self._lock:
            try:
                self._stream.write(line + "\n")
                self._stream.flush()
            except (OSError, ValueError):
                return  # closed, or its reader has left

    def seldom(self, level: Level, event: str, kind: str, **fields: object) -> None:
        """The same, at most once in ten seconds for every kind; says how many were left out."""
        now = time.monotonic()
        with self._lock:
            last, unsaid = self._last.get(kind, (-_SELDOM, 0))
            due = now - last >= _SELDOM
            self._last[kind] = (now, 0) if due else (last, unsaid + 1)
            self._last.move_to_end(kind)
            if len(self._last) > _KINDS:
                self._last.popitem(last=False)
        if due:
            more = {"unsaid_before": unsaid} if unsaid else {}
            self.write(level, event, **fields, **more)


def _text(value: object) -> str:
    text = f"{value:.3f}" if isinstance(value, float) else str(value)
    return text if text and set(text) <= _PLAIN else json.dumps(text)
