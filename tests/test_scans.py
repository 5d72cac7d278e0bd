"""Folders of point clouds: KITTI, PCD and PLY, with poses and without."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from pypcd4 import Encoding, PointCloud

from bags import pose_at, room
from dagmap.io.sources import Options, describe_source, open_source
from dagmap.io.sources._pcd import read_pcd, unpack_lzf
from dagmap.io.sources._poses import inverse
from dagmap.model import RecordingError
from test_replay import dagmap

STAMPS = [1.0 + 0.2 * i for i in range(5)]
TR = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1.0]])


def seen(stamp: float) -> np.ndarray:
    """(N, 3) m: the room from where the robot is."""
    pose = pose_at(stamp)
    return ((room() - pose[:3, 3]) @ pose[:3, :3]).astype(np.float32)


def save(path: Path, points: np.ndarray) -> None:
    if path.suffix == ".bin":
        np.column_stack([points, np.zeros(len(points))]).astype("<f4").tofile(path)
    elif path.suffix == ".pcd":
        PointCloud.from_xyz_points(points).save(path, Encoding.BINARY_COMPRESSED)
    else:
        rows = np.array([tuple(p) for p in points], [("x", "f4"), ("y", "f4"), ("z", "f4")])
        PlyData([PlyElement.describe(rows, "vertex")]).write(str(path))


def tum(stamps: list[float]) -> str:
    lines = ["# stamp x y z qx qy qz qw"]
    for stamp in stamps:
        half = 0.05 * stamp
        x = pose_at(stamp)[0, 3]
        lines.append(f"{stamp:.6f} {x} 0 0 0 0 {np.sin(half)} {np.cos(half)}")
    return "\n".join(lines) + "\n"


def kitti(stamps: list[float]) -> str:
    """Poses of the camera, in the frame in which the camera stands at the origin's pose."""
    poses = [TR @ pose_at(stamp) @ inverse(TR) for stamp in stamps]
    return "".join(" ".join(map(str, pose[:3].ravel())) + "\n" for pose in poses)


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """As KITTI's odometry benchmark lays a sequence out."""
    path = tmp_path / "drive"
    (path / "velodyne").mkdir(parents=True)
    for i, stamp in enumerate(STAMPS):
        save(path / "velodyne" / f"{i:06d}.bin", seen(stamp))
    (path / "poses.txt").write_text(kitti(STAMPS))
    calibration = " ".join(map(str, TR[:3].ravel()))
    (path / "calib.txt").write_text(f"P0: {'0 ' * 11}0\nTr: {calibration}\n")
    (path / "times.txt").write_text("".join(f"{stamp:.6e}\n" for stamp in STAMPS))
    return path


