"""Each experiment in a small setting: what its JSON says, not only that it wrote one."""

from __future__ import annotations

import json
import re
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import agreement
import all as everything
import common
import completion
import feature_poor
import figure_07
import figure_10
import figure_11
import section_5
import sensors

Row = dict[str, Any]
FOLDER = Path(common.__file__).parent


def checked(out: Path, result: Row, *pictures: str) -> Row:
    """The JSON that an experiment wrote is what it gave; its pictures are not empty."""
    path = out / f"{result['experiment']}.json"
    written = json.loads(path.read_text())
    assert written == json.loads(json.dumps(result))
    assert written["paper"] and written["measured"]
    for name in pictures or (f"{result['experiment']}.png",):
        data = (out / name).read_bytes()
        width, height = struct.unpack(">II", data[16:24])
        assert data[1:4] == b"PNG" and min(width, height) > 300
    return result


def test_figure_7_is_the_papers(tmp_path: Path) -> None:
    result = checked(tmp_path, figure_07.run(tmp_path))
    printed = [int(number) for number in re.findall(r"\d+", figure_07.PAPER)]
    numbers = [result["nodes_hit"], result["added_with_a_miss"], result["nodes"]]
    assert numbers == printed == [5, 4, 13]
    assert result["nodes_added"] == 4 and result["same_map_on_both"]
    assert result["features_sent"] == [9, 9] and result["bundles_sent"] == [1, 1]


def test_figure_10_counts_what_is_dropped_and_where(tmp_path: Path) -> None:
    pictures = ("figure_10.png", "figure_10_noisy.png")
    result = checked(tmp_path, figure_10.run(tmp_path, most=3), *pictures)
    plain, noisy, held = result["cases"]
    for row in result["cases"]:
        assert row["agree"]
        true, wrong = row["true_points"], row.get("displaced_points")
        for part in (true, wrong) if wrong else (true,):
            shares = [part[key] for key in ("not_sent", "sent_then_rejected", "in_the_map")]
            assert sum(shares) == pytest.approx(1.0) and min(shares) >= 0
    assert "displaced_points" not in plain
    # With V_th = 1 everything goes out and consensus sorts; with 3 validation keeps most back.
    assert noisy["displaced_points"]["not_sent"] == 0
    assert held["displaced_points"]["not_sent"] > 0.8
    assert held["true_points"]["not_sent"] < 0.4
    assert sum(held["halfway"]["not_broadcast"]) > sum(noisy["halfway"]["not_broadcast"])
    assert sum(plain["halfway"]["merged"]) <= sum(plain["halfway"]["broadcast"])
    assert sum(noisy["map"].values()) > sum(held["map"].values())


def test_figure_11_has_less_of_a_peak_with_dagmap(tmp_path: Path) -> None:
    pictures = ("figure_11_office.png", "figure_11_hour.png")
    result = checked(tmp_path, figure_11.run(tmp_path, seconds=40.0, cycles=24), *pictures)
    assert [row["case"] for row in result["cases"]] == ["office", "hour"]
    for row in result["cases"]:
        total = row["all"]
        assert total["part"] == total["peak_to_mean_with"] / total["peak_to_mean_without"]
        assert total["part"] < 0.5 and total["bytes"] > 0
        assert total["features_with"] == total["features_without"] > 0  # the same, only later
        assert total["features_with"] == sum(each["features_with"] for each in row["robots"])
    assert result["cases"][1]["seconds"] == 40.0


def test_section_5_has_both_readings_beside_what_was_measured(tmp_path: Path) -> None:
    result = checked(tmp_path, section_5.run(tmp_path, most=3_000))
    sizes = result["n_u"]
    assert [row["n_u"] for row in sizes][-3:] == [100_000, 1_000_000, 10_000_000]
    assert [row["measured_ms"] for row in sizes][-3:] == [None] * 3
    assert all(row["measured_ms"] > 0 for row in sizes[:-3])
    assert all(row["learnt"] == (row["n_u"] <= 10_000) for row in sizes)
    last = sizes[-1]
    assert last["paper_meant_ms"] > last["paper_printed_ms"] > 5 * last["own_ms"] > 0
    assert [row["n_c"] for row in result["n_c"]] == [2, 3, 4, 6, 8]
    assert [row["n_g"] for row in result["n_g"]] == [2, 4, 8, 16, 32]
    assert result["growth"]["n_g"]["own_ms"] > 2


