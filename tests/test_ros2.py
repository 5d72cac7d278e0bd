"""ROS 2 without ROS: the agent and another implementation of rmw_zenoh's format, over loopback."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
import zenoh_ros2_sdk as sdk

from bags import Make, room
from dagmap.io.ros.rmw import Node, Qos, Topic, attachment, gid
from dagmap.io.ros.types import Types
from dagmap.io.sources._ros import cloud_arrays
from robots import Nursery, Robot, agreed, running, until
from ros2 import DOMAIN, KINDS, Ros2, router, write_definitions
from test_rtabmap_msgs import drift, mapping

MAP, GRAPH, DIAGNOSTICS = (
    "sensor_msgs/msg/PointCloud2",
    "visualization_msgs/msg/MarkerArray",
    "diagnostic_msgs/msg/DiagnosticArray",
)


@pytest.fixture(scope="module")
def make() -> Make:
    made = Make(ros2=True)
    from rosbags import typesys

    from dagmap.io.sources._rtabmap_msgs import register

    register(made.types, typesys)
    return made


@pytest.fixture
def ros(tmp_path: Path, make: Make) -> Iterator[Ros2]:
    write_definitions(tmp_path / "definitions", make)
    with router() as port:
        ros = Ros2(port, tmp_path / "definitions")
        ros.port = port
        yield ros
        ros.close()


def table(port: int, namespace: str, **more: object) -> str:
    more = {"publish_period": 0.2, "patience": 60.0, **more}
    lines = "".join(f"{key} = {value!r}\n" for key, value in more.items()).replace("'", '"')
    return (
        f"[ros]\nvoxel = 0.02\n{lines}"
        f'[ros.zenoh]\ndomain = {DOMAIN}\nnamespace = "{namespace}"\n'
        f'connect = ["tcp/127.0.0.1:{port}"]\nlisten = ["tcp/127.0.0.1:0"]\n'
    )


def points_of(message: Any) -> np.ndarray:
    return cloud_arrays(message)[0]


def field_of(message: Any, name: str) -> np.ndarray:
    field = next(f for f in message.fields if f.name == name)
    kind = {2: "u1", 4: "<u2", 6: "<u4"}[field.datatype]
    rows = np.asarray(message.data, np.uint8).reshape(message.width, message.point_step)
    size = np.dtype(kind).itemsize
    return np.frombuffer(rows[:, field.offset : field.offset + size].tobytes(), kind)


def drive(ros: Ros2, make: Make, namespace: str, side: int, count: int = 5) -> None:
    """One robot's SLAM: its mounting, odometry, and clouds of more than half of the room."""
    world = room()
    half = world[side * world[:, 1] > -1]
    ros.publish(namespace, make.mount(f"lidar{side}"))
    for i in range(count):
        stamp = 1.05 + 0.1 * i
        ros.publish(namespace, make.odometry(1.0 + 0.1 * i))
        ros.publish(namespace, make.odometry(1.1 + 0.1 * i))
        sensor = make.sensor(stamp)
        seen = (half - sensor[:3, 3]) @ sensor[:3, :3]
        ros.publish(namespace, make.cloud(stamp, seen, f"lidar{side}"))


