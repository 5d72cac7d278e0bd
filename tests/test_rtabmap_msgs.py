"""RTAB-Map's MapData and MapGraph in bags: nodes, their words, and what a loop closure moves."""

from __future__ import annotations

import json
import sqlite3
import struct
import zlib
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from bags import Make, Message, pose_at, room, write_bag
from dagmap import Agent, Config, Cycle, Identity
from dagmap.config import GraphConfig
from dagmap.io.ros.types import Types
from dagmap.io.sources import Options, describe_source, open_source
from dagmap.io.sources._poses import inverse
from dagmap.io.sources._ros import Unusable
from dagmap.io.sources._rtabmap_graph import GraphFollower
from dagmap.io.sources._rtabmap_msgs import _DEFINITIONS
from dagmap.model import RecordingError
from test_replay import dagmap

TYPES = Types(ros2=True)
DATA, GRAPH = "rtabmap_msgs/msg/MapData", "rtabmap_msgs/msg/MapGraph"
NAN = float("nan")


def moved(x: float, y: float = 0.0) -> np.ndarray:
    out = np.eye(4)
    out[:2, 3] = x, y
    return out


def pose_message(matrix: np.ndarray) -> Any:
    return Make(ros2=True).pose(matrix)


def node(id_: int, stamp: float, pose: np.ndarray, words: np.ndarray, **more: Any) -> Any:
    points = [TYPES.make("rtabmap_msgs/msg/Point3f", x=x, y=y, z=z) for x, y, z in words.tolist()]
    keys = [TYPES.make("rtabmap_msgs/msg/KeyPoint", response=float(i)) for i in range(len(points))]
    given = {"word_pts": points, "word_kpts": keys, **more}
    return TYPES.make(
        "rtabmap_msgs/msg/Node", id=id_, stamp=stamp, pose=pose_message(pose), **given
    )


def graph(poses: dict[int, np.ndarray], stamp: float, **more: Any) -> Any:
    header = Make(ros2=True).header(stamp, "map")
    given = {
        "poses_id": np.array(list(poses), np.int32),
        "poses": [pose_message(pose) for pose in poses.values()],
        "map_to_odom": TYPES.make(
            "geometry_msgs/msg/Transform",
            rotation=TYPES.make("geometry_msgs/msg/Quaternion", w=1.0),
        ),
    }
    return TYPES.make(GRAPH, header=header, **{**given, **more})


def data(stamp: float, nodes: list[Any], poses: dict[int, np.ndarray]) -> Message:
    said = graph(poses, stamp)
    return "/rtabmap/mapData", DATA, stamp, TYPES.make(
        DATA, header=said.header, graph=said, nodes=nodes
    )  # fmt: skip


def drift(number: int) -> np.ndarray:
    """What the odometry of a node is off by."""
    return moved(0.0, 0.1 * number)


def mapping(closes: bool = True) -> list[Message]:
    """Four nodes a second apart; then a loop closure puts them where they were."""
    world, out = room()[:200], []
    for number in range(1, 5):
        truth = pose_at(float(number))
        words = (world - truth[:3, 3]) @ truth[:3, :3]
        poses = {n: drift(n) @ pose_at(float(n)) for n in range(1, number + 1)}
        out.append(data(number, [node(number, number, poses[number], words)], poses))
    if closes:
        closed = {n: drift(1) @ pose_at(float(n)) for n in range(1, 5)}
        out.append(("/rtabmap/mapGraph", GRAPH, 5.0, graph(closed, 5.0)))
    return out


def write(path: Path, messages: list[Message]) -> Path:
    make = Make(ros2=True)
    from rosbags import typesys

    from dagmap.io.sources._rtabmap_msgs import register

    register(make.types, typesys)
    return write_bag(path, make, messages)


