"""Messages of a robot's ROS as cycles: what waits, what is dropped, and what is told."""

from __future__ import annotations

import io
import random
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bags import Make, Message, pose_at, room
from dagmap import Agent, Config, Cycle, Identity
from dagmap.io.log import Log
from dagmap.io.queues import Inbox
from dagmap.io.ros import telling
from dagmap.io.ros.bridge import Bridge, _Backlog, _Heard
from dagmap.io.ros.config import RosConfig
from dagmap.io.ros.feed import Feed, wanted
from dagmap.io.ros.types import Types
from dagmap.io.runtime import Counts
from dagmap.io.settings import load_settings
from dagmap.io.sources._poses import inverse
from dagmap.io.sources._ros import Unusable, boundless, cloud_arrays, transforms
from dagmap.model import ConfigError
from test_rtabmap_msgs import data, drift, graph, moved, node

DOCS = Path(__file__).parents[1] / "docs"
MAKE = Make(ros2=True)
ROLES = {"/points": "cloud", "/odom": "odometry", "/tf": "tf", "/tf_static": "tf_static"}


def give(feed: Feed, *messages: Message, now: float = 0.0) -> list[Cycle]:
    return [cycle for topic, _, _, said in messages for cycle in feed.take(ROLES[topic], said, now)]


def cloud(stamp: float, frame: str = "lidar") -> Message:
    return MAKE.cloud(stamp, room(), frame)


class TestPoses:
    def test_a_cloud_waits_for_the_pose_behind_it(self) -> None:
        feed = Feed(RosConfig())
        give(feed, MAKE.mount(), MAKE.odometry(1.0))
        assert give(feed, cloud(1.05)) == [] and feed.waiting == 1
        (cycle,) = give(feed, MAKE.odometry(1.1))
        assert np.allclose(cycle.pose, MAKE.sensor(1.05), atol=1e-9)
        assert (cycle.stamp, feed.waiting, feed.problem) == (1.05, 0, None)

    def test_one_whose_pose_does_not_come_is_left_out_in_time(self) -> None:
        feed = Feed(RosConfig(patience=1.0))
        give(feed, MAKE.mount(), MAKE.odometry(1.0), cloud(1.05), now=10.0)
        assert feed.tick(10.9) == [] and feed.waiting == 1
        assert feed.tick(11.1) == [] and feed.waiting == 0
        assert (feed.dropped["clouds"], feed.problem) == (1, "no pose for its moment")
        (cycle,) = give(feed, cloud(1.15), MAKE.odometry(1.2), now=12.0)
        assert cycle.stamp == 1.15 and feed.problem is None

    def test_the_newest_pose_will_do_where_it_is_near(self) -> None:
        feed = Feed(RosConfig(patience=1.0))
        give(feed, MAKE.mount(), MAKE.odometry(1.04), cloud(1.05), now=10.0)
        (cycle,) = feed.tick(11.1)
        assert np.allclose(cycle.pose, MAKE.sensor(1.04))

    def test_without_the_mounting_it_says_what_lacks(self) -> None:
        feed = Feed(RosConfig(patience=0.0))
        give(feed, MAKE.odometry(1.0), MAKE.odometry(1.1), cloud(1.05))
        assert feed.dropped["clouds"] == 1
        assert feed.problem == "no pose for its moment"

    def test_poses_of_an_unnamed_frame_are_told_of(self) -> None:
        feed = Feed(RosConfig())
        give(feed, MAKE.odometry(1.0, ""), MAKE.odometry(1.1, ""))
        assert feed.assumed == ""  # nothing was made of it yet
        (cycle,) = give(feed, cloud(1.05), MAKE.odometry(1.2, ""))
        assert np.allclose(cycle.pose, pose_at(1.05), atol=1e-9)
        assert feed.assumed.startswith("odom does not say what it is the pose of")
        assert "same_frame = true" in feed.assumed and feed.problem is None
        feed = Feed(RosConfig(same_frame=True))
        give(feed, MAKE.odometry(1.0, ""), MAKE.odometry(1.2, ""), cloud(1.05))
        assert feed.assumed == ""
        feed = Feed(RosConfig())
        give(feed, MAKE.mount(), MAKE.odometry(1.0), MAKE.odometry(1.2), cloud(1.05))
        assert feed.assumed == ""

    def test_by_tf_alone(self) -> None:
        feed = Feed(RosConfig(odometry=""))
        assert [topic.role for topic in wanted(RosConfig(odometry=""))] == [
            "cloud", "tf", "tf_static",
        ]  # fmt: skip
        give(feed, MAKE.mount(), MAKE.tf(1.0, "map", "base_link", pose_at(1.0), False), cloud(1.05))
        assert feed.waiting == 1
        (cycle,) = give(feed, MAKE.tf(1.1, "map", "base_link", pose_at(1.1), False))
        assert np.allclose(cycle.pose, MAKE.sensor(1.05), atol=1e-9)
        name, pose = feed.map_frame() or ("", np.zeros(0))
        assert name == "map" and np.allclose(pose, np.eye(4))

    def test_the_map_frame_is_the_root_above_the_odometry(self) -> None:
        feed = Feed(RosConfig())
        give(feed, MAKE.mount(), MAKE.odometry(1.0), MAKE.odometry(1.2))
        assert feed.map_frame() == ("odom", pytest.approx(np.eye(4)))
        give(feed, MAKE.tf(1.2, "map", "odom", moved(3.0), False))
        name, pose = feed.map_frame() or ("", np.zeros(0))
        assert name == "map" and np.allclose(pose, inverse(moved(3.0)))

    def test_what_is_told_of_the_fleet_is_not_taken_for_news(self) -> None:
        feed = Feed(RosConfig())
        give(feed, MAKE.odometry(1.0), MAKE.tf(1.0, "fleet", "odom", moved(9.0), False))
        assert feed.map_frame() == ("odom", pytest.approx(np.eye(4)))

    def test_a_map_frame_that_is_not_there_is_told_of(self) -> None:
        feed = Feed(RosConfig(map_frame="map"))
        give(feed, MAKE.mount(), MAKE.odometry(1.0))
        assert feed.map_frame() is None and feed.lost_frame == "odom"
        give(feed, MAKE.tf(1.0, "map", "odom", moved(3.0), False))
        assert feed.map_frame() is not None and feed.lost_frame == ""


