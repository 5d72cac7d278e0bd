"""`dagmap keys`: folders of fleets and robots, who may read them, and what they are good for."""

from __future__ import annotations

import json
import os
import ssl
import stat
from datetime import datetime, timedelta, tzinfo
from pathlib import Path

import msgspec
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from dagmap import Agent, Config, Cycle, GraphConfig
from dagmap.cli import app
from dagmap.config import TransactionConfig, load_config
from dagmap.io.data_folder import open_folder, restore
from dagmap.io.keys import Fleet, create_fleet, load_identity, open_fleet, open_robot
from dagmap.io.settings import load_settings
from dagmap.io.store import Store
from dagmap.model import DagmapError, KeysError, Revoked, StoreError

WALL = np.random.default_rng(0).uniform([2, -1, -1], [2, 1, 1], (60, 3))


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    made = create_fleet(tmp_path / "fleet", "office")
    made.enroll("robot1", tmp_path / "robot1", 365)
    return made


def keys(*words: object) -> Result:
    return CliRunner().invoke(app, ["keys", *map(str, words)])


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_the_commands_make_a_fleet_whose_robots_map_together(tmp_path: Path) -> None:
    home = tmp_path / "fleet"
    done = keys("init-fleet", home, "--name", 'the "office"')
    assert done.exit_code == 0 and "next: dagmap keys enroll" in done.output
    agents = []
    for name in ("robot1", "robot2"):
        done = keys("enroll", name, "--fleet", home, "--out", tmp_path / name, "--json")
        facts = json.loads(done.output)
        assert facts["robot"] == name and facts["fleet"] == 'the "office"'
        config = load_config(tmp_path / name / "robot.toml")
        quick = TransactionConfig(proof_of_work_bits=0)
        graph = GraphConfig(v_th=3, reference_pitch=0.25, max_parent_distance=0.75)
        config = msgspec.structs.replace(config, transaction=quick, graph=graph)
        agents.append(Agent(load_identity(tmp_path / name), config))
        assert facts["author"] == agents[-1].identity.author.hex()
    for agent in agents:
        agent.observe(Cycle(0.0, np.eye(4), WALL), 0.0)
    for giver, taker in (agents, reversed(agents)):
        for out in giver.outbox():
            taker.receive(out.data, 0.0)
    assert agents[0].digest() == agents[1].digest() and len(agents[0].map)
    assert agents[0].robots.keys() == {"robot1", "robot2"}


def test_parameters_of_the_fleet_go_to_its_robots_and_into_its_revocations(tmp_path: Path) -> None:
    create_fleet(tmp_path / "fleet", "office")
    with open(tmp_path / "fleet" / "fleet.toml", "a") as file:
        file.write("[transaction]\nproof_of_work_bits = 9\n[fold]\nwitnesses = 3\n")
    fleet = open_fleet(tmp_path / "fleet")
    fleet.enroll("robot1", tmp_path / "robot1", 365)
    robot = open_robot(tmp_path / "robot1")
    assert (robot.name, robot.config.name) == ("robot1", "robot1")
    assert robot.config.parameters_id == fleet.config.parameters_id != Config().parameters_id
    data = fleet.revoke("robot1", 0).read_bytes()
    assert Agent(robot.identity, robot.config).take(data)[0] == Revoked(robot.identity.author, 1)


def test_a_revocation_file_goes_through_the_door(fleet: Fleet, tmp_path: Path) -> None:
    robot = open_robot(tmp_path / "robot1")
    agent = Agent(robot.identity, robot.config)
    done = keys("revoke", "robot1", "--last", 4, "--fleet", fleet.folder)
    path = fleet.folder / "revocations" / "0000.tx"
    assert done.exit_code == 0 and str(path) in done.output
    assert Revoked(robot.identity.author, 5) in agent.take(path.read_bytes())
    again = keys("revoke", robot.identity.author.hex(), "--last", "-1", "--fleet", fleet.folder)
    assert again.exit_code == 0, again.output
    second = fleet.folder / "revocations" / "0001.tx"
    assert Revoked(robot.identity.author, 0) in agent.take(second.read_bytes())
    shown = json.loads(keys("show", fleet.folder, "--json").output)
    assert [(row["number"], row["last"], row["name"]) for row in shown["revoked"]] == [
        (0, 4, "robot1"),
        (1, -1, "robot1"),
    ]