def test_completion_judges_the_claim(tmp_path: Path) -> None:
    result = checked(tmp_path, completion.run(tmp_path, 20, (1, 64), (2, 8), (2, 8)))
    for scene in ("wall", "room"):
        usual, *_, strict = result["judged"][scene]
        assert usual["v_th"] == 1 and not usual["claim_holds"]
        assert usual["cycles"][0] == usual["cycles"][1]
        assert strict["v_th"] == 64 and strict["claim_holds"]
        assert strict["covered"][1] < strict["covered"][0]


def test_agreement_comes_whatever_the_network(tmp_path: Path) -> None:
    result = checked(tmp_path, agreement.run(tmp_path, seconds=12.0))
    quiet, *_, trouble = result["cases"]
    assert all(row["agreed"] for row in result["cases"])
    apart = [sum(share for at, share in row["lacking"] if 3 <= at <= 6) for row in (quiet, trouble)]
    assert apart[1] > 2 * apart[0]  # the halves do not hear each other then
    assert all(row["lacking"][-1][1] < 0.2 for row in result["cases"])
    assert quiet["agreement_s"] < trouble["agreement_s"]


def test_what_is_learned_suits_sparse_sensors(tmp_path: Path) -> None:
    kinds = ("mono", sensors.MIXED)
    result = checked(tmp_path, sensors.run(tmp_path, 15.0, kinds, (0.05,)))
    assert [row["robots"] for row in result["cases"]] == [3, 4]
    for row in result["cases"]:
        ways = ("defaults", "dense", "tuned")
        assert all(each["agree"] for each in (*(row[way] for way in ways), *row["grid"]))
        assert row["defaults"]["f_10_cm"] > row["dense"]["f_10_cm"] + 0.05
        assert row["defaults"]["true_rejected"] < 0.1 < row["dense"]["true_rejected"]
        assert row["best_of_grid"]["f_10_cm"] == max(each["f_10_cm"] for each in row["grid"])
        assert [each["doubt"] for each in row["grid"]] == ["learned", 20, 36]
    assert "f_5_cm" in result["cases"][0]["tuned"]


def test_where_features_are_few_the_defaults_hold(tmp_path: Path) -> None:
    result = checked(tmp_path, feature_poor.run(tmp_path, 15.0, (100, 15, 1)))
    rich, poor, barren = result["cases"]
    assert [row["points_a_cycle"] for row in result["cases"]] == [100, 15, 1]
    assert rich["defaults"]["f_10_cm"] > 0.9 and rich["tuned"]["f_10_cm"] > 0.9
    assert poor["defaults"]["f_10_cm"] > 0.8 and poor["tuned"]["f_10_cm"] > 0.8
    assert poor["V_th = 3"]["issued"] < rich["V_th = 3"]["issued"] < rich["defaults"]["issued"]
    assert "tuned" not in barren and "no cycle has two points" in barren["refused"]
    assert "tune refuses" in result["measured"][2]


def test_all_of_them_are_run_by_make_figures() -> None:
    modules = {path.stem for path in FOLDER.glob("*.py")} - {"all", "common", "studies"}
    assert modules == set(everything.ALL)


def test_an_experiment_runs_alone(tmp_path: Path) -> None:
    command = [sys.executable, str(FOLDER / "figure_07.py"), "--out", str(tmp_path / "new")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "13 nodes in the end" in done.stdout
    assert (tmp_path / "new" / "figure_07.json").exists()


@pytest.mark.parametrize(
    ("name", "option", "value", "says"),
    [
        ("figure_11", "--seconds", "-5", "a number from 20"),
        ("figure_11", "--points", "0", "a whole number from 1"),
        ("section_5", "--most", "1e6", "a whole number from 3,000"),
        ("agreement", "--seconds", "nan", "a number from 6"),
        ("completion", "--cycles", "-1", "a whole number from 10"),
        ("sensors", "--seconds", "x", "a number from 5"),
        ("feature_poor", "--seconds", "0", "a number from 5"),
        ("figure_07", "--out", __file__, "no folder can be made"),
        ("all", "--jobs", "0", "a whole number from 1"),
    ],
)
def test_an_option_that_makes_no_sense_is_refused_in_a_line(
    name: str, option: str, value: str, says: str
) -> None:
    command = [sys.executable, str(FOLDER / f"{name}.py"), option, value]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert option in done.stderr and value in done.stderr and says in done.stderr
