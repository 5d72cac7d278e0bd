"""A bag as topics and messages, through rosbags; where it was cut short, as far as it goes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from ...model import RecordingError
from ._ros import Unusable, boundless
from ._rtabmap_msgs import register
from ._salvage import Cut, Record, db3_records, mcap_records, ros1_records
from ._source import Skips
from ._storage import PackedFolder, check_tables, packed_folder, storage_files
from ._unpacking import ZSTD, Budget, Swollen, bound_reader, bound_rosbags, unpack_zstd

T = TypeVar("T")
_REMEDY = (
    "copy it anew, or repair it (`ros2 bag reindex`, `rosbag reindex`, `mcap recover`); "
    "--keep-going reads what is whole"
)
_UNPACK = (
    "if you trust it, unpack or sort it with other tools (`mcap decompress`, `mcap sort`, `rosbag "
    "decompress`, `ros2 bag convert`) and read that; --keep-going reads what lies before"
)
_RECORDS = {".bag": ros1_records, ".mcap": mcap_records, ".db3": db3_records}


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
        self._place = path  # where rosbags reads
        self._packed: PackedFolder | None = None
        index = path / "metadata.yaml" if path.is_dir() else path
        if index.is_file() and not index.stat().st_size:
            raise RecordingError(f"{index}: an empty file; copy or record it anew")
        try:
            self._unpack()
            self.topics, self._types = self._look()
        except Exception as error:  # noqa: BLE001  whatever a foreign parser raises on such bytes
            self._note("when it is opened", "damaged, cut short, or of another version", error)
            self._salvaged = True
            self.topics, self._types = self._look_at_records(error)
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
                bound_reader(reader, Budget(self._place))
                for connection, stamp, raw in reader.messages(wanted):
                    count += 1
                    message = Message(connection.topic, connection.msgtype, stamp / 1e9, bytes(raw))
                    yield from self._plain(message)
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

    def _unpack(self) -> None:
        """A folder that is packed is read from where it was unpacked to."""
        packed = packed_folder(self.path)
        if packed is None:
            return
        self._packed, self._place = packed, packed.path  # the one keeps the other in being
        if packed.fault is not None:
            raise packed.fault

    def _plain(self, message: Message) -> Iterator[Message]:
        """The message as it was sent: recorders may pack each by itself. None where it is damaged,
        so that numbers of messages are those of every reading."""
        if self.ros2 and message.raw.startswith(ZSTD):
            try:
                message = message._replace(raw=unpack_zstd(message.raw))
            except Exception as error:  # noqa: BLE001  Swollen, or ZstdError of another module
                fault = self.wrong(message, f"cannot be unpacked ({_first_line(error)})")
                self.skips.note(fault)
                return
        yield message

    def _defaults(self) -> Any:
        stores = self._typesys
        default = stores.get_typestore(stores.Stores.ROS2_HUMBLE)
        register(default, stores)
        return default

    def _open(self) -> Any:
        return self._rosbags.AnyReader([self._place], default_typestore=self._defaults())

    def _look(self) -> tuple[dict[str, Topic], Any]:
        for file in storage_files(self._place):
            check_tables(file)
        with self._open() as reader:
            bound_reader(reader, Budget(self._place))
            found = {
                name: Topic(info.msgtype or "", info.msgcount)
                for name, info in reader.topics.items()
            }
            return found, reader.typestore

    def _records(self) -> Iterator[Record]:
        """Of all files. Raises Cut at the end where one is damaged."""
        cut = None
        for file in storage_files(self._place):
            try:
                yield from _RECORDS[file.suffix](file)
            except Cut as error:
                cut = error
        if cut is not None:
            raise cut

    def _look_at_records(self, error: Exception) -> tuple[dict[str, Topic], Any]:
        """error: why rosbags did not open it."""
        kinds: dict[str, tuple[str, str]] = {}
        counts: dict[str, int] = {}
        try:
            for record in self._records():
                kinds[record.topic] = (record.kind, record.definition)
                counts[record.topic] = counts.get(record.topic, 0) + 1
        except Cut:
            pass  # told of already
        if not counts:
            raise RecordingError(
                f"{self.path}: nothing in it can be read ({_first_line(error)}); copy it anew"
            )
        stores, defined = self._typesys, [each for each in kinds.values() if each[1]]
        types = stores.get_typestore(stores.Stores.EMPTY) if defined else self._defaults()
        for kind, definition in defined:
            try:
                types.register(stores.get_types_from_msg(definition, kind))
            except Exception as fault:  # noqa: BLE001  see above
                self.skips.note(
                    RecordingError(f"{self.path}: type {kind[:60]} ({_first_line(fault)})")
                )
        return {name: Topic(kinds[name][0], count) for name, count in counts.items()}, types

    def _salvaged_messages(self, topics: set[str]) -> Iterator[Message]:
        try:
            for record in self._records():
                if record.topic in topics:
                    stamp = record.stamp / 1e9
                    yield from self._plain(Message(record.topic, record.kind, stamp, record.data))
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