class TestBounds:
    def test_clouds_that_wait(self) -> None:
        feed = Feed(RosConfig(patience=60.0))
        for i in range(100):
            give(feed, cloud(1.0 + i))
        assert feed.waiting == 32 and feed.dropped["clouds"] == 68

    def test_poses_are_let_go_of(self) -> None:
        feed = Feed(RosConfig())
        give(feed, MAKE.mount())
        for i in range(2000):
            give(feed, MAKE.odometry(1 + 0.1 * i), MAKE.tf(0.1 * i, "x", "y", np.eye(4), False))
        assert len(feed._poses.trajectory) < 700
        assert len(feed._poses.tree._moving["y"]) < 700

    def test_frames_without_clouds_and_odometry(self) -> None:
        feed = Feed(RosConfig())
        for i in range(2000):
            give(feed, MAKE.tf(0.1 * i, "x", "y", np.eye(4), False))
        assert len(feed._poses.tree._moving["y"]) < 700
        many = MAKE.tf(1.0, "map", "a", np.eye(4), False)
        one = many[3].transforms[0]
        many[3].transforms = [replace(one, child_frame_id=f"f{i}") for i in range(3000)]
        give(feed, many)
        assert len(feed._poses.tree) == 1000

    def test_frames(self) -> None:
        feed = Feed(RosConfig())
        for i in range(3000):
            give(feed, MAKE.tf(1.0, "map", f"frame{i}", np.eye(4), True))
        assert len(feed._poses.tree) == 1000