def test_private_keys_are_private_from_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: dict[str, int] = {}
    real = os.open

    def watched(path: object, flags: int, mode: int = 0o777, **more: object) -> int:
        opened[Path(os.fspath(path)).name] = mode  # type: ignore[call-overload]
        return real(path, flags, mode, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(os, "open", watched)
    before = os.umask(0)
    try:
        create_fleet(tmp_path / "f", "f").enroll("r", tmp_path / "r", 30)
    finally:
        os.umask(before)
    parts = [f".{name}.key.{os.getpid()}.part" for name in ("fleet", "robot")]
    assert [opened[part] for part in parts] == [0o600, 0o600]
    assert mode(tmp_path / "f" / "fleet.key") == mode(tmp_path / "r" / "robot.key") == 0o600
    assert mode(tmp_path / "f") == mode(tmp_path / "r") == 0o700
    assert not [path for path in tmp_path.rglob("*") if path.name.startswith(".")]


@pytest.mark.parametrize("wrong", [0o640, 0o604, 0o660, 0o666])
def test_keys_that_others_can_read_are_not_used(fleet: Fleet, tmp_path: Path, wrong: int) -> None:
    for path, read in (
        (fleet.folder / "fleet.key", lambda: open_fleet(fleet.folder)),
        (tmp_path / "robot1" / "robot.key", lambda: load_identity(tmp_path / "robot1")),
    ):
        path.chmod(wrong)
        with pytest.raises(KeysError, match=f"mode {wrong:04o}.*chmod 600 .*{path.name}"):
            read()
        path.chmod(0o400)
        read()


def test_nothing_shows_a_private_key(fleet: Fleet, tmp_path: Path) -> None:
    robot = open_robot(tmp_path / "robot1")
    secrets = [
        line
        for path in (fleet.folder / "fleet.key", tmp_path / "robot1" / "robot.key")
        for line in path.read_text().splitlines()[1:-1]
    ]
    assert len(secrets) == 2
    shown = [keys("show", fleet.folder).output, keys("show", robot.folder).output, repr(robot)]
    shown += [keys("show", robot.folder, "--json").output, repr(fleet), repr(fleet.identity)]
    others = [p for p in tmp_path.rglob("*") if p.is_file() and p.suffix != ".key"]
    shown += [path.read_bytes().decode(errors="replace") for path in others]
    for text in shown:
        assert text and not any(secret in text or secret[-44:] in text for secret in secrets)


def test_what_is_there_is_not_overwritten(fleet: Fleet, tmp_path: Path) -> None:
    for done in (
        keys("init-fleet", fleet.folder, "--name", "x"),
        keys("enroll", "robot2", "--fleet", fleet.folder, "--out", tmp_path / "robot1"),
    ):
        assert isinstance(done.exception, KeysError)
        assert "exists and is not empty; name another folder" in str(done.exception)
    assert list(fleet.robots()) == ["robot1"]
    with pytest.raises(KeysError, match="robot1 is enrolled already; .* keys renew robot1"):
        fleet.enroll("robot1", tmp_path / "again", 365)
    with pytest.raises(KeysError, match="tls.pem: exists"):
        fleet.renew("robot1", tmp_path / "robot1" / "tls.pem", 365)
    assert not (tmp_path / "again").exists()


def test_an_empty_folder_may_be_named(fleet: Fleet, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    fleet.enroll("robot2", tmp_path / "empty", 1)
    assert open_robot(tmp_path / "empty").name == "robot2"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("revoke", "robot9", "--last", "3"), "no robot 'robot9' is enrolled; known are: robot1"),
        (("revoke", "robot1", "--last", "-2"), "--last -2: the number of a transaction, or -1"),
        (("enroll", "../x", "--out", "o"), "name '../x': 1 to 63 letters"),
        (("enroll", "", "--out", "o"), "name ''"),
        (("enroll", "a" * 64, "--out", "o"), "1 to 63 letters"),
        (("enroll", "a", "--out", "o", "--days", "0"), "--days 0: 1 to 3650 is wanted"),
        (("enroll", "a", "--out", "o", "--address", "ä.org"), "--address ä.org"),
        (("enroll", "a", "--out", "o", "--address", ""), "'' is no IP address or host name"),
        (("renew", "robot9", "--out", "o"), "known are: robot1"),
    ],
)
def test_mistakes_get_one_line(
    fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    done = keys(*words, "--fleet", fleet.folder)
    assert isinstance(done.exception, DagmapError), done.output
    assert message in str(done.exception) and "\n" not in str(done.exception)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["fleet", "robot1"]


def test_a_revocation_is_only_followed_by_a_stricter_one(fleet: Fleet) -> None:
    fleet.revoke("robot1", 4)
    for last in (4, 7):
        with pytest.raises(KeysError, match="robot1 is revoked from number 5 on already"):
            fleet.revoke("robot1", last)
    assert fleet.revoke("robot1", 3).name == "0001.tx"


def test_what_a_killed_command_left_blocks_no_later_one(
    fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in (os.getpid(), os.getpid() + 1):
        (fleet.folder / "revocations" / f".0000.tx.{number}.part").write_bytes(b"half")
    (fleet.folder / "revocations" / ".0000.tx.part").write_bytes(b"half")  # of an earlier release
    assert fleet.revoke("robot1", 4).name == "0000.tx"
    assert len(fleet.revocations()) == 1


@pytest.mark.parametrize("call", ["replace", "link"])
def test_an_enrolment_that_is_cut_short_burns_no_name(
    fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    """Before its folder is in place, and between that and the list of robots."""
    real = getattr(os, call)

    def cut(source: Path, target: Path) -> None:
        if target.name in ("robot2", "robot2.json"):
            raise KeyboardInterrupt
        real(source, target)

    monkeypatch.setattr(os, call, cut)
    with pytest.raises(KeyboardInterrupt):
        fleet.enroll("robot2", tmp_path / "robot2", 30)
    monkeypatch.undo()
    made = (tmp_path / "robot2" / "robot.key").exists()
    assert made == (call == "link") and list(fleet.robots()) == ["robot1"]
    enrolled = fleet.enroll("robot2", tmp_path / "robot2", 30)
    robot = open_robot(tmp_path / "robot2")
    assert fleet.robots()["robot2"] == enrolled and robot.identity.author == enrolled.author
    with pytest.raises(KeysError, match="exists and is not empty"):
        fleet.enroll("robot3", tmp_path / "robot2", 30)  # it is another's


def test_revoking_says_how_many_there_were(fleet: Fleet) -> None:
    """From an old copy of the folder a second 0000.tx would fork the fleet key."""
    for before in (0, 1):
        done = keys("revoke", "robot1", "--last", 4 - before, "--fleet", fleet.folder)
        assert f"held {before} revocations before. First see that `dagmap status`" in done.output
        assert fleet.identity.author.hex() in done.output


def test_folders_that_are_damaged_or_mixed_up(fleet: Fleet, tmp_path: Path) -> None:
    other = create_fleet(tmp_path / "other", "office")
    other.enroll("robot1", tmp_path / "theirs", 365)
    mine = tmp_path / "robot1"

    def swapped(path: Path, data: bytes, opens: object, message: str) -> None:
        kept = path.read_bytes()
        path.write_bytes(data)
        with pytest.raises(KeysError, match=message):
            opens()  # type: ignore[operator]
        path.write_bytes(kept)

    def robot() -> object:
        return open_robot(mine)

    def home() -> object:
        return open_fleet(fleet.folder)

    for name in ("certificate", "robot.toml", "robot.key"):
        theirs = (tmp_path / "theirs" / name).read_bytes()
        swapped(mine / name, theirs, robot, "is not one of the fleet 'office' of robot.toml")
    swapped(mine / "certificate", b"zz", robot, "certificate: no certificate; take")
    swapped(mine / "certificate", b"\xff", robot, "certificate: no certificate; take")
    swapped(mine / "certificate", b"ff" * 70, robot, "certificate: no certificate; take")
    swapped(mine / "tls.pem", b"-", robot, "tls.pem: no X.509 certificate")
    swapped(mine / "robot.key", b"junk", robot, "robot.key: no Ed25519 private key")
    swapped(mine / "robot.toml", b"x = 1", robot, "robot.toml: .*unknown field `x`")
    theirs = (other.folder / "fleet.toml").read_bytes()
    swapped(fleet.folder / "fleet.toml", theirs, home, "another fleet_key than that of fleet.key")
    toml = fleet.folder / "fleet.toml"
    swapped(toml, b"name = 'x'\n" + toml.read_bytes(), home, "name is a robot's, not the fleet's")
    entry = fleet.folder / "robots" / "robot1.json"
    swapped(entry, b"{}", lambda: home().robots(), "robot1.json: damaged")
    revoked = fleet.revoke("robot1", 4)
    theirs = other.revoke("robot1", 4).read_bytes()
    # its work is for another fleet id, and holds for this one only by chance
    foreign = "0000.tx: (proof of work missing|no certificate of this fleet)"
    swapped(revoked, theirs, lambda: home().revocations(), foreign)
    revoked.rename(revoked.with_name("0001.tx"))
    with pytest.raises(KeysError, match="0001.tx: does not follow from the one before"):
        fleet.revoke("robot1", 2)  # else the fleet key would sign two with one number
    for missing in (tmp_path / "nowhere", mine):
        with pytest.raises(KeysError, match="fleet.toml: cannot be read"):
            open_fleet(missing)
    done = keys("show", tmp_path / "nowhere")
    assert "neither fleet.key nor robot.key is here" in str(done.exception)


def test_a_robots_process_finds_its_keys(fleet: Fleet, tmp_path: Path) -> None:
    file = tmp_path / "agent.toml"
    head = f"fleet = 'office'\nfleet_key = '{fleet.config.fleet_key}'\n"
    file.write_text(f"{head}keys = 'robot1'\n[store]\npath = 'data/ledger.db'\n")
    settings, robot = load_settings(file), open_robot(tmp_path / "robot1")
    for _ in range(2):
        identity, store = open_folder(settings)
        with store:
            agent = restore(settings, identity, store, lambda data, _: data)
        assert identity.author == robot.identity.author and agent.config.name == "robot1"
    assert {p.name for p in (tmp_path / "data").iterdir()} == {"ledger.db"}
    file.write_text(f"{head}keys = 'robot1'\n[store]\npath = 'elsewhere/ledger.db'\n")
    with pytest.raises(StoreError, match="elsewhere/ledger.db: the ledger of the robot's key is"):
        open_folder(load_settings(file))
    assert not (tmp_path / "elsewhere" / "ledger.db").exists()
    Store.open(tmp_path / "elsewhere" / "ledger.db", settings.config.fleet_id).close()
    with pytest.raises(StoreError, match=r"signed for another ledger \(.*robot1/robot.ledger"):
        open_folder(load_settings(file))
    (tmp_path / "data" / "ledger.db").unlink()
    with pytest.raises(StoreError, match="key is gone.*enroll the robot anew"):
        open_folder(settings)
    file.write_text(f"{head}keys = 'robot9'\n[store]\npath = 'data9/ledger.db'\n")
    with pytest.raises(KeysError, match="robot9/robot.key: cannot be read"):
        open_folder(load_settings(file))
    assert not (tmp_path / "data9" / "ledger.db").exists()


# Sessions between robots


def session(server: tuple[Path, Path, Path], client: tuple[Path, Path, Path]) -> str:
    """A TLS handshake in memory, each side with (authority, certificate, key); the server's name
    for the client."""
    strict = ssl.VERIFY_X509_STRICT
    contexts = []
    for purpose, files in ((ssl.PROTOCOL_TLS_SERVER, server), (ssl.PROTOCOL_TLS_CLIENT, client)):
        context = ssl.SSLContext(purpose)
        context.load_verify_locations(files[0])
        context.load_cert_chain(files[1], files[2])
        context.verify_mode = ssl.CERT_REQUIRED
        context.verify_flags |= strict
        contexts.append(context)
    up, down = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = [
        contexts[1].wrap_bio(down, up, server_hostname="robot1"),
        contexts[0].wrap_bio(up, down, server_side=True),
    ]
    done = set()
    for _ in range(8):
        for end in ends:
            try:
                end.do_handshake()
                done.add(end)
            except ssl.SSLWantReadError:
                pass
    assert len(done) == 2
    return dict(entry[0] for entry in ends[1].getpeercert()["subject"])["commonName"]


def files(folder: Path) -> tuple[Path, Path, Path]:
    return folder / "ca.pem", folder / "tls.pem", folder / "robot.key"


def test_robots_open_sessions_with_each_other_and_with_nobody_else(
    fleet: Fleet, tmp_path: Path
) -> None:
    fleet.enroll("robot2", tmp_path / "robot2", 1, ["10.0.0.2", "two.local"])
    one, two = files(tmp_path / "robot1"), files(tmp_path / "robot2")
    assert session(one, two) == "robot2"
    other = create_fleet(tmp_path / "other", "office")
    other.enroll("robot2", tmp_path / "alien", 365)
    alien = files(tmp_path / "alien")
    with pytest.raises(ssl.SSLError):
        session(one, (one[0], *alien[1:]))
    with pytest.raises(ssl.SSLError):
        session(alien, two)
    with pytest.raises(ssl.SSLError):
        session(two, one)  # its name is robot2, and robot1 was asked for


def test_an_expired_certificate_opens_no_session_until_it_is_renewed(
    fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Earlier(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> datetime:  # type: ignore[override]
            return datetime.now(tz) - timedelta(days=40)

    monkeypatch.setattr("dagmap.io.certificates.datetime", Earlier)
    fleet.enroll("robot2", tmp_path / "robot2", 30)
    monkeypatch.undo()
    one, (authority, old, key) = files(tmp_path / "robot1"), files(tmp_path / "robot2")
    with pytest.raises(ssl.SSLError, match="expired"):
        session(one, (authority, old, key))
    new = tmp_path / "new.pem"
    done = keys("renew", "robot2", "--fleet", fleet.folder, "--out", new, "--days", 9)
    assert done.exit_code == 0 and "put it onto the robot as tls.pem" in done.output
    assert session(one, (authority, new, key)) == "robot2"