@pytest.mark.parametrize("name", ["walk.mcap", "walk.db3", "walk"])
def test_nodes_come_with_their_words_and_a_closure_moves_them(tmp_path: Path, name: str) -> None:
    source = open_source(write(tmp_path / name, mapping()))
    found = list(source)
    assert len(source) == len(found) == 5
    assert [cycle.stamp for cycle in found] == pytest.approx([1, 2, 3, 4, 4.001])
    for number, cycle in enumerate(found[:4], 1):
        assert np.allclose(cycle.pose, drift(number) @ pose_at(float(number)), atol=1e-6)
        assert len(cycle.points) == 200 and cycle.moved is None
    last = found[4]
    assert len(last.points) == 0 and last.moved is not None
    stamps, poses = (np.asarray(each) for each in last.moved)
    assert stamps.tolist() == [2.0, 3.0, 4.0]
    for stamp, pose in zip(stamps, poses, strict=True):
        assert np.allclose(pose, drift(1) @ pose_at(stamp), atol=1e-6)


def test_after_a_closure_the_map_is_straight(tmp_path: Path) -> None:
    """What the nodes saw lies where it is, but for what the first one was off by."""
    dense = GraphConfig(reference_pitch=0.25, max_parent_distance=0.75)

    def off(messages: list[Message]) -> np.ndarray:
        agent = Agent(Identity.from_seed(bytes(32)), Config(graph=dense))
        path = write(tmp_path / f"{len(messages)}.mcap", messages)
        for cycle in open_source(path):
            agent.observe(cycle, float(cycle.stamp))
        for i in range(20):
            agent.tick(10.0 + i)
        agent.settle()
        places = agent.map.positions[agent.map.kept] - drift(1)[:3, 3]
        return np.abs(places[:, :, None] - [[-4, 4], [-3, 3], [-1, 2]]).min(axis=(1, 2))

    before, after = off(mapping(closes=False)), off(mapping())
    assert len(after) == 200 and after.max() < 0.003
    assert before.max() > 0.05


def test_a_bag_that_brings_no_definitions_is_read(tmp_path: Path) -> None:
    path = write(tmp_path / "walk.db3", mapping())
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("DELETE FROM message_definitions")  # as Humble records
    assert len(open_source(path)) == 5


def test_a_bag_of_ros_1_calls_fields_otherwise(tmp_path: Path) -> None:
    names = {"map_to_odom": "mapToOdom", "poses_id": "posesId", "from_id": "fromId"}
    make = Make(ros2=False)
    for name, text in _DEFINITIONS.items():
        for new, old in {**names, "to_id": "toId"}.items():
            text = text.replace(new, old)
        kind = f"rtabmap_msgs/msg/{name}"
        make.types.register(get_types_from_msg(text, kind))
    old = Types(ros2=False)
    old._store = make.types

    def like(kind: str, value: Any) -> Any:
        """The same message with the fields of ROS 1."""
        _, fields = make.types.fielddefs[kind]
        given = {}
        for field, (how, of) in fields:
            new = next((k for k, v in names.items() if v == field), field)
            new = "to_id" if field == "toId" else new
            if hasattr(value, new):
                found = getattr(value, new)
                if int(how) == 2:
                    found = like(of, found)
                elif int(how) == 4 and int(of[0][0]) == 2:
                    found = [like(of[0][1], each) for each in found]
                given[field] = found
        return old.make(kind, **given)

    messages = [(topic, kind, stamp, like(kind, said)) for topic, kind, stamp, said in mapping()]
    found = list(open_source(write_bag(tmp_path / "walk.bag", make, messages)))
    assert len(found) == 5 and found[4].moved is not None
    assert np.allclose(found[3].pose, drift(4) @ pose_at(4.0), atol=1e-6)


def test_inspect_says_what_is_used(tmp_path: Path) -> None:
    path = write(tmp_path / "walk.mcap", mapping())
    ran = dagmap("inspect", path, "--json")
    said = json.loads(ran.stdout)
    assert (ran.returncode, said["cycles"]) == (0, 5)
    used = {item["name"]: item["use"] for item in said["items"]}
    assert used == {"/rtabmap/mapData": "nodes", "/rtabmap/mapGraph": "moved"}
    assert "RTAB-Map" in said["notes"][0]


