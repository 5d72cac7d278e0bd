"""The files of a ROS 2 bag: what of them SQLite may read, and folders that are packed."""

from __future__ import annotations

import re
import shutil
import sqlite3
import tempfile
import weakref
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from ._unpacking import MOST, Swollen, unpack_zstd_file

SQLITE = b"SQLite format 3\0"
_INDEX = "metadata.yaml"
_TABLES = ("schema", "metadata", "topics", "message_definitions", "messages")
_TIMES = 100  # a file of messages, of which none is mere zeros, never becomes so much smaller
_PACKED = ".zstd"
_STORED = (".mcap", ".db3")


def storage_files(path: Path) -> list[Path]:
    """The files that hold messages, in the order of the numbers in their names."""
    if not path.is_dir():
        return [path]

    def number(file: Path) -> tuple[int, str]:
        digits = re.search(r"\d+$", file.stem)
        return (int(digits[0]) if digits else -1, file.name)

    return sorted((f for f in path.iterdir() if f.suffix in _STORED and f.is_file()), key=number)


def require_plain(database: sqlite3.Connection, names: Iterable[str]) -> None:
    """Raises ValueError where one of these is no plain table: views and generated columns compute
    whatever they say, for ever."""
    wanted = {name.lower() for name in names}
    for kind, name, sql in database.execute("SELECT type, name, sql FROM sqlite_master"):
        if str(name).lower() not in wanted or kind in ("index", "trigger"):
            continue
        plain = kind == "table" and re.match(r"\s*CREATE\s+TABLE\b", str(sql), re.IGNORECASE)
        quoted = str(name).replace('"', '""')
        rows = database.execute(f'PRAGMA table_xinfo("{quoted}")').fetchall() if plain else []
        if not plain or any(row[6] for row in rows):
            raise ValueError(f"{name} is no plain table, but computes what it says")


def cut_short(path: Path) -> str:
    """What lacks of a database of SQLite by its own word, which misses it only where it looks for
    it; empty where nothing does. Raises OSError."""
    with path.open("rb") as file:
        head, size = file.read(32), path.stat().st_size
    page = int.from_bytes(head[16:18], "big")
    promised = int.from_bytes(head[28:32], "big") * (1 << 16 if page == 1 else page)
    if head.startswith(SQLITE) and size < promised:
        return f"{promised} bytes are promised, {size} are there"
    return ""


def check_tables(path: Path) -> None:
    """Of a `.db3`. Raises ValueError, or sqlite3.Error where it is damaged."""
    if path.suffix != ".db3":
        return
    if lacking := cut_short(path):
        raise ValueError(f"{path.name} is cut short: {lacking}")
    with _opened(path) as database:
        require_plain(database, _TABLES)


def rows_of(path: Path) -> Iterator[tuple[str, str, str, int, bytes]]:
    """(topic, type, definition, stamp in ns, message) of a `.db3`, as far as SQLite can read it.

    Raises sqlite3.Error, ValueError or TypeError where it ends.
    """
    with _opened(path) as database:
        database.execute(DAMAGED)
        require_plain(database, _TABLES)
        topics = {row[0]: (row[1], row[2]) for row in database.execute(_TOPICS)}
        found = "message_definitions" in {r[0] for r in database.execute(_NAMES)}
        defined = dict(database.execute(_DEFINITIONS)) if found else {}
        for id_, stamp, data in database.execute(_MESSAGES):
            if id_ in topics and isinstance(data, bytes):
                name, kind = topics[id_]
                yield str(name), str(kind), str(defined.get(kind, "")), int(stamp), data


DAMAGED = "PRAGMA writable_schema = ON"  # nothing is written: a file without its end is read too
_NAMES = "SELECT name FROM sqlite_master"
_TOPICS = "SELECT id, name, type FROM topics"
_DEFINITIONS = """SELECT topic_type, encoded_message_definition FROM message_definitions
    WHERE encoding = 'ros2msg'"""
_MESSAGES = "SELECT topic_id, timestamp, data FROM messages ORDER BY id"


def one_line(error: Exception) -> str:
    """What SQLite says, which may quote what it has read."""
    return "".join(c if c.isprintable() else "?" for c in str(error))[:200]


@contextmanager
def _opened(path: Path) -> Iterator[sqlite3.Connection]:
    uri = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
    with closing(sqlite3.connect(uri, uri=True)) as database:
        yield database


class PackedFolder:
    """A folder whose files or messages are packed (`ros2 bag record --compression-mode`), as one
    that is not: its files are unpacked once, into a place that is gone with this object.

    path: of that place. fault: why something could not be unpacked to its end, or None. Messages
    stay packed; whoever reads them knows by their beginning.
    """

    def __init__(self, path: Path, said: dict[str, Any]) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="dagmap-bag-"))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)
        self.fault: Exception | None = None
        info: dict[str, Any] = said["rosbag2_bagfile_information"]
        names = [Path(name).name for name in info["relative_file_paths"]]
        whole = str(info["compression_mode"]).lower() == "file"
        info |= {"compression_mode": "", "compression_format": ""}
        info["relative_file_paths"] = [n.removesuffix(_PACKED) if whole else n for n in names]
        with (self.path / _INDEX).open("w") as file:
            import_module("ruamel.yaml").YAML(typ="safe", pure=True).dump(said, file)
        for name in names:
            if whole:
                self._unpack(path / name)
            elif (path / name).is_file():
                (self.path / name).symlink_to((path / name).resolve())

    def _unpack(self, file: Path) -> None:
        """What is whole of a file that is damaged stays."""
        if not file.is_file():
            return  # rosbags says so
        most = _TIMES * file.stat().st_size + MOST
        room = shutil.disk_usage(self.path).free - MOST
        sink_path = self.path / file.name.removesuffix(_PACKED)
        try:
            with file.open("rb") as source, sink_path.open("wb") as sink:
                unpack_zstd_file(source, sink, min(most, max(room, 0)))
        except Swollen as error:
            reason = f"{file.name}: {error}"
            if room < most:
                reason += f"; {self.path.parent} has no more room, TMPDIR names another place"
            self.fault = Swollen(reason)
        except Exception as error:  # noqa: BLE001  ZstdError, of a module that may be missing
            self.fault = ValueError(f"{file.name} cannot be unpacked: {error}")


def packed_folder(path: Path) -> PackedFolder | None:
    """The folder unpacked; None where nothing of it is packed by zstd.

    Raises ValueError where its index repeats itself by reference, since a few lines of that can
    claim any size, or names a file twice; and what ruamel.yaml does.
    """
    if not (path / _INDEX).is_file():
        return None
    text, yaml = (path / _INDEX).read_text(), import_module("ruamel.yaml")
    if any(isinstance(event, yaml.AliasEvent) for event in yaml.YAML(typ="safe").parse(text)):
        raise ValueError(f"{_INDEX} repeats parts of itself by reference")
    said = yaml.YAML(typ="safe").load(text)
    info = said.get("rosbag2_bagfile_information") if isinstance(said, dict) else None
    if not isinstance(info, dict) or info.get("compression_format") != "zstd":
        return None
    names = info.get("relative_file_paths")
    if info.get("compression_mode") not in ("FILE", "MESSAGE", "file", "message"):
        return None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return None  # rosbags says what is wrong with it
    if len({Path(name).name for name in names}) < len(names):  # each time would cost as much again
        raise ValueError(f"{_INDEX} names a file twice")
    return PackedFolder(path, said)
