"""Bags that were cut short: their records one after the other, as far as they are whole."""

from __future__ import annotations

import os
import sqlite3
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import IO, Any, NamedTuple

from ._storage import rows_of
from ._unpacking import Budget, Swollen, unpack_bz2, unpack_lz4, unpacked

_MOST = 1 << 31  # bytes of a record
_MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _CHUNK, _CONNECTION = b"\x02", b"\x05", b"\x07"


class Record(NamedTuple):
    """A message with what is needed to read it. stamp: ns, when it was recorded."""

    topic: str
    kind: str
    definition: str
    stamp: int
    data: bytes


class Cut(Exception):
    """Where a file ends early or is damaged."""


def ros1_records(path: Path) -> Iterator[Record]:
    """The messages of a ROS 1 bag without its index. Raises Cut after the last whole one."""
    with path.open("rb") as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise Cut("it does not begin like a ROS 1 bag of version 2.0")
        known: dict[bytes, tuple[str, str, str]] = {}
        budget = Budget(path)
        while file.peek(1):
            header, data = _ros1_record(file)
            if header.get(b"op") == _CHUNK:
                yield from _ros1_chunk(header, data, known, budget)
            else:
                yield from _ros1_message(header, data, known)


def _ros1_chunk(
    header: dict[bytes, bytes],
    data: bytes,
    known: dict[bytes, tuple[str, str, str]],
    budget: Budget,
) -> Iterator[Record]:
    name = header.get(b"compression", b"")
    unpack = _ROS1_PACKED.get(name)
    if unpack is None:
        raise Cut(f"a chunk is packed by {name[:20]!r}")
    try:
        data = unpack(data, int.from_bytes(header.get(b"size", b""), "little"))
        budget.spend(len(data))
    except (OSError, EOFError, RuntimeError, ValueError, ImportError, Swollen) as error:
        raise Cut(f"a chunk cannot be unpacked ({error})") from None
    at = 0
    while at < len(data):
        header, body, at = _ros1_inner(data, at)
        yield from _ros1_message(header, body, known)


def _ros1_message(
    header: dict[bytes, bytes], data: bytes, known: dict[bytes, tuple[str, str, str]]
) -> Iterator[Record]:
    number = header.get(b"conn", b"")
    if header.get(b"op") == _CONNECTION:
        said = _fields(data)
        names = (header.get(b"topic"), said.get(b"type"), said.get(b"message_definition"))
        topic, kind, definition = ((name or b"").decode("utf-8", "replace") for name in names)
        if "/msg/" not in kind:
            kind = kind.replace("/", "/msg/")
        known[number] = (topic, kind, definition)
    elif header.get(b"op") == _MESSAGE and number in known:
        time = header.get(b"time", bytes(8)).ljust(8, b"\0")
        seconds, nanoseconds = struct.unpack_from("<II", time)
        yield Record(*known[number], seconds * 10**9 + nanoseconds, data)


def _ros1_record(file: IO[bytes]) -> tuple[dict[bytes, bytes], bytes]:
    parts = []
    for _ in range(2):
        size = int.from_bytes(_exactly(file, 4), "little")
        parts.append(_exactly(file, size))
    return _fields(parts[0]), parts[1]


def _ros1_inner(data: bytes, at: int) -> tuple[dict[bytes, bytes], bytes, int]:
    parts = []
    for _ in range(2):
        size = int.from_bytes(data[at : at + 4], "little")
        part = data[at + 4 : at + 4 + size]
        if len(part) < size:
            raise Cut("a chunk ends within a record")
        parts.append(part)
        at += 4 + size
    return _fields(parts[0]), parts[1], at


def _fields(data: bytes) -> dict[bytes, bytes]:
    """name=value, each after its length."""
    found, at = {}, 0
    while at + 4 <= len(data):
        size = int.from_bytes(data[at : at + 4], "little")
        name, _, value = data[at + 4 : at + 4 + size].partition(b"=")
        found[name] = value
        at += 4 + size
    return found


def _exactly(file: IO[bytes], size: int) -> bytes:
    at = file.tell()
    there = os.fstat(file.fileno()).st_size - at
    if size > min(there, _MOST):  # before memory is taken for it
        raise Cut(f"{size} bytes are promised at {at}, {there} are there")
    return file.read(size)


def _plain(data: bytes, size: int) -> bytes:
    return data


# (bytes, how many they promise to become): no more than promised comes out.
_ROS1_PACKED: dict[bytes, Callable[[bytes, int], bytes]] = {
    b"none": _plain,
    b"bz2": unpack_bz2,
    b"lz4": unpack_lz4,
}


def mcap_records(path: Path) -> Iterator[Record]:
    """The messages of an MCAP in the order of the file. Raises Cut after the last whole one."""
    streams = import_module("mcap.stream_reader")
    kinds = import_module("mcap.records")
    schemas: dict[int, tuple[str, str]] = {}
    topics: dict[int, tuple[str, int]] = {}
    with path.open("rb") as file:
        try:
            most = min(_MOST, path.stat().st_size)
            reader = streams.StreamReader(file, record_size_limit=most, emit_chunks=True)
            for record in _in_chunks(reader.records, streams, kinds, Budget(path)):
                if isinstance(record, kinds.Schema):
                    schemas[record.id] = (record.name, record.data.decode("utf-8", "replace"))
                elif isinstance(record, kinds.Channel):
                    topics[record.id] = (record.topic, record.schema_id)
                elif isinstance(record, kinds.Message) and record.channel_id in topics:
                    topic, schema = topics[record.channel_id]
                    yield Record(
                        topic, *schemas.get(schema, ("", "")), record.log_time, record.data
                    )
        except Exception as error:  # noqa: BLE001  whatever a foreign parser raises on such bytes
            raise Cut(str(error) or type(error).__name__) from None


def db3_records(path: Path) -> Iterator[Record]:
    """The messages of a `.db3` in the order of the file. Raises Cut after the last whole one."""
    try:
        for topic, kind, definition, stamp, data in rows_of(path):
            yield Record(topic, kind, definition, stamp, data)
    except (sqlite3.Error, ValueError, TypeError, OSError) as error:
        raise Cut(str(error)) from None


def _in_chunks(found: Iterator[Any], streams: Any, kinds: Any, budget: Budget) -> Iterator[Any]:
    """Records, those in chunks too."""
    for record in found:
        if isinstance(record, kinds.Chunk):
            plain = replace(record, compression="", data=unpacked(record))
            budget.spend(len(plain.data))
            yield from streams.breakup_chunk(plain)
        else:
            yield record
