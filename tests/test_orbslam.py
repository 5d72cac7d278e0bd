"""Maps of ORB-SLAM3 in text: a trajectory of key frames, and points."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

import rig
from dagmap.io.sources import Options, describe_source, open_source
from dagmap.model import RecordingError
from test_replay import dagmap

COUNT = 4


def points() -> np.ndarray:
    """(300, 3) m on the wall that the cameras look at."""
    rng = np.random.default_rng(2)
    return np.column_stack([rng.uniform(-1, 1, (300, 2)), np.full(300, rig.ROOM[2])])


@pytest.fixture
def map_(tmp_path: Path) -> Path:
    path = tmp_path / "office"
    path.mkdir()
    (path / "KeyFrameTrajectory.txt").write_text(rig.tum(COUNT))
    (path / "MapPoints.txt").write_text(
        "# x y z\n" + "".join(f"{x} {y} {z}\n" for x, y, z in points())
    )
    return path


def placed(path: Path, options: Options | None = None) -> np.ndarray:
    """(N, 3) m in the world, by id."""
    found = {}
    for cycle in open_source(path, options):
        world = np.asarray(cycle.points) @ cycle.pose[:3, :3].T + cycle.pose[:3, 3]
        found.update(zip(np.asarray(cycle.ids).tolist(), world, strict=True))
    return np.array([found[id_] for id_ in sorted(found)])


def test_every_point_goes_out_once_with_the_nearest_key_frame(map_: Path) -> None:
    source = open_source(map_)
    cycles = list(source)
    assert len(source) == len(cycles) == COUNT
    assert [round(c.stamp * 1e9) - rig.START for c in cycles] == [
        pytest.approx(rig.STEP * i, abs=1000) for i in range(COUNT)
    ]
    assert np.allclose(placed(map_), points(), atol=1e-6)
    centres = np.array([cycle.pose[:3, 3] for cycle in cycles])
    for cycle in cycles:
        world = np.asarray(cycle.points) @ cycle.pose[:3, :3].T + cycle.pose[:3, 3]
        distance = np.linalg.norm(world[:, None] - centres, axis=2)
        assert (distance.argmin(axis=1) == cycles.index(cycle)).all()
    few = list(open_source(map_, Options(max_features=3)))
    assert max(len(cycle.points) for cycle in few) == 3
    found = describe_source(map_)
    assert (found.kind, found.cycles) == ("map of ORB-SLAM3", COUNT)
    assert [item.count for item in found.items] == [COUNT, 300]


def test_what_lies_before_no_key_frame_is_left_out(map_: Path) -> None:
    with (map_ / "MapPoints.txt").open("a") as file:
        file.write("0 0 -2\nnan 0 1\n9 0 2\n")
    source = open_source(map_)
    assert len(placed(map_)) == 300
    assert source.notes == ("3 of 303 points before no key frame",)  # type: ignore[attr-defined]
    assert len(placed(map_, Options(max_depth=1.0))) == 0


def test_other_names_and_kinds_of_files(map_: Path) -> None:
    (map_ / "KeyFrameTrajectory.txt").unlink()
    (map_ / "kf_dataset-MH01_mono.txt").write_text(rig.tum(COUNT, nanoseconds=True))
    (map_ / "MapPoints.txt").rename(map_ / "map_points.csv")
    text = (map_ / "map_points.csv").read_text().replace("# x y z", "x,y,z").replace(" ", ",")
    (map_ / "map_points.csv").write_text(text)
    assert np.allclose(placed(map_), points(), atol=1e-6)
    assert next(iter(open_source(map_))).stamp == pytest.approx(rig.START / 1e9, abs=1e-6)
    (map_ / "map_points.csv").unlink()
    rows = np.array([tuple(p) for p in points()], [("x", "f8"), ("y", "f8"), ("z", "f8")])
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(map_ / "PointCloud.ply"))
    assert np.allclose(placed(map_), points(), atol=1e-6)


@pytest.mark.parametrize("place", ["mav0/cam0", "cam0", "."])
def test_key_frames_of_the_body_are_brought_to_the_camera(map_: Path, place: str) -> None:
    (map_ / "KeyFrameTrajectory.txt").unlink()
    (map_ / "kf_dataset-MH01_stereoi.txt").write_text(rig.tum(COUNT, nanoseconds=True, body=True))
    doubt = describe_source(map_).notes[1]
    assert doubt.startswith("the stamps of kf_dataset-MH01_stereoi.txt are in ns")
    assert "--body-poses" in doubt and "--same-frame" in doubt
    known = describe_source(map_, Options(same_frame=True)).notes
    assert doubt not in known and len(known) == 2
    body = Options(body_poses=True)
    with pytest.raises(RecordingError, match="mav0/cam0/sensor.yaml: missing; .*T_BS"):
        open_source(map_, body)
    (map_ / place).mkdir(parents=True, exist_ok=True)
    (map_ / place / "sensor.yaml").write_text(rig.sensor_yaml(0))
    for i, cycle in enumerate(open_source(map_, body)):
        assert np.allclose(cycle.pose, rig.camera_pose(i), atol=1e-6)
    assert np.allclose(placed(map_, body), points(), atol=1e-6)
    assert (
        f"brought to the camera by {map_ / place / 'sensor.yaml'}"
        in describe_source(map_, body).notes[1]
    )
    run = dagmap("inspect", map_, "--body-poses")
    assert run.returncode == 0 and "brought to the camera" in run.stdout


def test_a_map_to_share(map_: Path, tmp_path: Path) -> None:
    run = dagmap("replay", map_, "--out", tmp_path / "out", "--json")
    assert run.returncode == 0, run.stderr
    assert json.loads(run.stdout)["map"]["nodes"] > 200


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        ("KeyFrameTrajectory.txt", "", "KeyFrameTrajectory.txt: no poses; a line `stamp x y z"),
        ("KeyFrameTrajectory.txt", "1 2 3\n", "KeyFrameTrajectory.txt, line 1: 8 finite numbers"),
        ("KeyFrameTrajectory.txt", "1 0 0 0 0 0 0 9\n", "line 1: a quaternion of length 9"),
        ("MapPoints.txt", "", "MapPoints.txt: no points; save the map"),
        ("MapPoints.txt", "1 2 3\n1 2\n", "MapPoints.txt, line 2: `x y z` is wanted.*--keep-going"),
        ("MapPoints.txt", "0 0 1e9\n", "MapPoints.txt: .*--keep-going"),
    ],
)
def test_bad_texts_are_named(map_: Path, file: str, text: str, said: str) -> None:
    (map_ / file).write_text(text)
    with pytest.raises(RecordingError, match=said):
        list(open_source(map_))


def test_key_frames_that_are_damaged_are_left_out(map_: Path) -> None:
    file = map_ / "KeyFrameTrajectory.txt"
    file.write_text(file.read_text()[:-30])
    with pytest.raises(
        RecordingError, match="line 4: 8 finite numbers .* are wanted.*--keep-going"
    ):
        open_source(map_)
    assert len(open_source(map_, Options(keep_going=True))) == COUNT - 1


def test_half_of_a_map_is_named(map_: Path) -> None:
    (map_ / "KeyFrameTrajectory.txt").rename(map_ / "other")
    with pytest.raises(
        RecordingError, match="office: .*no KeyFrameTrajectory.txt beside MapPoints"
    ):
        open_source(map_)
    (map_ / "MapPoints.txt").unlink()
    (map_ / "other").rename(map_ / "KeyFrameTrajectory.txt")
    with pytest.raises(RecordingError, match="office: .*no MapPoints.txt beside KeyFrameTraj"):
        open_source(map_)


def test_lines_that_are_no_points_are_left_out_where_that_is_asked_for(map_: Path) -> None:
    with (map_ / "MapPoints.txt").open("a") as file:
        file.write("1 2\n0 0 2\n")
    assert len(placed(map_, Options(keep_going=True))) == 301
