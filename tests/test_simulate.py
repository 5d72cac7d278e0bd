"""`dagmap simulate` as a user runs it."""

from __future__ import annotations

import io
import json
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from dagmap import Agent
from dagmap.cli import main
from dagmap.io.sources import save_cycles
from dagmap.model import ConfigError
from dagmap.sim import truth
from dagmap.sim.mission import Mission
from dagmap.sim.scenario import load_scenario
from dagmap.sim.sweep import attempt, timeline_of
from dagmap.sim.timeline import Timeline
from scene import cycles

TEXT = """
name = "small"
robots = 3
seconds = 4.0
[link]
loss = 0.2
[sensor]
points = 16
[config.transaction]
proof_of_work_bits = 0
[config.graph]
reference_pitch = 0.25
max_parent_distance = 0.75
"""
APART = """
[[partitions]]
start = 1.0
end = 1e6
robots = ["r00", "r02"]
[[crashes]]
robot = "r01"
at = 2.0
"""


def dagmap(*arguments: object) -> tuple[int, str, str]:
    """Exit code and what the command printed."""
    out, err = io.StringIO(), io.StringIO()
    argv = patch.object(sys, "argv", ["dagmap", *map(str, arguments)])
    with argv, redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as exit_:
        main()
    return int(exit_.value.code or 0), out.getvalue(), err.getvalue()


