"""How rmw_zenoh names things, so that ROS 2 nodes on it and this process find each other.

Its design: github.com/ros2/rmw_zenoh, docs/design.md and `liveliness_utils.cpp`. Data goes to
`DOMAIN/TOPIC/TYPE/HASH`; who is there holds a liveliness token under `@ros2_lv`.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass
from typing import Literal

_SPACE = "@ros2_lv"
_NO_HASH = "TypeHashNotSupported"  # in Humble, whose types have none
_GID = 16  # bytes


@dataclass(frozen=True, slots=True)
class Qos:
    """What a token says of quality; what is as rmw_zenoh's default is left empty in it."""

    best_effort: bool = False
    still: bool = False  # transient local
    depth: int = 10

    @property
    def text(self) -> str:
        reliability, durability = "2" if self.best_effort else "", "1" if self.still else ""
        return f"{reliability}:{durability}:,{self.depth}:,:,:,,"


@dataclass(frozen=True, slots=True)
class Node:
    """A node of the ROS graph. session: Zenoh's id of the session, as text."""

    domain: int
    session: str
    namespace: str  # absolute, "/" for none
    name: str

    @property
    def token(self) -> str:
        return f"{_SPACE}/{self.domain}/{self.session}/0/0/NN/{self._place}"

    @property
    def _place(self) -> str:
        return f"%/{_mangled(self.namespace)}/{_mangled(self.name)}"  # %: no enclave

    def resolved(self, name: str) -> str:
        """An absolute topic of a name as people write it: `/a`, `a` or `~/a`."""
        if name.startswith("/"):
            return name
        below = self.namespace.rstrip("/")
        return f"{below}/{self.name}{name[1:]}" if name.startswith("~") else f"{below}/{name}"

    def endpoint(self, number: int, way: Literal["MP", "MS"], topic: Topic, qos: Qos) -> str:
        """The token of a publisher (MP) or a subscription (MS). number: unique in the session."""
        return (
            f"{_SPACE}/{self.domain}/{self.session}/0/{number}/{way}/{self._place}/"
            f"{_mangled(topic.name)}/{topic.dds}/{topic.hash}/{qos.text}"
        )

    def key(self, topic: Topic) -> str:
        """Where messages of a topic go."""
        return f"{self.domain}/{topic.name.strip('/')}/{topic.dds}/{topic.hash}"

    def heard(self, topic: Topic) -> str:
        """Where they come from: any hash, since older versions write none."""
        return f"{self.domain}/{topic.name.strip('/')}/{topic.dds}/*"


@dataclass(frozen=True, slots=True)
class Topic:
    """name: absolute. kind: such as sensor_msgs/msg/PointCloud2. hash: RIHS01 or `no_hash`."""

    name: str
    kind: str
    hash: str = _NO_HASH

    @property
    def dds(self) -> str:
        """The type as DDS mangles it."""
        package, group, name = self.kind.split("/")
        return f"{package}::{group}::dds_::{name}_"


def gid(token: str) -> bytes:
    """16 bytes that name an endpoint. rmw_zenoh hashes the token otherwise (XXH3); what counts is
    that each has its own."""
    return hashlib.blake2b(token.encode(), digest_size=_GID).digest()


def attachment(number: int, stamp: int, sender: bytes) -> bytes:
    """What goes beside a message: its number (from 1), ns when it was sent, and by whom."""
    return struct.pack("<qqB", number, stamp, len(sender)) + sender


def _mangled(name: str) -> str:
    return name.replace("/", "%")
