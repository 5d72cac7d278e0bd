"""Small bags, written by rosbags: a room that a robot walks through, as its sensors saw it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

Message = tuple[str, str, float, Any]  # topic, type, stamp s, message
WIDTH, HEIGHT = 160, 120


def pose_at(stamp: float) -> np.ndarray:
    """The robot turns as it goes along x."""
    yaw = 0.1 * stamp
    out = np.eye(4)
    out[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    out[0, 3] = 0.5 * stamp
    return out


def room() -> np.ndarray:
    """(N, 3) m: walls, floor and ceiling."""
    rng = np.random.default_rng(5)
    points = rng.uniform([-4, -3, -1], [4, 3, 2], (3000, 3))
    side = rng.integers(0, 6, len(points))
    for axis in range(3):
        for end, value in enumerate(((-4, -3, -1), (4, 3, 2))):
            points[side == 2 * axis + end, axis] = value[axis]
    return points


@dataclass
class Make:
    """Messages of one version of ROS. `mounted`: the sensor on the robot."""

    ros2: bool = True
    mounted: tuple[float, float, float] = (0.2, 0.0, 0.3)

    def __post_init__(self) -> None:
        self.types = get_typestore(Stores.ROS2_HUMBLE if self.ros2 else Stores.ROS1_NOETIC)
        if not self.ros2:  # which has no tf2
            frames = "geometry_msgs/TransformStamped[] transforms"
            self.types.register(get_types_from_msg(frames, "tf2_msgs/msg/TFMessage"))

    def of(self, kind: str, *args: Any, **more: Any) -> Any:
        return self.types.types[kind](*args, **more)

    def header(self, stamp: float, frame: str) -> Any:
        nanoseconds = round(stamp * 1e9)
        time = self.of("builtin_interfaces/msg/Time", nanoseconds // 10**9, nanoseconds % 10**9)
        first = () if self.ros2 else (0,)
        return self.of("std_msgs/msg/Header", *first, time, frame)

    def cloud(
        self, stamp: float, points: np.ndarray, frame: str = "lidar", **change: Any
    ) -> Message:
        kind = "sensor_msgs/msg/PointCloud2"
        rows = np.zeros(len(points), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
        for i, axis in enumerate("xyz"):
            rows[axis] = points[:, i]
        rows["rgb"] = 0x0A141E
        fields = [
            self.of("sensor_msgs/msg/PointField", name, 4 * i, 7, 1)
            for i, name in enumerate(("x", "y", "z", "rgb"))
        ]
        said: dict[str, Any] = {
            "header": self.header(stamp, frame), "height": 1, "width": len(rows), "fields": fields,
            "is_bigendian": False, "point_step": 16, "row_step": 16 * len(rows),
            "data": np.frombuffer(rows.tobytes(), np.uint8), "is_dense": True,
        }  # fmt: skip
        return "/points", kind, stamp, self.of(kind, **{**said, **change})

    def pose(self, matrix: np.ndarray) -> Any:
        yaw = np.arctan2(matrix[1, 0], matrix[0, 0])
        return self.of(
            "geometry_msgs/msg/Pose",
            self.of("geometry_msgs/msg/Point", *map(float, matrix[:3, 3])),
            self.of(
                "geometry_msgs/msg/Quaternion", 0.0, 0.0, float(np.sin(yaw / 2)),
                float(np.cos(yaw / 2)),
            ),
        )  # fmt: skip

    def odometry(self, stamp: float, child: str = "base_link") -> Message:
        kind, nothing = "nav_msgs/msg/Odometry", np.zeros(36)
        vector = self.of("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
        twist = self.of("geometry_msgs/msg/Twist", vector, vector)
        said = self.of(
            kind, self.header(stamp, "odom"), child,
            self.of("geometry_msgs/msg/PoseWithCovariance", self.pose(pose_at(stamp)), nothing),
            self.of("geometry_msgs/msg/TwistWithCovariance", twist, nothing),
        )  # fmt: skip
        return "/odom", kind, stamp, said

    def tf(
        self, stamp: float, parent: str, child: str, matrix: np.ndarray, static: bool
    ) -> Message:
        kind = "tf2_msgs/msg/TFMessage"
        pose = self.pose(matrix)
        place = pose.position
        transform = self.of(
            "geometry_msgs/msg/Transform",
            self.of("geometry_msgs/msg/Vector3", place.x, place.y, place.z), pose.orientation,
        )  # fmt: skip
        one = self.of(
            "geometry_msgs/msg/TransformStamped", self.header(stamp, parent), child, transform
        )
        return "/tf_static" if static else "/tf", kind, stamp, self.of(kind, [one])

    def mount(self, frame: str = "lidar") -> Message:
        matrix = np.eye(4)
        matrix[:3, 3] = self.mounted
        return self.tf(0.0, "base_link", frame, matrix, static=True)

    def sensor(self, stamp: float) -> np.ndarray:
        matrix = np.eye(4)
        matrix[:3, 3] = self.mounted
        return pose_at(stamp) @ matrix

    def clouds(self, count: int = 5) -> list[Message]:
        """At 1.05, 1.15, ... s: between two messages of odometry."""
        out, world = [], room()
        for i in range(count):
            stamp = 1.05 + 0.1 * i
            sensor = self.sensor(stamp)
            out.append(self.cloud(stamp, (world - sensor[:3, 3]) @ sensor[:3, :3]))
        return out

    def odometries(self) -> list[Message]:
        return [self.odometry(1.0 + 0.1 * i) for i in range(12)]

    def image(self, topic: str, stamp: float, pixels: np.ndarray, encoding: str) -> Message:
        kind = "sensor_msgs/msg/Image"
        said = self.of(
            kind, self.header(stamp, "camera"), pixels.shape[0], pixels.shape[1], encoding, 0,
            pixels.strides[0], np.frombuffer(pixels.tobytes(), np.uint8),
        )  # fmt: skip
        return topic, kind, stamp, said

    def compressed(self, topic: str, stamp: float, data: bytes, form: str) -> Message:
        kind = "sensor_msgs/msg/CompressedImage"
        said = self.of(kind, self.header(stamp, "camera"), form, np.frombuffer(data, np.uint8))
        return topic, kind, stamp, said

    def camera_info(
        self,
        stamp: float,
        fx: float = 100.0,
        model: str = "plumb_bob",
        d: tuple[float, ...] = (0.0,) * 5,
        p: tuple[float, ...] = (0.0,) * 12,
    ) -> Message:
        kind = "sensor_msgs/msg/CameraInfo"
        k = np.array([fx, 0, 80.0, 0, 110.0, 60.0, 0, 0, 1.0])
        roi = self.of("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        said = self.of(
            kind, self.header(stamp, "camera"), HEIGHT, WIDTH, model, np.array(d), k,
            np.eye(3).ravel(), np.array(p), 0, 0, roi,
        )  # fmt: skip
        return "/camera/color/camera_info", kind, stamp, said


def pictures(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """BGR and depth in mm, as in a TUM folder."""
    rng = np.random.default_rng(seed)
    blocks = rng.integers(0, 256, (HEIGHT // 8, WIDTH // 8, 3), np.uint8)
    color = np.kron(blocks, np.ones((8, 8, 1), np.uint8))
    depth = np.full((HEIGHT, WIDTH), 2000, np.uint16)
    depth[:, :40] = 0
    return color, depth


def write_bag(path: Path, make: Make, messages: list[Message], packed: Any = None) -> Path:
    """A file of ROS 1 or 2, or (without a suffix) a folder as `ros2 bag record` makes it."""
    types = make.types
    save: Callable[[Any, str], Any] = types.serialize_cdr if make.ros2 else types.serialize_ros1
    plugin = StoragePlugin.SQLITE3 if path.suffix == ".db3" else StoragePlugin.MCAP
    folder = path.with_name(path.stem + "_bag") if make.ros2 and path.suffix else path
    writer: Any = Writer1(path)
    if packed:
        writer.set_compression(packed)
    if make.ros2:
        writer = Writer2(folder, version=9, storage_plugin=plugin)
    with writer:
        topics: dict[str, Any] = {}
        for topic, kind, stamp, said in messages:
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=types)
            writer.write(topics[topic], round(stamp * 1e9), save(said, kind))
    if make.ros2 and path.suffix:
        next(folder.glob(f"*{path.suffix}")).rename(path)
    return path