def test_clouds_are_preferred_unless_it_is_asked_for(tmp_path: Path) -> None:
    make = Make(ros2=True)
    messages = [*mapping(), make.mount(), *make.odometries(), *make.clouds()]
    path = write(tmp_path / "walk.mcap", sorted(messages, key=lambda message: message[2]))
    assert len(open_source(path)) == 5
    assert "odom" in describe_source(path).notes[0]
    asked = Options(topics=("/rtabmap/mapData",))
    assert "RTAB-Map" in describe_source(path, asked).notes[0]


class TestChoice:
    def words(self, **more: Any) -> list[list[float]]:
        words = np.array([[1, 0, 0], [NAN, 0, 0], [0, 0, 0], [9, 0, 0], [2, 0, 0], [3, 0, 0]])
        follower = GraphFollower(Options(max_depth=5.0, max_features=2), lambda what: None)
        message = data(1.0, [node(1, 1.0, np.eye(4), words, **more)], {1: np.eye(4)})[3]
        (cycle,) = follower.data(message)
        return np.asarray(cycle.points).tolist()

    def test_the_strongest_words_with_a_position_near_enough(self) -> None:
        assert self.words() == [[3, 0, 0], [2, 0, 0]]

    def test_words_without_keypoints_in_their_order(self) -> None:
        assert self.words(word_kpts=[]) == [[1, 0, 0], [2, 0, 0]]

    def test_local_features_where_there_are_no_words(self) -> None:
        point = TYPES.make("rtabmap_msgs/msg/Point3f", x=1.5)
        features = TYPES.make("rtabmap_msgs/msg/SensorData", points=[point])
        assert self.words(word_pts=[], data=features) == [[1.5, 0, 0]]


def matrix_bytes(values: np.ndarray, kind: int = 0) -> np.ndarray:
    """A matrix as RTAB-Map packs it: zlib, then rows, columns and OpenCV's type."""
    packed = zlib.compress(values.tobytes()) + struct.pack("<iii", *values.shape, kind)
    return np.frombuffer(packed, np.uint8)


