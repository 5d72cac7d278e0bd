"""A replay's output folder as something to look at."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from ...config import Config
from ...identity import Identity
from ...model import ConfigError, DagmapError, Rejected, StoreError
from ..export import read_ply
from ..store import Store
from .snapshot import Snapshot, take
from .source import Progress, Standing

if TYPE_CHECKING:
    from .history import History

_STEP = 64  # transactions that are read between two words on the progress
_FEATURES = 50_000  # that are folded between two


class _Robot(msgspec.Struct, frozen=True):
    name: str
    digest: str


class _Summary(msgspec.Struct, frozen=True):
    """What is needed of `summary.json`."""

    robots: list[_Robot]
    parameters: dict[str, Any]


class Run:
    """What `dagmap replay --out FOLDER` has written.

    robot: whose ledger is shown; None: the first one's. Raises DagmapError that names what is
    missing or wrong.
    """

    live = False

    def __init__(self, folder: Path, robot: str | None = None) -> None:
        summary = _read_summary(folder)
        self.config = _config(folder / "summary.json", summary)
        self._folder, self._robots = folder, summary.robots
        names = [each.name for each in summary.robots]
        self.robot = names[0] if robot is None else robot
        if self.robot not in names:
            raise DagmapError(
                f"--robot {self.robot}: not in {folder}; its robots are {', '.join(names)}"
            )
        self.title = f"{folder.resolve().name}: the ledger of {self.robot}"
        self._identity = Identity.from_seed(secrets.token_bytes(32))
        self._transactions = self._read(self.robot)
        self._latest: Snapshot | None = None
        self._history: History | None = None
        self._refused = 0

    def first(self) -> Snapshot | None:
        """The map as `map.ply` has it, where it is there: nothing needs to be folded for that."""
        path = self._folder / "map.ply"
        return Snapshot(read_ply(path)) if path.is_file() else None

    def latest(self, progress: Progress) -> Snapshot:
        if self._latest is None:
            self._latest, self._history = self._fold(progress)
        return self._latest

    @property
    def count(self) -> int:
        return 0 if self._history is None else len(self._history)

    def at(self, count: int, progress: Progress) -> Snapshot:
        latest = self.latest(progress)
        if self._history is None or count >= len(self._history):
            return latest
        return take(self._history.agent_at(count, progress))

    def standings(self) -> Sequence[Standing]:
        """A robot that holds the same set of transactions holds the same map: that is looked at,
        not what `summary.json` says."""
        mine = set(self._transactions)
        digest = "" if self._latest is None else self._latest.digest
        return [self._standing(robot, mine, digest) for robot in self._robots]

    def remark(self) -> str:
        if not self._refused:
            return ""
        return (
            f"{self._refused} transactions do not hold under the parameters of summary.json, "
            "so they are not shown: the folder holds files of two runs, or one is damaged"
        )

    def close(self) -> None:
        """Nothing is held open."""

    def _fold(self, progress: Progress) -> tuple[Snapshot, History]:
        """The whole ledger, and how to walk through it."""
        from ...agent import Agent  # these load compiled kernels: the first picture comes before
        from .history import History

        agent = Agent(self._identity, self.config)
        for i, data in enumerate(self._transactions):
            events = agent.take(data)
            self._refused += any(isinstance(event, Rejected) for event in events)
            if i % _STEP == 0:
                progress(0.5 * i / len(self._transactions))
        folded = 0
        while agent.consensus.pending:
            folded += agent.consensus.advance(_FEATURES)[1]
            progress(0.5 + 0.5 * folded / len(self._transactions))
        counted = [each.transaction.data for each in agent.consensus.contributions()]
        return take(agent), History(self.config, self._identity, counted)

    def _standing(self, robot: _Robot, mine: set[bytes], digest: str) -> Standing:
        try:
            theirs = mine if robot.name == self.robot else set(self._read(robot.name))
        except StoreError as error:
            return Standing(robot.name, robot.digest, None, str(error))
        if theirs != mine:
            lacks, more = len(mine - theirs), len(theirs - mine)
            return Standing(robot.name, robot.digest, False, f"lacks {lacks}, has {more} others")
        if digest and robot.digest != digest:
            detail = "the same transactions, but summary.json has another digest"
            return Standing(robot.name, robot.digest, False, detail)
        return Standing(robot.name, robot.digest, True, f"{len(theirs):,} transactions")

    def _read(self, robot: str) -> list[bytes]:
        path = self._folder / "ledgers" / f"{robot}.db"
        with Store.open(path) as store:
            if store.fleet_id != self.config.fleet_id:
                raise StoreError(
                    f"{path}: the ledger of another fleet ({store.fleet_id.hex()}) than that of "
                    f"summary.json ({self.config.fleet_id.hex()}); put back the run's own ledger"
                )
            return list(store)


def _read_summary(folder: Path) -> _Summary:
    path = folder / "summary.json"
    if not folder.is_dir():
        raise DagmapError(f"{folder}: there is no such folder; name the --out of a replay")
    try:
        summary = msgspec.json.decode(path.read_bytes(), type=_Summary)
    except OSError as error:
        raise DagmapError(
            f"{folder}: not the folder of a run, its summary.json cannot be read "
            f"({error.strerror}); name the --out of a replay"
        ) from None
    except msgspec.DecodeError as error:
        raise DagmapError(
            f"{path}: not what a replay writes ({error}); run the replay again"
        ) from None
    if not summary.robots:
        raise DagmapError(f"{path}: a run without robots; there is nothing to look at")
    for robot in summary.robots:
        if Path(robot.name).name != robot.name:
            raise DagmapError(f"{path}: {robot.name!r} cannot be a robot's name; run it again")
    return summary


def _config(path: Path, summary: _Summary) -> Config:
    try:
        return msgspec.convert(summary.parameters, Config, strict=False)
    except (msgspec.ValidationError, ConfigError) as error:
        raise DagmapError(
            f"{path}: parameters that this version of DAGmap does not know ({error}); view it "
            "with the version that wrote it"
        ) from None
