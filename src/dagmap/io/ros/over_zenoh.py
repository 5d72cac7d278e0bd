"""ROS 2 without ROS: its topics over Zenoh, as rmw_zenoh carries them."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

from ..settings import NetworkConfig
from ..transport import load_zenoh, open_session
from .bridge import Quality
from .config import ZenohConfig
from .rmw import Node, Qos, Topic, attachment, gid
from .types import Types

_HEARTBEAT = 0.5  # s: how soon somebody notices that the last map was lost
_HISTORY = 100  # messages of one topic that were said before, as tf2 asks for


class ZenohLink:
    """A node of the ROS graph. Raises NetworkError that names the endpoint or the extra."""

    ros2 = True

    def __init__(self, config: ZenohConfig) -> None:
        self._zenoh, self._types, self._config = load_zenoh(), Types(ros2=True), config
        listen = config.listen if config.mode == "peer" else ()
        network = NetworkConfig(
            mode=config.mode, connect=config.connect, listen=listen, scouting=False
        )
        self._session = open_session(self._zenoh, network, Path(), "ros.zenoh")
        session = str(self._session.info.zid())
        self.node = Node(config.domain, session, config.namespace, config.node)
        self._numbers = count(1)
        self._declared: list[object] = []
        self._declare_token(self.node.token)
        self.unsent = 0

    def subscribe(
        self, name: str, kind: str, quality: Quality, take: Callable[[bytes, str, str], None]
    ) -> None:
        """See `bridge.Link`."""
        still = quality == "still"
        topic = self._topic(name, kind)
        hear, key = partial(self._hear, take), self.node.heard(topic)
        others = self._zenoh.Locality.REMOTE  # the node's own transforms among them are not news
        if still:
            history = self._zenoh.ext.HistoryConfig(
                detect_late_publishers=True, max_samples=_HISTORY
            )
            listening = self._zenoh.ext.declare_advanced_subscriber(
                self._session, key, hear, allowed_origin=others, history=history
            )
        else:
            listening = self._session.declare_subscriber(key, hear, allowed_origin=others)
        self._declared.append(listening)
        sensor = quality == "sensor"
        qos = Qos(best_effort=sensor, still=still, depth=10 if sensor else _HISTORY)
        self._declare_token(self.node.endpoint(next(self._numbers), "MS", topic, qos))

    def advertise(self, name: str, kind: str, still: bool) -> Callable[[bytes], None]:
        """See `bridge.Link`."""
        topic, qos = self._topic(name, kind), Qos(still=still, depth=1 if still else 10)
        key, control = self.node.key(topic), self._zenoh.CongestionControl
        if still:
            ext = self._zenoh.ext
            publisher = ext.declare_advanced_publisher(
                self._session,
                key,
                congestion_control=control.BLOCK,  # large ones must not be dropped in the middle
                cache=ext.CacheConfig(max_samples=1),
                sample_miss_detection=ext.MissDetectionConfig(sporadic_heartbeat=_HEARTBEAT),
                publisher_detection=True,
            )
        else:
            publisher = self._session.declare_publisher(key, congestion_control=control.DROP)
        token = self.node.endpoint(next(self._numbers), "MP", topic, qos)
        self._declared.append(publisher)
        self._declare_token(token)
        return partial(self._put, publisher, count(1), gid(token))

    def close(self) -> None:
        """Leave the graph."""
        with suppress(self._zenoh.ZError):  # a link that gave up closes by itself
            self._session.close()  # type: ignore[no-untyped-call]

    def _topic(self, name: str, kind: str) -> Topic:
        full = self.node.resolved(name)
        if self._config.type_hash == "none":
            return Topic(full, kind)
        return Topic(full, kind, self._types.hash(kind))

    def _declare_token(self, key: str) -> None:
        self._declared.append(self._session.liveliness().declare_token(key))

    def _hear(self, take: Callable[[bytes, str, str], None], sample: Any) -> None:
        """In a thread of Zenoh's."""
        if sample.kind == self._zenoh.SampleKind.PUT:
            take(sample.payload.to_bytes(), "", "")

    def _put(self, publisher: Any, numbers: Any, sender: bytes, data: bytes) -> None:
        beside = attachment(next(numbers), time.time_ns(), sender)
        try:
            publisher.put(data, attachment=beside)
        except self._zenoh.ZError:  # the session is closed, or nobody takes it
            self.unsent += 1
