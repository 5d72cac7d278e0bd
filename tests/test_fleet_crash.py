"""What a process, a disk or a person can do to one robot: nothing acknowledged is lost."""

from __future__ import annotations

import os
import random
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dagmap import Accepted, Agent, Forked
from dagmap.io.data_folder import open_folder
from dagmap.io.queues import Inbox
from dagmap.io.settings import NetworkConfig, load_settings
from dagmap.io.store import Store
from dagmap.io.transport import Transport
from dagmap.model import StoreError
from robots import PATIENCE, Nursery, Robot, agreed, record, running, until
from scene import agent as scene_agent

KILLS = int(os.environ.get("DAGMAP_KILLS", "20"))


class Witness:
    """Another robot, in this process: keeps what it was told."""

    def __init__(self, robot: Robot) -> None:
        config = load_settings(robot.file).config
        self.agent: Agent = scene_agent("witness", config)
        self.inbox = Inbox(1 << 24, 1 << 24)
        network = NetworkConfig(
            listen=("tcp/127.0.0.1:0",),
            connect=(f"tcp/127.0.0.1:{robot.port}",),
            scouting=False,
            gossip=False,
        )
        me = self.agent.identity.author
        self.transport = Transport(network, Path(), config.fleet_id, me, self.inbox)
        self.told: set[bytes] = set()
        self.forks: list[Forked] = []
        self.started = time.monotonic()

    def watch(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            now = time.monotonic() - self.started
            events = self.agent.tick(now)
            for data in self.inbox.take(min(left, 0.05)).messages:
                events += self.agent.receive(data, now)
            self.told |= {event.id for event in events if isinstance(event, Accepted)}
            self.forks += [event for event in events if isinstance(event, Forked)]
            self.transport.send(self.agent.outbox())

    def wait_for_news(self) -> None:
        """Returns once the robot is heard, however slow the machine is."""
        before, deadline = len(self.told), time.monotonic() + PATIENCE
        while len(self.told) == before:
            assert time.monotonic() < deadline, f"no news in {PATIENCE:.0f} s"
            self.watch(0.05)


class TestKill:
    def test_kill_at_any_moment_loses_nothing_and_forks_nothing(
        self, nursery: Nursery, tmp_path: Path
    ) -> None:
        seed = random.SystemRandom().randrange(1 << 32)
        rng = random.Random(seed)
        robot = Robot(nursery, tmp_path, "a", record(tmp_path / "walk.npz", 1, count=40, points=25))
        robot.write()
        with running(robot):
            robot.start("--speed", 50)
            witness = Witness(robot)
            with witness.transport:
                for i in range(KILLS):
                    if i % 4:  # the others may be killed while they start
                        witness.wait_for_news()
                    witness.watch(rng.uniform(0.0, 0.5))
                    if i % 7 == 1:  # leaves a checkpoint: older than the ledger at later kills
                        until(robot.status, "an answer")
                        assert robot.stop() == 0
                        assert (robot.data / "checkpoint").is_file()
                    else:
                        robot.kill()
                    witness.watch(0.05)  # what is still under way
                    assert witness.told <= robot.ids(), f"seed {seed}"
                    robot.start("--speed", 50)
                until(robot.status, "the last start")
                witness.watch(1.0)
                assert robot.stop() == 0
        assert witness.forks == [], f"seed {seed}"
        assert len(witness.told) >= KILLS // 2  # it did tell, again and again
        author = robot.identity().author
        restored = robot.restored()
        mine, theirs = (a.ledger.chain(author) for a in (restored, witness.agent))
        assert mine.cut is None and theirs.cut is None
        assert [tx.id for tx in theirs.main] == [tx.id for tx in mine.main[: len(theirs.main)]]


class TestDisk:
    def test_a_full_disk_stops_one_robot_and_harms_no_other(
        self, nursery: Nursery, tmp_path: Path
    ) -> None:
        recording = record(tmp_path / "walk.npz", 1, count=60, points=60)
        a = Robot(nursery, tmp_path, "a", recording)
        b = Robot(nursery, tmp_path, "b", recording, (a.port,))
        with running(a, b):
            a.start("--speed", 20)
            until(a.status, "a")
            b.start("--speed", 20, file_size=200_000)
            assert b.wait() == 2
            assert "ledger.db: cannot be written: " in b.log.splitlines()[-1]
            assert "Traceback" not in b.log
            theirs = b.identity().author.hex()
            until(lambda: a.answer()["cycles"] == 60, "a to end")
            told = a.answer()["heads"][theirs]["length"]
            b.start("--speed", 50)  # the disk has room again: it goes on where it was
            until(lambda: b.status().get("cycles") == 60 and agreed(a, b, authors=2), "agreement")
            head = a.answer()["heads"][theirs]
            assert head["length"] > told > 0 and head["forked_at"] is None

    def test_a_read_only_folder(self, nursery: Nursery) -> None:
        with tempfile.TemporaryDirectory() as name, unprivileged(Path(name)) as folder:
            settings = load_settings(Robot(nursery, folder, "a").write())
            (folder / "a").mkdir()
            (folder / "a").chmod(0o555)
            with pytest.raises(StoreError, match=r"a/ledger\.db: cannot be opened"):
                open_folder(settings)
            assert list((folder / "a").iterdir()) == []

    def test_an_older_backup_is_completed_by_the_others_before_it_is_gone_on_with(
        self, nursery: Nursery, tmp_path: Path
    ) -> None:
        a = Robot(nursery, tmp_path, "a", record(tmp_path / "walk.npz", 1))
        b = Robot(nursery, tmp_path, "b", connect=(a.port,))
        lengths = []
        with running(a, b):
            b.start()
            for run in range(3):
                a.start("--speed", 20, "--wait-for", 1)
                until(lambda: a.status().get("cycles") == 8 and agreed(a, b, authors=1), "a and b")
                head = b.answer()["heads"][a.identity().author.hex()]
                assert head["forked_at"] is None
                lengths.append(head["length"])
                assert a.stop() == 0
                if run == 0:
                    shutil.copy(a.ledger, tmp_path / "backup")
                elif run == 1:
                    assert "own transactions found" not in a.log
                    shutil.copy(tmp_path / "backup", a.ledger)
            assert lengths[0] < lengths[1] < lengths[2]
            assert f'"own transactions found" count={lengths[1] - lengths[0]} ' in a.log

    @pytest.mark.parametrize("place", [0, 1])
    def test_a_corrupt_page(self, nursery: Nursery, tmp_path: Path, place: int) -> None:
        robot = Robot(nursery, tmp_path, "a", record(tmp_path / "walk.npz", 1, count=20))
        with running(robot):
            robot.start("--speed", 50, "--until-agreed", 0.3)
            assert robot.wait() == 0
            size = robot.ledger.stat().st_size
            with robot.ledger.open("r+b") as file:
                file.seek((100, size // 2 + 100)[place])
                file.write(bytes(range(256)) * 8)
            robot.start()
            assert robot.wait() == 2
        assert f"{robot.ledger}: " in robot.log and "the file is damaged" in robot.log
        assert "Traceback" not in robot.log


class TestMistakes:
    """A person's: each a line that names the file and the remedy, and exit code 2."""

    def test_the_ledger_of_another_fleet(self, nursery: Nursery, tmp_path: Path) -> None:
        robot = Robot(nursery, tmp_path, "a")
        Store.open(_made(robot.ledger), b"anothers").close()
        assert self._refused(robot, "ledger.db: the ledger of fleet", "correct `fleet`")

    def test_the_ledger_of_another_robot(self, nursery: Nursery, tmp_path: Path) -> None:
        a, b = (Robot(nursery, tmp_path, name) for name in "ab")
        with running(a):
            a.start("--until-agreed", 0.1)
            assert a.wait() == 0, a.log
        _made(b.ledger).write_bytes(a.ledger.read_bytes())
        assert self._refused(b, "ledger.db: the ledger of robot", "a file of its own")

    def test_a_key_without_its_ledger(self, nursery: Nursery, tmp_path: Path) -> None:
        robot = Robot(nursery, tmp_path, "a")
        with running(robot):
            robot.start("--until-agreed", 0.1)
            assert robot.wait() == 0
        robot.ledger.unlink()
        assert self._refused(robot, "ledger.db: the ledger of the robot's key is gone", "backup")
        assert not robot.ledger.exists()

    def test_a_key_that_others_can_read(self, nursery: Nursery, tmp_path: Path) -> None:
        robot = Robot(nursery, tmp_path, "a")
        with running(robot):
            robot.start("--until-agreed", 0.1)
            assert robot.wait() == 0
        key = robot.data / "robot.key"
        assert key.stat().st_mode & 0o777 == 0o600
        assert key.read_text().strip() not in robot.log + robot.said
        key.chmod(0o644)
        assert self._refused(robot, "robot.key: others can read", "chmod 600")
        key.chmod(0o600)
        key.write_text("not a key")
        assert self._refused(robot, "robot.key: damaged", "backup")

    def test_two_processes_on_one_ledger(self, nursery: Nursery, tmp_path: Path) -> None:
        robot = Robot(nursery, tmp_path, "a")
        second = Robot(nursery, tmp_path, "a")
        with running(robot):
            robot.start()
            until(robot.status)
            assert self._refused(second, "ledger.db: cannot be opened: another process")
            assert robot.answer()  # which goes on

    def test_parameters_under_which_the_ledger_does_not_hold(
        self, nursery: Nursery, tmp_path: Path
    ) -> None:
        robot = Robot(nursery, tmp_path, "a", record(tmp_path / "walk.npz", 1))
        with running(robot):
            robot.start("--speed", 50, "--until-agreed", 0.3)
            assert robot.wait() == 0
        before = robot.ids()
        robot.parameters = robot.parameters.replace("bits = 0", "bits = 20")
        assert self._refused(robot, "do not hold under this configuration", "fleet-wide parameters")
        assert robot.ids() == before

    def test_a_port_in_use(self, nursery: Nursery, tmp_path: Path) -> None:
        a = Robot(nursery, tmp_path, "a")
        b = Robot(nursery, tmp_path, "b", port=a.port)
        with running(a):
            a.start()
            until(a.status)
            assert self._refused(b, f"network (tcp/127.0.0.1:{a.port})", "Address already in use")

    @pytest.mark.parametrize(
        ("line", "message"),
        [
            ("nonsense = 1", "unknown field `nonsense`"),
            ('[source]\npath = "nowhere"', "nowhere: there is no such file or folder"),
            ('[metrics]\nlisten = "here"', "listen = 'here'"),
            ('mode = "router"\nlisten = []', "TOML"),
        ],
    )
    def test_a_configuration_that_makes_no_sense(
        self, nursery: Nursery, tmp_path: Path, line: str, message: str
    ) -> None:
        assert self._refused(Robot(nursery, tmp_path, "a", more=line), message)

    @staticmethod
    def _refused(robot: Robot, *words: str) -> str:
        """Its last words, with those among them."""
        with running(robot):
            robot.start()
            assert robot.wait() == 2, robot.log
        last = robot.log.splitlines()[-1]
        assert last.startswith("dagmap: ") and all(word in last for word in words), robot.log
        assert "Traceback" not in robot.log
        return last


@contextmanager
def unprivileged(folder: Path) -> Iterator[Path]:
    """The folder as one that this user may write to: permissions do not bind root."""
    root = os.geteuid() == 0
    if root:
        folder.chmod(0o777)
        os.seteuid(65534)
    try:
        yield folder
    finally:
        if root:
            os.seteuid(0)


def _made(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path
