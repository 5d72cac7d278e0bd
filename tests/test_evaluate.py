"""`dagmap evaluate` and what it measures, on clouds whose scores follow by hand."""

from __future__ import annotations

import io
import json
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from dagmap import metrics
from dagmap.cli import main
from dagmap.io.clouds import read_cloud
from dagmap.io.export import PlyMap, write_ply
from dagmap.io.sources import save_cycles
from dagmap.model import Cycle, DagmapError, RecordingError


def dagmap(*arguments: object) -> tuple[int, str, str]:
    out, err = io.StringIO(), io.StringIO()
    argv = patch.object(sys, "argv", ["dagmap", *map(str, arguments)])
    with argv, redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as exit_:
        main()
        raise SystemExit(0)
    return int(exit_.value.code or 0), out.getvalue(), err.getvalue()


def row(*x: float) -> np.ndarray:
    """Points on the x axis."""
    return np.array([[value, 0.0, 0.0] for value in x])


def wall(z: float, pitch: float = 0.025, size: int = 40) -> np.ndarray:
    """A square metre, points in the middle of the cubes of the thinning."""
    x, y = np.meshgrid((np.arange(size) + 0.5) * pitch, (np.arange(size) + 0.5) * pitch)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1)


def write_map(path: Path, positions: np.ndarray, states: np.ndarray | None = None) -> Path:
    n = len(positions)
    zeros = np.zeros(n, np.int64)
    states = np.zeros(n, np.uint8) if states is None else states.astype(np.uint8)
    write_ply(path, PlyMap(positions, np.zeros((n, 3), np.uint8), states, zeros, zeros, zeros))
    return path


def write_ascii(path: Path, lines: list[str], count: int | None = None) -> Path:
    head = ["ply", "format ascii 1.0", f"element vertex {len(lines) if count is None else count}"]
    head += [f"property double {name}" for name in "xyz"] + ["end_header"]
    path.write_text("\n".join([*head, *lines]) + "\n")
    return path


def test_thinning_keeps_the_first_point_of_each_cube() -> None:
    cloud = row(0.030, 0.001, 0.002, 0.031, -0.001)
    assert metrics.thin(cloud)[:, 0].tolist() == [-0.001, 0.001, 0.030]


def test_scores_of_a_row_of_points_follow_by_hand() -> None:
    # the map is off by 0, 3 and 7 cm, and has one point 50 cm from everything; it lacks one
    estimate, reference = row(0.0, 1.03, 2.07, 3.5), row(0.0, 1.0, 2.0, 4.0)
    found = metrics.score(estimate, reference)
    assert (found.points, found.reference_points, found.recall_points) == (4, 4, 4)
    off = np.array([0.0, 0.03, 0.07, 0.5])
    for got in (found.accuracy, found.completeness):
        assert got.mean == pytest.approx(off.mean())
        assert got.rmse == pytest.approx(np.sqrt((off**2).mean()))
        assert got.p95 == pytest.approx(np.percentile(off, 95))
    assert [(at.threshold, at.precision, at.recall) for at in found.at] == [
        (0.02, 0.25, 0.25),
        (0.05, 0.5, 0.5),
        (0.10, 0.75, 0.75),
    ]
    assert found.f_score(0.10) == pytest.approx(0.75)
    assert found.chamfer_l1 == pytest.approx(off.mean())
    assert found.chamfer_l2 == pytest.approx(2 * (off**2).mean())
    assert found.mean_map_entropy is None and found.double_walls is None


def test_recall_is_measured_against_its_own_reference() -> None:
    found = metrics.score(row(0.0, 1.0), row(0.0, 1.0, 2.0, 3.0), row(0.0))
    assert [(at.precision, at.recall, at.f_score) for at in found.at] == [(1.0, 1.0, 1.0)] * 3
    found = metrics.score(row(0.0, 1.0), row(0.0, 1.0, 2.0, 3.0))
    assert [(at.precision, at.recall) for at in found.at] == [(1.0, 0.5)] * 3
    assert found.f_score(0.05) == pytest.approx(2 / 3)