class TestStamps:
    def ready(self) -> Feed:
        feed = Feed(RosConfig())
        give(feed, MAKE.mount(), *(MAKE.odometry(10.0 + 0.1 * i) for i in range(10)))
        assert len(give(feed, cloud(10.55))) == 1
        return feed

    def test_that_do_not_rise_are_refused(self) -> None:
        with pytest.raises(Unusable, match="its stamp 10.550000 does not come after"):
            give(self.ready(), cloud(10.55))

    def test_that_are_missing_are_refused(self) -> None:
        with pytest.raises(Unusable, match="no stamp"):
            give(Feed(RosConfig()), cloud(0.0))

    def test_a_clock_that_starts_anew_is_a_new_session(self) -> None:
        feed = self.ready()
        with pytest.raises(Unusable, match="its stamp 0.900000 is far from that of"):
            give(feed, MAKE.odometry(0.9))
        with pytest.raises(Unusable):
            give(feed, MAKE.odometry(0.95))
        give(feed, MAKE.odometry(1.0), MAKE.odometry(1.1))
        (cycle,) = give(feed, cloud(1.05))
        assert (cycle.session, cycle.stamp) == (1, 1.05)
        assert np.allclose(cycle.pose, MAKE.sensor(1.05), atol=1e-9)  # what is mounted stays

    @pytest.mark.parametrize("stamp", [0.0, 100_000.0])
    @pytest.mark.parametrize("what", [MAKE.odometry, cloud])
    def test_a_wild_one_is_no_new_session(
        self, stamp: float, what: Callable[[float], Message]
    ) -> None:
        feed = self.ready()
        with pytest.raises(Unusable, match="stamp"):
            give(feed, what(stamp))
        assert feed.newest < 11
        (cycle,) = give(feed, cloud(10.85), MAKE.odometry(11.0))
        assert (cycle.stamp, cycle.session) == (10.85, 0)


class TestFrames:
    def test_one_that_appears_above_the_fixed_one_changes_nothing(self) -> None:
        feed, found = Feed(RosConfig(odometry="")), []
        give(feed, MAKE.mount())
        for i in range(1, 7):
            give(feed, MAKE.tf(i, "odom", "base_link", pose_at(i), False))
            if i > 3:
                give(feed, MAKE.tf(i, "map", "odom", moved(50.0), False))
            found += give(feed, cloud(i))
        assert [cycle.session for cycle in found] == [0] * 6
        for cycle in found:
            assert np.allclose(cycle.pose, MAKE.sensor(cycle.stamp), atol=1e-9)

    def test_another_fixed_one_is_a_new_session(self) -> None:
        feed, found = Feed(RosConfig(odometry="")), []
        give(feed, MAKE.mount())
        for i in range(6):
            parent, stamp = ("odom", "other")[i > 2], 1 + 0.1 * i
            give(feed, MAKE.tf(stamp, parent, "base_link", moved(100.0 * (i > 2)), False))
            found += give(feed, cloud(stamp))
        assert [cycle.session for cycle in found] == [0] * 3 + [1] * 3
        assert len({tuple(np.asarray(cycle.pose)[:3, 3]) for cycle in found}) == 2

    def test_odometry_in_another_one_is_a_new_session(self) -> None:
        feed = Feed(RosConfig(same_frame=True))
        found = give(feed, MAKE.odometry(1.0), cloud(1.0))
        for i in range(1, 6):
            message = MAKE.odometry(1 + 0.1 * i)[3]
            header = replace(message.header, frame_id="other")
            other = ("/odom", "", 0.0, replace(message, header=header))
            if i < 3:
                with pytest.raises(Unusable, match="in 'other', the ones before it .* in 'odom'"):
                    give(feed, other)
            else:
                found += give(feed, other, cloud(1 + 0.1 * i))
        assert [cycle.session for cycle in found] == [0, 1, 1, 1]


def test_map_data_feeds_nodes_and_moves() -> None:
    feed = Feed(RosConfig(map_data="mapData", map_graph="mapGraph"), session=3)
    words = np.array([[1.0, 0, 0]])
    poses = {n: drift(n) @ pose_at(float(n)) for n in (1, 2)}
    for n in (1, 2):
        said = data(n, [node(n, n, poses[n], words)], {k: poses[k] for k in range(1, n + 1)})[3]
        (cycle,) = feed.take("map_data", said, 0.0)
        assert (cycle.stamp, cycle.session) == (n, 3)
    closed = {n: drift(1) @ pose_at(float(n)) for n in (1, 2)}
    (cycle,) = feed.take("map_graph", graph(closed, 3.0), 0.0)
    assert cycle.moved is not None and np.asarray(cycle.moved[0]).tolist() == [2.0]
    assert (feed.map_frame() or ("",))[0] == "map"
    with pytest.raises(Unusable, match="9 nodes are named"):
        wrong = graph(closed, 4.0, poses_id=np.arange(9, dtype=np.int32))
        feed.take("map_graph", wrong, 0.0)


