"""What a robot's file says of its ROS: topics, frames and bounds."""

from __future__ import annotations

import re
from typing import Literal

from ...config import _Checked
from ..sources import Options

_TOKEN = "[A-Za-z][A-Za-z0-9_]*"
_NAME = re.compile(rf"(~/|/)?{_TOKEN}(/{_TOKEN})*")
_NAMESPACE = re.compile(rf"/|(/{_TOKEN})+")


class ZenohConfig(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How `dagmap agent` reaches a ROS 2 that runs on rmw_zenoh, without ROS installed here."""

    domain: int = 0  # ROS_DOMAIN_ID
    namespace: str = "/"  # of relative topics, such as "/robot1"
    node: str = "dagmap"  # what `ros2 node list` shows
    mode: Literal["peer", "client"] = "peer"
    connect: tuple[str, ...] = ("tcp/localhost:7447",)  # the router, `ros2 run rmw_zenoh_cpp ...`
    listen: tuple[str, ...] = ("tcp/localhost:0",)  # where other nodes of this machine reach it
    type_hash: Literal["rihs01", "none"] = "rihs01"  # none: as Humble writes keys

    def __post_init__(self) -> None:
        self._require_range("domain", 0, 232)
        named = _NAMESPACE.fullmatch(self.namespace) is not None
        self._require(named, "namespace", 'one such as "/robot1", or "/", is wanted')
        named = re.fullmatch(_TOKEN, self.node) is not None
        self._require(named, "node", "letters, digits and underscores are wanted")
        for name in ("listen", "connect"):
            ends: tuple[str, ...] = getattr(self, name)
            right = all("/" in end.strip("/") for end in ends)
            self._require(right, name, 'endpoints such as "tcp/localhost:7447" are wanted')


class RosConfig(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Topics of the robot's SLAM, and those on which the fleet's map is told.

    Names may be absolute (`/tf`), relative to the namespace (`points`) or to the node (`~/map`).
    """

    cloud: str = "points"  # sensor_msgs/PointCloud2
    odometry: str = "odom"  # nav_msgs/Odometry; empty: where the sensor is says tf alone
    map_data: str = ""  # rtabmap_msgs/MapData: instead of the two above
    map_graph: str = ""  # rtabmap_msgs/MapGraph, with it
    tf: str = "/tf"
    tf_static: str = "/tf_static"
    frame: str | None = None  # of tf alone: the frame that stands still
    same_frame: bool = False  # poses are those of the sensor, whatever their frames are called
    map: str = "~/map"  # PointCloud2: x y z rgb state hits misses witnesses
    graph: str = "~/graph"  # MarkerArray: edges of the adjacency DAG; empty: none
    diagnostics: str = "/diagnostics"  # DiagnosticArray; empty: none
    fleet_frame: str = "fleet"  # what tf calls the fleet's frame; empty: no transform is told
    map_frame: str = ""  # its child; default: the root of tf above the frame of the poses
    publish_period: float = 2.0  # s between two maps
    tf_period: float = 0.1  # s between two transforms
    max_nodes: int = 500_000  # of a map that is told; of more it is thinned evenly
    max_edges: int = 2_000  # the newest ones
    patience: float = 1.0  # s that a cloud waits for its pose
    max_features: int = 1000  # points that a cloud or a node gives at most
    max_depth: float | None = None  # m, points beyond are dropped
    voxel: float = 0.1  # m: of a cloud one point a voxel is kept
    queue_bytes: int = 64 << 20  # of messages that wait; of more the oldest is dropped
    zenoh: ZenohConfig = ZenohConfig()

    def __post_init__(self) -> None:
        for name in self.topics:
            given = getattr(self, name)
            named = _NAME.fullmatch(given) is not None
            empty = not given and name not in ("tf", "tf_static", "map")
            self._require(named or empty, name, 'a topic such as "/robot1/points" is wanted')
        self._require(bool(self.cloud or self.map_data), "cloud", "this or map_data is wanted")
        self._require_range("publish_period", 0.05, 3600.0)
        self._require_range("tf_period", 0.01, 3600.0)
        self._require_range("max_nodes", 1, 1 << 26)
        self._require_range("max_edges", 1, 1 << 22)
        self._require_range("patience", 0.0, 60.0)
        self._require_range("queue_bytes", 1 << 16, 1 << 32)
        self.options()

    @property
    def topics(self) -> tuple[str, ...]:
        """Names of the fields that are topics."""
        heard = ("cloud", "odometry", "map_data", "map_graph", "tf", "tf_static")
        return (*heard, "map", "graph", "diagnostics")

    def options(self) -> Options:
        """What the readers take. Raises ConfigError where one is out of its range."""
        return Options(max_features=self.max_features, max_depth=self.max_depth, voxel=self.voxel)
