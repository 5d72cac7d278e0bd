"""ROS bags: what they give, and what is said where something lacks or is broken."""

from __future__ import annotations

import json
import struct
import sys
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer

from bags import Make, Message, pictures, pose_at, write_bag
from dagmap.io.sources import Options, _bagged, describe_source, open_source
from dagmap.io.sources._poses import FrameTree, between, inverse
from dagmap.model import RecordingError
from test_replay import dagmap

KINDS = ("walk.bag", "walk.mcap", "walk.db3", "walk")


def make_for(name: str) -> Make:
    return Make(ros2=not name.endswith(".bag"))


def in_order(messages: list[Message]) -> list[Message]:
    return sorted(messages, key=lambda message: message[2])


def lidar(make: Make) -> list[Message]:
    return in_order([make.mount(), *make.odometries(), *make.clouds()])


def rgbd(make: Make, compressed: bool = False) -> list[Message]:
    """Three pictures, the colour 5 ms after the depth; the robot is the camera."""
    out = [make.odometry(1.0 + 0.1 * i, "camera") for i in range(12)]
    for i in range(3):
        stamp = 1.05 + 0.2 * i
        color, depth = pictures(i)
        out.append(make.camera_info(stamp))
        if compressed:
            png = cv2.imencode(".png", depth)[1].tobytes()
            out += [
                make.compressed(
                    "/camera/depth/image_raw/compressedDepth", stamp, bytes(12) + png,
                    "16UC1; compressedDepth png",
                ),
                make.compressed(
                    "/camera/color/image_raw/compressed", stamp + 0.005,
                    cv2.imencode(".png", color)[1].tobytes(), "rgb8; png compressed bgr8",
                ),
            ]  # fmt: skip
        else:
            rgb = np.ascontiguousarray(color[:, :, ::-1])
            out += [
                make.image("/camera/depth/image_raw", stamp, depth, "16UC1"),
                make.image("/camera/color/image_raw", stamp + 0.005, rgb, "rgb8"),
            ]
    return in_order(out)


@pytest.mark.parametrize("name", KINDS)
def test_clouds_have_the_pose_of_their_moment(tmp_path: Path, name: str) -> None:
    make = make_for(name)
    source = open_source(write_bag(tmp_path / name, make, lidar(make)))
    found = list(source)
    assert (source.name, len(source), len(found)) == ("walk", 5, 5)
    for i, cycle in enumerate(found):
        assert cycle.stamp == pytest.approx(1.05 + 0.1 * i)
        assert np.allclose(cycle.pose, make.sensor(cycle.stamp), atol=1e-9)
        world = np.asarray(cycle.points) @ cycle.pose[:3, :3].T + cycle.pose[:3, 3]
        on_wall = np.abs(world[:, :, None] - np.array([[-4, 4], [-3, 3], [-1, 2]])).min(axis=(1, 2))
        assert on_wall.max() < 1e-5
        assert len(cycle.points) == 1000
        assert set(map(tuple, np.asarray(cycle.colors))) == {(0x0A, 0x14, 0x1E)}
    again = list(source)
    assert all(np.array_equal(a.points, b.points) for a, b in zip(found, again, strict=True))


@pytest.mark.parametrize("name", KINDS[:2])
def test_tf_alone_is_enough(tmp_path: Path, name: str) -> None:
    make = make_for(name)
    frames = [make.mount()]
    for i in range(12):
        stamp = 1.0 + 0.1 * i
        frames.append(make.tf(stamp, "odom", "base_link", pose_at(stamp), static=False))
        frames.append(make.tf(stamp, "map", "odom", np.eye(4), static=False))
    path = write_bag(tmp_path / name, make, in_order([*frames, *make.clouds()]))
    assert describe_source(path).notes == ("poses by tf: lidar in map",)
    for cycle in open_source(path, Options(frame="odom")):
        assert np.allclose(cycle.pose, make.sensor(cycle.stamp), atol=1e-9)
    with pytest.raises(RecordingError, match="no tf leads from 'earth' .*lidar, base_link, odom"):
        open_source(path, Options(frame="earth"))