def test_a_place_that_was_seen_often_counts_once() -> None:
    often = np.concatenate([row(0.0), np.repeat(row(5.0), 98, axis=0) + 1e-4, row(1.0)])
    assert metrics.score(often, row(0.0, 1.0)).at[0].precision == pytest.approx(2 / 3)


def test_f_is_zero_where_nothing_agrees() -> None:
    assert [at.f_score for at in metrics.score(row(0.0), row(9.0)).at] == [0.0, 0.0, 0.0]


def test_entropy_is_that_of_the_covariance_around_each_point() -> None:
    # 6 points within 30 cm of each other: one covariance for all of them
    cloud = np.array([[x, y, z] for x, y, z in np.ndindex(2, 3, 1)]) * 0.1
    spread = np.linalg.eigvalsh(np.cov(cloud.T))
    assert spread[0] == pytest.approx(0.0)
    expected = 0.5 * np.log(2 * np.pi * np.e * np.maximum(spread, 1e-6)).sum()
    assert metrics.mean_map_entropy(cloud) == pytest.approx(expected)
    rough = wall(0.01) + np.random.default_rng(1).normal(0, [0, 0, 0.01], (1600, 3))
    crisp, blurred = metrics.mean_map_entropy(wall(0.01)), metrics.mean_map_entropy(rough)
    assert crisp is not None and blurred is not None and crisp < blurred


def test_a_wall_that_is_there_twice_is_seen_and_a_rough_one_is_not() -> None:
    single, noise = wall(0.01), np.random.default_rng(2).normal(0, [0, 0, 0.012], (1600, 3))
    twice = np.concatenate([wall(0.01), wall(0.06)])
    assert metrics.double_walls(single, single) == 0.0
    assert metrics.double_walls(single + noise, single) == 0.0
    assert metrics.double_walls(twice, single) == 1.0
    assert metrics.double_walls(twice, twice) is None  # two walls are really there: not flat
    half = twice[(twice[:, 2] < 0.03) | (twice[:, 0] < 0.5)]
    share = metrics.double_walls(half, single)
    assert share is not None and 0.5 < share < 0.8  # patches count by the map's points


@pytest.mark.parametrize(
    ("cloud", "what"),
    [
        (np.zeros((0, 3)), "no points in it"),
        (np.array([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]]), "point 1 .* is not finite"),
        (np.zeros((4, 2)), r"shape \(4, 2\)"),
        (np.zeros(3), r"shape \(3,\)"),
    ],
)
def test_what_is_no_cloud_is_named(cloud: np.ndarray, what: str) -> None:
    with pytest.raises(DagmapError, match=f"the map: {what}"):
        metrics.score(cloud, row(0.0))
    with pytest.raises(DagmapError, match=f"the reference: {what}"):
        metrics.score(row(0.0), cloud)
    with pytest.raises(DagmapError, match=f"the recall reference: {what}"):
        metrics.score(row(0.0), row(0.0), cloud)


def test_without_scipy_the_extra_is_named() -> None:
    with (
        patch.dict(sys.modules, {"scipy": None, "scipy.spatial": None}),
        pytest.raises(DagmapError, match=r"needs scipy.*dagmap\[evaluate\]"),
    ):
        metrics.score(row(0.0), row(0.0))


def test_the_command_scores_what_is_kept_unless_told_otherwise(tmp_path: Path) -> None:
    states = np.array([0, 1, 2])
    world = write_map(tmp_path / "map.ply", row(0.0, 1.0, 9.0), states)
    truth = write_ascii(tmp_path / "truth.ply", ["0 0 0", "1 0 0"])
    code, out, err = dagmap("evaluate", world, "--reference", truth, "--json")
    assert (code, err) == (0, "")
    found = json.loads(out)
    assert found["thinned_to"] == 0.025 and found["points"] == 2
    assert found["at"][1] == {"threshold": 0.05, "precision": 1.0, "recall": 1.0, "f_score": 1.0}
    for names, points in (("rejected", 1), ("confirmed,tentative,rejected", 3), ("confirmed", 1)):
        _, out, _ = dagmap("evaluate", world, "--reference", truth, "--json", "--states", names)
        assert json.loads(out)["points"] == points
    np.savez(tmp_path / "part.npz", points=row(0.0))
    more = ("--recall-reference", tmp_path / "part.npz", "--states", "confirmed")
    _, out, _ = dagmap("evaluate", world, "--reference", truth, "--json", *more)
    assert json.loads(out)["at"][0]["recall"] == 1.0