def test_two_robots_map_what_ros_publishes_and_publish_what_both_know(
    tmp_path: Path, nursery: Nursery, ros: Ros2, make: Make
) -> None:
    a = Robot(nursery, tmp_path, "a", more=table(ros.port, "/a", max_features=5000))
    b = Robot(nursery, tmp_path, "b", connect=(a.port,))
    b.more = table(ros.port, "/b", max_features=5000)
    with running(a, b):
        a.start()
        b.start()
        for name in ("a", "b"):
            ros.listen(f"/{name}/dagmap/map", MAP)
            ros.wait_for_listener(f"/{name}/points", f"/{name}/odom")
        ros.wait_for_listener("/tf_static", count=2)
        ros.listen("/diagnostics", DIAGNOSTICS)
        ros.listen("/a/dagmap/graph", GRAPH)
        ros.listen("/tf", "tf2_msgs/msg/TFMessage")
        drive(ros, make, "/a", side=1)
        drive(ros, make, "/b", side=-1)
        until(lambda: agreed(a, b, authors=2), "the robots to agree")

        def whole(topic: str) -> Any:
            message = ros.last(topic)
            if message is None or not message.width:
                return None
            y = points_of(message)[:, 1]
            both = field_of(message, "witnesses").max() == 2
            return message if y.min() < -2.9 and y.max() > 2.9 and both else None

        for topic in ("/a/dagmap/map", "/b/dagmap/map"):
            message = until(lambda topic=topic: whole(topic), f"both halves on {topic}")
            assert message.header.frame_id == "fleet"
            names = [field.name for field in message.fields]
            assert names == ["x", "y", "z", "rgb", "state", "hits", "misses", "witnesses"]
            walls = np.array([[-4, 4], [-3, 3], [-1, 2]])
            off = np.abs(points_of(message)[:, :, None] - walls).min(axis=(1, 2))
            assert np.quantile(off, 0.99) < 0.02
            confirmed = field_of(message, "witnesses") == 2
            assert set(field_of(message, "state")) == {0, 1}
            assert ((field_of(message, "state") == 0) == confirmed).all()
            assert (np.abs(points_of(message)[confirmed, 1]) < 1.1).all()
            assert (field_of(message, "hits") >= field_of(message, "witnesses")).all()
            colors = cloud_arrays(message)[1]
            assert colors is not None and set(map(tuple, colors)) == {(0x0A, 0x14, 0x1E)}

        markers = until(lambda: ros.last("/a/dagmap/graph"), "the DAG")
        marker = markers.markers[0]
        assert (marker.type, marker.header.frame_id) == (5, "odom")
        assert len(marker.points) > 100 and len(marker.points) % 2 == 0

        said = until(lambda: ros.last("/diagnostics"), "diagnostics").status[0]
        assert said.name in ("dagmap: a", "dagmap: b")
        transforms = until(
            lambda: [
                each
                for message in ros.heard.get("/tf", [])
                for each in message.transforms
                if each.header.frame_id == "fleet"
            ],
            "the transform of the fleet's frame",
        )
        assert {each.child_frame_id for each in transforms} == {"odom"}
        turn = transforms[-1].transform.rotation
        assert (turn.x, turn.y, turn.z, turn.w) == (0.0, 0.0, 0.0, 1.0)
        assert a.answer()["map"]["nodes"] == b.answer()["map"]["nodes"]
        assert a.stop() == b.stop() == 0


def test_the_graph_of_ros_shows_the_node_with_its_topics(
    tmp_path: Path, nursery: Nursery, ros: Ros2, make: Make
) -> None:
    a = Robot(nursery, tmp_path, "a", more=table(ros.port, "/r1"))
    with running(a):
        a.start()
        ros.wait_for_listener("/r1/points")
        (listener,) = until(lambda: ros.endpoints("/r1/points"), "the node")
        assert (listener.node_name, listener.topic_type) == ("dagmap", MAP)
        assert listener.node_namespace.strip("/") == "r1"
        (teller,) = until(lambda: ros.endpoints("/r1/dagmap/map", publishers=True), "a publisher")
        assert sdk.publisher.QosProfile.decode(teller.qos).durability.name == "TRANSIENT_LOCAL"
        assert teller.type_hash == listener.type_hash == Types(True).hash(MAP)
        assert a.stop() == 0
        until(lambda: not ros.endpoints("/r1/points"), "the node to leave the graph")


def test_a_map_is_kept_for_who_comes_later(
    tmp_path: Path, nursery: Nursery, ros: Ros2, make: Make
) -> None:
    a = Robot(nursery, tmp_path, "a", more=table(ros.port, "/", map="/map", publish_period=3600.0))
    with running(a):
        a.start()
        late = sdk.subscriber.QosProfile(durability=sdk.subscriber.QosDurability.TRANSIENT_LOCAL)
        until(lambda: ros.endpoints("/map", publishers=True), "a publisher")
        until(a.status, "the agent")

        def heard() -> bool:
            ros.listen("/map", MAP, qos=late)
            return ros.last("/map") is not None

        until(heard, "the map that was published once")
        assert a.stop() == 0


def test_bad_messages_are_told_of_and_stop_nothing(
    tmp_path: Path, nursery: Nursery, ros: Ros2, make: Make
) -> None:
    a = Robot(nursery, tmp_path, "a", more=table(ros.port, "/"))
    with running(a):
        a.start()
        ros.wait_for_listener("/points", "/odom", "/tf_static")
        ros.listen("/diagnostics", DIAGNOSTICS)
        topic, kind, _, cloud = make.cloud(1.0, room())
        ros.publish("", (topic, kind, 1.0, make.cloud(1.0, room(), row_step=1 << 30)[3]))
        key = Node(DOMAIN, "x", "/", "x").key(Topic(topic, kind, Types(True).hash(kind)))
        for junk in (b"", b"\0", bytes(100), bytes(make.types.serialize_cdr(cloud, kind))[:-20]):
            block = zenoh.CongestionControl.BLOCK
            ros.session.session.put(key, junk, congestion_control=block)
        ros.publish("", make.cloud(0.0, room()))  # no stamp
        drive(ros, make, "", side=1)
        until(lambda: a.answer()["cycles"] == 5, "the good ones")

        def refused() -> str:
            message = ros.last("/diagnostics")
            values = {} if message is None else {v.key: v.value for v in message.status[0].values}
            return str(values.get("messages refused"))

        until(lambda: refused() == "6", "diagnostics to count")
        assert 'event="message refused"' in a.log and "topic=cloud" in a.log
        assert a.stop() == 0