@pytest.mark.parametrize("name", KINDS[:2])
@pytest.mark.parametrize("compressed", [False, True])
def test_pictures_with_depth(tmp_path: Path, name: str, compressed: bool) -> None:
    make = make_for(name)
    path = write_bag(tmp_path / name, make, rgbd(make, compressed))
    source = open_source(path)
    found = list(source)
    assert len(source) == len(found) == 3
    for i, cycle in enumerate(found):
        assert cycle.stamp == pytest.approx(1.05 + 0.2 * i)
        assert np.allclose(cycle.pose, pose_at(cycle.stamp), atol=1e-9)
        points = np.asarray(cycle.points)
        assert len(points) > 10
        assert np.allclose(points[:, 2], 2.0)
        column = points[:, 0] / 2.0 * 100 + 80
        row = points[:, 1] / 2.0 * 110 + 60
        at = np.floor(np.stack([row, column]) + 0.5).astype(int)
        assert np.array_equal(cycle.colors, pictures(i)[0][at[0], at[1], ::-1])
    uses = {item.use: item.name for item in describe_source(path).items}
    assert set(uses) == {"poses", "depth", "colour", "camera"}


def posed(make: Make, stamp: float) -> Message:
    kind, pose = "geometry_msgs/msg/PoseStamped", make.pose(make.sensor(stamp))
    return "/pose", kind, stamp, make.of(kind, make.header(stamp, "map"), pose)


@pytest.mark.parametrize("topic", ["/odom", "/pose"])
def test_poses_of_an_unnamed_frame_are_told_of(tmp_path: Path, topic: str) -> None:
    """They count as the sensor's, and that may be wrong."""
    make = Make()
    poses = [
        make.odometry(1.0 + 0.1 * i, "") if topic == "/odom" else posed(make, 1.0 + 0.1 * i)
        for i in range(12)
    ]
    path = write_bag(tmp_path / "walk.mcap", make, in_order([*poses, *make.clouds()]))
    first, doubt = describe_source(path).notes
    assert first == f"poses of {topic}"
    assert doubt.startswith(f"{topic} does not say what it is the pose of")
    assert "--same-frame" in doubt and "--topic /tf" in doubt
    assert describe_source(path, Options(same_frame=True)).notes == (f"poses of {topic}",)
    run = dagmap("inspect", path)
    assert doubt in run.stdout
    run = dagmap("replay", path, "--out", tmp_path / "out")
    assert run.returncode == 0 and f"walk: {doubt}" in run.stderr


def test_topics_that_are_named_are_used(tmp_path: Path) -> None:
    make = Make()
    other = [("/other", kind, stamp, said) for _, kind, stamp, said in make.clouds(3)]
    messages = in_order([*lidar(make), *other, *rgbd(make)])
    path = write_bag(tmp_path / "walk.mcap", make, messages)
    options = Options(same_frame=True)
    assert len(open_source(path, options)) == 5
    assert len(open_source(path, replace(options, topics=("/other",)))) == 3
    pictured = replace(options, topics=("/camera/depth/image_raw",))
    assert {i.name for i in describe_source(path, pictured).items if i.use == "colour"} == {
        "/camera/color/image_raw"
    }
    with pytest.raises(RecordingError, match="no topic /none; there are /camera/color/camera_info"):
        open_source(path, replace(options, topics=("/none",)))


def test_clouds_without_poses_are_registered(tmp_path: Path) -> None:
    pytest.importorskip("kiss_icp")
    make = Make(mounted=(0, 0, 0))
    path = write_bag(tmp_path / "walk.mcap", make, make.clouds(8))
    assert describe_source(path).notes == ("no poses in it: odometry by KISS-ICP",)
    found = list(open_source(path, Options(max_depth=20.0)))
    start = inverse(make.sensor(found[0].stamp))
    for cycle in found:
        truth = start @ make.sensor(cycle.stamp)
        assert np.linalg.norm(cycle.pose[:3, 3] - truth[:3, 3]) < 0.05
    with (
        patch.dict(sys.modules, {"kiss_icp.kiss_icp": None}),
        pytest.raises(RecordingError, match=r"clouds without poses; .*dagmap\[lidar\]"),
    ):
        open_source(path)