@pytest.fixture(params=[".pcd", ".ply"])
def sequence(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """Clouds that are named by their stamps, and poses between them."""
    path = tmp_path / "walk"
    path.mkdir()
    for stamp in STAMPS:
        save(path / f"{stamp:.6f}{request.param}", seen(stamp))
    (path / "poses.txt").write_text(tum([0.9 + 0.2 * i for i in range(7)]))
    return path


def check(path: Path, options: Options | None = None) -> None:
    source = open_source(path, options)
    found = list(source)
    assert [cycle.stamp for cycle in found] == pytest.approx(STAMPS)
    assert len(source) == 5
    for cycle in found:
        assert np.allclose(cycle.pose, pose_at(cycle.stamp), atol=1e-6)
        world = np.asarray(cycle.points) @ cycle.pose[:3, :3].T + cycle.pose[:3, 3]
        walls = np.array([[-4, 4], [-3, 3], [-1, 2]])
        assert np.abs(world[:, :, None] - walls).min(axis=(1, 2)).max() < 1e-5


def test_kitti(drive: Path) -> None:
    check(drive)
    assert describe_source(drive).cycles == 5


def test_sequences_with_tum_poses(sequence: Path) -> None:
    check(sequence)
    (sequence / "poses.txt").rename(sequence.parent / "slam.txt")
    check(sequence, Options(poses=sequence.parent / "slam.txt"))


def test_clouds_are_thinned(drive: Path) -> None:
    few = next(iter(open_source(drive, Options(max_features=50))))
    assert len(few.points) == 50
    near = next(iter(open_source(drive, Options(max_depth=2.0, max_features=9999))))
    assert 0 < len(near.points) < 3000
    assert np.linalg.norm(near.points, axis=1).max() <= 2.0
    coarse = next(iter(open_source(drive, Options(voxel=1.0, max_features=9999))))
    cells = np.floor(np.asarray(coarse.points))
    assert len(np.unique(cells, axis=0)) == len(cells)


def test_without_poses_by_kiss_icp(drive: Path) -> None:
    pytest.importorskip("kiss_icp")
    for file in ("poses.txt", "times.txt"):
        (drive / file).unlink()
    source = open_source(drive, Options(max_depth=20.0))
    assert describe_source(drive).notes == ("no poses.txt: odometry by KISS-ICP",)
    for stamp, cycle in zip(STAMPS, source, strict=True):
        truth = inverse(pose_at(STAMPS[0])) @ pose_at(stamp)
        assert np.linalg.norm(cycle.pose[:3, 3] - truth[:3, 3]) < 0.05


@pytest.mark.parametrize("encoding", [e for e in Encoding if e.value != "binaryscompressed"])
def test_pcd_of_every_encoding(tmp_path: Path, encoding: Encoding) -> None:
    """Written by pypcd4, and so packed by liblzf."""
    points = np.round(np.random.default_rng(1).uniform(-5, 5, (500, 3)), 2).astype(np.float32)
    colors = np.random.default_rng(2).integers(0, 256, (500, 3), np.uint8)
    packed = PointCloud.encode_rgb(colors)
    cloud = PointCloud.from_xyzrgb_points(np.column_stack([points, packed]).astype(np.float32))
    cloud.save(tmp_path / "a.pcd", encoding)
    found, seen_colors = read_pcd(tmp_path / "a.pcd")
    assert np.allclose(found, points, atol=1e-6)
    if encoding != Encoding.ASCII:  # whose colours are printed as floats
        assert seen_colors is not None
        assert np.array_equal(seen_colors, colors)


def test_lzf_that_lies() -> None:
    assert unpack_lzf(b"\x02abc\xe0\x05\x02", 17) == b"abc" * 5 + b"ab"
    for data, size in ((b"\x02abc", 4), (b"\x20\x05", 3), (b"\xe0\xff\x00", 9), (b"\x02abc", 2)):
        with pytest.raises((ValueError, IndexError)):
            unpack_lzf(data, size)


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        ("poses.txt", "", "no poses; 12 numbers"),
        ("poses.txt", "1 2 3\n", "poses.txt, line 1: 12 finite numbers are wanted"),
        ("poses.txt", "x " * 12, "poses.txt, line 1: 12 finite numbers are wanted"),
        ("poses.txt", "nan " * 12, "poses.txt, line 1: 12 finite numbers are wanted"),
        ("poses.txt", kitti(STAMPS[:3]), "3 poses for 5 clouds.*--keep-going"),
        ("poses.txt", tum([50.0]), "none of 5 clouds has a pose"),
        ("poses.txt", "1 0 0 0 0 0 0 9\n", "line 1: a quaternion of length 9; 1 is"),
        ("times.txt", "1\n2\n", "2 stamps for 5 clouds"),
        ("times.txt", "1\n2\n2\n3\n4\n", "stamp 3: the stamp 2.0 does not come after 2.0"),
        ("calib.txt", "P0: 1\n", "no line `Tr:`"),
        ("calib.txt", "Tr: 1\n", "calib.txt, line 1: 12 finite numbers"),
    ],
)
def test_bad_texts_are_named(drive: Path, file: str, text: str, said: str) -> None:
    (drive / file).write_text(text)
    with pytest.raises(RecordingError, match=said):
        open_source(drive)


def test_what_is_whole_of_the_texts_is_kept(drive: Path, sequence: Path) -> None:
    """Lines that count by their number: up to the first that is damaged; a cloud that is missing
    takes none of the others' lines."""

    def stamps(path: Path) -> list[float]:
        source = open_source(path, Options(keep_going=True))
        found = list(source)
        assert len(source) == len(found) and source.skips.count
        assert all(np.allclose(c.pose, pose_at(c.stamp), atol=1e-6) for c in found)
        return [round(cycle.stamp, 3) for cycle in found]

    poses, times = (drive / "poses.txt").read_text(), (drive / "times.txt").read_text()
    (drive / "poses.txt").write_text(poses[:-150])
    assert stamps(drive) == pytest.approx(STAMPS[:4])
    (drive / "poses.txt").write_text(poses)
    (drive / "times.txt").write_text(times.replace("1.400000e+00", "soon"))
    assert stamps(drive) == pytest.approx(STAMPS[:2])
    (drive / "times.txt").write_text(times)
    (drive / "velodyne" / "000001.bin").unlink()
    assert stamps(drive) == pytest.approx([STAMPS[0], *STAMPS[2:]])
    lines = (sequence / "poses.txt").read_text().splitlines()
    lines[3] = lines[3][:20] + "x" * 100_000
    (sequence / "poses.txt").write_text("\n".join(lines))
    assert stamps(sequence) == pytest.approx(STAMPS)
    with pytest.raises(RecordingError, match=r"8 finite numbers \(stamp x y z") as caught:
        open_source(sequence)
    assert len(str(caught.value)) < 1000


