"""EuRoC folders: a room that two cameras see, its depth, its poses, and what may be wrong."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

import rig
from dagmap.io.sources import Options, describe_source, open_source
from dagmap.io.sources._poses import inverse
from dagmap.model import ConfigError, Cycle, RecordingError
from test_replay import dagmap

COUNT = 5
CAMERAS = ("cam0", "cam1")
TRUTH = "state_groundtruth_estimate0"


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rig.write_rig(tmp_path_factory.mktemp("euroc") / "walk", COUNT)


@pytest.fixture
def walk(rendered: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(rendered, tmp_path / "walk"))


def off(cycles: list[Cycle]) -> np.ndarray:
    """Distances from the walls in pixels of disparity: depth has its noise there."""
    found = []
    for cycle in cycles:
        world = np.asarray(cycle.points) @ cycle.pose[:3, :3].T + cycle.pose[:3, 3]
        depth = np.asarray(cycle.points)[:, 2]
        found.append(rig.off_walls(world) * 200 * rig.BASELINE / depth**2)
    return np.concatenate(found)


def check(cycles: list[Cycle]) -> None:
    """Points on the walls, whatever the lenses do; poses of the camera, turned by rectifying."""
    assert [cycle.stamp for cycle in cycles] == [
        pytest.approx((rig.START + rig.STEP * i) / 1e9, abs=1e-6) for i in range(COUNT)
    ]
    for i, cycle in enumerate(cycles):
        assert len(cycle.points) > 400 and cycle.descriptors is not None
        assert np.allclose(cycle.pose[:3, 3], rig.camera_pose(i)[:3, 3], atol=1e-6)
        turned = cycle.pose[:3, :3].T @ rig.camera_pose(i)[:3, :3]
        assert np.trace(turned) > 1 + 2 * np.cos(0.05)
    noise = off(cycles)
    assert np.median(noise) < 0.1 and np.quantile(noise, 0.95) < 0.5  # pixels
    depths = np.concatenate([np.asarray(cycle.points)[:, 2] for cycle in cycles])
    assert depths.min() < 2.2 and depths.max() > 2.6  # more than one wall


def test_depth_and_poses_are_those_of_the_room(walk: Path) -> None:
    source = open_source(walk)
    cycles = list(source)
    assert (source.name, len(source), source.dropped) == ("walk", COUNT, 0)  # type: ignore[attr-defined]
    check(cycles)
    again = list(open_source(walk / "mav0"))
    assert open_source(walk / "mav0").name == "walk"
    assert all(np.array_equal(a.points, b.points) for a, b in zip(cycles, again, strict=True))
    found = describe_source(walk)
    assert found.cycles == COUNT and found.notes == (f"poses of {TRUTH}",)
    assert [item.count for item in found.items] == [COUNT, COUNT]


def test_lenses_of_the_fisheye_model(tmp_path: Path) -> None:
    check(list(open_source(rig.write_rig(tmp_path / "walk", COUNT, fisheye=True))))


@pytest.mark.parametrize("nanoseconds", [False, True])
def test_poses_of_a_slam(walk: Path, tmp_path: Path, nanoseconds: bool) -> None:
    (tmp_path / "slam.txt").write_text(rig.tum(COUNT, nanoseconds))
    shutil.rmtree(walk / "mav0" / TRUTH)
    check(list(open_source(walk, Options(poses=tmp_path / "slam.txt"))))


def test_poses_of_an_inertial_slam(walk: Path, tmp_path: Path) -> None:
    (tmp_path / "f_walk.txt").write_text(rig.tum(COUNT, nanoseconds=True, body=True))
    shutil.rmtree(walk / "mav0" / TRUTH)
    options = Options(poses=tmp_path / "f_walk.txt", body_poses=True)
    check(list(open_source(walk, options)))
    (note,) = describe_source(walk, options).notes
    assert note == f"poses of {tmp_path / 'f_walk.txt'}, those of the body"


def test_poses_that_may_be_those_of_the_body_are_told_of(walk: Path, tmp_path: Path) -> None:
    poses = tmp_path / "f_walk.txt"
    poses.write_text(rig.tum(COUNT, nanoseconds=True))
    _, doubt = describe_source(walk, Options(poses=poses)).notes
    assert "taken for those of the left camera" in doubt and "--body-poses" in doubt
    assert len(describe_source(walk, Options(poses=poses, same_frame=True)).notes) == 1
    run = dagmap("inspect", walk, "--poses", poses, "--body-poses")
    assert "those of the body" in run.stdout and doubt not in run.stdout
    poses.write_text(rig.tum(COUNT))  # in s: ORB-SLAM3 saves these of the camera always
    assert describe_source(walk, Options(poses=poses)).notes == (f"poses of {poses}",)
    with pytest.raises(ConfigError, match="body_poses and same_frame"):
        Options(body_poses=True, same_frame=True)


def test_pictures_alone_suffice(walk: Path) -> None:
    shutil.rmtree(walk / "mav0" / TRUTH)
    source = open_source(walk)
    assert source.notes == (f"no {TRUTH}: odometry by OpenCV",)  # type: ignore[attr-defined]
    for i, cycle in enumerate(source):
        truth = inverse(rig.camera_pose(0)) @ rig.camera_pose(i)
        assert cycle.session == 0
        assert np.linalg.norm(cycle.pose[:3, 3] - truth[:3, 3]) < 0.05  # of 0.27 m


def test_names_of_files_are_stamps_too(walk: Path) -> None:
    for camera in CAMERAS:
        (walk / "mav0" / camera / "data.csv").unlink()
    check(list(open_source(walk)))
    (walk / "mav0" / "cam0" / "data" / "left.png").write_bytes(b"")
    with pytest.raises(RecordingError, match="'left' is no stamp in ns"):
        open_source(walk)


def test_pictures_without_a_partner_or_a_pose_are_dropped(walk: Path) -> None:
    right = walk / "mav0" / "cam1" / "data.csv"
    right.write_text("".join(right.read_text().splitlines(keepends=True)[:-1]))
    truth = walk / "mav0" / TRUTH / "data.csv"
    head, _first, *rest = truth.read_text().splitlines(keepends=True)
    truth.write_text(head + "".join(rest))
    source = open_source(walk)
    assert (len(source), len(list(source)), source.dropped) == (3, 3, 2)  # type: ignore[attr-defined]


def test_a_pair_becomes_a_map(walk: Path, tmp_path: Path) -> None:
    run = dagmap("replay", walk, "--max-features", "200", "--out", tmp_path / "out", "--json")
    assert run.returncode == 0, run.stderr
    assert json.loads(run.stdout)["map"]["nodes"] > 100


Change = Callable[[Path], None]


def sensor(camera: int, **changed: str) -> Change:
    def change(mav: Path) -> None:
        (mav / f"cam{camera}" / "sensor.yaml").write_text(rig.sensor_yaml(camera, **changed))

    return change


def write(name: str, text: str) -> Change:
    return lambda mav: (mav / name).write_text(text) and None


def remove(name: str) -> Change:
    def change(mav: Path) -> None:
        shutil.rmtree(mav / name) if (mav / name).is_dir() else (mav / name).unlink()

    return change


def without(key: str) -> Change:
    def change(mav: Path) -> None:
        file = mav / "cam0" / "sensor.yaml"
        lines = [line for line in file.read_text().splitlines() if not line.startswith(key)]
        file.write_text("\n".join(lines))

    return change


def later(mav: Path) -> None:
    """The right camera's clock is 20 ms off, of pictures that are 50 ms apart."""
    lines = "".join(f"{rig.START + rig.STEP * i + 20_000_000},{rig.START}.png\n" for i in range(5))
    (mav / "cam1" / "data.csv").write_text(lines)