def test_pictures_without_poses_are_registered(tmp_path: Path) -> None:
    make = Make()
    same = [make.camera_info(1.0)]
    color, depth = pictures(1)
    for i in range(3):
        rgb = np.ascontiguousarray(color[:, :, ::-1])
        same.append(make.image("/depth", 1.0 + i, depth, "16UC1"))
        same.append(make.image("/color", 1.0 + i, rgb, "rgb8"))
    path = write_bag(tmp_path / "walk.mcap", make, same)
    assert describe_source(path).notes == ("no poses in it: odometry by OpenCV",)
    assert [cycle.session for cycle in open_source(path)] == [0, 0, 0]
    for cycle in open_source(path):
        assert np.allclose(cycle.pose, np.eye(4), atol=1e-3)


def missing(make: Make, kind: str) -> list[Message]:
    drop = {
        "tf": lambda m: m[0] == "/tf_static",
        "camera": lambda m: m[0].endswith("camera_info"),
        "colour": lambda m: m[0] == "/camera/color/image_raw",
        "depth": lambda m: m[0] == "/camera/depth/image_raw",
    }[kind]
    messages = lidar(make) if kind == "tf" else rgbd(make)
    return [message for message in messages if not drop(message)]


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (
            "tf",
            "/odom tells where 'base_link' is, and no tf leads from there to 'lidar'.*same-frame",
        ),
        ("camera", "no camera info beside /camera/depth/image_raw; .* camera.json with --camera"),
        ("colour", "no colour pictures beside /camera/depth/image_raw"),
        ("depth", "neither clouds .* nor pictures with depth .*`dagmap inspect` lists"),
    ],
)
def test_what_is_missing_is_named(tmp_path: Path, kind: str, said: str) -> None:
    make = Make()
    path = write_bag(tmp_path / "walk.mcap", make, missing(make, kind))
    with pytest.raises(RecordingError, match=f"walk.mcap: {said}"):
        open_source(path)
    assert describe_source(path).problem is not None


def test_a_camera_that_is_not_calibrated_is_named(tmp_path: Path) -> None:
    make = Make()
    messages = [make.camera_info(m[2], 0.0) if "info" in m[0] else m for m in rgbd(make)]
    path = write_bag(tmp_path / "walk.mcap", make, messages)
    with pytest.raises(
        RecordingError, match="camera_info, message of 1.05.* not calibrated .*camera.json"
    ):
        open_source(path)
    camera = {"fx": 100.0, "fy": 110.0, "cx": 80.0, "cy": 60.0, "width": 160, "height": 120}
    (tmp_path / "camera.json").write_text(json.dumps({**camera, "depth_scale": 1000.0}))
    assert len(list(open_source(path, Options(camera=tmp_path / "camera.json")))) == 3


def shifted(messages: list[Message], topic: str, seconds: float) -> list[Message]:
    out = []
    for name, kind, stamp, said in messages:
        if name == topic:
            said.header.stamp = type(said.header.stamp)(
                said.header.stamp.sec + int(seconds), said.header.stamp.nanosec
            )
        out.append((name, kind, stamp, said))
    return out


def test_clocks_that_differ_are_named(tmp_path: Path) -> None:
    make = Make()
    late = shifted(lidar(make), "/odom", 100)
    with pytest.raises(RecordingError, match="none of 5 messages of /points has a pose of /odom"):
        open_source(write_bag(tmp_path / "a.mcap", make, late))
    late = shifted(rgbd(make), "/camera/color/image_raw", 100)
    with pytest.raises(RecordingError, match="no picture of /camera/color/image_raw lies within"):
        open_source(write_bag(tmp_path / "b.mcap", make, late))


def bad_clouds(make: Make) -> list[Message]:
    """Five clouds of which three cannot be used: promises, fields, and an old stamp."""
    clouds = make.clouds()
    points = np.ones((5, 3))
    stamps = [cloud[2] for cloud in clouds]
    clouds[1] = make.cloud(stamps[1], points, width=4_000_000_000, row_step=4_000_000_000)
    clouds[2] = make.cloud(stamps[2], points, fields=[])
    topic, kind, _, said = make.cloud(0.5, points)
    clouds[3] = (topic, kind, stamps[3], said)
    return in_order([make.mount(), *make.odometries(), *clouds])