def test_kitti_s_poses_need_its_calibration(drive: Path) -> None:
    (drive / "calib.txt").unlink()
    with pytest.raises(RecordingError, match="calib.txt: missing; .* --same-frame"):
        open_source(drive)
    assert len(list(open_source(drive, Options(same_frame=True)))) == 5


def test_clouds_without_stamps_go_with_numbered_poses_only(drive: Path) -> None:
    (drive / "times.txt").unlink()
    assert [cycle.stamp for cycle in open_source(drive)] == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    (drive / "poses.txt").write_text(tum(STAMPS))
    with pytest.raises(RecordingError, match="goes by stamps, but the clouds have none"):
        open_source(drive)


BAD_PCD = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {0}\nPOINTS {0}\n"


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("a.bin", b"", "0 bytes are no whole number of points"),
        ("a.bin", bytes(17), "17 bytes are no whole number"),
        ("a.pcd", b"", "its header has no line DATA"),
        ("a.pcd", b"x\n" * 1000, "its header has no line DATA"),
        ("a.pcd", BAD_PCD.format(10**15).encode() + b"DATA binary\n", "1000000000000000 points"),
        ("a.pcd", BAD_PCD.format(-1).encode() + b"DATA binary\n", "-1 points are promised"),
        ("a.pcd", BAD_PCD.format(10**12).encode() + b"DATA ascii\n1 2 3\n", "points are promised"),
        ("a.pcd", BAD_PCD.format(2).encode() + b"DATA ascii\n1 2 3\n1 2\n", "columns changed"),
        (
            "a.pcd",
            BAD_PCD.format(10**9).encode()
            + b"DATA binary_compressed\n"
            + np.array([4, 12 * 10**9 % 2**32], "<u4").tobytes()
            + b"abcd",
            "points are promised",
        ),
        ("a.pcd", BAD_PCD.format(1).encode() + b"DATA jpeg\n", "its data is 'jpeg'"),
        ("a.pcd", b"FIELDS x\nSIZE 4\nTYPE F\nPOINTS 1\nDATA ascii\n1\n", "x y z are wanted"),
        ("a.ply", b"ply", "no PLY header"),
    ],
)
def test_bad_clouds_are_named_or_left_out(
    tmp_path: Path, name: str, data: bytes, said: str
) -> None:
    (tmp_path / name).write_bytes(data)
    save(tmp_path / f"b{name[1:]}", seen(1.0))
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2)
    with pytest.raises(RecordingError, match=f"{name}: .*{said}.*; --keep-going leaves it out"):
        list(open_source(tmp_path))
    source = open_source(tmp_path, Options(keep_going=True))
    assert len(list(source)) == 1
    assert len(source.skips.told) == 1


def test_a_nan_that_signals_is_a_point_left_out(tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    rows = np.ones((3, 4), "<f4") * [[1], [2], [3]]
    data = bytearray(rows.astype("<f4").tobytes())
    data[16:20] = bytes.fromhex("7f7fbf7f")  # x of the second point
    (tmp_path / "000000.bin").write_bytes(data)
    (cycle,) = open_source(tmp_path)
    assert cycle.points[:, 0].tolist() == [1.0, 3.0]


def test_damaged_clouds_never_crash(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    path = tmp_path / "a.pcd"
    save(path, np.round(seen(1.0)[:200], 1))
    whole = np.frombuffer(path.read_bytes(), np.uint8)
    for _ in range(200):
        damaged = whole.copy()
        damaged[rng.integers(0, len(whole), 3)] = rng.integers(0, 256, 3)
        path.write_bytes(damaged[: rng.integers(1, len(whole) + 1)].tobytes())
        try:
            list(open_source(tmp_path))
        except RecordingError as error:
            assert str(tmp_path) in str(error)


def test_a_drive_becomes_a_map(drive: Path, tmp_path: Path) -> None:
    run = dagmap("inspect", drive)
    assert "5 cycles" in run.stdout
    run = dagmap("replay", drive, "--out", tmp_path / "out", "--max-features", 200)
    assert run.returncode == 0, run.stderr


def test_no_error_goes_on_for_pages(sequence: Path) -> None:
    cloud = sorted(sequence.glob("1.*"))[0]
    text = b"# .PCD v0.7\nFIELDS " + b"9" * 100_000 + b" y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
    cloud.with_suffix(".pcd").write_bytes(
        text + b"WIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n1 2 3\n"
    )
    for other in sequence.glob("*.ply"):
        other.unlink()
    with pytest.raises(RecordingError, match="pcd: .*; copy or write it anew") as caught:
        list(open_source(sequence))
    assert len(str(caught.value)) < 2000
