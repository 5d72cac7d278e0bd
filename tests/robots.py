"""Robots as real processes for tests: their files, start and end, and a network that breaks."""

from __future__ import annotations

import json
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dagmap import Agent, Cycle, DagmapError, Identity
from dagmap.io.data_folder import load_identity
from dagmap.io.settings import load_settings
from dagmap.io.sources import save_cycles
from dagmap.io.status import ask
from dagmap.io.store import Store
from dagmap.transaction import id_of
from scene import cycles

PATIENCE = 60.0  # s: a test fails after it, none waits for it
PARAMETERS = """
same_origin = true
[graph]
reference_pitch = 0.25
max_parent_distance = 0.75
[transaction]
proof_of_work_bits = 0
[sync]
announce_period = 0.2
retry_period = 0.5
"""


_ports = iter(range(20_000 + os.getpid() % 60 * 200, 32_700))  # below those of connections


def until(condition: Callable[[], Any], what: str = "") -> Any:
    """What the condition gives, once it is true. Fails after a minute."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        if value := condition():
            return value
        time.sleep(0.03)
    raise AssertionError(f"waited {PATIENCE:.0f} s for {what or condition}")


def free_port() -> int:
    """One that the system gives to nobody by itself, and this process to nobody else."""
    for port in _ports:
        with socket.socket() as sock, suppress(OSError):
            sock.bind(("127.0.0.1", port))
            return port
    raise AssertionError("no free port")


def plain(seed: int, **more: Any) -> Iterator[Cycle]:
    """Cycles without colours: a stream has them in all cycles or in none."""
    return (replace(cycle, colors=None) for cycle in cycles(seed, **more))


def record(path: Path, seed: int, count: int = 8, points: int = 40) -> Path:
    """A recording of `count` cycles, a second apart."""
    save_cycles(path, plain(seed, count=count, points=points))
    return path


def record_much(path: Path, count: int = 60, points: int = 1500) -> Path:
    """A recording that makes many bytes: every cycle sees another part of a wall."""
    rng = np.random.default_rng(3)
    walls = (rng.uniform([2, i, 0], [2, i + 1, 1], (points, 3)) for i in range(count))
    save_cycles(path, (Cycle(float(i), np.eye(4), wall) for i, wall in enumerate(walls)))
    return path


class Nursery:
    """Starts processes and knows how they ended. One for all tests of a pytest process."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("zygote.py"))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        self._started: queue.Queue[int] = queue.Queue()
        self._codes: dict[int, int] = {}
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self._started.get(timeout=120)  # ready; a first start compiles kernels

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            message = json.loads(line)
            if "ended" in message:
                self._codes[message["ended"]] = message["code"]
            else:
                self._started.put(message.get("started", 0))

    def start(self, argv: list[str], log: Path, file_size: int | None = None) -> int:
        """The pid of a new process `dagmap argv`; what it prints goes to log.out and log.err."""
        order = {
            "argv": argv,
            "out": str(log.with_suffix(".out")),
            "err": str(log.with_suffix(".err")),
            "file_size": file_size,
        }
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(order).encode() + b"\n")
        self._process.stdin.flush()
        return self._started.get(timeout=PATIENCE)

    def code(self, pid: int) -> int | None:
        """How it ended (negative: by which signal), or None."""
        return self._codes.get(pid)

    def close(self) -> None:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait(30)
        self._reader.join(30)
        self._process.stdout.close()