def test_messages_that_cannot_be_used_are_named_or_left_out(tmp_path: Path) -> None:
    make = Make()
    path = write_bag(tmp_path / "walk.mcap", make, bad_clouds(make))
    with pytest.raises(RecordingError, match="/points, message of 1.35.* does not come after"):
        open_source(path)
    source = open_source(path, Options(keep_going=True))
    assert [cycle.stamp for cycle in source] == pytest.approx([1.05, 1.45])
    told = " ".join(source.skips.told)
    assert "4000000000 x 1 points of 16 bytes are promised, 80 bytes are there" in told
    assert "no field x among none" in told


@pytest.mark.parametrize("name", KINDS[:3])
@pytest.mark.parametrize("part", [0.0, 0.001, 0.02, 0.3, 0.7, 0.99])
def test_a_bag_that_was_cut_short(tmp_path: Path, name: str, part: float) -> None:
    """Never more than a message; what is whole is kept where that is asked for."""
    make = make_for(name)
    path = write_bag(tmp_path / name, make, lidar(make))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * part)])
    with pytest.raises(RecordingError, match=rf"{name}: "):
        list(open_source(path))
    try:
        found = list(open_source(path, Options(keep_going=True, same_frame=True)))
    except RecordingError as error:
        assert str(error).startswith(str(path))
        found = []
    if part == 0.99 and name != "walk.db3":
        assert len(found) >= 4


@pytest.mark.parametrize("packed", list(Writer.CompressionFormat))
def test_a_packed_bag_without_its_end(tmp_path: Path, packed: Writer.CompressionFormat) -> None:
    make = Make(ros2=False)
    path = write_bag(tmp_path / "walk.bag", make, lidar(make), packed)
    assert len(list(open_source(path))) == 5
    whole = path.read_bytes()
    path.write_bytes(whole[:-100])
    assert len(list(open_source(path, Options(keep_going=True)))) == 5


def test_huge_counts_in_messages_cost_nothing(tmp_path: Path) -> None:
    make = Make()
    path = write_bag(tmp_path / "walk.mcap", make, lidar(make))
    whole, name = path.read_bytes(), b"lidar\0"
    at = whole.index(name, whole.index(b"/points"))  # the frame, then height, width, fields
    at = (at + len(name) + 3) // 4 * 4
    for place in range(at - 16, at + 24, 3):  # every alignment
        path.write_bytes(whole[:place] + b"\xff\xff\xff\xff" + whole[place + 4 :])
        for keep_going in (True, False):
            try:
                list(open_source(path, Options(keep_going=keep_going)))
            except RecordingError as error:
                assert str(path) in str(error)


@pytest.mark.parametrize("name", KINDS[:3])
def test_damaged_bags_never_crash(tmp_path: Path, name: str) -> None:
    make, rng = make_for(name), np.random.default_rng(3)
    points = np.ones((20, 3))
    clouds = [make.cloud(1.05 + 0.1 * i, points) for i in range(5)]
    path = write_bag(tmp_path / name, make, in_order([make.mount(), *make.odometries(), *clouds]))
    whole = np.frombuffer(path.read_bytes(), np.uint8)
    for _ in range(25):
        damaged = whole.copy()
        damaged[rng.integers(0, len(whole), 12)] = rng.integers(0, 256, 12)
        at = int(rng.integers(0, len(whole) - 8))
        damaged[at : at + 4] = 255  # a huge count, if one is there
        path.write_bytes(damaged.tobytes())
        for keep_going in (False, True):
            try:
                for cycle in open_source(path, Options(keep_going=keep_going)):
                    assert len(cycle.points) <= 1000
            except RecordingError as error:
                assert str(path) in str(error)


def test_what_is_no_bag_is_named(tmp_path: Path) -> None:
    for name in KINDS[:3]:
        path = tmp_path / name
        path.write_bytes(b"")
        with pytest.raises(RecordingError, match=f"{name}: an empty file"):
            open_source(path)
        path.write_bytes(b"something else" * 100)
        with pytest.raises(RecordingError, match=f"{name}: damaged, cut short, or of another"):
            open_source(path)
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").touch()
    with pytest.raises(RecordingError, match="metadata.yaml: an empty file"):
        open_source(tmp_path / "bag")
    (tmp_path / "bag" / "metadata.yaml").write_text(
        "rosbag2_bagfile_information: {version: 99, relative_file_paths: []}"
    )
    with pytest.raises(RecordingError, match="bag: damaged, .* version 99 not supported"):
        open_source(tmp_path / "bag")
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V1.2\n" + bytes(100))
    with pytest.raises(RecordingError, match="old.bag: .*version 102 is not supported"):
        open_source(tmp_path / "old.bag")


