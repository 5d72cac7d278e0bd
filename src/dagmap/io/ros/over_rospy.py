"""ROS 1: topics through rospy, as bytes. Of ROS only rospy is needed, no packages of messages."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from .bridge import Quality
from .types import Types

_BUFFER = 1 << 24  # bytes: rospy reads a cloud in one go, or falls behind
_QUEUE = 100


class RospyLink:
    """A node that `rospy.init_node` has made. rospy: the module."""

    ros2 = False

    def __init__(self, rospy: Any) -> None:
        self._rospy, self._types = rospy, Types(ros2=False)
        self._open: list[Any] = []

    def subscribe(
        self, name: str, kind: str, quality: Quality, take: Callable[[bytes, str, str], None]
    ) -> None:
        """See `bridge.Link`."""
        self._open.append(
            self._rospy.Subscriber(
                _named(name),
                self._rospy.AnyMsg,
                partial(_hear, take),
                queue_size=_QUEUE,
                buff_size=_BUFFER,
                tcp_nodelay=True,
            )
        )

    def advertise(self, name: str, kind: str, still: bool) -> Callable[[bytes], None]:
        """See `bridge.Link`."""
        text, digest = self._types.definition(kind)
        fields = {"_type": kind.replace("/msg/", "/"), "_md5sum": digest, "_full_text": text}
        raw = type("Raw", (self._rospy.AnyMsg,), fields)  # bytes under the type's name
        publisher = self._rospy.Publisher(
            _named(name), raw, queue_size=1 if still else _QUEUE, latch=still
        )
        self._open.append(publisher)
        return partial(self._put, publisher, raw)

    def close(self) -> None:
        """Hear and say nothing more."""
        for each in self._open:
            each.unregister()

    def _put(self, publisher: Any, raw: Any, data: bytes) -> None:
        message = raw()
        message.deserialize(data)
        if not self._rospy.is_shutdown():
            publisher.publish(message)


def _hear(take: Callable[[bytes, str, str], None], message: Any) -> None:
    """In a thread of rospy's. The publisher's type and its definition come along."""
    said = message._connection_header
    kind = str(said.get("type", "")).replace("/", "/msg/", 1)
    take(bytes(message._buff), kind, str(said.get("message_definition", "")))


def _named(name: str) -> str:
    """ROS 1 writes private names without a slash."""
    return name.replace("~/", "~", 1)