class TestDescriptors:
    WORDS = np.array([[1, 0, 0], [NAN, 0, 0], [0, 0, 0], [9, 0, 0], [2, 0, 0], [3, 0, 0]])
    ORB = np.arange(6 * 32, dtype=np.uint8).reshape(6, 32)

    def cycles(self, *told: Any, options: Options | None = None) -> list[Cycle]:
        chosen = options or Options(max_depth=5.0)
        follower = GraphFollower(chosen, lambda what: None)
        found = []
        for number, more in enumerate(told, 1):
            said = node(number, float(number), np.eye(4), self.WORDS, **more)
            poses = {n: moved(0.5 * (len(told) - n)) for n in range(1, number + 1)}
            found += follower.data(data(float(number), [said], poses)[3])
        return found

    def test_come_with_their_words(self) -> None:
        (cycle,) = self.cycles({"word_descriptors": matrix_bytes(self.ORB)})
        assert np.asarray(cycle.points)[:, 0].tolist() == [3, 2, 1]  # the strongest first
        assert np.array_equal(np.asarray(cycle.descriptors), self.ORB[[5, 4, 0]])
        few = Options(max_depth=5.0, max_features=1)
        (cycle,) = self.cycles({"word_descriptors": matrix_bytes(self.ORB)}, options=few)
        assert np.array_equal(np.asarray(cycle.descriptors), self.ORB[[5]])

    def test_stay_with_a_cycle_that_brings_moves(self) -> None:
        more = {"word_descriptors": matrix_bytes(self.ORB)}
        poses = {1: np.eye(4), 2: moved(1.0)}
        follower = GraphFollower(Options(), lambda what: None)
        follower.data(data(1.0, [node(1, 1.0, np.eye(4), self.WORDS)], {1: np.eye(4)})[3])
        follower.data(data(2.0, [node(2, 2.0, np.eye(4), self.WORDS)], poses)[3])
        closed = {1: np.eye(4), 2: moved(1.5), 3: moved(2.0)}
        said = data(3.0, [node(3, 3.0, np.eye(4), self.WORDS, **more)], closed)[3]
        (cycle,) = follower.data(said)
        assert cycle.moved is not None and cycle.descriptors is not None

    def test_of_local_features_where_there_are_no_words(self) -> None:
        points = [TYPES.make("rtabmap_msgs/msg/Point3f", x=x) for x in (1.0, 2.0)]
        described = matrix_bytes(self.ORB[:2])
        features = TYPES.make("rtabmap_msgs/msg/SensorData", points=points, descriptors=described)
        (cycle,) = self.cycles({"word_pts": [], "data": features})
        assert np.array_equal(np.asarray(cycle.descriptors), self.ORB[:2])

    @pytest.mark.parametrize(
        "packed",
        [
            np.zeros(0, np.uint8),
            matrix_bytes(ORB[:5]),  # of fewer words
            matrix_bytes(ORB.reshape(3, 64)),  # of another kind
            matrix_bytes(ORB.reshape(12, 16)),
            matrix_bytes(np.zeros((6, 32), np.float32), 5),  # SURF
            matrix_bytes(ORB)[2:],
            matrix_bytes(ORB)[:7],
        ],
    )
    def test_that_do_not_fit_are_left_out(self, packed: np.ndarray) -> None:
        (cycle,) = self.cycles({"word_descriptors": packed})
        assert len(np.asarray(cycle.points)) == 3 and cycle.descriptors is None

    def test_by_the_name_of_ros_1(self) -> None:
        said = data(1.0, [node(1, 1.0, np.eye(4), self.WORDS)], {1: np.eye(4)})[3]
        fields = {name: getattr(said.nodes[0], name) for name in ("id", "stamp", "pose", "data")}
        fields["wordDescriptors"] = matrix_bytes(self.ORB)
        fields |= {"wordPts": said.nodes[0].word_pts, "wordKpts": said.nodes[0].word_kpts}
        old = SimpleNamespace(
            header=said.header, graph=said.graph, nodes=[SimpleNamespace(**fields)]
        )
        (cycle,) = GraphFollower(Options(), lambda what: None).data(old)
        assert np.array_equal(np.asarray(cycle.descriptors)[0], self.ORB[5])


