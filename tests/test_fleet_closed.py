"""Closed fleets as real processes, over mutual TLS: who takes part, who does not, who no longer."""

from __future__ import annotations

import shutil
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from dagmap import Identity
from dagmap.io import keys
from dagmap.io.certificates import make_leaf
from robots import PARAMETERS, Nursery, Robot, agreed, record, running, until


@dataclass
class Enrolled(Robot):
    """A robot with a key and certificates of a fleet's."""

    tls: bool = True

    @property
    def keys(self) -> Path:
        return self.folder / f"{self.name}.keys"

    def identity(self) -> Identity:
        return keys.load_identity(self.keys)

    def write(self) -> Path:
        text = super().write().read_text()
        config = keys.open_robot(self.keys).config
        text = text.replace(f'fleet = "{self.fleet}"', f'fleet = "{config.fleet}"')
        head = f'fleet_key = "{config.fleet_key}"\nkeys = "{self.keys}"\n'
        if self.tls:
            text = text.replace('"tcp/', '"tls/')
            text += "[network.tls]\n"
            for name, file in (("ca", "ca"), ("certificate", "tls"), ("key", "robot")):
                ending = "key" if name == "key" else "pem"
                text += f'{name} = "{self.keys}/{file}.{ending}"\n'
        self.file.write_text(head + text)
        return self.file

    def hears(self) -> list[str]:
        """Names of the robots whose transactions count here."""
        answer = self.status()
        return sorted(head["name"] for head in answer["heads"].values() if head["length"])


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("recordings")
    return [record(folder / f"walk{i}.npz", seed=i) for i in range(3)]


@pytest.fixture
def fleet(tmp_path: Path) -> keys.Fleet:
    return make_fleet(tmp_path, "office")


def make_fleet(folder: Path, name: str) -> keys.Fleet:
    """Its parameters are those of the tests' robots: revocations are made by them."""
    made = keys.create_fleet(folder / f"{name}.fleet", name).folder
    with (made / "fleet.toml").open("a") as file:
        file.write("[transaction]\nproof_of_work_bits = 0\n")
    assert "proof_of_work_bits = 0" in PARAMETERS
    return keys.open_fleet(made)


def enroll(
    nursery: Nursery,
    fleet: keys.Fleet,
    name: str,
    recording: Path | None,
    *others: Robot,
    **more: Any,
) -> Enrolled:
    folder = fleet.folder.parent
    fleet.enroll(name, folder / f"{name}.keys", days=1)
    return Enrolled(nursery, folder, name, recording, tuple(r.port for r in others), **more)


def settled(*robots: Enrolled) -> bool:
    """All cycles are in, and all is issued."""
    answers = [robot.status() for robot in robots]
    return all(a.get("cycles") == 8 and not a["lag"]["to_issue"] for a in answers)


def two_announcements() -> None:
    time.sleep(0.5)


class TestMembers:
    def test_robots_agree_and_a_newcomer_joins_without_anybody_being_told(
        self, nursery: Nursery, fleet: keys.Fleet, recordings: list[Path]
    ) -> None:
        a = enroll(nursery, fleet, "a", recordings[0])
        b = enroll(nursery, fleet, "b", recordings[1], a)
        with running(a, b):
            a.start("--speed", 20, "--wait-for", 1)
            b.start("--speed", 20, "--wait-for", 1)
            until(lambda: settled(a, b) and agreed(a, b, authors=2), "a and b")
            files = [a.file.read_bytes(), b.file.read_bytes()]
            c = enroll(nursery, fleet, "newcomer", recordings[2], b)
            with running(c):
                c.start("--speed", 20)
                until(lambda: settled(a, b, c) and agreed(a, b, c, authors=3), "the newcomer")
                assert a.hears() == b.hears() == c.hears() == ["a", "b", "newcomer"]
            assert [a.file.read_bytes(), b.file.read_bytes()] == files
            assert [a.stop(), b.stop()] == [0, 0]
        assert "open mode" not in a.log
        assert a.restored().digest() == b.restored().digest()


