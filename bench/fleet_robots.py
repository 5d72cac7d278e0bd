"""Robots as real processes for `fleet.py`: their files, what they log, and a bad link."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dagmap.io.status import ask
from dagmap.model import DagmapError

PATIENCE = 120.0  # s
FLEET = "bench"
_FIELD = re.compile(r'(\w+)=("(?:[^"\\]|\\.)*"|\S+)')
_TICKS = os.sysconf("SC_CLK_TCK")
Line = dict[str, str]


def until(condition: Callable[[], Any], what: str, period: float = 0.01) -> Any:
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        if value := condition():
            return value
        time.sleep(period)
    raise DagmapError(f"bench fleet: waited {PATIENCE:.0f} s for {what}")


def _free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


@dataclass
class Robot:
    """One process of `dagmap agent`, with what it logs on the clock that all processes share."""

    folder: Path
    name: str
    connect: tuple[int, ...] = ()  # ports on this machine
    recording: Path | None = None
    program: str = "from dagmap.cli import main; main()"
    port: int = field(default_factory=_free_port)
    process: subprocess.Popen[bytes] | None = None
    began: int = 0  # ns, when the process was started

    @property
    def ledger(self) -> Path:
        return self.folder / self.name / "ledger.db"

    @property
    def log(self) -> Path:
        return self.folder / f"{self.name}.log"

    def start(self, *options: str) -> Robot:
        ends = [f"tcp/127.0.0.1:{port}" for port in self.connect]
        source = "" if self.recording is None else f'[source]\npath = "{self.recording}"\n'
        file = self.folder / f"{self.name}.toml"
        file.write_text(
            f'fleet = "{FLEET}"\n{source}[store]\npath = "{self.name}/ledger.db"\n[network]\n'
            f'listen = ["tcp/127.0.0.1:{self.port}"]\nconnect = {json.dumps(ends)}\n'
            "scouting = false\ngossip = false\n"
        )
        command = [sys.executable, "-c", self.program, "agent", str(file)]
        self.began = time.monotonic_ns()
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [*command, "--log", "debug", *options],
                stderr=log,
                stdout=subprocess.DEVNULL,
                env={**os.environ, "PYTHONDONTWRITEBYTECODE": ""},  # compiled once, as for a user
            )
        return self

    def lines(self, event: str) -> list[Line]:
        """The lines of this run of one kind, each by its keys."""
        text = self.log.read_text().splitlines()
        return [
            {key: value.strip('"') for key, value in _FIELD.findall(line)}
            for line in text
            if f" event={event} " in line and line.isprintable()
        ]

    def wait_for(self, event: str) -> float:
        """Seconds from the start of the process to the first such line."""
        mark = f" event={event} ".encode()

        def there() -> bool:
            assert self.process is not None
            if self.process.poll() is not None:
                raise DagmapError(f"{self.name} ended: {self.log.read_text()[-500:]}")
            return mark in self.log.read_bytes()

        until(there, f"{event} of {self.name}")
        return (time.monotonic_ns() - self.began) / 1e9

    def status(self) -> dict[str, Any]:
        with suppress(DagmapError):
            return ask(self.ledger.with_name("status.sock"))
        return {}

    def cpu(self) -> float:
        """Seconds of processor time so far, of all threads."""
        assert self.process is not None
        words = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(words[11]) + int(words[12])) / _TICKS

    def peak(self) -> int:
        """Largest memory so far, bytes."""
        assert self.process is not None
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return 1024 * int(status.partition("VmHWM:")[2].split()[0])

    def memory(self) -> int:
        """Memory now, bytes."""
        assert self.process is not None
        pages = Path(f"/proc/{self.process.pid}/statm").read_text().split()[1]
        return int(pages) * os.sysconf("SC_PAGE_SIZE")

    def stop(self) -> None:
        if self.process is not None:
            self.process.send_signal(signal.SIGTERM)
            self.process.wait(PATIENCE)
            self.process = None


@contextmanager
def running(*robots: Robot) -> Iterator[None]:
    """Whatever happens inside, no process is left behind."""
    try:
        yield
    finally:
        for robot in robots:
            if robot.process is not None:
                robot.process.kill()
                robot.process.wait()


class Link:
    """A TCP proxy that lets `rate` bytes a second pass each way, and now and then nothing at all.

    stall, every: s. Nothing passes in the first `stall` seconds of every `every`.
    """

    def __init__(self, target: int, rate: float, stall: float = 0.0, every: float = 2.0) -> None:
        self._target, self._rate, self._stall, self._every = target, rate, stall, every
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)
        self.port = int(self._listener.getsockname()[1])
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _accept(self) -> None:
        while True:
            try:
                here, _ = self._listener.accept()
            except OSError:
                return
            try:
                there = socket.create_connection(("127.0.0.1", self._target), 5)
            except OSError:  # not there yet: the other one tries again
                here.close()
                continue
            for pair in ((here, there), (there, here)):
                threading.Thread(target=self._pump, args=pair, daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        free = time.monotonic()  # when the link has passed on all that it took
        with suppress(OSError):
            while data := source.recv(1 << 12):
                now = time.monotonic()
                free = max(free, now) + len(data) / self._rate
                stalled = self._stall - free % self._every
                time.sleep(max(0.0, free - now) + max(0.0, stalled))
                sink.sendall(data)
        for sock in (source, sink):
            with suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)