class TestSessions:
    one = np.array([[1.0, 0, 0]])

    def follow(self, *messages: Message) -> list[Any]:
        follower = GraphFollower(Options(), lambda what: None)
        return [cycle for message in messages for cycle in follower.data(message[3])]

    def test_a_graph_without_any_node_of_before_is_a_new_session(self) -> None:
        a, b = moved(1.0), moved(5.0)
        found = self.follow(
            data(1.0, [node(1, 1.0, a, self.one)], {1: a}),
            data(2.0, [node(2, 2.0, b, self.one)], {2: b}),
        )
        assert [cycle.session for cycle in found] == [0, 1]

    def test_nodes_that_are_numbered_anew_are_a_new_session(self) -> None:
        """As where RTAB-Map starts again with an empty database."""
        first, again = self.follow(
            data(5.0, [node(1, 5.0, np.eye(4), self.one)], {1: np.eye(4)}),
            data(1.0, [node(1, 1.0, moved(9.0), self.one)], {1: moved(9.0)}),
        )
        assert (first.session, again.session, again.stamp) == (0, 1, 1.0)
        assert again.moved is None and np.allclose(again.pose, moved(9.0))

    def test_a_map_that_moves_as_a_whole_has_not_moved(self) -> None:
        """As where RTAB-Map optimises from the newest node, or joins an older map."""
        poses = {1: moved(1.0), 2: moved(2.0)}
        shift = pose_at(30.0)
        shifted = {n: shift @ pose for n, pose in poses.items()} | {3: shift @ moved(3.0)}
        *_, third = self.follow(
            data(1.0, [node(1, 1.0, poses[1], self.one)], {1: poses[1]}),
            data(2.0, [node(2, 2.0, poses[2], self.one)], poses),
            data(3.0, [node(3, 3.0, moved(3.0), self.one)], shifted),
        )
        assert third.moved is None and third.session == 0
        assert np.allclose(third.pose, moved(3.0), atol=1e-9)

    def test_a_node_that_is_told_again_is_no_news(self) -> None:
        a = data(1.0, [node(1, 1.0, np.eye(4), self.one)], {1: np.eye(4)})
        assert len(self.follow(a, a)) == 1

    @pytest.mark.parametrize("overtakes", range(5))
    def test_a_graph_that_overtakes_nodes_counts_all_the_same(self, overtakes: int) -> None:
        """Topics come by ways of their own; an older graph must not bend the map again."""
        *nodes, closure = mapping()
        follower = GraphFollower(Options(), lambda what: None)
        poses: dict[float, Any] = {}
        for topic, _, _, said in [*nodes[:overtakes], closure, *nodes[overtakes:]]:
            for cycle in follower.graph(said) if "Graph" in topic else follower.data(said):
                if cycle.moved is not None:
                    poses |= zip(*(np.asarray(each).tolist() for each in cycle.moved), strict=True)
                if len(cycle.points):
                    poses[float(cycle.stamp)] = cycle.pose
        assert {*poses} == {1.0, 2.0, 3.0, 4.0}
        for stamp, pose in poses.items():
            assert np.allclose(pose, drift(1) @ pose_at(stamp), atol=1e-6), stamp

    def test_an_older_graph_brings_nodes_that_the_newest_one_does_not_have(self) -> None:
        truth = {n: moved(float(n)) for n in (1, 2, 3)}
        shift = pose_at(30.0)
        _, third = self.follow(
            data(5.0, [node(1, 1.0, truth[1], self.one)], {n: truth[n] for n in (1, 2)}),
            data(4.0, [node(3, 3.0, truth[3], self.one)], {n: shift @ truth[n] for n in (1, 2, 3)}),
        )
        assert third.moved is None and np.allclose(third.pose, truth[3])

    def test_fields_as_ros_1_calls_them(self) -> None:
        said = data(1.0, [node(1, 1.0, np.eye(4), self.one)], {1: moved(2.0)})[3]
        old = SimpleNamespace(
            posesId=said.graph.poses_id, poses=said.graph.poses, header=said.graph.header,
            mapToOdom=said.graph.map_to_odom,
        )  # fmt: skip
        follower = GraphFollower(Options(), lambda what: None)
        (cycle,) = follower.data(SimpleNamespace(graph=old, nodes=said.nodes))
        assert np.allclose(cycle.pose, moved(2.0))
        assert follower.map_frame == "map"


