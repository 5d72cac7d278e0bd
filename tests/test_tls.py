"""The files of a TLS session: what is wrong with them is said before the session is opened."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from pathlib import Path

import pytest

from dagmap.io.keys import Fleet, create_fleet
from dagmap.io.settings import NetworkConfig, TlsConfig
from dagmap.io.tls import tls_doubts
from dagmap.io.transport import open_session
from dagmap.model import NetworkError

NOW = datetime.now(timezone.utc)


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    made = create_fleet(tmp_path / "fleet", "office")
    for robot in ("robot1", "robot2"):
        made.enroll(robot, tmp_path / robot, 30)
    return made


def table(ca: str = "robot1", certificate: str = "robot1", key: str = "robot1") -> TlsConfig:
    """Files by the robots whose they are."""
    return TlsConfig(
        ca=f"{ca}/ca.pem", certificate=f"{certificate}/tls.pem", key=f"{key}/robot.key"
    )


def test_what_was_enrolled_raises_no_doubt(fleet: Fleet, tmp_path: Path) -> None:
    assert tls_doubts(table(), tmp_path, NOW) == []
    assert tls_doubts(table(ca="robot2"), tmp_path, NOW) == []  # one authority
    with (tmp_path / "robot2" / "ca.pem").open("ab") as bundle:  # while a fleet changes it
        bundle.write((create_fleet(tmp_path / "next", "next").folder / "ca.pem").read_bytes())
    assert tls_doubts(table(ca="robot2"), tmp_path, NOW) == []


def test_doubts_name_the_file_and_the_remedy(fleet: Fleet, tmp_path: Path) -> None:
    other = create_fleet(tmp_path / "other", "office")
    other.enroll("robot1", tmp_path / "theirs", 30)
    for files, now, wanted in (
        (table(), NOW + timedelta(days=31), "it expired 20"),
        (table(), NOW - timedelta(days=400), "it is not valid before 20"),
        (table(ca="theirs"), NOW, f"no authority in {tmp_path}/theirs/ca.pem has signed it"),
    ):
        ((path, why),) = tls_doubts(files, tmp_path, now)
        assert path == tmp_path / "robot1" / "tls.pem"
        assert wanted in why and "dagmap keys renew robot1" in why and "\n" not in why
    both = tls_doubts(table(ca="theirs"), tmp_path, NOW + timedelta(days=31))
    assert len(both) == 2


def write(data: bytes) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(data)


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("tls.pem", write(b"junk"), r"tls\.certificate: .*tls.pem holds no X.509 certificate"),
        ("tls.pem", write(b""), r"tls\.certificate: .*tls.pem holds no X.509 certificate"),
        ("ca.pem", write(b"-----BEGIN CERTIFICATE-----\n"), r"tls\.ca: .*ca.pem holds no X.509"),
        ("robot.key", write(b"junk"), r"tls\.key: .*robot.key holds no private key"),
        ("robot.key", Path.unlink, r"tls\.key: .*robot.key is missing"),
        ("robot.key", lambda path: path.chmod(0o644), r"tls\.key: .*\(mode 0644\).*chmod 600"),
        ("robot.key", lambda path: path.chmod(0o640), r"tls\.key: .*\(mode 0640\).*chmod 600"),
        ("ca.pem", lambda path: (path.unlink(), path.mkdir()), r"tls\.ca: .*cannot be read"),
    ],
)
def test_what_cannot_be_used_is_an_error(
    fleet: Fleet, tmp_path: Path, file: str, change: Callable[[Path], object], message: str
) -> None:
    change(tmp_path / "robot1" / file)
    with pytest.raises(NetworkError, match=message) as error:
        tls_doubts(table(), tmp_path, NOW)
    assert "\n" not in str(error.value)


def test_files_of_two_robots_open_no_session(fleet: Fleet, tmp_path: Path) -> None:
    for files in (table(certificate="robot2"), table(key="robot2")):
        with pytest.raises(NetworkError, match="tls.pem is not of the key in .*robot.key; name"):
            open_session(None, NetworkConfig(tls=files), tmp_path)