def test_a_folder_whose_index_is_missing(tmp_path: Path) -> None:
    make = Make()
    folder = write_bag(tmp_path / "walk", make, lidar(make))
    (folder / "metadata.yaml").unlink()
    with pytest.raises(RecordingError, match="walk: .*walk.mcap .*no metadata.yaml.*reindex"):
        open_source(folder)
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 9, rel")
    with pytest.raises(RecordingError, match="walk: damaged, cut short"):
        open_source(folder)
    assert len(list(open_source(folder, Options(keep_going=True)))) == 5


def test_a_bag_of_several_files(tmp_path: Path) -> None:
    """As `--max-bag-size` splits it, more than nine of them; one that is damaged costs itself."""
    make, folder = Make(), tmp_path / "walk"
    folder.mkdir()
    messages, names = lidar(make), []
    for i in range(11):
        part = write_bag(tmp_path / f"part_{i}", make, messages[2 * i : 2 * i + 2] or messages[-1:])
        names.append(f"walk_{i}.mcap")
        next(part.glob("*.mcap")).rename(folder / names[-1])
    said = (tmp_path / "part_0" / "metadata.yaml").read_text()
    whole = write_bag(tmp_path / "whole", make, messages) / "metadata.yaml"
    said = whole.read_text().replace("- whole.mcap", "\n  ".join(f"- {name}" for name in names), 1)
    (folder / "metadata.yaml").write_text(said)
    source = open_source(folder)
    assert len(list(source)) == len(source) == 5
    (folder / "walk_1.mcap").write_bytes(b"damaged")
    with pytest.raises(RecordingError, match="walk: .*--keep-going"):
        open_source(folder)
    assert len(list(open_source(folder, Options(keep_going=True)))) == 4


def test_pictures_far_from_their_partners_fill_no_memory(tmp_path: Path) -> None:
    make = Make()
    messages = rgbd(make)
    depths = [m for m in messages if m[0] == "/camera/depth/image_raw"]
    late = [(*m[:2], m[2] + 100, m[3]) for m in depths]
    others = [m for m in messages if m not in depths]
    path = write_bag(tmp_path / "walk.mcap", make, in_order([*others, *late]))
    assert len(list(open_source(path))) == 3
    for name, most in (("_STORED", 2), ("_STORED_BYTES", 150_000)):
        with (
            patch.object(_bagged, name, most),
            pytest.raises(RecordingError, match="3 pictures of .* bytes wait .*ros2 bag convert"),
        ):
            list(open_source(path))


def test_without_rosbags_the_extra_is_named(tmp_path: Path) -> None:
    (tmp_path / "walk.bag").write_bytes(b"x")
    with (
        patch.dict(sys.modules, {"rosbags.highlevel": None}),
        pytest.raises(
            RecordingError, match=r"rosbags, which is not installed; pip install 'dagmap\[ros\]'"
        ),
    ):
        open_source(tmp_path / "walk.bag")


def test_inspect_says_what_it_would_use(tmp_path: Path) -> None:
    make = Make()
    path = write_bag(tmp_path / "walk.mcap", make, lidar(make))
    run = dagmap("inspect", path, "--json")
    assert run.returncode == 0
    said = json.loads(run.stdout)
    assert (said["kind"], said["cycles"], said["problem"]) == ("ROS 2 bag", 5, None)
    assert {i["name"]: i["use"] for i in said["items"]} == {
        "/odom": "poses", "/points": "clouds", "/tf_static": "frames",
    }  # fmt: skip
    run = dagmap("inspect", path)
    assert "/points" in run.stdout
    assert "5 cycles" in run.stdout
    path = write_bag(tmp_path / "no.mcap", make, [make.mount()])
    run = dagmap("inspect", path)
    assert run.returncode == 1
    assert "neither clouds" in run.stdout


def test_a_bag_becomes_a_map(tmp_path: Path) -> None:
    make = Make()
    path = write_bag(tmp_path / "walk.mcap", make, bad_clouds(make))
    run = dagmap("replay", path, "--out", tmp_path / "out", "--keep-going", "--json")
    assert run.returncode == 0, run.stderr
    assert json.loads(run.stdout)["robots"][0]["cycles"] == 2
    assert run.stderr.count("left out: ") == 3