def test_the_command_shows_a_table_and_draws_a_picture(tmp_path: Path) -> None:
    world = write_map(tmp_path / "map.ply", wall(0.01))
    truth = write_map(tmp_path / "truth.ply", wall(0.013))
    picture = tmp_path / "error.png"
    code, out, _ = dagmap("evaluate", world, "--reference", truth, "--picture", picture)
    assert code == 0 and "F-score" in out and "Chamfer L1" in out and "3.00 mm" in out
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_clouds_are_read_from_ply_and_npz_of_any_origin(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", positions=row(1.0), states=np.array([2]))
    cloud = read_cloud(tmp_path / "a.npz")
    assert cloud.positions.tolist() == [[1.0, 0.0, 0.0]]
    assert cloud.states is not None and cloud.states.tolist() == [2]
    assert read_cloud(write_ascii(tmp_path / "b.ply", ["1 2 3"])).positions.tolist() == [[1, 2, 3]]
    pose = np.eye(4)
    pose[:3, 3] = [0.0, 0.0, 1.0]
    cycles = [Cycle(0.0, np.eye(4), row(1.0)), Cycle(1.0, pose, row(2.0))]
    save_cycles(tmp_path / "c.npz", cycles)  # a cycle stream is put together by its poses
    assert read_cloud(tmp_path / "c.npz").positions.tolist() == [[1, 0, 0], [2, 0, 1]]


@pytest.mark.parametrize(
    ("name", "content", "what"),
    [
        ("missing.ply", None, r"cannot be read \(No such file"),
        ("picture.ply", b"\x89PNG\r\n", "neither a PLY nor an NPZ"),
        ("empty.npz", b"", "neither a PLY nor an NPZ"),
        ("cut.npz", b"PK\x03\x04 and no more", "damaged or no .npz file"),
        (
            "flat.ply",
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n",
            "its vertices lack y, z",
        ),
    ],
)
def test_a_file_that_is_no_cloud_is_named(
    tmp_path: Path, name: str, content: bytes | None, what: str
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(RecordingError, match=f"{name}: .*{what}"):
        read_cloud(tmp_path / name)


def test_wrong_arrays_and_lines_are_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", places=row(0.0))
    with pytest.raises(RecordingError, match=r"a.npz: no array positions or points"):
        read_cloud(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", points=row(0.0), states=np.zeros(2))
    with pytest.raises(RecordingError, match=r"b.npz: states \(2,\) for 1 points"):
        read_cloud(tmp_path / "b.npz")
    np.savez(tmp_path / "c.npz", points=row(0.0), pose=np.zeros((2, 4, 4)))
    with pytest.raises(RecordingError, match=r"c.npz: pose, offsets and points"):
        read_cloud(tmp_path / "c.npz")
    for lines, count, what in (
        (["1 2 three"], None, "a line of its vertices is wrong"),
        (["1 2"], None, "2 numbers in a line"),
        (["1 2 3"], 5, "5 nodes are promised, 1 are there"),
    ):
        with pytest.raises(RecordingError, match=what):
            read_cloud(write_ascii(tmp_path / "d.ply", lines, count))


def test_mistakes_at_the_command_get_one_line(tmp_path: Path) -> None:
    world = write_map(tmp_path / "map.ply", row(0.0), np.array([2]))
    truth = write_ascii(tmp_path / "truth.ply", ["0 0 nan"])
    none = write_ascii(tmp_path / "none.ply", [])
    for arguments, what in (
        ((world, "--reference", none), "map.ply (confirmed,tentative nodes): no points in it"),
        ((none, "--reference", world), "none.ply: no points in it"),
        ((world, "--reference", truth, "--states", "rejected"), "truth.ply: point 0"),
        ((world, "--reference", world, "--states", "good"), "--states: there is no 'good'"),
        ((tmp_path, "--reference", world), "cannot be read"),
    ):
        code, out, err = dagmap("evaluate", *arguments)
        assert code == 2 and out == "" and what in err and err.count("\n") == 1
