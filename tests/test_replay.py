"""The command as a user runs it: three recordings in, one map and its files out."""

from __future__ import annotations

import io
import json
import random
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from dagmap import Agent, Config, Cycle, Identity
from dagmap.cli import main
from dagmap.io.sources import save_cycles
from dagmap.io.store import Store
from dagmap.messages import Transactions, encode
from scene import cycles

OFFICE = Path(__file__).parents[1] / "examples" / "office"


@dataclass(frozen=True)
class Ran:
    returncode: int
    stdout: str
    stderr: str


def dagmap(*arguments: object) -> Ran:
    """The command in this process: what it prints and how it exits."""
    out, err = io.StringIO(), io.StringIO()
    argv = patch.object(sys, "argv", ["dagmap", *map(str, arguments)])
    with argv, redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as exit_:
        main()
    return Ran(int(exit_.value.code or 0), out.getvalue(), err.getvalue())


def plain(seed: int, **more: object) -> Iterator[Cycle]:
    """Cycles without colours: a stream has them in all cycles or in none."""
    return (replace(cycle, colors=None) for cycle in cycles(seed, **more))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def streams(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("streams")
    paths = [folder / f"{name}.npz" for name in ("red", "green", "blue")]
    for i, path in enumerate(paths):
        save_cycles(path, plain(i, count=8, points=120))
    return paths


@pytest.fixture(scope="module")
def office(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """The office with a loss of a third of all messages and a robot that comes late."""
    out = tmp_path_factory.mktemp("office") / "out"
    run = dagmap(
        "replay", *sorted(OFFICE.glob("robot?")), "--out", out, "--loss", 0.33, "--late", "late",
        "--json",
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    return out, json.loads(run.stdout)


def test_three_robots_map_one_office(office: tuple[Path, dict]) -> None:
    out, summary = office
    assert summary == json.loads((out / "summary.json").read_text())
    assert summary["converged"] is True
    assert [r["name"] for r in summary["robots"]] == ["robot1", "robot2", "robot3", "late"]
    assert {r["digest"] for r in summary["robots"]} == {summary["digest"]}
    for robot in summary["robots"][:3]:
        assert robot["cycles"] in (41, 42) and robot["transactions"] >= 41
        assert 10_000 < robot["features_issued"] <= robot["features_observed"]
        assert robot["bytes_sent"] > 0 and robot["bytes_received"] > 0
    late = summary["robots"][3]
    assert late["cycles"] == late["features_issued"] == late["transactions"] == 0
    assert summary["map"]["confirmed"] > 500
    counts = summary["map"]
    assert counts["nodes"] == counts["confirmed"] + counts["tentative"] + counts["rejected"]
    sent = sum(r["bytes_sent"] for r in summary["robots"])
    issued = sum(r["features_issued"] for r in summary["robots"])
    assert summary["bytes_per_feature"] == pytest.approx(sent / issued)


def test_robots_of_the_office_find_each_others_frames(tmp_path: Path) -> None:
    """Each starts at its own identity: the recorded poses are the truth, their frames the test."""
    from dagmap.io.sources import open_source
    from dagmap.model import FrameId, pose_matrix

    paths = []
    starts = {}
    for i, folder in enumerate(sorted(OFFICE.glob("robot?"))):
        seen = list(open_source(folder))
        starts[folder.name] = back = np.linalg.inv(np.asarray(seen[0].pose))
        paths.append(tmp_path / f"{folder.name}.npz")
        save_cycles(paths[i], (replace(c, pose=back @ np.asarray(c.pose)) for c in seen))
    run = dagmap("replay", *paths, "--out", tmp_path / "out", "--unknown-frames", "--json")
    assert run.returncode == 0, run.stderr
    summary = json.loads(run.stdout)
    assert summary["converged"] and summary["map"]["confirmed"] > 500
    assert all(robot["placed"] and not robot["unplaced"] for robot in summary["robots"])
    with Store.open(tmp_path / "out" / "ledgers" / "robot1.db") as store:
        held = Agent.restore(Identity.from_seed(bytes(32)), Config(start_pose=None), list(store))
    assert held.digest().hex() == summary["digest"]
    authors = {a.name: a for a in held.consensus.authors.values()}
    frames = held.consensus.frames
    poses = {name: pose_matrix(frames[FrameId(a.id)][1]) for name, a in authors.items()}

    for one, other in (("robot1", "robot2"), ("robot2", "robot3"), ("robot1", "robot3")):
        truth = starts[other] @ np.linalg.inv(starts[one])
        off = np.linalg.inv(truth) @ np.linalg.inv(poses[other]) @ poses[one]
        walked = [pose_matrix(a.pose)[:3, 3] for a in authors[one].anchors.values()]
        metres = np.linalg.norm(walked @ off[:3, :3].T + off[:3, 3] - walked, axis=1)
        degrees = np.degrees(np.arccos(np.clip((np.trace(off[:3, :3]) - 1) / 2, -1, 1)))
        assert metres.mean() < 0.03 and degrees < 1.0


def test_robots_that_share_nothing_are_told_apart(streams: list[Path], tmp_path: Path) -> None:
    run = dagmap("replay", *streams[:2], "--out", tmp_path / "out", "--unknown-frames")
    assert run.returncode == 0, run.stderr
    told = "red does not know where green is: too few described points came yet (a sensor without"
    assert told in run.stdout


def test_the_map_is_where_the_office_is(office: tuple[Path, dict]) -> None:
    """Nodes of the map lie on what the depth images of other frames show."""
    from scipy.spatial import cKDTree

    from dagmap.io.sources import open_source

    out, summary = office
    positions, states = ply(out / "map.ply")
    assert len(positions) == summary["map"]["nodes"]
    raw = []
    for folder in sorted(OFFICE.glob("robot?")):
        for cycle in open_source(folder):
            pose = np.asarray(cycle.pose)
            raw.append(np.asarray(cycle.points) @ pose[:3, :3].T + pose[:3, 3])
    everything = np.concatenate(raw)
    kept = positions[states < 2]
    away, _ = cKDTree(everything).query(kept)
    assert np.quantile(away, 0.99) < 0.05
    missed, _ = cKDTree(kept).query(everything)
    assert (missed < 0.10).mean() > 0.9


def ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    data = path.read_bytes()
    head, body = data.split(b"end_header\n", 1)
    count = int(next(line for line in head.splitlines() if b"element vertex" in line).split()[-1])
    row = struct.calcsize("<3f3BBIIH")
    rows = [struct.unpack_from("<3f3BBIIH", body, i * row) for i in range(count)]
    assert len(body) == count * row
    return np.array([r[:3] for r in rows]), np.array([r[6] for r in rows])


def test_every_file_is_there_and_holds_what_it_says(office: tuple[Path, dict]) -> None:
    out, summary = office
    for name in ("robot1", "robot2", "robot3", "late"):
        with Store.open(out / "ledgers" / f"{name}.db") as store:
            transactions = list(store)
        assert len(transactions) == sum(r["transactions"] for r in summary["robots"])
        again = Agent.restore(Identity.from_seed(bytes(32)), Config(), transactions)
        assert again.digest().hex() == summary["digest"]
    graph = np.load(out / "graph" / "robot1.npz")
    assert set(graph.files) == {"ids", "positions", "parents", "validity", "issued"}
    issued = next(r for r in summary["robots"] if r["name"] == "robot1")["features_issued"]
    assert graph["issued"].sum() == issued
    parents = graph["parents"]
    assert ((parents == -1) | (parents < graph["ids"][:, None])).all()
    for picture in ("maps.png", "traffic.png"):
        assert (out / picture).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert summary["digest"] in (out / "report.html").read_text()


def test_the_real_transactions_in_any_order_give_the_same_digest(office: tuple[Path, dict]) -> None:
    out, summary = office
    with Store.open(out / "ledgers" / "late.db") as store:
        transactions = list(store)
    for seed in range(3):
        order = transactions + transactions[::7]
        random.Random(seed).shuffle(order)
        listener = Agent(Identity.from_seed(bytes([seed]) * 32), Config())
        for at, data in enumerate(order):
            listener.receive(encode(Transactions((data,)), Config(), bytes(8)), float(at))
            if at % 5 == 0:
                listener.tick(float(at))
        assert listener.digest().hex() == summary["digest"]


def test_the_same_command_gives_the_same_map(streams: list[Path], tmp_path: Path) -> None:
    runs = [dagmap("replay", *streams, "--out", tmp_path / n, "--json") for n in ("a", "b")]
    assert [r.returncode for r in runs] == [0, 0], runs[0].stderr
    one, two = (json.loads(r.stdout) for r in runs)
    for key in ("digest", "robots", "map"):
        assert one[key] == two[key]
    assert (tmp_path / "a" / "map.ply").read_bytes() == (tmp_path / "b" / "map.ply").read_bytes()


def test_people_get_a_table(streams: list[Path], tmp_path: Path) -> None:
    run = dagmap("replay", *streams, "--out", tmp_path / "out", "--late", "blue")
    assert run.returncode == 0, run.stderr
    assert "all robots hold the same map" in run.stdout and "blue" in run.stdout
    assert "replaying" in run.stderr or "agreeing" in run.stderr


def test_an_out_folder_is_never_overwritten_unasked(streams: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "precious.txt").write_text("mine")
    run = dagmap("replay", streams[0], "--out", out)
    assert run.returncode == 2 and "not empty" in run.stderr and "Traceback" not in run.stderr
    assert [p.name for p in out.iterdir()] == ["precious.txt"]
    assert dagmap("replay", streams[0], "--out", out, "--force").returncode == 0
    assert (out / "precious.txt").read_text() == "mine"


BAD_CONFIG = {
    "n_c below n_p": ("[graph]\nn_p = 3\nn_c = 2\n", "terminals run dry"),
    "unknown key": ("[graph]\nn_q = 3\n", "n_q"),
    "wrong type": ('[fold]\ndelta = "wide"\n', "fold.delta"),
    "not toml": ("graph = [", "TOML"),
}


@pytest.mark.parametrize("name", BAD_CONFIG)
def test_a_bad_config_is_told(name: str, streams: list[Path], tmp_path: Path) -> None:
    text, told = BAD_CONFIG[name]
    (tmp_path / "fleet.toml").write_text(text)
    run = dagmap("replay", streams[0], "--out", tmp_path / "o", "--config", tmp_path / "fleet.toml")
    assert run.returncode == 2 and told in run.stderr and "Traceback" not in run.stderr
    assert not (tmp_path / "o").exists()


def test_mistakes_on_the_command_line(streams: list[Path], tmp_path: Path) -> None:
    cases = [
        ((tmp_path / "none.npz",), "no such file"),
        ((streams[0], streams[0]), "rename"),
        ((streams[0], "--loss", "1.5"), "--loss"),
        ((streams[0], "--config", tmp_path / "none.toml"), "cannot be read"),
    ]
    for arguments, told in cases:
        run = dagmap("replay", *arguments, "--out", tmp_path / "out")
        assert run.returncode == 2 and told in run.stderr, run.stderr
        assert "Traceback" not in run.stderr


def test_ctrl_c_leaves_valid_ledgers(tmp_path: Path) -> None:
    path = tmp_path / "long.npz"
    save_cycles(path, plain(1, count=2000, points=60, churn=False))
    # a process that is started in the background would ignore the signal
    heed = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    command = [sys.executable, "-c", f"{heed}; from dagmap.cli import main; main()"]
    out = tmp_path / "out"
    run = subprocess.Popen(
        [*command, "replay", str(path), "--out", str(out)], stderr=subprocess.PIPE, text=True
    )
    ledger = out / "ledgers" / "long.db"
    deadline = time.monotonic() + 60
    grown = ledger.with_name("long.db-wal")
    while time.monotonic() < deadline and not (grown.exists() and grown.stat().st_size > 60_000):
        time.sleep(0.2)
    run.send_signal(signal.SIGINT)
    _, errors = run.communicate(timeout=60)
    assert run.returncode == 130 and "interrupted" in errors and "Traceback" not in errors
    with Store.open(ledger) as store:
        transactions = list(store)
    again = Agent.restore(Identity.from_seed(bytes(32)), Config(), transactions)
    assert len(again.ledger) == len(transactions) > 5