def tiny(mav: Path) -> None:
    for camera in (0, 1):
        sensor(camera, resolution="[8, 8]")(mav)


def swapped(mav: Path) -> None:
    for a, b in (("cam0", "x"), ("cam1", "cam0"), ("x", "cam1")):
        (mav / a).rename(mav / b)


FIRST = f"{rig.START}.png"
FAR = "[1,0,0,0, 0,1,0,500, 0,0,1,0, 0,0,0,1]"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (remove("cam1"), "cam1: no folder data/ with pictures"),
        (remove("cam0/sensor.yaml"), "cam0/sensor.yaml: missing; the calibration"),
        (write("cam0/sensor.yaml", ""), "cam0/sensor.yaml: no T_BS; a list of 16 numbers"),
        (without("intrinsics"), "no intrinsics; a list of 4 numbers"),
        (without("resolution"), "no resolution; a list of 2 numbers"),
        (sensor(0, T_BS="[1, 2, 3]"), "T_BS is no list of 16 numbers"),
        (sensor(0, T_BS=f"[{', '.join(['1'] * 16)}]"), "T_BS holds no rotation"),
        (sensor(0, intrinsics="[1, 2, x, 4]"), "intrinsics is no list of 4 numbers"),
        (sensor(0, intrinsics="[0, 200, 1, 1]"), "intrinsics .* more than 0"),
        (sensor(0, resolution="[99999, 99999]"), "resolution .99999, 99999.; .* no more pixels"),
        (sensor(0, resolution="[1e999, 2]"), "resolution is no list of 2 numbers"),
        (sensor(0, distortion_model="magic"), "distortion models .*, not 'magic'"),
        (sensor(0, distortion_coefficients="[1]"), "is no list of 0 or 4 or 5 numbers"),
        (sensor(1, T_BS=FAR), "5e.02 m apart by their T_BS|500 m apart by their T_BS"),
        (sensor(1, resolution="[320, 241]"), "cam0 has .320, 240. pixels, cam1 .320, 241."),
        (tiny, "pictures of 8 x 8 pixels by sensor.yaml; 32 x 32 at least"),
        (swapped, "cam0 is the right camera by T_BS; swap"),
        (later, "not synchronised: the nearest of their 5 and 5 pictures are 20 ms apart"),
        (write("cam0/data.csv", "#none\n"), "cam0: an empty recording"),
        (write("cam0/data.csv", "1,2,3\n"), "data.csv, line 1: `stamp in ns,file` is wanted"),
        (write("cam0/data.csv", "1.5,a.png\n"), "data.csv, line 1: '1.5' is no stamp in ns"),
        (write("cam0/data.csv", "2,a.png\n1,b.png\n"), "line 2: the stamp 1 does not come after 2"),
        (write(f"{TRUTH}/data.csv", "1,2,3\n"), "line 1: `stamp x y z qw qx qy qz` is wanted"),
        (write(f"{TRUTH}/data.csv", "1,0,0,0,9,0,0,0\n"), "the quaternion of length 1"),
        (write(f"{TRUTH}/data.csv", "1,0,0,0,1,0,0,0\n"), "none of 5 pairs .* same clock"),
        (write(f"{TRUTH}/data.csv", "#\n"), "no poses; remove the file for odometry"),
        (remove(f"cam1/data/{FIRST}"), f"{FIRST}: missing; the recording needs it"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(walk: Path, change: Change, said: str) -> None:
    change(walk / "mav0")
    with pytest.raises(RecordingError, match=said) as caught:
        list(open_source(walk))
    assert str(walk) in str(caught.value) and "\n" not in str(caught.value)


def test_damaged_pictures_are_left_out_where_that_is_asked_for(walk: Path) -> None:
    pictures = sorted((walk / "mav0" / "cam1" / "data").iterdir())
    pictures[1].write_bytes(pictures[1].read_bytes()[:-40])
    cv2.imwrite(str(pictures[3]), np.zeros((10, 10), np.uint8))
    with pytest.raises(RecordingError, match=r"truncated or damaged.*--keep-going"):
        list(open_source(walk))
    source = open_source(walk, Options(keep_going=True))
    assert len(list(source)) == COUNT - 2
    told = source.skips.told
    assert pictures[1].name in told[0] and "10 x 10 pixels, but sensor.yaml" in told[1]


def test_what_is_whole_of_the_lists_is_kept(walk: Path) -> None:
    for name in ("cam0", TRUTH):
        file = walk / "mav0" / name / "data.csv"
        lines = file.read_text().splitlines()
        lines[3] = lines[3][:12] + "\0" * 100_000
        file.write_text("\n".join(lines))
    with pytest.raises(RecordingError, match="data.csv, line 4: .*--keep-going") as caught:
        open_source(walk)
    assert len(str(caught.value)) < 1000
    source = open_source(walk, Options(keep_going=True))
    assert len(source) >= COUNT - 2
    assert source.skips.count == 2


def test_a_scene_without_texture_gives_empty_cycles(walk: Path) -> None:
    for camera in CAMERAS:
        for picture in (walk / "mav0" / camera / "data").iterdir():
            cv2.imwrite(str(picture), np.full(rig.SIZE[::-1], 128, np.uint8))
    assert [len(cycle.points) for cycle in open_source(walk)] == [0] * COUNT