@pytest.fixture(scope="module")
def agent() -> Agent:
    agent = Agent(Identity.from_seed(bytes(32)), Config(name="r1"))
    rng = np.random.default_rng(1)
    points = rng.uniform([2, -1, -1], [2.01, 1, 1], (3000, 3))
    colors = np.full((3000, 3), (1, 2, 3), np.uint8)
    agent.observe(Cycle(1.0, np.eye(4), points, colors=colors), 0.0)
    for i in range(30):
        agent.tick(1.0 + i)
    agent.settle()
    return agent


class TestTelling:
    @pytest.mark.parametrize("ros2", [True, False])
    def test_the_map(self, agent: Agent, ros2: bool) -> None:
        types, world = Types(ros2), agent.map
        raw = telling.map_message(types, world, 12.5, "fleet", most=10**6)
        message = types.decode(telling.CLOUD, raw)
        points, colors = cloud_arrays(message)
        assert np.allclose(points, world.positions[world.kept], atol=1e-5)
        assert colors is not None and (colors == (1, 2, 3)).all()
        stamp = message.header.stamp
        assert (stamp.sec, stamp.nanosec, message.header.frame_id) == (12, 500_000_000, "fleet")
        few = types.decode(telling.CLOUD, telling.map_message(types, world, 0.0, "x", most=100))
        assert few.width == 100

    @pytest.mark.parametrize("ros2", [True, False])
    def test_a_transform(self, ros2: bool) -> None:
        types, pose = Types(ros2), pose_at(3.0)
        raw = telling.transform_message(types, pose, "fleet", "map", 1.0)
        (found,) = transforms(types.decode(telling.TRANSFORMS, raw))
        assert found[:3] == ("fleet", "map", 1.0) and np.allclose(found[3], pose, atol=1e-8)

    def test_a_transform_may_lead_to_the_other_end_of_the_world(self) -> None:
        types, pose = Types(True), moved(-5.4e6, 1.0)
        raw = telling.transform_message(types, pose, "fleet", "utm", 1.0)
        ((_, _, _, found),) = transforms(types.decode(telling.TRANSFORMS, raw))
        assert np.allclose(found, pose)

    def test_the_graph_in_the_robots_map_frame(self) -> None:
        types = Types(True)
        edges = np.arange(12.0).reshape(2, 2, 3)
        raw = telling.graph_message(types, edges, moved(10.0), 1.0, "map")
        (marker,) = types.decode(telling.MARKERS, raw).markers
        assert [(p.x, p.y, p.z) for p in marker.points][:2] == [(10, 1, 2), (13, 4, 5)]


def picture_of(agent: Agent) -> telling.Picture:
    network = SimpleNamespace(here=frozenset(), waiting_bytes=0)
    runtime: Any = SimpleNamespace(agent=agent, counts=Counts(), network=network)
    return telling.take_picture(runtime, edges=100)


def test_diagnostics_say_how_it_stands(agent: Agent) -> None:
    types, picture = Types(True), picture_of(agent)
    assert picture.placed and picture.edges.shape == (100, 2, 3)

    def status(picture: telling.Picture, problem: str | None) -> Any:
        raw = telling.diagnostics_message(types, picture, {"clouds waiting": 3}, problem, 1.0)
        return types.decode(telling.DIAGNOSTICS, raw).status[0]

    good = status(picture, None)
    assert (good.level, good.name, good.message) == (0, "dagmap: r1", "mapping")
    values = {each.key: each.value for each in good.values}
    assert values["map nodes"] == str(len(agent.map)) and values["clouds waiting"] == "3"
    assert values["digest"] == agent.digest().hex()
    bad = status(picture, "nothing was heard")
    assert (bad.level, bad.message) == (1, "nothing was heard")
    lost = Agent(Identity.from_seed(bytes(32)), Config(start_pose=None))
    lost.observe(Cycle(1.0, np.eye(4), np.ones((9, 3))), 0.0)
    assert not picture_of(lost).placed
    assert status(picture_of(lost), None).message == "not placed in the fleet's frame yet"