def test_rtabmap_feeds_a_robot_and_its_closures_move_the_map(
    tmp_path: Path, nursery: Nursery, ros: Ros2
) -> None:
    topics = {"map_data": "/rtabmap/mapData", "map_graph": "/rtabmap/mapGraph"}
    a = Robot(nursery, tmp_path, "a", more=table(ros.port, "/", **topics))
    with running(a):
        a.start()
        ros.wait_for_listener(*topics.values())
        ros.listen("/dagmap/map", MAP)
        ros.listen("/tf", "tf2_msgs/msg/TFMessage")
        for message in mapping():
            ros.publish("", message)

        def straight() -> bool:
            message = ros.last("/dagmap/map")
            if message is None or message.width != 200:
                return False
            places = points_of(message) - drift(1)[:3, 3]
            walls = np.array([[-4, 4], [-3, 3], [-1, 2]])
            return bool(np.abs(places[:, :, None] - walls).min(axis=(1, 2)).max() < 0.003)

        until(lambda: a.answer()["cycles"] >= 4, "four nodes")  # the closure may overtake some
        until(straight, "the map that the closure straightens")
        until(lambda: ros.last("/tf"), "a transform")
        assert ros.last("/tf").transforms[0].child_frame_id == "map"
        assert a.stop() == 0


class TestNames:
    node = Node(0, "a1b2", "/robot1", "dagmap")

    def test_of_a_node(self) -> None:
        assert self.node.token == "@ros2_lv/0/a1b2/0/0/NN/%/%robot1/dagmap"
        assert Node(7, "f", "/", "n").token == "@ros2_lv/7/f/0/0/NN/%/%/n"

    @pytest.mark.parametrize(
        ("name", "full"),
        [("/tf", "/tf"), ("points", "/robot1/points"), ("~/map", "/robot1/dagmap/map")],
    )
    def test_of_topics(self, name: str, full: str) -> None:
        assert self.node.resolved(name) == full

    def test_the_other_side_reads_what_this_one_writes(self) -> None:
        kind = "std_msgs/msg/String"
        topic = Topic("/robot1/chatter", kind, Types(True).hash(kind))
        token = self.node.endpoint(3, "MP", topic, Qos(best_effort=True, still=True, depth=5))
        said = sdk.discovery._parse_liveliness_keyexpr(token)
        assert said is not None
        assert (said["qualified_name"], said["node_name"]) == ("/robot1/chatter", "dagmap")
        assert (said["kind"], said["entity_id"], said["dds_type"]) == ("MP", 3, topic.dds)
        qos = sdk.publisher.QosProfile.decode(said["qos"])
        assert (qos.reliability.name, qos.durability.name) == ("BEST_EFFORT", "TRANSIENT_LOCAL")
        assert qos.history_depth == 5
        theirs = sdk.publisher.topic_keyexpr(0, topic.name, topic.dds, topic.hash)
        assert self.node.key(topic) == theirs
        back = sdk.service_client.Attachment.from_bytes(attachment(7, 8, gid(token)))
        assert (back.sequence_id, back.timestamp_ns, back.gid) == (7, 8, gid(token))

    def test_humble_has_no_hashes(self) -> None:
        key = self.node.key(Topic("/a", "std_msgs/msg/String"))
        assert key == "0/a/std_msgs::msg::dds_::String_/TypeHashNotSupported"

    def test_hashes_are_those_that_ros_and_the_other_side_compute(
        self, tmp_path: Path, make: Make
    ) -> None:
        types = Types(True)
        published = {  # by rosidl, in ROS 2's and RTAB-Map's generated code
            "std_msgs/msg/String": (
                "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
            ),
            MAP: "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
            "rtabmap_msgs/msg/MapData": (
                "4b8c747c152724ea5de4e2be8809313bb49c7ad3753b32b99e7f50587c4ea6c9"
            ),
            "rtabmap_msgs/msg/MapGraph": (
                "25c8097ccc472a2134e59113106a13302b0025829ef39e2066e2075fa84228c4"
            ),
        }
        assert {kind: types.hash(kind) for kind in published} == {
            kind: f"RIHS01_{digest}" for kind, digest in published.items()
        }
        write_definitions(tmp_path, make)
        files = {
            f"{path.parent.parent.name}/msg/{path.stem}": path.read_text()
            for path in tmp_path.rglob("*.msg")
        }
        for kind in KINDS:
            assert types.hash(kind) == sdk.utils.get_type_hash(kind, files[kind], files)
