"""Recordings: what they give, and what is said where they are broken."""

from __future__ import annotations

import builtins
import io
import json
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import dagmap.io.sources
from dagmap.io.sources import Options, describe_source, open_source, save_cycles
from dagmap.model import (
    ConfigError,
    Cycle,
    CycleError,
    OutputError,
    RecordingError,
)
from dagmap.quantising import quantise_cycle

ROOT = Path(__file__).parents[1]
OFFICE = ROOT / "examples" / "office"
CAMERA = {
    "fx": 100.0,
    "fy": 110.0,
    "cx": 80.0,
    "cy": 60.0,
    "width": 160,
    "height": 120,
    "depth_scale": 1000.0,
}
STAMPS = ("1.0", "1.5", "2.0")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A recording of three small frames, named by associations.txt."""
    path = tmp_path / "walk"
    rng = np.random.default_rng(3)
    for part in ("rgb", "depth"):
        (path / part).mkdir(parents=True)
    for stamp in STAMPS:
        blocks = rng.integers(0, 256, (15, 20, 3), np.uint8)
        color = np.kron(blocks, np.ones((8, 8, 1), np.uint8))
        depth = np.full((120, 160), 2000, np.uint16)
        depth[:, :80] = 0
        depth[60:, 80:] = 5000
        cv2.imwrite(str(path / "rgb" / f"{stamp}.png"), color)
        cv2.imwrite(str(path / "depth" / f"{stamp}.png"), depth)
    lines = [f"{s} rgb/{s}.png {s} depth/{s}.png" for s in STAMPS]
    (path / "associations.txt").write_text("# comment\n" + "\n".join(lines) + "\n")
    poses = [f"{s} 0.5 0 {s} 0 0 0 1" for s in STAMPS]
    (path / "groundtruth.txt").write_text("# comment\n\n" + "\n".join(poses) + "\n")
    (path / "camera.json").write_text(json.dumps(CAMERA))
    return path


def read(path: Path, **options: Any) -> list[Cycle]:
    """All cycles; also that iterating twice gives the same and the length is told."""
    source = open_source(path, **options)
    cycles = list(source)
    assert len(source) == len(cycles)
    for cycle, again in zip(cycles, source, strict=True):
        assert_same(cycle, again)
    return cycles


def assert_same(a: Cycle, b: Cycle, atol: float = 0.0) -> None:
    assert a.stamp == b.stamp and a.session == b.session
    np.testing.assert_allclose(a.points, b.points, rtol=0, atol=atol)
    np.testing.assert_array_equal(a.pose, b.pose)
    for left, right in ((a.ids, b.ids), (a.colors, b.colors), (a.removed, b.removed)):
        np.testing.assert_array_equal(*((), ()) if left is None is right else (left, right))
    assert (a.moved is None) == (b.moved is None)
    if a.moved is not None and b.moved is not None:
        np.testing.assert_array_equal(a.moved[0], b.moved[0])
        np.testing.assert_array_equal(a.moved[1], b.moved[1])


# TUM RGB-D folders


def test_office_gives_its_cycles() -> None:
    cycles = read(OFFICE / "robot3")
    assert open_source(OFFICE / "robot3").name == "robot3"
    assert len(cycles) == 41
    points = [np.asarray(cycle.points) for cycle in cycles]
    assert all(0 < len(rows) <= 1000 for rows in points)
    assert sum(map(len, points)) > 15_000
    assert all((rows[:, 2] > 0).all() for rows in points)
    assert all(np.asarray(c.colors).shape == np.asarray(c.points).shape for c in cycles)
    for cycle in cycles:
        quantise_cycle(cycle)


def test_office_ranges_are_disjoint() -> None:
    names = [set((OFFICE / f"robot{i}/associations.txt").read_text().split()) for i in (1, 2, 3)]
    assert not names[0] & names[1] and not names[1] & names[2] and not names[0] & names[2]


def test_cutting_the_office_again_gives_the_same_files(tmp_path: Path) -> None:
    """The script, on a walk put together from one robot: it takes every third frame."""
    command = [sys.executable, str(ROOT / "examples/cut_office.py"), str(tmp_path)]
    assert subprocess.run(command[:-1], check=False, capture_output=True).returncode != 0
    source = tmp_path / "walk"
    for part in ("rgb", "depth"):
        (source / part).mkdir(parents=True)
    for i in range(373):
        for picture in (f"rgb/{i:05}.jpg", f"depth/{i:05}.png"):
            (source / picture).write_bytes(picture.encode())
    rows = [f"{i} rgb/{i:05}.jpg {i} depth/{i:05}.png\n" for i in range(373)]
    (source / "associations.txt").write_text("".join(rows))
    (source / "groundtruth.txt").write_text("".join(f"{i} 0 0 0 0 0 0 1\n" for i in range(373)))
    for name in ("LICENSE", "camera.json"):
        (source / name).write_text(name)
    subprocess.run([*command[:-1], str(source), str(tmp_path / "cut")], check=True)
    kept = sorted((tmp_path / "cut" / "robot2" / "rgb").iterdir())
    assert [p.name for p in kept] == [f"{i:05}.jpg" for i in range(125, 250, 3)]
    assert kept[0].read_bytes() == b"rgb/00125.jpg"
    assert (tmp_path / "cut" / "LICENSE").read_text() == "LICENSE"


def test_points_are_under_their_pixels(folder: Path) -> None:
    cycle = read(folder)[0]
    points, colors = np.asarray(cycle.points), np.asarray(cycle.colors)
    assert cycle.stamp == 1.0 and np.asarray(cycle.pose)[:3, 3].tolist() == [0.5, 0.0, 1.0]
    u = points[:, 0] / points[:, 2] * 100 + 80
    v = points[:, 1] / points[:, 2] * 110 + 60
    assert len(points) > 10
    assert (np.floor(u + 0.5) >= 80).all()  # there is no depth on the left
    row, column = np.floor(v + 0.5).astype(int), np.floor(u + 0.5).astype(int)
    assert (points[:, 2] == np.where(row >= 60, 5.0, 2.0)).all()
    picture = cv2.imread(str(folder / "rgb" / "1.0.png"))[:, :, ::-1]
    assert (colors == picture[row, column]).all()


def test_options_bound_features_and_depth(folder: Path) -> None:
    assert all(len(np.asarray(c.points)) <= 7 for c in read(folder, max_features=7))
    near = np.concatenate([np.asarray(c.points) for c in read(folder, max_depth=3.0)])
    assert len(near) and (near[:, 2] == 2.0).all()
    for bad in ({"max_features": 0}, {"max_depth": 0.0}, {"max_depth": float("nan")}):
        with pytest.raises(ConfigError, match=next(iter(bad))):
            open_source(folder, **bad)


def test_a_frame_without_any_depth_is_an_empty_cycle(folder: Path) -> None:
    cv2.imwrite(str(folder / "depth" / "1.5.png"), np.zeros((120, 160), np.uint16))
    assert [len(np.asarray(c.points)) > 0 for c in read(folder)] == [True, False, True]


@pytest.mark.parametrize("listed", [True, False])
def test_stamps_are_matched_without_associations(folder: Path, listed: bool) -> None:
    before = read(folder)
    (folder / "associations.txt").unlink()
    moved = folder / "rgb" / "1.015.png"
    (folder / "rgb" / "1.0.png").rename(moved)  # 15 ms off
    (folder / "rgb" / "2.0.png").rename(folder / "rgb" / "2.03.png")  # 30 ms off
    (folder / "rgb" / ".hidden").write_text("")
    if listed:
        (folder / "rgb.txt").write_text("1.015 rgb/1.015.png\n1.5 rgb/1.5.png\n2.03 rgb/2.03.png")
        (folder / "depth.txt").write_text("".join(f"{s} depth/{s}.png\n" for s in STAMPS))
    cycles = read(folder)
    assert [c.stamp for c in cycles] == [1.0, 1.5]
    assert_same(cycles[0], before[0])


def test_two_depths_do_not_share_a_picture(folder: Path) -> None:
    (folder / "associations.txt").unlink()
    data = (folder / "depth" / "1.0.png").read_bytes()
    (folder / "depth" / "1.01.png").write_bytes(data)
    assert [c.stamp for c in read(folder)] == [1.0, 1.5, 2.0]


def test_frames_without_a_pose_are_dropped_and_counted(folder: Path) -> None:
    (folder / "groundtruth.txt").write_text("1.01 0 0 0 0 0 0 1\n1.521 0 0 0 0 0 0 1\n")
    source = open_source(folder)
    assert [c.stamp for c in source] == [1.0]
    assert getattr(source, "dropped", None) == 2


def test_camera_may_be_named(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.json"
    (folder / "camera.json").rename(other)
    with pytest.raises(RecordingError, match="camera.json.*--camera FILE"):
        open_source(folder)
    assert len(read(folder, camera=other)) == 3


def test_name_of_a_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    assert open_source(".").name == "walk"
    assert open_source(str(folder) + "/").name == "walk"


def test_without_opencv_the_extra_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *args: Any) -> Any:
        if name == "cv2":
            raise ImportError(name)
        return real(name, *args)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(RecordingError, match=r"pip install 'dagmap\[rgbd\]'"):
        open_source(folder)


def write(name: str, text: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_text(text) and None


def cut(name: str, share: float) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(len(data) * share)])

    return change


def remove(name: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / name
        if path.is_dir():
            path.rename(folder.parent / "away")
        else:
            path.unlink()

    return change


def camera(**changes: Any) -> Callable[[Path], None]:
    kept = {k: v for k, v in {**CAMERA, **changes}.items() if v is not None}
    return write("camera.json", json.dumps(kept))


def flip(folder: Path) -> None:
    data = bytearray((folder / "depth/1.5.png").read_bytes())
    data[len(data) // 2] ^= 1
    (folder / "depth/1.5.png").write_bytes(data)


def jpeg(share: float) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        picture = cv2.imread(str(folder / "rgb/1.5.png"))
        data = cv2.imencode(".jpg", picture)[1].tobytes()
        (folder / "rgb/1.5.png").write_bytes(data[: int(len(data) * share)])

    return change


def picture(name: str, shape: tuple[int, ...], dtype: type) -> Callable[[Path], None]:
    return lambda folder: cv2.imwrite(str(folder / name), np.ones(shape, dtype)) and None


POSE = "0 0 0 0 0 0 1\n"
BROKEN: dict[str, tuple[Callable[[Path], None], str]] = {
    "no depth": (remove("depth"), "no folder depth/"),
    "no pictures": (remove("rgb"), "no folder rgb/"),
    "no camera": (remove("camera.json"), "camera.json.*--camera FILE"),
    "no picture": (remove("rgb/1.5.png"), "rgb/1.5.png: missing.*associations.txt, line 3"),
    "no depth picture": (remove("depth/2.0.png"), "depth/2.0.png: missing.*line 4"),
    "key": (camera(fy=None), "camera.json: .*`fy`"),
    "type": (camera(cx="middle"), r"camera.json: .*\$.cx"),
    "zero": (camera(depth_scale=0.0), "camera.json: depth_scale = 0"),
    "no json": (write("camera.json", "{"), "camera.json: .*wanted"),
    "other camera": (camera(width=640), "rgb/1.0.png: 160 x 120 .* 640 x 120.*--camera"),
    "truncated png": (cut("depth/1.5.png", 0.7), "depth/1.5.png: .*truncated"),
    "truncated colour": (cut("rgb/1.5.png", 0.9), "rgb/1.5.png: .*truncated"),
    "truncated at the end": (cut("depth/1.5.png", 0.999), "depth/1.5.png: .*truncated"),
    "empty picture": (cut("rgb/1.5.png", 0.0), "rgb/1.5.png: .*truncated"),
    "truncated jpg": (jpeg(0.6), "rgb/1.5.png: .*truncated"),
    "one bit of a png": (flip, "depth/1.5.png: .*damaged"),
    "no picture at all": (write("rgb/1.5.png", "hello"), "rgb/1.5.png: OpenCV cannot read"),
    "only a head": (write("rgb/1.5.png", "GIF89a"), "rgb/1.5.png: OpenCV cannot read"),
    "8 bit depth": (picture("depth/1.0.png", (120, 160), np.uint8), "depth/1.0.png: .*16 bits"),
    "colour as depth": (
        picture("depth/1.0.png", (120, 160, 3), np.uint16),
        "depth/1.0.png: .*16 bits",
    ),
    "size of depth": (picture("depth/1.0.png", (60, 80), np.uint16), "depth/1.0.png: 80 x 60"),
    "pose of 7": (write("groundtruth.txt", f"1.0 {POSE}\n2.0 0 0 0 0 0 1"), "line 3: .*qw"),
    "pose of words": (write("groundtruth.txt", f"#\n1.0 x{POSE}"), "line 2: 8 .*'x0'"),
    "pose nan": (write("groundtruth.txt", "1.0 nan 0 0 0 0 0 1"), "line 1: 8 .*'nan'"),
    "pose inf": (write("groundtruth.txt", "1.0 inf 0 0 0 0 0 1"), "line 1: 8 .*'inf'"),
    "pose far": (write("groundtruth.txt", "1.0 1e9 0 0 0 0 0 1"), "walk: cycle at 1.0.*beyond"),
    "no rotation": (
        write("groundtruth.txt", "1.0 0 0 0 0 0 0 0"),
        "line 1: a quaternion of length 0; 1",
    ),
    "poses back": (write("groundtruth.txt", f"2 {POSE}1 {POSE}"), "line 2: .*1.0 .*after 2.0"),
    "no pose line": (write("groundtruth.txt", "# nothing\n"), "groundtruth.txt: no poses"),
    "other clock": (write("groundtruth.txt", f"100 {POSE}"), "none of 3 frames.*clock"),
    "empty": (write("associations.txt", "\n"), "walk: an empty recording"),
    "three words": (write("associations.txt", "1.0 rgb/1.0.png 1.0"), "line 1: `stamp rgb"),
    "stamp": (write("associations.txt", "1.0 rgb/1.0.png one depth/1.0.png"), "line 1: 'one'"),
    "stamps back": (
        write("associations.txt", "2 rgb/2.0.png 2 depth/2.0.png\n1 rgb/1.0.png 1 depth/1.0.png"),
        "associations.txt, line 2: .*rise",
    ),
    "stamps equal": (
        write("associations.txt", "1 rgb/1.0.png 1 depth/1.0.png\n" * 2),
        "associations.txt, line 2: .*rise",
    ),
    "a directory": (lambda f: (remove("camera.json")(f), (f / "camera.json").mkdir())[1], "read"),
    "no text": (lambda f: (f / "groundtruth.txt").write_bytes(b"\xff\xfe") and None, "UTF-8"),
}


@pytest.mark.parametrize("change, message", BROKEN.values(), ids=BROKEN)
def test_broken_folder(folder: Path, change: Callable[[Path], None], message: str) -> None:
    change(folder)
    with pytest.raises(RecordingError, match=message) as caught:
        list(open_source(folder))
    assert str(folder) in str(caught.value)


LISTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "no stamps": (write("rgb/left.png", ""), "left.png .*write rgb.txt.*'left'"),
    "bad list": (write("rgb.txt", "1.0"), "rgb.txt, line 1: `stamp file`"),
    "list back": (write("depth.txt", "2 depth/2.0.png\n1 depth/1.0.png"), "depth.txt, line 2"),
    "list names nothing": (write("rgb.txt", "1.0 rgb/none.png"), "rgb/none.png: missing"),
    "empty list": (write("rgb.txt", ""), "an empty recording"),
    "same stamp twice": (write("rgb/1.00.png", ""), "1.00.png: .*rise"),
}


@pytest.mark.parametrize("change, message", LISTS.values(), ids=LISTS)
def test_broken_lists(folder: Path, change: Callable[[Path], None], message: str) -> None:
    (folder / "associations.txt").unlink()
    change(folder)
    with pytest.raises(RecordingError, match=message) as caught:
        list(open_source(folder))
    assert str(folder) in str(caught.value)


def test_pictures_alone_suffice(tmp_path: Path) -> None:
    """Without poses by odometry, beside the poses that the recording came with."""
    walk = tmp_path / "walk"
    shutil.copytree(OFFICE / "robot1", walk)
    lines = (walk / "associations.txt").read_text().splitlines()
    (walk / "associations.txt").write_text("\n".join(lines[:10]) + "\n")
    truth = list(open_source(walk))
    (walk / "groundtruth.txt").unlink()
    source = open_source(walk)
    assert describe_source(walk).notes == ("no groundtruth.txt: odometry by OpenCV",)
    found = list(source)
    assert len(found) == len(truth) == 10
    first: dict[int, np.ndarray] = {}  # what each session's frame is in the recording's
    for mine, theirs in zip(found, truth, strict=True):
        assert np.array_equal(mine.points, theirs.points)
        pose, wanted = np.asarray(mine.pose), np.asarray(theirs.pose)
        placed = first.setdefault(mine.session, wanted @ np.linalg.inv(pose)) @ pose
        assert np.linalg.norm(placed[:3, 3] - wanted[:3, 3]) < 0.15
    assert len(first) <= 3
    again = list(source)
    assert all(np.array_equal(a.pose, b.pose) for a, b in zip(found, again, strict=True))


def test_where_nothing_is_known_again_a_session_begins(folder: Path) -> None:
    """The three pictures have nothing in common."""
    (folder / "groundtruth.txt").unlink()
    found = list(open_source(folder))
    assert [cycle.session for cycle in found] == [0, 1, 2]
    assert all(np.array_equal(cycle.pose, np.eye(4)) for cycle in found)


def test_damaged_pictures_are_left_out_where_that_is_asked_for(folder: Path) -> None:
    (folder / "depth" / "1.5.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    with pytest.raises(RecordingError, match=r"1.5.png: .*--keep-going leaves it out"):
        list(open_source(folder))
    source = open_source(folder, Options(keep_going=True))
    assert [cycle.stamp for cycle in source] == [1.0, 2.0]
    assert len(source.skips.told) == 1


def test_what_is_no_recording(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="gone: there is no such"):
        open_source(tmp_path / "gone")
    with pytest.raises(RecordingError, match="TUM RGB-D folder.*npz|npz.*TUM RGB-D folder"):
        open_source(tmp_path)
    (tmp_path / "walk.txt").write_text("")
    with pytest.raises(RecordingError, match="walk.txt: not a recording"):
        open_source(tmp_path / "walk.txt")


def test_a_third_reader_is_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "xyz.py").write_text(
        """
