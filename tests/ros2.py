"""Another implementation of rmw_zenoh's format (zenoh-ros2-sdk), as the robot's own SLAM."""

from __future__ import annotations

import dataclasses
import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import zenoh

os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")  # it could fetch types by git: it need not
import zenoh_ros2_sdk as sdk

from bags import Make, Message
from robots import until

DOMAIN = 42
KINDS = (
    "sensor_msgs/msg/PointCloud2",
    "nav_msgs/msg/Odometry",
    "tf2_msgs/msg/TFMessage",
    "visualization_msgs/msg/MarkerArray",
    "diagnostic_msgs/msg/DiagnosticArray",
    "rtabmap_msgs/msg/MapData",
    "rtabmap_msgs/msg/MapGraph",
)


@contextmanager
def router() -> Iterator[int]:
    """What `rmw_zenohd` is: a router on a port of loopback."""
    for _ in range(10):
        with socket.socket() as sock:
            sock.bind(("127.0.0.1", 0))
            port = int(sock.getsockname()[1])
        config = zenoh.Config()
        config.insert_json5("mode", '"router"')
        config.insert_json5("listen/endpoints", f'["tcp/127.0.0.1:{port}"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        try:
            session = zenoh.open(config)
        except zenoh.ZError:  # somebody else took the port meanwhile
            continue
        try:
            yield port
        finally:
            session.close()
        return
    raise AssertionError("no port for a router")


def write_definitions(folder: Path, make: Make) -> None:
    """`.msg` files as a ROS installation has them, so that the other side loads its own types."""
    for kind in KINDS:
        text, _ = make.types.generate_msgdef(kind, ros_version=2)
        name = kind.replace("/msg/", "/")
        for i, part in enumerate(text.split("=" * 80)):
            if i:
                head, _, part = part.strip().partition("\n")
                name = head.removeprefix("MSG: ")
            package, _, base = name.partition("/")
            path = folder / package / "msg" / f"{base.rpartition('/')[2]}.msg"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(part)


class Ros2:
    """A ROS 2 machine on the router: publishes, hears, lists. One at a time in a process."""

    def __init__(self, port: int, definitions: Path) -> None:
        self.session = sdk.ZenohSession(router_ip="127.0.0.1", router_port=port)
        sdk.ZenohSession._instance = self.session  # what publishers and registries share
        registry = sdk.get_registry()  # one for the process, of types in the session before
        registry.messages_dir, registry._loaded_types = definitions, set()
        self._open: list[Any] = []
        self._publishers: dict[str, Any] = {}
        self._lock = threading.Lock()
        self.heard: dict[str, list[Any]] = {}

    def publish(self, namespace: str, message: Message) -> None:
        """A message as `bags.Make` makes it; relative topics go below the namespace."""
        topic, kind, _, said = message
        name = topic if topic[:3] == "/tf" else namespace + topic
        if name not in self._publishers:
            self._publishers[name] = self._publisher(name, kind)
        fields = {field.name: getattr(said, field.name) for field in dataclasses.fields(said)}
        self._publishers[name].publish(**{k: v for k, v in fields.items() if k[:2] != "__"})

    def _publisher(self, name: str, kind: str) -> Any:
        """One that loses nothing: by default what is too much is dropped, and so is what is said
        before it is known here that somebody listens."""
        made = sdk.ROS2Publisher(name, kind, domain_id=DOMAIN)
        made.pub.undeclare()
        control = zenoh.CongestionControl.BLOCK
        made.pub = self.session.session.declare_publisher(made.keyexpr, congestion_control=control)
        self._open.append(made)
        until(lambda: made.pub.matching_status.matching, f"somebody to hear {name}")
        return made

    def listen(self, topic: str, kind: str, qos: str | None = None) -> None:
        def take(message: Any) -> None:
            with self._lock:
                self.heard.setdefault(topic, []).append(message)

        made = sdk.ROS2Subscriber(topic, kind, take, qos=qos, domain_id=DOMAIN)
        self._open.append(made)

    def last(self, topic: str) -> Any:
        """The newest message of a topic that is listened to, or None."""
        with self._lock:
            return (self.heard.get(topic) or [None])[-1]

    def endpoints(self, topic: str, publishers: bool = False) -> list[Any]:
        """Who subscribes (or publishes), as `ros2 topic info -v` says it."""
        info = sdk.get_topic_info(topic, domain_id=DOMAIN, verbose=True)
        if info is None:
            return []
        return list(info.publishers if publishers else info.subscribers)

    def wait_for_listener(self, *topics: str, count: int = 1) -> None:
        for topic in topics:
            found = partial(self.endpoints, topic)
            until(lambda found=found: len(found()) >= count, f"{count} to subscribe to {topic}")

    def close(self) -> None:
        for each in self._open:
            each.close()
        self.session.close()
