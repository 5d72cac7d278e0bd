"""Chunks that claim, or become, far more than their few kilobytes: named, and not unpacked."""

from __future__ import annotations

import bz2
import json
import shutil
import sqlite3
import struct
import subprocess
import sys
from contextlib import closing
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import lz4.frame
import pytest
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from bags import Make, write_bag
from dagmap.io.sources import Options, _storage, _unpacking, open_source
from dagmap.io.sources._storage import storage_files
from dagmap.io.sources._unpacking import (
    MOST,
    Budget,
    Swollen,
    bound_rosbags,
    unpack_bz2,
    unpack_lz4,
)
from dagmap.model import RecordingError
from test_bags import lidar

HUGE = 1 << 30
MAGIC = b"\x89MCAP0\r\n"


def packed(kind: str, size: int) -> bytes:
    """So many zeros, made piece by piece; whole messages before them."""
    head = struct.pack("<BQHIQQ", 5, size - 9, 1, 0, 10**9, 10**9)
    out, piece = BytesIO(), bytes(1 << 20)
    writer: Any = (
        zstandard.ZstdCompressor().stream_writer(out, closefd=False)
        if kind == "zstd"
        else lz4.frame.LZ4FrameFile(out, "wb")
    )
    with writer:
        writer.write(head + bytes(len(piece) - len(head)))
        for _ in range(size // len(piece) - 1):
            writer.write(piece)
    return out.getvalue()


def mcap(path: Path, kind: str, claimed: int, size: int, indexed: bool) -> Path:
    """A file with one such chunk; without an index, rosbags looks into the chunk at once."""
    build = RecordBuilder()

    def at() -> int:
        return len(MAGIC) + build.count

    records.Header(profile="ros2", library="").write(build)
    begin = at()
    records.Chunk(
        compression=kind, data=packed(kind, size), message_start_time=0,
        message_end_time=2 * 10**9, uncompressed_crc=0, uncompressed_size=claimed,
    ).write(build)  # fmt: skip
    length = at() - begin
    records.DataEnd(data_section_crc=0).write(build)
    summary = at() if indexed else 0
    if indexed:
        definition = b"std_msgs/Header header"
        records.Schema(
            id=1, name="sensor_msgs/msg/PointCloud2", encoding="ros2msg", data=definition
        ).write(build)
        records.Channel(
            id=1, topic="/points", message_encoding="cdr", metadata={}, schema_id=1
        ).write(build)
        records.ChunkIndex(
            chunk_length=length, chunk_start_offset=begin, compression=kind,
            compressed_size=length - 49 - len(kind), message_end_time=2 * 10**9,
            message_index_length=31, message_index_offsets={1: begin + length},
            message_start_time=0, uncompressed_size=claimed,
        ).write(build)  # fmt: skip
        records.Statistics(
            attachment_count=0, channel_count=1, channel_message_counts={1: 1}, chunk_count=1,
            message_count=1, message_end_time=2 * 10**9, message_start_time=0, metadata_count=0,
            schema_count=1,
        ).write(build)  # fmt: skip
    records.Footer(summary_start=summary, summary_offset_start=0, summary_crc=0).write(build)
    path.write_bytes(MAGIC + build.end() + MAGIC)
    return path


OPEN = """
import json, sys
from pathlib import Path
from dagmap.io.sources import Options, _storage, open_source
from dagmap.model import RecordingError
import rosbags.highlevel, mcap.stream_reader, zstandard, lz4.frame, dagmap.io.sources._kiss

def peak():
    line = next(l for l in open("/proc/self/status") if l.startswith("VmHWM"))
    return int(line.split()[1]) * 1024

before = peak()
said = ""
try:
    list(open_source(Path(sys.argv[1]), Options(keep_going=sys.argv[2] == "1")))
except RecordingError as error:
    said = str(error)
print(json.dumps([said, peak() - before]))
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the peak is Linux's")
@pytest.mark.parametrize("indexed", [True, False])
@pytest.mark.parametrize(
    ("kind", "claimed", "size"),
    [("zstd", HUGE, HUGE), ("zstd", 4096, HUGE), ("lz4", 4096, HUGE // 4), ("zstd", 1 << 62, HUGE)],
)
def test_a_chunk_that_swells_takes_no_memory(
    tmp_path: Path, indexed: bool, kind: str, claimed: int, size: int
) -> None:
    path = mcap(tmp_path / "walk.mcap", kind, claimed, size, indexed)
    assert path.stat().st_size < 2 << 20
    for keep_going in "01":
        command = [sys.executable, "-c", OPEN, str(path), keep_going]
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
        assert done.returncode == 0, done.stderr
        said, taken = json.loads(done.stdout)
        assert said.startswith(f"{path}: ") and "\n" not in said
        if keep_going == "0":
            assert f"a packed chunk {'claims' if claimed > MOST else 'becomes more than'}" in said
            assert f"walk.mcap: {'after 0 messages' if indexed else 'when it is opened'}" in said
            assert "mcap decompress" in said and "damaged" not in said
        assert taken < 64 << 20


def test_chunks_of_ros_1_are_bounded_too() -> None:
    bound_rosbags()
    from rosbags.rosbag1 import reader

    for kind, pack in (("bz2", bz2.compress), ("lz4", lz4.frame.compress)):
        assert reader.decompressors[kind](pack(b"walk")) == b"walk"
        with pytest.raises(Swollen, match="becomes more than the"):
            reader.decompressors[kind](pack(bytes(MOST + 1)))
        for size in (4, 5):
            assert reader.decompressors[kind](pack(b"walk"), size) == b"walk"
        for end in (1, 4):
            with pytest.raises(ValueError, match="cut short"):
                reader.decompressors[kind](pack(bytes(100_000))[:-end])
    with pytest.raises(Swollen, match="than the 3 bytes"):
        unpack_bz2(bz2.compress(b"walk"), 3)
    with pytest.raises(Swollen, match=f"claims {MOST + 1} bytes"):
        unpack_lz4(b"", MOST + 1)


@pytest.mark.parametrize("kind", ["zstd", "lz4"])
@pytest.mark.parametrize("end", [0, 100])
def test_packed_chunks_that_keep_their_promise_are_read(
    tmp_path: Path, kind: str, end: int
) -> None:
    """Also without their end, record by record."""
    from mcap.reader import make_reader
    from mcap.writer import CompressionType, Writer

    make = Make()
    plain = write_bag(tmp_path / "plain.mcap", make, lidar(make))
    path = tmp_path / "walk.mcap"
    with plain.open("rb") as source, path.open("wb") as sink:
        writer = Writer(sink, chunk_size=1 << 14, compression=CompressionType[kind.upper()])
        writer.start(profile="ros2")
        known: dict[str, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            assert schema is not None
            if channel.topic not in known:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                known[channel.topic] = writer.register_channel(channel.topic, "cdr", number)
            writer.add_message(
                known[channel.topic], message.log_time, message.data, message.publish_time
            )
        writer.finish()
    if end:
        path.write_bytes(path.read_bytes()[:-end])
        with pytest.raises(RecordingError, match="damaged, cut short"):
            open_source(path)
    assert len(list(open_source(path, Options(keep_going=bool(end))))) == 5


def test_chunks_of_one_moment_are_not_all_held_at_once(tmp_path: Path) -> None:
    """Some 100 MB each, from a few kilobytes: their messages would be sorted in memory together."""
    path = tmp_path / "walk.mcap"
    size = 100 << 20
    build, content = RecordBuilder(), packed("zstd", size)

    def at() -> int:
        return len(MAGIC) + build.count

    records.Header(profile="ros2", library="").write(build)
    places = []
    for _ in range(12):
        begin = at()
        records.Chunk(
            compression="zstd", data=content, message_start_time=10**9, message_end_time=2 * 10**9,
            uncompressed_crc=0, uncompressed_size=size,
        ).write(build)  # fmt: skip
        places.append((begin, at() - begin))
    records.DataEnd(data_section_crc=0).write(build)
    summary = at()
    records.Schema(
        id=1, name="sensor_msgs/msg/PointCloud2", encoding="ros2msg", data=b"std_msgs/Header header"
    ).write(build)
    records.Channel(id=1, topic="/points", message_encoding="cdr", metadata={}, schema_id=1).write(
        build
    )
    for begin, length in places:
        records.ChunkIndex(
            chunk_length=length, chunk_start_offset=begin, compression="zstd",
            compressed_size=len(content), message_end_time=2 * 10**9, message_index_length=31,
            message_index_offsets={1: begin + length}, message_start_time=10**9,
            uncompressed_size=size,
        ).write(build)  # fmt: skip
    records.Statistics(
        attachment_count=0, channel_count=1, channel_message_counts={1: 12}, chunk_count=12,
        message_count=12, message_end_time=2 * 10**9, message_start_time=10**9, metadata_count=0,
        schema_count=1,
    ).write(build)  # fmt: skip
    records.Footer(summary_start=summary, summary_offset_start=0, summary_crc=0).write(build)
    path.write_bytes(MAGIC + build.end() + MAGIC)
    assert path.stat().st_size < 1 << 20
    command = [sys.executable, "-c", OPEN, str(path), "0"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    said, taken = json.loads(done.stdout)
    assert "chunks of one moment claim" in said and "`mcap sort`" in said, said
    assert said.startswith(f"{path}: when it is opened") and taken < 64 << 20


def test_a_file_becomes_no_more_than_files_of_sensors_do(tmp_path: Path) -> None:
    """However often its chunks are unpacked, and into whatever."""
    make = Make(ros2=False)
    path = write_bag(tmp_path / "walk.bag", make, lidar(make), Writer1.CompressionFormat.BZ2)
    budget = Budget(path)
    assert budget.most > 1000 * path.stat().st_size
    assert len(list(open_source(path))) == 5
    with patch.object(_unpacking, "_TIMES", 0), patch.object(_unpacking, "_SPARE", 100_000):
        with pytest.raises(RecordingError, match="walk.bag: after .* again and again; "):
            list(open_source(path))
        with pytest.raises(RecordingError, match="/points holds no message"):
            open_source(path, Options(keep_going=True))


def packed_as(path: Path, mode: str, plugin: StoragePlugin = StoragePlugin.SQLITE3) -> Path:
    """The folder of a bag, packed by rosbags as rosbag2 does it."""
    make, writer = Make(), Writer2(path, version=9, storage_plugin=plugin)
    writer.set_compression(CompressionMode[mode.upper()], CompressionFormat.ZSTD)
    with writer:
        topics: dict[str, Any] = {}
        for topic, kind, stamp, said in lidar(make):
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=make.types)
            writer.write(topics[topic], round(stamp * 1e9), make.types.serialize_cdr(said, kind))
    return path


@pytest.mark.parametrize("mode", ["file", "message"])
@pytest.mark.parametrize("plugin", list(StoragePlugin))
def test_folders_that_rosbag2_packs_are_read(
    tmp_path: Path, mode: str, plugin: StoragePlugin
) -> None:
    path = packed_as(tmp_path / "walk", mode, plugin)
    source = open_source(path)
    found = list(source)
    assert (source.name, len(found)) == ("walk", 5)
    assert len(list(source)) == 5
    if mode == "message":  # the file alone says nothing of it
        assert len(list(open_source(storage_files(path)[0]))) == 5


def swollen(path: Path, size: int) -> None:
    with path.open("wb") as sink, zstandard.ZstdCompressor().stream_writer(sink) as writer:
        for _ in range(size >> 20):
            writer.write(bytes(1 << 20))


def test_a_packed_file_that_swells_fills_no_disk(tmp_path: Path) -> None:
    folder = packed_as(tmp_path / "walk", "file")
    file = next(folder.glob("*.zstd"))
    swollen(file, 1 << 30)
    assert file.stat().st_size < 1 << 20
    for keep_going in (False, True):
        with pytest.raises(RecordingError, match="walk: .*") as caught:
            open_source(folder, Options(keep_going=keep_going))
        assert "a packed file becomes more than the" in str(caught.value)
    with (
        patch.object(shutil, "disk_usage", lambda place: SimpleNamespace(free=0)),
        pytest.raises(RecordingError, match="has no more room, TMPDIR names another place"),
    ):
        open_source(folder)


def test_a_packed_message_that_swells_is_left_out(tmp_path: Path) -> None:
    folder = packed_as(tmp_path / "walk", "message")
    bomb = tmp_path / "bomb"
    swollen(bomb, MOST + (1 << 20))
    file = storage_files(folder)[0]
    with closing(sqlite3.connect(file)) as database, database:
        points = "(SELECT id FROM topics WHERE name = '/points')"
        last = f"(SELECT max(id) FROM messages WHERE topic_id = {points})"
        database.execute(f"UPDATE messages SET data = ? WHERE id = {last}", (bomb.read_bytes(),))
    said = "/points, message of 1.45.*: cannot be unpacked .*becomes more than the .*keep-going"
    with pytest.raises(RecordingError, match=said):
        open_source(folder)
    source = open_source(folder, Options(keep_going=True))
    assert len(list(source)) == 4
    assert source.skips.count == 1


@pytest.mark.parametrize("mode", ["file", "message"])
def test_a_folder_without_its_end_gives_what_is_whole(tmp_path: Path, mode: str) -> None:
    folder = packed_as(tmp_path / "walk", mode)
    file = next(file for file in folder.iterdir() if file.name != "metadata.yaml")
    file.write_bytes(file.read_bytes()[:-2000])
    with pytest.raises(RecordingError, match="walk: .*cut short: .* promised.*keep-going"):
        open_source(folder)
    source = open_source(folder, Options(keep_going=True))
    assert 3 <= len(list(source)) <= 5 and source.name == "walk"


@pytest.mark.parametrize("table", ["schema", "topics", "messages", "message_definitions"])
def test_a_table_that_computes_is_refused(tmp_path: Path, table: str) -> None:
    """For ever, or any amount of memory: SQLite does what a view says."""
    make = Make()
    path = write_bag(tmp_path / "walk.db3", make, lidar(make))
    endless = "WITH RECURSIVE more(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM more)"
    with closing(sqlite3.connect(path)) as database, database:
        database.execute(f"ALTER TABLE {table} RENAME TO other")
        database.execute(
            f"CREATE VIEW {table} AS {endless} SELECT n AS schema_version, n AS id FROM more "
            "WHERE n < 0"
        )
    for keep_going in (False, True):
        with pytest.raises(RecordingError, match=f"walk.db3: .*{table} is no plain table"):
            open_source(path, Options(keep_going=keep_going))


def test_an_index_that_refers_to_itself_is_refused(tmp_path: Path) -> None:
    folder = packed_as(tmp_path / "walk", "file")
    lines = ["a: &a0 [x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 8)}]" for i in range(1, 20)]
    text = "\n".join(
        [*lines, "rosbag2_bagfile_information: {version: 9, storage_identifier: *a19}"]
    )
    (folder / "metadata.yaml").write_text(text)
    with pytest.raises(RecordingError, match="walk: .*repeats parts of itself by reference"):
        open_source(folder)


@pytest.mark.parametrize("mode", ["file", "message"])
def test_an_index_that_names_a_file_again_and_again_is_refused(tmp_path: Path, mode: str) -> None:
    folder = packed_as(tmp_path / "walk", mode)
    index, name = folder / "metadata.yaml", next(iter(folder.glob("walk.*"))).name
    again = "".join(f"\n  - ./{i * '/'}{name}" for i in range(1000))
    index.write_text(index.read_text().replace(f"- {name}", f"- {name}{again}", 1))
    with (
        patch.object(_storage, "unpack_zstd_file", side_effect=AssertionError("unpacked")),
        pytest.raises(RecordingError, match="metadata.yaml names a file twice"),
    ):
        open_source(folder)