def test_a_pose_between_two_others() -> None:
    a, b = pose_at(0.0), pose_at(4.0)
    assert np.allclose(between(a, b, 0.25), pose_at(1.0))
    assert np.allclose(between(a, a, 0.5), a)
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])
    assert np.allclose(between(np.eye(4), turned, 0.9), turned)


def test_frames_that_form_a_ring_end() -> None:
    tree = FrameTree()
    tree.add("a", "b", None, np.eye(4))
    tree.add("b", "a", None, np.eye(4))
    assert len(tree.above("a")) == 100
    assert tree.pose("c", "a", 0.0) is None


def test_depth_is_metres_whatever_its_encoding(tmp_path: Path) -> None:
    from dagmap.io.sources import _ros as ros

    make = Make()
    metres = np.array([[1.5, np.nan], [2.0, 0.25]], np.float32)
    _, kind, _, said = make.image("/depth", 1.0, metres, "32FC1")
    assert np.array_equal(ros.depth_picture(cv2, kind, said), metres, equal_nan=True)
    quantised = np.array([[100, 0]], np.uint16)
    data = struct.pack("<iff", 0, 300.0, 50.0) + cv2.imencode(".png", quantised)[1].tobytes()
    _, kind, _, said = make.compressed("/depth", 1.0, data, "32FC1; compressedDepth png")
    found = ros.depth_picture(cv2, kind, said)
    assert found[0, 0] == pytest.approx(6.0)
    assert np.isnan(found[0, 1])
    _, kind, _, said = make.compressed("/depth", 1.0, data[:-5], "32FC1; compressedDepth png")
    with pytest.raises(ros.Unusable, match="cut short or damaged"):
        ros.depth_picture(cv2, kind, said)
    _, kind, _, said = make.compressed("/depth", 1.0, data, "16UC1; compressedDepth rvl")
    with pytest.raises(ros.Unusable, match="RVL"):
        ros.depth_picture(cv2, kind, said)
    for encoding in ("yuv422", "rgb8"):
        _, kind, _, said = make.image("/depth", 1.0, np.zeros((2, 6), np.uint8), encoding)
        with pytest.raises(ros.Unusable):
            ros.depth_picture(cv2, kind, said)


def test_a_cloud_in_another_byte_order(tmp_path: Path) -> None:
    from dagmap.io.sources import _ros as ros

    make = Make()
    rows = np.zeros(2, [("x", ">f8"), ("y", ">f8"), ("z", ">f8")])
    rows["x"] = [1.0, 2.0]
    fields = [make.of("sensor_msgs/msg/PointField", n, 8 * i, 8, 1) for i, n in enumerate("xyz")]
    *_, said = make.cloud(
        1.0, np.zeros((2, 3)), fields=fields, is_bigendian=True, point_step=24, row_step=48,
        data=np.frombuffer(rows.tobytes(), np.uint8),
    )  # fmt: skip
    points, colors = ros.cloud_arrays(said)
    assert points.tolist() == [[1, 0, 0], [2, 0, 0]]
    assert colors is None


def test_a_definition_of_which_four_bytes_hold_millions_is_refused(tmp_path: Path) -> None:
    header = struct.pack("<III", 1, 100, 0) + struct.pack("<I", 5) + b"lidar"
    rule = "=" * 80
    definition = (
        f"Header header\nstd_msgs/Empty[] fields\n{rule}\nMSG: std_msgs/Header\nuint32 seq\n"
        f"time stamp\nstring frame_id\n{rule}\nMSG: std_msgs/Empty\n"
    )
    known = "2a07272eca11fef21f9464636e783977"  # by which rosbags takes it for the real one
    with Writer(tmp_path / "a.bag") as writer:
        topic = writer.add_connection(
            "/points", "sensor_msgs/msg/PointCloud2", msgdef=definition, md5sum=known
        )
        writer.write(topic, 100 * 10**9, header + struct.pack("<I", (1 << 32) - 1))
    with pytest.raises(RecordingError, match=r"a\.bag: a definition repeats std_msgs/msg/Empty"):
        list(open_source(tmp_path / "a.bag"))
