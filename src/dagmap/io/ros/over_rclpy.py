"""ROS 2 where it is installed: topics through rclpy, as CDR, over whatever middleware it has."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any

from ...model import NetworkError
from .bridge import Quality

_DEPTH = {"sensor": 10, "reliable": 100, "still": 100}


class RclpyLink:
    """A node of rclpy, which is spun in a thread of its own. rclpy: the module."""

    ros2 = True

    def __init__(self, rclpy: Any, node: Any) -> None:
        self._node, self._qos = node, import_module("rclpy.qos")
        self._utilities = import_module("rosidl_runtime_py.utilities")
        self._executor: Any = import_module("rclpy.executors").SingleThreadedExecutor()
        self._executor.add_node(node)
        self._rclpy = rclpy
        self._thread = threading.Thread(
            target=self._executor.spin, name="dagmap rclpy", daemon=True
        )
        self._thread.start()

    def subscribe(
        self, name: str, kind: str, quality: Quality, take: Callable[[bytes, str, str], None]
    ) -> None:
        """See `bridge.Link`. What is best effort hears reliable publishers, too."""
        profile = self._profile(_DEPTH[quality], quality == "sensor", quality == "still")
        hear = partial(_hear, take)
        self._node.create_subscription(self._class(kind), name, hear, profile, raw=True)

    def advertise(self, name: str, kind: str, still: bool) -> Callable[[bytes], None]:
        """See `bridge.Link`."""
        profile = self._profile(1 if still else 10, best_effort=False, still=still)
        publisher = self._node.create_publisher(self._class(kind), name, profile)
        return partial(_put, publisher)

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._thread.join()
        self._node.destroy_node()
        self._rclpy.try_shutdown()

    def _profile(self, depth: int, best_effort: bool, still: bool) -> Any:
        reliability, durability = self._qos.ReliabilityPolicy, self._qos.DurabilityPolicy
        return self._qos.QoSProfile(
            depth=depth,
            reliability=reliability.BEST_EFFORT if best_effort else reliability.RELIABLE,
            durability=durability.TRANSIENT_LOCAL if still else durability.VOLATILE,
        )

    def _class(self, kind: str) -> Any:
        """Raises NetworkError where the package of a type is not installed."""
        try:
            return self._utilities.get_message(kind)
        except (ImportError, AttributeError, ValueError) as error:
            package = kind.partition("/")[0]
            raise NetworkError(
                f"[ros]: the type {kind} is not installed ({error}); install the ROS package "
                f"{package}, or leave its topic empty"
            ) from None


def _hear(take: Callable[[bytes, str, str], None], raw: bytes) -> None:
    take(bytes(raw), "", "")


def _put(publisher: Any, data: bytes) -> None:
    publisher.publish(data)
