"""A bag as topics and messages, through rosbags; where it was cut short, as far as it goes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from ...model import RecordingError
from ._ros import Unusable, boundless
from ._rtabmap_msgs import register
from ._salvage import Cut, Record, mcap_records, ros1_records
from ._source import Skips
from ._unpacking import Swollen, bound_rosbags

T = TypeVar("T")
_REMEDY = (
    "copy it anew, or repair it (`ros2 bag reindex`, `rosbag reindex`, `mcap recover`); "
    "--keep-going reads what is whole"
)
_UNPACK = (
    "if you trust it, unpack it with other tools (`mcap decompress`, `rosbag decompress`) and read "
    "that; --keep-going reads what lies before"
)


class Topic(NamedTuple):
    kind: str  # such as sensor_msgs/msg/PointCloud2, for ROS 1 too
    messages: int


class Message(NamedTuple):
    topic: str
    kind: str
    stamp: float  # s, when it was recorded
    raw: bytes


class Bag:
    """topics: what is in it, by name. ros2: whether messages are CDR.

    Raises RecordingError that names the file, the place, and what helps.
    """

    def __init__(self, path: Path, skips: Skips) -> None:
        self.path, self.skips = path, skips
        self._rosbags = _import(path, "rosbags.highlevel")
        self._typesys = _import(path, "rosbags.typesys")
        bound_rosbags()
        self.ros2 = path.suffix != ".bag"
        self._salvaged = False
        index = path / "metadata.yaml" if path.is_dir() else path
        if index.is_file() and not index.stat().st_size:
            raise RecordingError(f"{index}: an empty file; copy or record it anew")
        try:
            self.topics, self._types = self._look()
        except Exception as error:  # noqa: BLE001  whatever a foreign parser raises on such bytes
            self._note("when it is opened", "damaged, cut short, or of another version", error)
            self._salvaged = True
            self.topics, self._types = self._look_at_records()
        if (name := boundless(self._types.fielddefs)) is not None:
            raise RecordingError(
                f"{path}: a definition repeats {name[:60]}, which is empty, so that a message may "
                "claim any number of them; record it anew with the published definitions"
            )

    def messages(self, topics: set[str]) -> Iterator[Message]:
        """The messages of some topics in the order in which they were recorded."""
        if self._salvaged:
            yield from self._salvaged_messages(topics)
            return
        count = 0
        try:
            with self._open() as reader:
                wanted = [c for c in reader.connections if c.topic in topics]
                if not wanted:
                    return
                for connection, stamp, raw in reader.messages(wanted):
                    count += 1
                    message = Message(connection.topic, connection.msgtype, stamp / 1e9, bytes(raw))
                    yield message
        except RecordingError:
            raise
        except Exception as error:  # noqa: BLE001  see above
            self._note(f"after {count} messages", f"damaged after {count} messages", error)

    def read(self, message: Message, convert: Callable[[Any], T]) -> T:
        """What `convert` makes of the message with its fields as attributes.

        Raises RecordingError: a damaged definition gives other fields than the type should have.
        """
        types = self._types
        decode = types.deserialize_cdr if self.ros2 else types.deserialize_ros1
        try:
            return convert(decode(message.raw, message.kind))
        except RecordingError:
            raise
        except Unusable as fault:
            raise self.wrong(message, fault) from None
        except Exception as error:  # noqa: BLE001  see above
            raise self.wrong(message, f"cannot be decoded ({_first_line(error)})") from None

    def wrong(self, message: Message, what: object) -> RecordingError:
        """What is wrong with one message, and where it is."""
        return RecordingError(
            f"{self.path}: {message.topic}, message of {message.stamp:.6f} s: {what}"
        )

    def _note(self, where: str, what: str, error: Exception) -> None:
        said = f"{what} ({_first_line(error)}); {_REMEDY}"
        if isinstance(error, Swollen):
            said = f"{where} {error}; {_UNPACK}"
        self.skips.note(RecordingError(f"{self.path}: {said}"))

    def _open(self) -> Any:
        stores = self._typesys
        default = stores.get_typestore(stores.Stores.ROS2_HUMBLE)
        register(default, stores)
        return self._rosbags.AnyReader([self.path], default_typestore=default)

    def _look(self) -> tuple[dict[str, Topic], Any]:
        with self._open() as reader:
            found = {
                name: Topic(info.msgtype or "", info.msgcount)
                for name, info in reader.topics.items()
            }
            return found, reader.typestore

    def _records(self) -> Iterator[Record]:
        if self.path.suffix == ".bag":
            return ros1_records(self.path)
        if self.path.suffix == ".mcap":
            return mcap_records(self.path)
        return iter(())

    def _look_at_records(self) -> tuple[dict[str, Topic], Any]:
        kinds: dict[str, tuple[str, str]] = {}
        counts: dict[str, int] = {}
        try:
            for record in self._records():
                kinds[record.topic] = (record.kind, record.definition)
                counts[record.topic] = counts.get(record.topic, 0) + 1
        except Cut:
            pass  # told of already
        if not counts:
            raise RecordingError(f"{self.path}: nothing in it can be read; copy it anew")
        types = self._typesys.get_typestore(self._typesys.Stores.EMPTY)
        for kind, definition in kinds.values():
            try:
                types.register(self._typesys.get_types_from_msg(definition, kind))
            except Exception as error:  # noqa: BLE001  see above
                self.skips.note(
                    RecordingError(f"{self.path}: type {kind[:60]} ({_first_line(error)})")
                )
        return {name: Topic(kinds[name][0], count) for name, count in counts.items()}, types

    def _salvaged_messages(self, topics: set[str]) -> Iterator[Message]:
        try:
            for record in self._records():
                if record.topic in topics:
                    yield Message(record.topic, record.kind, record.stamp / 1e9, record.data)
        except Cut:
            return  # told of when the bag was opened


def _import(path: Path, name: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise RecordingError(
            f"{path}: bags are read with rosbags, which is not installed; pip install 'dagmap[ros]'"
        ) from None


def _first_line(error: Exception) -> str:
    if isinstance(error, (TypeError, AttributeError)):  # Python's own words help nobody
        return "its parts do not fit together"
    text = str(error).strip().split("\n")[0][:200]
    return text or type(error).__name__