UNDERSTANDS = "a list of points (.xyz)"

class Source(list):
    name = "points"

def matches(path):
    return path.suffix == ".xyz"

def open(path, options):
    from dagmap.model import Cycle
    import numpy as np
    return Source([Cycle(0.0, np.eye(4), np.loadtxt(path))])
"""
    )
    folders = [*dagmap.io.sources.__path__, str(tmp_path)]
    monkeypatch.setattr(dagmap.io.sources, "__path__", folders)
    np.savetxt(tmp_path / "scan.xyz", np.ones((4, 3)))
    (cycle,) = read(tmp_path / "scan.xyz")
    assert np.asarray(cycle.points).shape == (4, 3)


# Cycle streams


def stream() -> list[Cycle]:
    """Cycles with everything that a cycle can have."""
    rng = np.random.default_rng(5)
    turned = np.eye(4)
    turned[:2, :2] = [[0, -1], [1, 0]]
    return [
        Cycle(
            stamp,
            turned,
            rng.normal(size=(n, 3)).astype(np.float32),
            ids=np.arange(n, dtype=np.uint64) + np.uint64(1 << 63),
            colors=rng.integers(0, 256, (n, 3), np.uint8),
            moved=moved,
            removed=removed,
            session=session,
        )
        for stamp, n, moved, removed, session in [
            (1.25, 5, None, None, 0),
            (2.5, 0, ([1.25], [np.eye(4)]), [3, 4], 0),
            (0.125, 2, None, None, 7),
        ]
    ]


def test_stream_round_trip(tmp_path: Path) -> None:
    save_cycles(tmp_path / "robot9.npz", stream())
    assert open_source(tmp_path / "robot9.npz").name == "robot9"
    for cycle, again in zip(stream(), read(tmp_path / "robot9.npz"), strict=True):
        assert_same(cycle, again)
    again = tmp_path / "again.npz"
    save_cycles(again, read(tmp_path / "robot9.npz"))
    assert again.read_bytes() == (tmp_path / "robot9.npz").read_bytes()


def test_office_through_the_stream(tmp_path: Path) -> None:
    cycles = list(open_source(OFFICE / "robot1", max_features=200))
    save_cycles(tmp_path / "robot1.npz", cycles)
    for cycle, again in zip(cycles, read(tmp_path / "robot1.npz"), strict=True):
        assert_same(cycle, again, atol=1e-6)


def test_only_what_is_needed(tmp_path: Path) -> None:
    """As somebody would write it with numpy alone, without a version."""
    path = tmp_path / "plain.npz"
    np.savez(path, **plain())
    cycles = read(path)
    assert [len(np.asarray(c.points)) for c in cycles] == [3, 1]
    for cycle in cycles:
        assert cycle.ids is None and cycle.colors is None and cycle.session == 0
        assert cycle.moved is None and cycle.removed is None


def test_uneven_cycles_are_not_saved(tmp_path: Path) -> None:
    cycles = [Cycle(0, np.eye(4), np.ones((2, 3)), ids=[1, 2]), Cycle(1, np.eye(4), [[1, 2, 3]])]
    with pytest.raises(CycleError, match="ids: some cycles"):
        save_cycles(tmp_path / "x.npz", cycles)
    with pytest.raises(CycleError, match="not finite"):
        save_cycles(tmp_path / "x.npz", [Cycle(0, np.eye(4), [[np.nan] * 3])])
    with pytest.raises(OutputError, match="nowhere"):
        save_cycles(tmp_path / "nowhere" / "x.npz", stream())
    assert list(tmp_path.iterdir()) == []


def plain(**changes: Any) -> dict[str, Any]:
    arrays = {
        "stamp": np.array([1.0, 2.0]),
        "pose": np.stack([np.eye(4)] * 2),
        "points": np.ones((4, 3), np.float32),
        "offsets": np.array([0, 3, 4]),
    }
    return {k: v for k, v in {**arrays, **changes}.items() if v is not None}


NAN_POINTS = np.array([[1, 1, 1], [1, 1, 1], [1, 1, 1], [1, np.nan, 1]], np.float32)
NAN_POSE = np.stack([np.eye(4), np.full((4, 4), np.inf)])
SHEAR = np.stack([np.eye(4), np.diag([1.0, 2.0, 1.0, 1.0])])
WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "version": ({"version": np.array(2)}, "version 2 .* reads 1"),
    "version first": ({"version": np.array(9), "points": None, "cloud": 1}, "version 9"),
    "version text": ({"version": np.array("1")}, "version is"),
    "missing": ({"pose": None}, "no array pose"),
    "unknown": ({"color": np.ones((4, 3), np.uint8)}, "unknown array 'color'"),
    "no cycle": (
        {
            "stamp": np.zeros(0),
            "pose": np.zeros((0, 4, 4)),
            "points": np.zeros((0, 3), np.float32),
            "offsets": np.array([0]),
        },
        "an empty recording",
    ),
    "points": ({"points": np.ones((4, 2), np.float32)}, r"points is \(4, 2\) float32; \(N, 3\)"),
    "points flat": ({"points": np.ones(12, np.float32)}, r"points is \(12,\)"),
    "points complex": ({"points": np.ones((4, 3), complex)}, "points is .*complex.*wanted"),
    "points objects": ({"points": np.array([[None] * 3] * 4)}, "points is .*object.*wanted"),
    "pose": ({"pose": np.eye(4)}, "pose is"),
    "poses": ({"pose": np.stack([np.eye(4)] * 3)}, "pose is"),
    "offsets short": ({"offsets": np.array([0, 4])}, "offsets is"),
    "offsets float": ({"offsets": np.array([0.0, 3.0, 4.0])}, "offsets is"),
    "offsets start": ({"offsets": np.array([1, 3, 4])}, "offsets run from 1"),
    "offsets end": ({"offsets": np.array([0, 3, 5])}, "offsets run .* to 4"),
    "offsets fall": ({"offsets": np.array([0, 5, 4])}, "offsets .*must rise"),
    "offsets negative": ({"offsets": np.array([0, -1, 4])}, "offsets .*must rise"),
    "offsets huge": ({"offsets": np.array([0, 3, 1 << 62])}, "offsets run"),
    "offsets unsigned": (
        {"offsets": np.array([0, (1 << 64) - 1, 4], np.uint64)},
        "offsets .*must rise",
    ),
    "ids": ({"ids": np.arange(3)}, "ids is"),
    "ids float": ({"ids": np.ones(4)}, "ids is"),
    "ids negative": ({"ids": np.array([0, 1, 2, -3])}, "ids holds a negative"),
    "colors": ({"colors": np.ones((4, 3), np.int64)}, "colors is .*uint8 is wanted"),
    "removed alone": ({"removed": np.array([1])}, "removed alone"),
    "removed offsets": (
        {"removed": np.array([1]), "removed_offsets": np.array([0, 0, 2])},
        "removed_offsets run",
    ),
    "removed twice": (
        {"removed": np.array([1, 1]), "removed_offsets": np.array([0, 0, 2])},
        "cycle at 2.0.*removed names an id twice",
    ),
    "moved": ({"moved_stamp": np.array([1.0])}, "moved_stamp alone"),
    "moved poses": (
        {
            "moved_stamp": np.array([1.0]),
            "moved_pose": np.zeros((2, 4, 4)),
            "moved_offsets": np.array([0, 0, 1]),
        },
        "moved_pose is",
    ),
    "moved rigid": (
        {
            "moved_stamp": np.array([1.0]),
            "moved_pose": np.zeros((1, 4, 4)),
            "moved_offsets": np.array([0, 0, 1]),
        },
        "cycle at 2.0.*rigid",
    ),
    "session": ({"session": np.array([0.0, 0.0])}, "session is"),
    "session negative": ({"session": np.array([0, -1])}, "session holds a negative"),
    "nan": ({"points": NAN_POINTS}, r"points\[3\] \(cycle 1\) is not finite"),
    "nan stamp": ({"stamp": np.array([1.0, np.nan])}, r"stamp\[1\] is not finite"),
    "nan pose": ({"pose": NAN_POSE}, r"pose\[1\] is not finite"),
    "rigid": ({"pose": SHEAR}, "cycle at 2.0.*rigid"),
    "far": ({"points": np.full((4, 3), 1e6, np.float32)}, "cycle at 1.0.*beyond"),
    "back": ({"stamp": np.array([2.0, 1.0])}, r"stamp\[1\] = 1.0 .*rise"),
    "equal": ({"stamp": np.array([1.0, 1.0])}, r"stamp\[1\] = 1.0 .*rise"),
}


@pytest.mark.parametrize("changes, message", WRONG.values(), ids=WRONG)
def test_wrong_stream(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    path = tmp_path / "wrong.npz"
    np.savez(path, **plain(**changes))
    with pytest.raises(RecordingError, match=message) as caught:
        list(open_source(path))
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    "what", ["nan", "nan stamp", "nan pose", "rigid", "back", "equal", "moved rigid"]
)
def test_the_other_cycles_of_a_stream_are_kept(tmp_path: Path, what: str) -> None:
    path = tmp_path / "wrong.npz"
    np.savez(path, **plain(**WRONG[what][0]))
    with pytest.raises(RecordingError, match="--keep-going leaves it out"):
        list(open_source(path))
    source = open_source(path, Options(keep_going=True))
    for _ in range(2):
        assert [cycle.stamp for cycle in source] == [1.0 if what not in ("back",) else 2.0]
    assert source.skips.count == 1


@pytest.mark.parametrize("packed", [True, False])
def test_every_truncation_of_a_stream(tmp_path: Path, packed: bool) -> None:
    file = io.BytesIO()
    (np.savez_compressed if packed else np.savez)(file, **plain())
    data, path = file.getvalue(), tmp_path / "cut.npz"
    for size in range(0, len(data), 7):
        path.write_bytes(data[:size])
        with pytest.raises(RecordingError, match="cut.npz: truncated"):
            open_source(path)


def test_damaged_streams_say_so_or_read_as_written(tmp_path: Path) -> None:
    """One byte at a time: an error, never another exception and never other points."""
    file = io.BytesIO()
    np.savez_compressed(file, **plain())
    data, path = file.getvalue(), tmp_path / "bent.npz"
    for at in range(0, len(data), 3):
        path.write_bytes(data[:at] + bytes([data[at] ^ 0x55]) + data[at + 1 :])
        try:
            cycles = list(open_source(path))
        except RecordingError:
            continue
        assert [np.asarray(c.points).tolist() for c in cycles] == [[[1.0] * 3] * 3, [[1.0] * 3]]


def test_claims_are_checked_before_memory_is_taken(tmp_path: Path) -> None:
    """Headers that announce a terabyte, in a file of a few hundred bytes."""
    path = tmp_path / "huge.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in plain().items():
            with archive.open(f"{name}.npy", "w") as member:
                if name != "points":
                    np.lib.format.write_array(member, array)
                    continue
                header = {"descr": "<f4", "fortran_order": False, "shape": (1 << 37, 3)}
                np.lib.format.write_array_header_1_0(member, header)
    with pytest.raises(RecordingError, match="points claims"):
        open_source(path)


def test_objects_are_never_unpickled(tmp_path: Path) -> None:
    path = tmp_path / "object.npz"
    np.savez(path, **plain(ids=np.array([{}] * 4)))
    with pytest.raises(RecordingError, match="ids is .*object"):
        open_source(path)
