"""`dagmap agent`: one robot as one process, from its configuration file to the fleet's network."""

from __future__ import annotations

import gc
import json
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from types import FrameType

import msgspec
from rich.console import Console
from rich.progress import track

from ..agent import Agent
from ..io.checkpoint_file import CheckpointFile
from ..io.data_folder import next_session, open_folder, restore
from ..io.log import Level, Log
from ..io.metrics import MetricsServer
from ..io.player import Player
from ..io.queues import Inbox, Rates
from ..io.revocations import Revocations
from ..io.ros.bridge import Bridge, Link
from ..io.ros.config import RosConfig
from ..io.ros.over_zenoh import ZenohLink
from ..io.ros.types import Types
from ..io.runtime import Runtime, Slam
from ..io.settings import AgentConfig, Settings, load_settings
from ..io.sources import Source, open_source
from ..io.status import StatusServer, report
from ..io.tls import tls_doubts
from ..io.transport import Transport, load_zenoh
from ..model import ConfigError, DagmapError
from .inspect import tell_notes
from .kernels import warm_up


@dataclass(slots=True)
class AgentCommand:
    """One run of the command. `run` returns its exit code."""

    config_file: Path
    speed: float
    wait_for: int
    until_agreed: float | None
    check: bool
    level: Level
    json: bool
    link: Callable[[], Link] | None = None  # to ROS; None: over Zenoh, as the file says
    ros: dict[str, object] = field(default_factory=dict)  # what is to replace keys of [ros]
    console: Console = field(default_factory=lambda: Console(stderr=True))

    def run(self) -> int:
        """0: stopped, or agreed. Raises DagmapError."""
        if not self.speed > 0:
            raise DagmapError(f"--speed {self.speed}: more than 0 is wanted; 1 is as recorded")
        if self.wait_for < 0:
            raise DagmapError(f"--wait-for {self.wait_for}: a number of robots is wanted")
        if self.until_agreed is not None and not self.until_agreed >= 0:
            raise DagmapError(f"--until-agreed {self.until_agreed}: seconds, 0 or more, are wanted")
        settings = self._settings()
        load_zenoh()
        doubts = _doubts(settings)
        source = self._open_source(settings)
        if settings.config.ros is not None and self.link is None:
            Types(ros2=True)  # says what is not installed
        warm_up(self.console)
        if self.check:
            for file, why in doubts:
                self.console.print(f"{file}: {why}", soft_wrap=True)
            self.console.print(f"{self.config_file}: all right")
            return 0
        log = Log(sys.stderr, self.level)
        for file, why in doubts:
            log.write("warning", "tls certificate", file=file, meaning=why)
        with ExitStack() as stack:
            runtime, transport = self._assemble(settings, log, stack)
            gc.collect()
            gc.freeze()  # what is loaded by now stays: to look at it again would cost a pause
            with _signals(runtime, log):
                runtime.listen(settings.config.network.hear_first)
                session = next_session(runtime.agent)
                log.write("info", "mapping", session=session)
                ready = partial(_enough, transport, self.wait_for)
                slam: Slam | None = None
                if source is not None:
                    player = Player(source, runtime.inbox, self.speed, session, ready)
                    player.start()
                    stack.callback(player.stop)
                    slam = player
                elif settings.config.ros is not None:
                    slam = self._bridge(settings.config.ros, runtime, log, session, ready, stack)
                runtime.run(slam, self.until_agreed)
            runtime.agent.settle()
            answer = report(runtime, transport)
        log.write("info", "stopped", transactions=len(runtime.agent.ledger))
        sys.stdout.write(json.dumps(answer) + "\n" if self.json else _farewell(answer))
        return 0

    def _settings(self) -> Settings:
        """The file, with what a launch file says instead of it. Raises ConfigError."""
        settings = load_settings(self.config_file)
        if self.link is None:
            return settings
        try:
            said = msgspec.to_builtins(settings.config.ros or RosConfig())
            ros = msgspec.convert({**said, **self.ros}, RosConfig)
        except msgspec.ValidationError as error:
            raise ConfigError(f"parameters of the node: {error}") from None
        config = msgspec.structs.replace(settings.config, ros=ros)
        return Settings(config, settings.folder)

    def _bridge(
        self,
        config: RosConfig,
        runtime: Runtime,
        log: Log,
        session: int,
        ready: Callable[[], bool],
        stack: ExitStack,
    ) -> Bridge:
        """From and to the robot's ROS, as long as the stack."""
        link = ZenohLink(config.zenoh) if self.link is None else self.link()
        try:
            bridge = Bridge(config, link, runtime.inbox, log, session, ready)
        except BaseException:
            link.close()
            raise
        stack.enter_context(bridge).start()
        return bridge

    def _open_source(self, settings: Settings) -> Source | None:
        table = settings.config.source
        if table is None:
            return None
        camera = None if table.camera is None else settings.at(table.camera)
        poses = None if table.poses is None else settings.at(table.poses)
        source = open_source(settings.at(table.path), table.options(camera, poses))
        tell_notes(source, self.console)
        return source

    def _assemble(
        self, settings: Settings, log: Log, stack: ExitStack
    ) -> tuple[Runtime, Transport]:
        """Everything but the SLAM. What is opened here closes with the stack."""
        config = settings.config
        identity, store = open_folder(settings)
        stack.enter_context(store)
        agent = restore(settings, identity, store, self._track)
        inbox = _inbox(config)
        transport = stack.enter_context(
            Transport(config.network, settings.folder, config.fleet_id, identity.author, inbox)
        )
        checkpoint = CheckpointFile(store, log)
        answer = partial(_report, transport)
        brought = Revocations(settings.keys / "revocations").new if config.closed else list
        runtime = Runtime(agent, store, transport, inbox, log, answer, checkpoint.keep, brought)
        stack.callback(checkpoint.write, agent)  # closes before the store does
        stack.enter_context(StatusServer(settings.control, inbox))
        if (address := config.metrics.address) is not None:
            askers = config.metrics.askers
            stack.enter_context(MetricsServer(address, runtime, transport, askers))
        _log_start(log, agent, settings)
        return runtime, transport

    def _track(self, transactions: Iterable[bytes], total: int) -> Iterable[bytes]:
        """The progress bar of a restart."""
        return track(
            transactions,
            "reading the ledger",
            total,
            console=self.console,
            transient=True,
            disable=not (total and self.console.is_terminal),
        )