def test_of_messages_that_wait_the_oldest_are_dropped() -> None:
    backlog = _Backlog(10_000)
    for i in range(20):
        backlog.put(_Heard("cloud", "", "", bytes([i]) * 1000))
    assert backlog.dropped == 12
    item = backlog.take(0.0)
    assert item is not None and item.raw[0] == 12
    for _ in range(7):
        assert backlog.take(0.0) is not None
    assert backlog.take(0.0) is None


@pytest.mark.parametrize("ros2", [True, False])
def test_the_published_definitions_are_bounded(ros2: bool) -> None:
    assert boundless(Types(ros2)._store.fielddefs) is None


@pytest.mark.parametrize("field", ["std_msgs/Empty[] all", "std_msgs/Empty[1000000] all", "A a"])
def test_a_type_of_which_four_bytes_hold_millions_is_not_learnt(field: str) -> None:
    inner = "\n".join(["", "=" * 80, "MSG: evil/A", "std_msgs/Empty[] all"])
    with pytest.raises(Unusable, match="repeats std_msgs/msg/Empty, which is empty"):
        Types(False).learn("evil/msg/X", field + (inner if field == "A a" else ""))


def test_a_stamp_that_ros_cannot_say_does_not_silence_the_robot(agent: Agent) -> None:
    raw = telling.map_message(Types(True), agent.map, 3e9, "fleet", 1000)
    assert Types(True).decode(telling.CLOUD, raw).header.stamp.sec == (1 << 31) - 1


def test_what_ros_1_sends_along_is_learnt() -> None:
    """rtabmap_msgs of ROS 1 calls fields otherwise: their definition comes with the messages."""
    kind = "rtabmap_msgs/msg/MapGraph"
    definition = "\n".join(
        [
            "Header header", "geometry_msgs/Transform mapToOdom", "int32[] posesId",
            "geometry_msgs/Pose[] poses", "Link[] links", "=" * 80, "MSG: rtabmap_msgs/Link",
            "int32 fromId", "int32 toId", "int32 type", "geometry_msgs/Transform transform",
            "float64[36] information",
        ]
    )  # fmt: skip
    theirs, ours = Types(False), Types(False)
    theirs.learn(kind, definition)
    poses = [theirs.make("geometry_msgs/msg/Pose")]
    raw = theirs.encode(kind, theirs.make(kind, posesId=np.ones(1, np.int32), poses=poses))
    with pytest.raises(Unusable, match="cannot be decoded as rtabmap_msgs/msg/MapGraph"):
        ours.decode(kind, raw)
    ours.learn(kind, definition)
    assert ours.decode(kind, raw).posesId.tolist() == [1]
    with pytest.raises(Unusable, match="definition of x_msgs/msg/Y cannot be read"):
        ours.learn("x_msgs/msg/Y", "int32[ x")


class Recorder:
    """A link that nobody is at the other end of."""

    ros2 = True

    def __init__(self) -> None:
        self.takes: dict[str, Callable[[bytes, str, str], None]] = {}

    def subscribe(self, name: str, kind: str, quality: str, take: Any) -> None:
        self.takes[name] = take

    def advertise(self, name: str, kind: str, still: bool) -> Callable[[bytes], None]:
        return lambda data: None

    def close(self) -> None:
        """There is nothing to close."""


def test_the_log_says_why_there_are_no_cycles() -> None:
    said = io.StringIO()
    bridge = Bridge(RosConfig(), Recorder(), Inbox(1 << 20, 1 << 20), Log(said, "warning"))
    for now in (1.0, 100.0):
        before = said.getvalue()
        bridge._question = None
        bridge._tell(now)
    assert not before and 'event="no cycles"' in said.getvalue()
    assert "nothing was heard yet on points, odom" in said.getvalue()


def test_the_log_says_once_what_is_assumed_of_the_poses() -> None:
    said = io.StringIO()
    bridge = Bridge(RosConfig(), Recorder(), Inbox(1 << 20, 1 << 20), Log(said, "warning"))
    give(bridge._feed, MAKE.odometry(1.0, ""), MAKE.odometry(1.2, ""), cloud(1.05))
    for now in (1.0, 100.0, 200.0):
        bridge._question = None
        bridge._tell(now)
    assert said.getvalue().count('event="frame assumed"') == 1
    assert "same_frame = true" in said.getvalue() and "no cycles" not in said.getvalue()
    assert "is taken for the sensor's" in str(bridge._said()[0]["assumed"])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("mapped", [False, True])
