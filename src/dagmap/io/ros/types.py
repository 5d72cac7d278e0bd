"""Messages of one version of ROS, as rosbags knows them: bytes to fields and back."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from ...model import NetworkError
from ..sources._ros import Unusable, boundless
from ..sources._rtabmap_msgs import register

_TRANSFORMS = "geometry_msgs/TransformStamped[] transforms"
_BASE, _NAME, _ARRAY = 1, 2, 3  # kinds of fields in rosbags' definitions


class Types:
    """ros2: whether bytes are CDR. Raises NetworkError where rosbags is not installed."""

    def __init__(self, ros2: bool) -> None:
        self.ros2 = ros2
        try:
            self._typesys: Any = import_module("rosbags.typesys")
        except ImportError:
            raise NetworkError(
                "[ros] needs rosbags for the messages of ROS; install it by pip install "
                "'dagmap[ros]'"
            ) from None
        stores = self._typesys.Stores
        self._store: Any = self._typesys.get_typestore(
            stores.ROS2_HUMBLE if ros2 else stores.ROS1_NOETIC
        )
        if ros2:
            register(self._store, self._typesys)
        elif "tf2_msgs/msg/TFMessage" not in self._store.types:
            self.learn("tf2_msgs/msg/TFMessage", _TRANSFORMS)

    def learn(self, kind: str, definition: str) -> None:
        """Take over a definition (as ROS 1 sends it along), unless the type is known.

        Raises Unusable.
        """
        if kind in self._store.types:
            return
        try:
            found = self._typesys.get_types_from_msg(definition, kind)
            known = self._store.types
            new = {name: it for name, it in found.items() if name not in known}
            if (name := boundless({**self._store.fielddefs, **new})) is not None:
                raise Unusable(f"the definition of {kind[:80]} repeats {name[:80]}, which is empty")
            self._store.register(new)
        except Unusable:
            raise
        except Exception as error:  # noqa: BLE001  whatever a foreign parser raises on such bytes
            raise Unusable(f"the definition of {kind[:80]} cannot be read ({error})") from None

    def decode(self, kind: str, raw: bytes) -> Any:
        """A message with its fields as attributes. Raises Unusable."""
        store = self._store
        try:
            return (store.deserialize_cdr if self.ros2 else store.deserialize_ros1)(raw, kind)
        except Exception as error:  # noqa: BLE001  see above
            what = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise Unusable(f"cannot be decoded as {kind} ({what})") from None

    def encode(self, kind: str, message: Any) -> bytes:
        store = self._store
        return bytes((store.serialize_cdr if self.ros2 else store.serialize_ros1)(message, kind))

    def definition(self, kind: str) -> tuple[str, str]:
        """The text of a definition with those that it needs, and its MD5, as ROS 1 has them."""
        text, digest = self._store.generate_msgdef(kind, ros_version=2 if self.ros2 else 1)
        return str(text), str(digest)

    def hash(self, kind: str) -> str:
        """RIHS01 of a type, as ROS 2 writes it."""
        return str(self._store.hash_rihs01(kind))

    def make(self, kind: str, **fields: Any) -> Any:
        """A message; fields that are not given are zero or empty."""
        _, definition = self._store.fielddefs[kind]
        values = {name: self._nothing(*what) for name, what in definition if name not in fields}
        return self._store.types[kind](**values, **fields)

    def _nothing(self, kind: Any, of: Any) -> Any:
        if int(kind) == _NAME:
            return self.make(of)
        if int(kind) == _BASE:
            return {"string": "", "bool": False}.get(of[0], 0.0 if "float" in of[0] else 0)
        (element, what), count = of[0], of[1] if int(kind) == _ARRAY else 0
        if int(element) == _BASE and what[0] != "string":
            return np.zeros(count, {"byte": "u1", "char": "u1"}.get(what[0], what[0]))
        return [self._nothing(element, what) for _ in range(count)]