def _doubts(settings: Settings) -> list[tuple[Path, str]]:
    """What is wrong with the certificate for TLS. Raises NetworkError where it cannot be used."""
    tls = settings.config.network.tls
    return [] if tls is None else tls_doubts(tls, settings.folder, datetime.now(timezone.utc))


def _inbox(config: AgentConfig) -> Inbox:
    """What comes in, within the configuration's limits."""
    network = config.network
    rates = Rates(
        messages=network.receive_messages_per_second,
        bytes=network.receive_bytes_per_second,
        messages_of_one=network.receive_messages_per_second_per_robot,
        bytes_of_one=network.receive_bytes_per_second_per_robot,
        question=config.sync.chunk_bytes,
        senders=network.senders_remembered,
    )
    most, of_one = network.receive_bytes, network.receive_bytes_per_robot
    return Inbox(most, of_one, rates, at_once=network.messages_per_step)


def _report(transport: Transport, runtime: Runtime) -> dict[str, object]:
    return report(runtime, transport)


def _enough(transport: Transport, robots: int) -> bool:
    return len(transport.here) >= robots


def _log_start(log: Log, agent: Agent, settings: Settings) -> None:
    log.write(
        "info",
        "started",
        name=agent.config.name,
        author=agent.identity.author.hex(),
        fleet=agent.config.fleet,
        ledger=settings.ledger,
        transactions=len(agent.ledger),
    )
    if not agent.config.closed:
        log.write(
            "warning",
            "open mode",
            meaning="any key may take part: no bound against liars holds; for a first try only",
        )


@contextmanager
def _signals(runtime: Runtime, log: Log) -> Iterator[None]:
    """The first SIGINT or SIGTERM finishes the step and stops; the second one kills."""

    def stop(number: int, frame: FrameType | None) -> None:
        for each in before:
            signal.signal(each, signal.SIG_DFL)
        runtime.stop()

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number in before:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _farewell(answer: dict[str, object]) -> str:
    return f"{answer['name']}: {answer['transactions']} transactions, digest {answer['digest']}\n"


def level_named(name: str) -> Level:
    """A level of the log. Raises ConfigError for another word."""
    levels: tuple[Level, ...] = ("debug", "info", "warning", "error")
    for level in levels:
        if level == name:
            return level
    raise ConfigError(f"--log {name}: one of {', '.join(levels)} is wanted")