class TestStrangers:
    """They do not get a connection, or are not heard; the others go on."""

    def test_a_certificate_of_another_fleet(
        self, nursery: Nursery, tmp_path: Path, fleet: keys.Fleet, recordings: list[Path]
    ) -> None:
        other = make_fleet(tmp_path, "pirates")
        a = enroll(nursery, fleet, "a", recordings[0])
        b = enroll(nursery, fleet, "b", recordings[1], a)
        stranger = enroll(nursery, other, "stranger", recordings[2], a, b)
        assert self.kept_out(a, b, stranger)

    def test_an_expired_certificate(
        self, nursery: Nursery, fleet: keys.Fleet, recordings: list[Path]
    ) -> None:
        a = enroll(nursery, fleet, "a", recordings[0])
        b = enroll(nursery, fleet, "b", recordings[1], a)
        late = enroll(nursery, fleet, "late", recordings[2], a, b)
        robot, key = keys.open_robot(late.keys), keys._private_key(fleet.folder / "fleet.key")
        expired = make_leaf(key, "office", robot.identity.public_key, "late", (), days=-1)
        (late.keys / "tls.pem").write_bytes(expired)
        assert self.kept_out(a, b, late)
        told = [line for line in late.log.splitlines() if 'event="tls certificate"' in line]
        assert len(told) == 1 and f"file={late.keys}/tls.pem" in told[0], late.log
        assert "it expired 20" in told[0] and "dagmap keys renew late" in told[0]
        with running(a, b, late):  # what it wrote meanwhile counts, once its certificate holds
            for one in (a, b):
                one.start("--speed", 50)
            (late.keys / "tls.pem").unlink()
            fleet.renew("late", late.keys / "tls.pem", days=1)
            late.start("--speed", 50)
            until(lambda: agreed(a, b, late, authors=3), "all three")

    @pytest.mark.parametrize("same_name", [True, False])
    def test_an_unknown_fleet_where_links_are_open(
        self,
        nursery: Nursery,
        tmp_path: Path,
        fleet: keys.Fleet,
        recordings: list[Path],
        same_name: bool,
    ) -> None:
        elsewhere = tmp_path / "elsewhere"
        elsewhere.mkdir()
        other = make_fleet(elsewhere, "office" if same_name else "pirates")
        a = enroll(nursery, fleet, "a", recordings[0], tls=False)
        b = enroll(nursery, fleet, "b", recordings[1], a, tls=False)
        assert self.kept_out(
            a, b, enroll(nursery, other, "stranger", recordings[2], a, b, tls=False)
        )

    @staticmethod
    def kept_out(a: Enrolled, b: Enrolled, stranger: Enrolled) -> bool:
        with running(a, b, stranger):
            for robot in (stranger, a, b):
                robot.start("--speed", 20)
            until(lambda: settled(a, b, stranger) and agreed(a, b, authors=2), "a and b")
            two_announcements()
            assert a.hears() == b.hears() == ["a", "b"]
            assert stranger.hears() == [stranger.name]
            outcast = stranger.status()
            assert outcast["peers"] == {} and outcast["traffic"]["received"] == {}
            assert outcast["author"] not in a.answer()["peers"].keys() | b.answer()["peers"].keys()
            return [robot.stop() for robot in (a, b, stranger)] == [0, 0, 0]

    def test_a_robot_that_shows_anothers_certificate_does_not_start(
        self, nursery: Nursery, fleet: keys.Fleet, recordings: list[Path]
    ) -> None:
        a = enroll(nursery, fleet, "a", recordings[0])
        b = enroll(nursery, fleet, "b", recordings[1], a)
        b.write()
        shutil.copy(a.keys / "certificate", b.keys / "certificate")
        b.pid = nursery.start(["agent", str(b.file)], b.folder / b.name)
        with running(b):
            assert b.wait() == 2
        assert "the certificate of" in b.log and "Traceback" not in b.log


class TestRevoked:
    def test_nothing_counts_after_the_number_named_on_any_robot(
        self, nursery: Nursery, fleet: keys.Fleet, recordings: list[Path]
    ) -> None:
        a = enroll(nursery, fleet, "a", recordings[0])
        b = enroll(nursery, fleet, "b", recordings[1], a)
        lost = enroll(nursery, fleet, "lost", recordings[2], a, b)
        robots = (a, b, lost)
        with running(*robots):
            for robot in robots:
                robot.start("--speed", 20, "--wait-for", 2)
            before = until(lambda: settled(*robots) and agreed(*robots, authors=3), "agreement")
            author = before[2]["author"]
            assert before[0]["heads"][author]["length"] > 2
            word = fleet.revoke("lost", last=1)
            (b.keys / "revocations" / "copy.tx").write_bytes(word.read_bytes()[:50])  # half a copy
            until(lambda: "event=refused" in b.log, "half a copy to be looked at")
            shutil.copy(word, b.keys / "revocations" / "copy.tx")
            until(lambda: all(r.answer()["heads"][author]["length"] == 2 for r in robots), "word")
            after = until(lambda: agreed(*robots, authors=3), "agreement")
            assert after[0]["digest"] != before[0]["digest"]
            assert all("event=revoked" in robot.log for robot in robots)
            assert "this robot issues nothing more" in lost.log
            lost.signal(signal.SIGTERM)
            assert lost.wait() == 0
            held = len(lost.ids())
            lost.start("--speed", 20)  # its SLAM goes on; nobody hears of it, and nothing waits
            until(lambda: lost.status().get("cycles") == 8 and agreed(*robots), "the rerun")
            two_announcements()
            assert (
                len({robot.answer()["digest"] for robot in (*robots,)} | {after[0]["digest"]}) == 1
            )
            assert lost.answer()["transactions"] == held
            newcomer = enroll(nursery, fleet, "newcomer", None, b)
            with running(newcomer):
                newcomer.start()
                until(lambda: agreed(*robots, newcomer), "a newcomer that learns of it")
                assert newcomer.answer()["digest"] == after[0]["digest"]