def test_mutated_messages_never_end_the_bridge(seed: int, mapped: bool) -> None:
    """Whatever the bytes, they are cycles or counted; the bridge goes on, and is not slow."""
    rng, types = random.Random(seed), Types(True)
    if mapped:
        said = data(1.0, [node(1, 1.0, np.eye(4), np.ones((5, 3)))], {1: np.eye(4)})
        messages = [("map_data", *said[1:])]
    else:
        few = MAKE.cloud(1.05, room()[:20])
        all_of = (few, MAKE.odometry(1.0), MAKE.mount())
        messages = [(ROLES[m[0]], *m[1:]) for m in all_of]
    config = RosConfig(map_data="mapData") if mapped else RosConfig()
    bridge = Bridge(config, Recorder(), Inbox(1 << 20, 1 << 20), Log(sys.stderr, "error"))
    for i in range(400):
        role, kind, _, message = rng.choice(messages)
        raw = bytearray(types.encode(kind, message))
        for _ in range(rng.randint(1, 8)):
            raw[rng.randrange(len(raw))] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
        if rng.random() < 0.3:
            del raw[rng.randrange(len(raw)) :]
        for cycle in bridge._decoded(_Heard(role, kind, "", bytes(raw)), float(i)):
            assert np.isfinite(np.asarray(cycle.points)).all()


class TestSettings:
    def read(self, tmp_path: Path, text: str) -> Any:
        path = tmp_path / "r.toml"
        path.write_text(f'[store]\npath = "ledger.db"\n{text}')
        return load_settings(path).config.ros

    def test_defaults(self, tmp_path: Path) -> None:
        ros = self.read(tmp_path, "[ros]\n")
        assert (ros.cloud, ros.odometry, ros.map, ros.zenoh.domain) == (
            "points",
            "odom",
            "~/map",
            0,
        )

    def test_the_documented_table_holds_the_defaults(self, tmp_path: Path) -> None:
        """The file in docs/ros.md shows every key, each with its default."""
        text = (DOCS / "ros.md").read_text()
        block = re.search(r"```toml\n(.*?)```", text, re.S)
        assert block is not None
        ros = self.read(tmp_path, block[1])
        assert ros == RosConfig()
        for key in (*ros.__struct_fields__, *ros.zenoh.__struct_fields__):
            assert re.search(rf"^(# |\[ros\.)?{key}\b", block[1], re.M), key

    @pytest.mark.parametrize("name", ["robot1", "robot2", "robot3"])
    def test_the_examples(self, name: str) -> None:
        settings = load_settings(DOCS.parent / "examples" / "ros" / f"{name}.toml")
        assert settings.config.name == name and settings.config.ros is not None
        assert settings.config.ros.zenoh.namespace == f"/{name}"

    @pytest.mark.parametrize(
        ("text", "said"),
        [
            ('[ros]\ncloud = "bad name"', "cloud = 'bad name'"),
            ('[ros]\ncloud = ""', "this or map_data is wanted"),
            ('[ros]\ntf = ""', "tf = ''"),
            ("[ros]\nvoxel = 0.0", "voxel = 0.0"),
            ("[ros]\npublish_period = 0", "publish_period"),
            ("[ros.zenoh]\ndomain = 300", "0 to 232"),
            ('[ros.zenoh]\nnamespace = "robot1"', "namespace"),
            ('[ros.zenoh]\nconnect = ["localhost"]', "tcp/localhost:7447"),
            ("[ros]\nclouds = 1", "clouds"),
            ('[ros]\n[source]\npath = "a.bag"', "one robot has one SLAM"),
        ],
    )
    def test_what_is_wrong_is_named(self, tmp_path: Path, text: str, said: str) -> None:
        with pytest.raises(ConfigError) as error:
            self.read(tmp_path, text)
        assert said in str(error.value) and str(tmp_path) in str(error.value)
