"""`dagmap export`: every format opened by a library that is not ours."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import cv2
import laspy
import numpy as np
import pye57
import pytest
from mcap.reader import make_reader
from plyfile import PlyData
from pypcd4 import PointCloud
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

from dagmap.config import Config
from dagmap.io.exported import Filter, MapTable, Observations, choose
from dagmap.io.ledger_map import read_map
from dagmap.io.sources import save_cycles
from dagmap.io.store import Store
from dagmap.io.writers import WriteOptions, formats, write_map
from dagmap.model import ConfigError, DagmapError, OutputError, State, StoreError
from scene import cycles
from test_replay import dagmap

ROBOTS = ("red", "green")


def table(count: int = 50) -> MapTable:
    """Nodes of all states, each seen by robot 0 at 10 s and, every other, by robot 1 at 20 s."""
    rng = np.random.default_rng(1)
    node = np.concatenate([np.arange(count), np.arange(0, count, 2)])
    second = np.arange(len(node)) >= count
    fields = {
        "state": (np.arange(count) % 3).astype("u1"),
        "hits": rng.integers(0, 1 << 20, count).astype("<u4"),
        "misses": rng.integers(0, 1 << 20, count).astype("<u4"),
        "witnesses": rng.integers(1, 5, count).astype("<u2"),
        "robot": np.zeros(count, "<u2"),
        "stamp": np.where(np.arange(count) % 2 == 0, 20.0, 10.0),
    }
    seen = Observations(
        node,
        second.astype(np.int64),
        np.where(second, 20.0, 10.0),
        np.tile([0.02, 0.02, 1.02], (len(node), 1)),
    )
    positions = rng.uniform(-3, 3, (count, 3)).astype(np.float32).astype(np.float64)
    colors = rng.integers(0, 256, (count, 3)).astype(np.uint8)
    return MapTable(positions, colors, fields, ROBOTS, seen)


FIELDS = tuple(table(1).fields)


def test_ply_is_read_by_plyfile(tmp_path: Path) -> None:
    world, path = table(), tmp_path / "map.ply"
    write_map(path, world)
    ply = PlyData.read(str(path))
    vertex = ply["vertex"]
    assert np.array_equal(np.column_stack([vertex[a] for a in "xyz"]), world.positions)
    assert np.array_equal(
        np.column_stack([vertex[c] for c in ("red", "green", "blue")]), world.colors
    )
    for name in FIELDS:
        assert np.array_equal(vertex[name], world.fields[name]), name
    assert "robot 1 is green" in ply.comments
    again = read_map(path)  # and by ourselves, as a map
    assert np.array_equal(again.fields["hits"], world.fields["hits"])


def test_pcd_is_read_by_pypcd4(tmp_path: Path) -> None:
    world, path = table(), tmp_path / "map.pcd"
    write_map(path, world)
    cloud = PointCloud.from_path(path)
    assert np.array_equal(cloud.numpy(("x", "y", "z")), world.positions)
    assert np.array_equal(PointCloud.decode_rgb(cloud.pc_data["rgb"]), world.colors)
    for name in FIELDS:
        assert np.array_equal(cloud.pc_data[name], world.fields[name]), name


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_is_read_by_laspy(tmp_path: Path, suffix: str) -> None:
    """Written through laspy too; of what is ours, the layout is tested here."""
    world, path = table(), tmp_path / f"map{suffix}"
    write_map(path, world)
    las = laspy.read(path)
    assert las.header.are_points_compressed == (suffix == ".laz")
    assert np.abs(las.xyz - world.positions).max() <= 0.0005 + 1e-9
    assert np.array_equal(
        np.column_stack([las.red, las.green, las.blue]), world.colors.astype(int) * 257
    )
    assert np.array_equal(las.gps_time, world.fields["stamp"])
    for name in set(FIELDS) - {"stamp"}:
        assert np.array_equal(las[name], world.fields[name]), name
    assert b"robot 1 is green" in las.vlrs.get_by_id("DAGmap")[0].record_data


def test_npz_is_read_by_numpy(tmp_path: Path) -> None:
    world, path = table(), tmp_path / "map.npz"
    write_map(path, world)
    with np.load(path) as arrays:
        assert np.array_equal(arrays["positions"], world.positions)
        assert np.array_equal(arrays["states"], world.fields["state"])
        assert np.array_equal(arrays["robot"], world.fields["robot"])
        assert arrays["robots"].tolist() == list(ROBOTS)


def test_e57_holds_a_scan_of_each_state(tmp_path: Path) -> None:
    world, path = table(), tmp_path / "map.e57"
    write_map(path, world)
    assert [file.name for file in tmp_path.iterdir()] == ["map.e57"]
    image = pye57.E57(str(path))
    assert image.scan_count == 3
    for i, state in enumerate(State):
        rows = world.fields["state"] == state
        scan = image.read_scan_raw(i)
        assert image.get_header(i)["name"].value() == state.name.lower()
        places = np.column_stack([scan[f"cartesian{axis}"] for axis in "XYZ"])
        assert np.allclose(places, world.positions[rows])
        assert np.array_equal(scan["intensity"], world.fields["witnesses"][rows])
        assert np.array_equal(scan["colorRed"], world.colors[rows, 0])
    image.close()


def test_mcap_holds_a_cloud_that_ros_reads(tmp_path: Path) -> None:
    world, path = table(), tmp_path / "map.mcap"
    write_map(path, world)
    with path.open("rb") as file:
        found = list(make_reader(file).iter_messages())
    assert len(found) == 1
    schema, channel, message = found[0]
    assert (schema.name, schema.encoding) == ("sensor_msgs/msg/PointCloud2", "ros2msg")
    assert (channel.topic, channel.message_encoding) == ("/dagmap/map", "cdr")
    types = get_typestore(Stores.ROS2_JAZZY)
    cloud = types.deserialize_cdr(message.data, schema.name)
    assert (cloud.width, cloud.height, cloud.header.frame_id) == (len(world), 1, "fleet")
    assert cloud.header.stamp.sec == 20
    codes = {2: "u1", 4: "u2", 6: "u4", 7: "f4", 8: "f8"}
    rows = np.frombuffer(
        cloud.data,
        {
            "names": [f.name for f in cloud.fields],
            "formats": [codes[f.datatype] for f in cloud.fields],
            "offsets": [f.offset for f in cloud.fields],
            "itemsize": cloud.point_step,
        },
    )
    assert np.array_equal(np.column_stack([rows[a] for a in "xyz"]), world.positions)
    for name in FIELDS:
        assert np.array_equal(rows[name], world.fields[name]), name


def one_ray() -> MapTable:
    """A node that was seen from (0.05, 0.05, 1) at 1 m, and one that only lies there."""
    positions = np.array([[1.05, 0.05, 1.0], [0.55, -0.45, 1.0], [0.05, 0.05, 5.0]])
    seen = Observations(
        np.array([0]), np.array([0]), np.array([1.0]), np.array([[0.05, 0.05, 1.0]])
    )
    return MapTable(
        positions,
        np.zeros((3, 3), np.uint8),
        {"state": np.zeros(3, "u1")},
        ("red",),
        seen,
    )


def grid(path: Path) -> tuple[np.ndarray, dict]:
    """As Nav2's map server does it: occupancy 0 to 1 from the darkness, the first row on top."""
    info = YAML(typ="safe").load(path.read_text())
    picture = cv2.imread(str(path.parent / info["image"]), cv2.IMREAD_UNCHANGED)
    occupancy = (255 - picture[::-1].astype(np.float64)) / 255
    known = np.full(picture.shape, -1)
    known[occupancy > info["occupied_thresh"]] = 100
    known[occupancy < info["free_thresh"]] = 0
    return known, info