class TestBad:
    def test_more_ids_than_poses(self, tmp_path: Path) -> None:
        good = mapping(closes=False)
        bad = good[1][3]
        bad = replace(bad, graph=graph({1: np.eye(4)}, 2.0, poses_id=np.arange(9, dtype=np.int32)))
        path = write(tmp_path / "walk.mcap", [good[0], (*good[1][:3], bad), *good[2:]])
        with pytest.raises(RecordingError, match="9 nodes are named, 1 poses.*--keep-going"):
            list(open_source(path))
        source = open_source(path, Options(keep_going=True))
        assert len(source) == len(list(source)) == 3
        assert len(source.skips.told) == 1

    def test_stamps_out_of_order(self, tmp_path: Path) -> None:
        good = mapping(closes=False)
        nodes = [node(9, 0.5, np.eye(4), np.ones((1, 3)))]
        late = data(3.0, nodes, {1: pose_at(1.0), 9: np.eye(4)})
        path = write(tmp_path / "walk.mcap", [*good[:3], late, good[3]])
        with pytest.raises(RecordingError, match="node 9: its stamp 0.5 does not come after 3"):
            list(open_source(path))
        assert len(open_source(path, Options(keep_going=True))) >= 4

    def test_a_node_that_is_left_out_is_not_moved(self, tmp_path: Path) -> None:
        messages = mapping()
        messages[2][3].nodes[0].word_pts[0].x = 1e9
        path = write(tmp_path / "walk.mcap", messages)
        with pytest.raises(RecordingError, match="node 3: cycle at 3.0.*not finite.*--keep-going"):
            list(open_source(path))
        found = list(open_source(path, Options(keep_going=True)))
        assert [cycle.stamp for cycle in found] == pytest.approx([1, 2, 4, 4.001])
        assert found[3].moved is not None
        assert np.asarray(found[3].moved[0]).tolist() == [2.0, 4.0]
        agent = Agent(Identity.from_seed(bytes(32)), Config())
        for cycle in found:
            agent.observe(cycle, float(cycle.stamp))

    def test_what_a_refused_message_would_have_moved_the_next_one_moves(self) -> None:
        told: list[str] = []
        follower = GraphFollower(Options(), told.append)
        for message in mapping(closes=False)[:2]:
            follower.data(message[3])
        closed = {n: drift(1) @ pose_at(float(n)) for n in (1, 2, 3)}
        bad = data(3.0, [node(3, 3.0, closed[3], np.ones((1, 3)))], closed)[3]
        bad.nodes[0].word_pts[0] = SimpleNamespace(x=1.0)
        with pytest.raises(AttributeError):
            follower.data(bad)
        (cycle,) = follower.graph(graph(closed, 4.0))
        assert cycle.moved is not None and np.asarray(cycle.moved[0]).tolist() == [2.0]
        far = {**closed, 2: moved(1e9)}
        assert follower.graph(graph(far, 5.0)) == [] and "node 2 would be 1e+09 m" in told[0]

    def test_a_wild_stamp_of_a_node_is_no_new_session(self) -> None:
        told: list[str] = []
        follower = GraphFollower(Options(), told.append)
        poses = {n: np.eye(4) for n in (1, 2)}
        found = []
        for id_, stamp in ((1, 1.0), (2, NAN), (2, 3e9), (1, NAN), (2, 2.0)):
            said = data(1.0, [node(id_, stamp, np.eye(4), np.ones((1, 3)))], poses)[3]
            found += follower.data(said)
        assert [(cycle.stamp, cycle.session) for cycle in found] == [(1.0, 0), (2.0, 0)]
        assert len(told) == 2

    def test_no_node_with_words(self, tmp_path: Path) -> None:
        nothing = np.zeros((0, 3))
        path = write(
            tmp_path / "walk.mcap", [data(1.0, [node(1, 1.0, np.eye(4), nothing)], {1: np.eye(4)})]
        )
        with pytest.raises(RecordingError, match="holds no node with a pose and words"):
            open_source(path)

    def test_a_bag_that_was_cut_short(self, tmp_path: Path) -> None:
        path = write(tmp_path / "walk.mcap", mapping())
        whole = path.read_bytes()
        path.write_bytes(whole[: len(whole) * 2 // 3])
        with pytest.raises(RecordingError, match="walk.mcap.*cut short"):
            open_source(path)

    def test_fields_of_no_known_version(self) -> None:
        follower = GraphFollower(Options(), lambda what: None)
        strange = SimpleNamespace(header=SimpleNamespace(frame_id="map"), poses=[])
        with pytest.raises(Unusable, match="version of rtabmap_msgs.*poses_id"):
            follower.graph(strange)

    def test_no_pose_is_no_pose(self) -> None:
        told: list[str] = []
        follower = GraphFollower(Options(), told.append)
        bad = pose_message(np.eye(4))
        bad = replace(bad, position=replace(bad.position, x=NAN))
        said = data(1.0, [replace(node(1, 1.0, np.eye(4), np.ones((1, 3))), pose=bad)], {})[3]
        assert inverse(np.eye(4)).shape == (4, 4) and follower.data(said) == []
        assert told == ["node 1 has no pose"]