@pytest.fixture
def small(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(TEXT)
    return path


def test_a_run_prints_what_it_gave(small: Path) -> None:
    code, out, err = dagmap("simulate", small, "--seed", 3)
    assert code == 0 and "simulating" not in out
    for words in ("small, seed 3", "3, 0 of them liars", "on all", "times the least needed"):
        assert words in out
    assert "comparing maps" in err


def test_the_truth_is_named_with_what_it_needs(
    small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = " ".join(dagmap("simulate", small)[1].split())
    assert "accuracy" in out and "completeness" in out
    for module in (sys.modules["dagmap.cli.simulate"], truth):
        monkeypatch.setattr(module, "find_spec", lambda name: None)
    code, out, _ = dagmap("simulate", small)
    assert code == 0 and "dagmap[evaluate]" in out and "completeness" not in out


def test_json_is_one_object_with_all_figures(small: Path) -> None:
    code, out, _ = dagmap("simulate", small, "--seed", 3, "--json")
    report = json.loads(out)
    assert code == 0 and report["agreed"] is True
    expected = Mission(load_scenario(small), 3).run()
    for name in ("digest", "messages", "bytes_received", "transactions", "agreement_s"):
        assert report[name] == getattr(expected, name)
    assert report["quality"]["precision"] > 0.5 and report["lies"] is None


def test_the_timeline_goes_to_a_file_or_to_the_terminal(small: Path, tmp_path: Path) -> None:
    file = tmp_path / "timeline.txt"
    code, table, _ = dagmap("simulate", small, "--seed", 3, "--timeline", file)
    assert code == 0 and "small, seed 3" in table
    code, out, _ = dagmap("simulate", small, "--seed", 3, "--timeline", "-")
    assert code == 0 and out == file.read_text()
    lines = Timeline(lambda: mission.fleet.now)
    mission = Mission(load_scenario(small), 3, on_event=lines)
    mission.play()
    assert out.splitlines() == lines.lines
    at = [float(line.split()[0]) for line in out.splitlines()]
    assert at == sorted(at) and len(at) > 50


def test_recordings_are_found_beside_the_scenario(tmp_path: Path) -> None:
    for i, name in enumerate(("red.npz", "blue.npz")):
        save_cycles(tmp_path / name, [replace(c, colors=None) for c in cycles(i, count=5)])
    text = TEXT.replace("robots = 3", 'robots = 2\nrecordings = ["red.npz", "blue.npz"]')
    (tmp_path / "real.toml").write_text(text)
    code, out, _ = dagmap("simulate", tmp_path / "real.toml", "--json")
    report = json.loads(out)
    assert code == 0 and report["robots"] == 2 and report["quality"] is None
    assert report["transactions"] >= 8
    code, _, err = dagmap("simulate", tmp_path / "real.toml", "--seeds", 2)
    assert code == 2 and "recordings" in err


def test_a_map_of_recordings_is_judged_by_a_reference(tmp_path: Path) -> None:
    """The walls that `scene.cycles` shows are its truth; what lies half a metre off is not."""
    for i, name in enumerate(("red.npz", "blue.npz")):
        save_cycles(tmp_path / name, [replace(c, colors=None) for c in cycles(i, count=5)])
    text = 'reference = "truth.npz"\n' + TEXT.replace("robots = 3", "robots = 2")
    text = 'recordings = ["red.npz", "blue.npz"]\n' + text
    (tmp_path / "real.toml").write_text(text)
    scores = []
    for aside in (0.0, 0.5):
        wall = np.random.default_rng(7).uniform([2.0, -2.0, -1.0], [2.0, 2.0, 1.0], (300, 3))
        np.savez(tmp_path / "truth.npz", points=wall + np.array([aside, 0.0, 0.0]))
        code, out, _ = dagmap("simulate", tmp_path / "real.toml", "--json")
        assert code == 0
        scores.append(json.loads(out)["quality"])
    near, far = scores
    assert near["f_score"] > 0.5 and near["completeness"] < 0.3
    assert far["f_score"] < 0.1 and far["accuracy"] > near["accuracy"] + 0.2
    (tmp_path / "truth.npz").unlink()
    code, _, err = dagmap("simulate", tmp_path / "real.toml")
    assert code == 2 and "truth.npz" in err.replace("\n", "")


def test_a_place_for_the_timeline_is_looked_at_before_the_work(small: Path) -> None:
    with patch.object(Mission, "run", side_effect=AssertionError("it ran all the same")):
        code, _, err = dagmap("simulate", small, "--timeline", small.parent / "none" / "a.txt")
    assert code == 2 and "there is no such folder" in err.replace("\n", " ")


def test_recordings_of_robots_that_are_not_there_are_refused(small: Path) -> None:
    with pytest.raises(ConfigError, match="recordings of .'red'., but the robots are"):
        Mission(load_scenario(small), 1, {"red": cycles(0, count=2)})


def test_a_liar_that_the_seed_draws_has_its_recording(tmp_path: Path) -> None:
    for i, name in enumerate(("red.npz", "blue.npz")):
        save_cycles(tmp_path / name, [replace(c, colors=None) for c in cycles(i, count=5)])
    text = TEXT.replace("robots = 3", 'robots = 2\nrecordings = ["red.npz", "blue.npz"]')
    (tmp_path / "real.toml").write_text(text + '[[liars]]\nkind = "any"')
    code, out, _ = dagmap("simulate", tmp_path / "real.toml", "--seed", 2, "--timeline", "-")
    liar = next(line.split()[1] for line in out.splitlines() if " r00 " not in line)
    assert code == 0 and liar != "any00" and out.count(f" {liar} observes ") == 5


def test_robots_that_do_not_agree_are_exit_code_1(small: Path) -> None:
    small.write_text(TEXT.replace("seconds", "patience = 1.0\nseconds") + APART)
    code, out, _ = dagmap("simulate", small)
    assert code == 1 and "never" in out and "THE ROBOTS DISAGREE" in out


def test_a_sweep_without_a_failure(small: Path) -> None:
    code, out, _ = dagmap("simulate", small, "--seeds", 3, "--jobs", 1)
    assert (code, out) == (0, "3 runs, no promise broken\n")
    code, out, _ = dagmap("simulate", small, small, "--seeds", 2, "--jobs", 2, "--json")
    assert code == 0 and json.loads(out) == {"runs": 4, "failure": None}


def test_a_sweep_cuts_the_first_failure_down_to_what_it_takes(small: Path, tmp_path: Path) -> None:
    """What matters is the partition, which outlasts the patience; everything else goes."""
    text = TEXT.replace("seconds", "patience = 2.0\nseconds").replace("loss = 0.2", "tail = 0.01")
    small.write_text(text + APART)
    code, out, _ = dagmap("simulate", small, "--seed", 5, "--seeds", 2, "--jobs", 1)
    assert code == 1 and out.startswith("BROKEN with seed 5: no agreement")
    told, _, text = out.partition("\n\n")
    again = tmp_path / "again.toml"
    again.write_text(text)
    scenario = load_scenario(again)
    assert len(scenario.partitions) == 1 and not scenario.crashes
    assert scenario.robots == 2 and scenario.link.tail == 0 and scenario.seconds < 4.0
    failure = attempt(scenario, 5)
    assert failure is not None and failure.name == "no agreement" and failure.detail in told
    assert f"has {failure.timeline} events" in told
    assert len(timeline_of(scenario, 5)) == failure.timeline
    assert dagmap("simulate", again, "--seed", 5)[0] == 1


def test_an_exception_that_escapes_is_a_failure_with_its_seed(
    small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    receive, calls = Agent.receive, []

    def broken(agent: Agent, data: bytes, now: float) -> list:
        calls.append(data)
        if len(data) > 100:
            raise ZeroDivisionError("planted")
        return receive(agent, data, now)

    monkeypatch.setattr(Agent, "receive", broken)
    code, out, _ = dagmap("simulate", small, "--seeds", 1, "--jobs", 1, "--json")
    failure = json.loads(out)["failure"]
    assert code == 1 and failure["name"] == "ZeroDivisionError escaped" and failure["seed"] == 0
    assert failure["scenario"]["seconds"] < 4.0


@pytest.mark.parametrize("late", ["late = [1.0]", "late = [4.0]"])
def test_a_scenario_with_late_robots_is_cut_down_too(small: Path, late: str) -> None:
    small.write_text(TEXT.replace("seconds", f"{late}\npatience = 1.0\nseconds") + APART)
    code, out, _ = dagmap("simulate", small, "--seeds", 1, "--jobs", 1)
    assert code == 1 and "BROKEN" in out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["small.toml", "small.toml"], "--seeds"),
        (["nowhere.toml"], "nowhere.toml: cannot be read"),
        (["small.toml", "--seed", "-1"], "--seed"),
        (["small.toml", "--seeds", "0"], "--seeds"),
        (["small.toml", "--seeds", "1", "--timeline", "-"], "--timeline"),
        (["small.toml", "--json", "--timeline", "-"], "--json"),
        (["small.toml", "--timeline", "nowhere/timeline.txt"], "nowhere"),
        (["bad.toml"], "bad.toml: Link: loss = 2.0"),
        (["binary.toml"], "binary.toml: not a text file"),
        (["lost.toml"], "lost.npz"),
    ],
)
def test_mistakes_are_exit_code_2_and_one_message(
    small: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], words: str
) -> None:
    monkeypatch.chdir(small.parent)
    Path("bad.toml").write_text("[link]\nloss = 2.0")
    Path("binary.toml").write_bytes(b"\xff\xfe")
    Path("lost.toml").write_text('robots = 1\nrecordings = ["lost.npz"]')
    code, out, err = dagmap("simulate", *arguments)
    assert code == 2 and not out and words in err and "Traceback" not in err