def test_a_grid_is_what_nav2_loads(tmp_path: Path) -> None:
    write_map(tmp_path / "map.yaml", one_ray(), WriteOptions(resolution=0.1))
    known, info = grid(tmp_path / "map.yaml")
    assert (info["mode"], info["negate"], info["resolution"]) == ("trinary", 0, 0.1)

    def at(x: float, y: float) -> int:
        column, row = (int((v - o) // 0.1) for v, o in zip((x, y), info["origin"], strict=False))
        return int(known[row, column])

    assert at(1.05, 0.05) == at(0.55, -0.45) == 100
    assert all(at(0.1 * i + 0.05, 0.05) == 0 for i in range(10))  # the ray
    assert (known == 100).sum() == 2  # what lies at 5 m is not in the slice
    assert (known == 0).sum() == 10
    write_map(tmp_path / "map.yaml", one_ray(), WriteOptions(resolution=0.1, free=False))
    assert (grid(tmp_path / "map.yaml")[0] == 0).sum() == 0


@pytest.mark.parametrize("up", ["x", "-x", "y", "-y", "z", "-z"])
def test_up_turns_and_never_mirrors(up: str) -> None:
    turn = WriteOptions(up=up).upright(np.eye(3)).T
    assert np.linalg.det(turn) == pytest.approx(1.0)
    axis = np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1)
    assert (turn @ axis).tolist() == [0, 0, 1]


def test_an_octomap_is_read_by_octomap(tmp_path: Path) -> None:
    pyoctomap = pytest.importorskip("pyoctomap")
    world, path = table(), tmp_path / "map.bt"
    write_map(path, world, WriteOptions(resolution=0.1))
    tree = pyoctomap.OcTree(0.5)
    assert tree.readBinary(str(path))
    assert tree.getResolution() == pytest.approx(0.1)
    sizes = [line for line in path.read_bytes().split(b"\n") if line.startswith(b"size ")]
    assert tree.size() == int(sizes[0].split()[1]) == tree.calcNumNodes()
    for position in world.positions:
        assert tree.isNodeOccupied(tree.search(position))
    sensor, ends = world.rays()
    cells = {tuple(np.floor(p / 0.1).astype(int)) for p in world.positions}
    for a, b in zip(sensor, ends, strict=True):
        halfway = a + 0.5 * (b - a)
        if tuple(np.floor(halfway / 0.1).astype(int)) not in cells:
            node = tree.search(halfway)
            # Steps of half a cell may leave out the corner of one.
            if node is not None:
                assert not tree.isNodeOccupied(node)
    occupied, free = 0, 0
    for leaf in tree.begin_leafs():
        if tree.isNodeOccupied(leaf):
            occupied += 1
        else:
            free += 1
    assert occupied == len(cells)
    assert free > 50


def test_an_octomap_has_bounds(tmp_path: Path) -> None:
    far = replace(one_ray(), positions=one_ray().positions + 1e6)
    with pytest.raises(OutputError, match=r"reaches 1638.4 m .* coarser --resolution"):
        write_map(tmp_path / "map.bt", far)


def test_a_grid_has_bounds(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="no node lies between 7 and 8 m along z"):
        write_map(tmp_path / "map.yaml", one_ray(), WriteOptions(height=(7, 8)))
    wide = replace(one_ray(), positions=one_ray().positions * [1e5, 1e5, 1])
    with pytest.raises(OutputError, match="cells; a coarser"):
        write_map(tmp_path / "map.yaml", wide)


@pytest.mark.parametrize("suffix", sorted(formats()))
def test_a_map_without_observations_has_no_such_columns(tmp_path: Path, suffix: str) -> None:
    world = table()
    fields = {name: world.fields[name] for name in ("state", "hits", "misses", "witnesses")}
    write_map(tmp_path / f"map{suffix}", MapTable(world.positions, world.colors, fields))
    assert (tmp_path / f"map{suffix}").stat().st_size > 0


@pytest.mark.parametrize(
    ("suffix", "module", "extra"),
    [(".las", "laspy", "las"), (".laz", "lazrs", "las"), (".e57", "pye57", "e57"),
     (".mcap", "mcap.writer", "ros"), (".mcap", "rosbags.typesys", "ros")],
)  # fmt: skip
def test_a_library_that_is_missing_is_named(
    tmp_path: Path, suffix: str, module: str, extra: str
) -> None:
    with (
        patch.dict(sys.modules, {module: None}),
        pytest.raises(
            OutputError,
            match=rf"map{suffix}: written with {module.split('.')[0]}.*dagmap\[{extra}\]",
        ),
    ):
        write_map(tmp_path / f"map{suffix}", table())
    assert list(tmp_path.iterdir()) == []


def test_nodes_are_chosen_by_state_box_robot_and_time() -> None:
    world = table()
    confirmed = choose(world, Filter((State.CONFIRMED,)))
    assert set(confirmed.fields["state"]) == {0}
    everything = tuple(State)
    box = choose(world, Filter(everything, box=(0, 0, 0, 3, 3, 3)))
    assert len(box) == ((world.positions >= 0) & (world.positions <= 3)).all(axis=1).sum()
    green = choose(world, Filter(everything, robots=("green",)))
    assert np.array_equal(green.positions, world.positions[::2])
    assert len(choose(world, Filter(everything, robots=ROBOTS))) == len(world)
    late = choose(world, Filter(everything, since=15.0))
    assert np.array_equal(late.positions, world.positions[::2])
    early = choose(world, Filter(everything, until=15.0))
    assert len(early) == len(world)
    assert set(early.fields["stamp"]) == {10.0}  # of what passed
    assert len(choose(world, Filter(everything, robots=("red",), since=15.0))) == 0
    sensors, ends = green.rays()
    assert np.array_equal(ends, green.positions)
    assert len(sensors) == len(green)


def test_filters_that_cannot_be_are_named() -> None:
    with pytest.raises(OutputError, match="no robot of this name; there are red, green"):
        choose(table(), Filter(robots=("blue",)))
    with pytest.raises(OutputError, match="lower corner is wanted first"):
        Filter(box=(1, 1, 1, 0, 2, 2))
    with pytest.raises(OutputError, match="lies after --until"):
        Filter(since=2.0, until=1.0)
    with pytest.raises(OutputError, match="does not say who saw a node"):
        choose(replace(table(), observations=None), Filter(since=1.0))


@pytest.fixture(scope="module")
def replayed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("replayed")
    for i, name in enumerate(ROBOTS):
        save_cycles(
            folder / f"{name}.npz",
            (replace(cycle, colors=None) for cycle in cycles(i, count=8, points=120)),
        )
    run = dagmap(
        "replay", *(folder / f"{n}.npz" for n in ROBOTS), "--out", folder / "out", "--json"
    )
    assert run.returncode == 0, run.stderr
    return folder / "out", json.loads(run.stdout)


def test_a_ledger_folds_to_the_map_that_the_replay_wrote(replayed: tuple[Path, dict]) -> None:
    out, summary = replayed
    written, folded = read_map(out / "map.ply"), read_map(out)
    assert len(folded) == summary["map"]["nodes"] > 100
    assert np.array_equal(folded.positions.astype(np.float32), written.positions)
    for name in ("state", "hits", "misses", "witnesses"):
        assert np.array_equal(folded.fields[name], written.fields[name]), name
    assert sorted(folded.robots) == sorted(ROBOTS)
    seen = folded.observations
    assert seen is not None
    authors = [len(set(seen.robot[seen.node == i])) for i in range(len(folded))]
    assert authors == folded.fields["witnesses"].tolist()
    assert set(np.unique(seen.stamp)) <= set(map(float, range(8)))
    sensors, _ = folded.rays()
    assert np.allclose(sensors[:, 2], sensors[:, 2].round(2), atol=1e-9)
    assert np.abs(sensors).max() < 2.0  # where the robots walked
    one = read_map(out / "ledgers" / "red.db")
    assert np.array_equal(one.positions, folded.positions)


def test_the_command_exports_what_is_asked_for(replayed: tuple[Path, dict], tmp_path: Path) -> None:
    out, _ = replayed
    run = dagmap(
        "export", out, "--out", tmp_path / "part.npz", "--state", "tentative,rejected",
        "--robot", "red", "--box", "-9", "-9", "-9", "9", "9", "9", "--until", "3", "--json",
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    said = json.loads(run.stdout)
    with np.load(tmp_path / "part.npz") as arrays:
        assert len(arrays["positions"]) == said["nodes"] < said["of"]
        assert not (arrays["states"] == State.CONFIRMED).any()
        assert arrays["stamp"].max() <= 3.0
    again = dagmap("export", out, "--out", tmp_path / "part.npz")
    assert (again.returncode, "say --force" in again.stderr) == (2, True)
    run = dagmap("export", out, "--out", tmp_path / "part.npz", "--force")
    assert run.returncode == 0
    assert "nodes (" in run.stderr


def test_an_agents_file_is_enough(replayed: tuple[Path, dict], tmp_path: Path) -> None:
    ledger = replayed[0] / "ledgers" / "red.db"
    robot = tmp_path / "robot.toml"
    robot.write_text(f'name = "red"\n[store]\npath = "{ledger}"\n')
    assert len(read_map(robot)) == replayed[1]["map"]["nodes"]


def test_an_empty_ledger_is_an_empty_map(tmp_path: Path) -> None:
    Store.open(tmp_path / "ledger.db", Config().fleet_id).close()
    assert len(read_map(tmp_path)) == 0
    run = dagmap("export", tmp_path, "--out", tmp_path / "map.ply")
    assert (run.returncode, "none of 0 nodes passes" in run.stderr) == (2, True)


def test_bad_input_is_named(replayed: tuple[Path, dict], tmp_path: Path) -> None:
    def fails(error: type[DagmapError], match: str, path: Path, config: Path | None = None) -> None:
        with pytest.raises(error, match=match):
            read_map(path, config)

    fails(OutputError, "no such file or folder", tmp_path / "none")
    fails(OutputError, r"neither ledgers/\*.db nor ledger.db", tmp_path)
    (tmp_path / "no.db").write_bytes(b"SQLite format 3\0 but not really" * 100)
    fails(StoreError, "no.db: cannot be opened", tmp_path / "no.db")
    ledger = replayed[0] / "ledgers" / "red.db"
    other = tmp_path / "other.toml"
    other.write_text("[transaction]\nproof_of_work_bits = 24\n")
    fails(StoreError, "transactions do not hold under these parameters", ledger, other)
    other.write_text('fleet = "another"\n')
    fails(StoreError, "the ledger of fleet", ledger, other)
    fails(ConfigError, "cannot be read", ledger, tmp_path / "none.toml")
    (tmp_path / "ledgers").mkdir()
    (tmp_path / "ledgers" / "red.db").write_bytes(ledger.read_bytes())
    (tmp_path / "summary.json").write_text("{}")
    fails(OutputError, "summary.json: its `parameters` cannot be read", tmp_path)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--out", "map.xyz"), "the suffix names the format: .bt OctoMap"),
        (("--out", "map.ply", "--state", "good"), "--state: there is no 'good'"),
        (("--out", "map.bt", "--resolution", "0"), "0.001 to 1000 m is wanted"),
        (("--out", "map.yaml", "--height", "2", "1"), "the lower one is wanted first"),
        (("--out", "map.yaml", "--up", "w"), "--up w: one of z"),
    ],
)
def test_bad_options_are_named(arguments: tuple[str, ...], said: str, tmp_path: Path) -> None:
    run = dagmap("export", tmp_path, *arguments)
    assert run.returncode == 2
    assert said in run.stderr
    assert run.stderr.count("\n") == 1