@dataclass
class Robot:
    """One robot: its file, its process, its ledger."""

    nursery: Nursery
    folder: Path
    name: str
    recording: Path | None = None
    connect: tuple[int, ...] = ()  # ports on this machine
    fleet: str = "test"
    more: str = ""  # lines of the [network] table and further tables
    parameters: str = PARAMETERS
    port: int = field(default_factory=free_port)
    pid: int | None = None

    @property
    def file(self) -> Path:
        return self.folder / f"{self.name}.toml"

    @property
    def data(self) -> Path:
        return self.folder / self.name

    @property
    def ledger(self) -> Path:
        return self.data / "ledger.db"

    def write(self) -> Path:
        ends = [f"tcp/127.0.0.1:{port}" for port in self.connect]
        source = "" if self.recording is None else f'[source]\npath = "{self.recording}"\n'
        self.file.write_text(
            f'fleet = "{self.fleet}"\n{self.parameters}{source}'
            f'[store]\npath = "{self.name}/ledger.db"\n'
            f"[control]\npath = {json.dumps(self.socket)}\n"
            f'[network]\nlisten = ["tcp/127.0.0.1:{self.port}"]\nconnect = {json.dumps(ends)}\n'
            f"scouting = false\ngossip = false\n{self.more}\n"
        )
        return self.file

    @property
    def socket(self) -> str:
        return str(self.folder / f"{self.name}.sock")

    def start(self, *options: object, **limits: Any) -> Robot:
        argv = ["agent", str(self.write()), *map(str, options)]
        self.pid = self.nursery.start(argv, self.folder / self.name, **limits)
        return self

    def status(self) -> dict[str, Any]:
        """The answer of the running agent; {} while it does not answer."""
        with suppress(DagmapError):
            return ask(Path(self.socket))
        assert self.code() is None, self.log
        return {}

    def answer(self) -> dict[str, Any]:
        """The status, however long a slow machine takes for it."""
        status: dict[str, Any] = until(self.status, f"{self.name} to answer")
        return status

    def signal(self, number: int) -> None:
        assert self.pid is not None
        with suppress(ProcessLookupError):
            os.kill(self.pid, number)

    def code(self) -> int | None:
        return None if self.pid is None else self.nursery.code(self.pid)

    def wait(self) -> int:
        """How the process ended."""
        until(lambda: self.code() is not None, f"{self.name} to end")
        code = self.code()
        assert code is not None
        self.pid = None
        return code

    def stop(self) -> int:
        self.signal(signal.SIGTERM)
        return self.wait()

    def kill(self) -> None:
        self.signal(signal.SIGKILL)
        assert self.wait() == -signal.SIGKILL

    @property
    def log(self) -> str:
        """What it has written to standard error so far, in all its runs."""
        path = self.folder / f"{self.name}.err"
        return path.read_text() if path.exists() else ""

    @property
    def said(self) -> str:
        return (self.folder / f"{self.name}.out").read_text()

    def identity(self) -> Identity:
        return load_identity(self.data)

    def transactions(self) -> list[bytes]:
        """What the ledger of a stopped robot holds."""
        if not self.ledger.exists():
            return []
        with Store.open(self.ledger, load_settings(self.file).config.fleet_id) as store:
            return list(store)

    def ids(self) -> set[bytes]:
        return {id_of(data) for data in self.transactions()}

    def restored(self) -> Agent:
        """The agent that a restart would give."""
        return Agent.restore(self.identity(), load_settings(self.file).config, self.transactions())


@contextmanager
def running(*robots: Robot) -> Iterator[None]:
    """Whatever happens inside, no process is left behind."""
    try:
        yield
    finally:
        for robot in robots:
            if robot.pid is not None:
                robot.signal(signal.SIGKILL)
                robot.wait()


def agreed(*robots: Robot, authors: int = 0) -> list[dict[str, Any]]:
    """The statuses, where all are done and hold one map of so many authors; else []."""
    answers = [robot.status() for robot in robots]
    digests = {answer["digest"] for answer in answers if answer}
    if not all(answers) or len(digests) > 1 or None in digests:
        return []
    for answer in answers:
        busy = answer["lag"]["to_issue"] or answer["lag"]["missing"]
        if busy or len(answer["heads"]) < authors or not answer["transactions"]:
            return []
    return answers


class Proxy:
    """A TCP proxy on loopback that can be cut and healed, or stalled for a while."""

    def __init__(self, target: int) -> None:
        self._target = target
        self._cut = False
        self.flowing = threading.Event()  # cleared: connections stay, nothing passes
        self.flowing.set()
        self._open: list[socket.socket] = []
        self._lock = threading.Lock()
        self._threads: list[threading.Thread] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)  # stalls soon
        self.port = int(self._listener.getsockname()[1])
        self._run(self._accept)

    def cut(self) -> None:
        with self._lock:
            self._cut = True
            for sock in self._open:
                with suppress(OSError):
                    sock.shutdown(socket.SHUT_RDWR)

    def heal(self) -> None:
        self._cut = False

    def close(self) -> None:
        self.flowing.set()
        self.cut()
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for thread in self._threads:
            thread.join(10)

    def _run(self, target: Callable[..., None], *arguments: Any) -> None:
        thread = threading.Thread(target=target, args=arguments, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        while True:
            try:
                here, _ = self._listener.accept()
            except OSError:
                return
            with self._lock:
                if self._cut:
                    here.close()
                    continue
                try:
                    there = socket.create_connection(("127.0.0.1", self._target), 5)
                except OSError:
                    here.close()
                    continue
                self._open += [here, there]
            left = [2]
            self._run(self._pump, here, there, left)
            self._run(self._pump, there, here, left)

    def _pump(self, source: socket.socket, sink: socket.socket, left: list[int]) -> None:
        with suppress(OSError):
            source.settimeout(None)
            while self.flowing.wait() and (data := source.recv(1 << 12)):
                sink.sendall(data)
        for sock in (source, sink):
            with suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)
        with self._lock:
            left[0] -= 1
            if not left[0]:
                source.close()
                sink.close()
                self._open = [sock for sock in self._open if sock not in (source, sink)]
