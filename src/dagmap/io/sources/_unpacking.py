"""Bags are unpacked within bounds: a few kilobytes may claim, or become, any size."""

from __future__ import annotations

import bz2
from collections.abc import Callable, Iterable
from importlib import import_module
from pathlib import Path
from typing import IO, Any

MOST = 1 << 27  # bytes of one packed chunk; recorders make chunks of a message or some megabytes
MOST_TOGETHER = 2 * MOST  # of the chunks of an MCAP whose times overlap: they are in memory at once
_TIMES = 1000  # what sensors say never becomes so much smaller by packing
_SPARE = 1 << 30  # bytes that a small file may become all the same
_PIECE = 1 << 20
ZSTD = b"\x28\xb5\x2f\xfd"  # how what zstd packs begins; no message in CDR does


class Swollen(Exception):
    """Something packed claims, or becomes, more than it may."""


class Budget:
    """What a file may become in all, however often its chunks are unpacked."""

    def __init__(self, path: Path) -> None:
        files = path.iterdir() if path.is_dir() else [path]
        self.most = _TIMES * sum(file.stat().st_size for file in files) + _SPARE
        self.spent = 0

    def spend(self, count: int) -> None:
        """Raises Swollen where it is more than there may be."""
        self.spent += count
        if self.spent > self.most:
            raise Swollen(
                f"its chunks become more than {self.most} bytes in all, or lie so that they must "
                "be unpacked again and again"
            )

    def counted(self, unpack: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
        """The same function, whose results are counted."""

        def counting(data: bytes) -> bytes:
            raw = unpack(data)
            self.spend(len(raw))
            return raw

        return counting


def unpack_zstd(data: bytes, size: int = MOST) -> bytes:
    """What is packed, in one frame or several. size: bytes that it promises to be.

    Raises Swollen before memory is taken for more than that, ZstdError for damaged bytes.
    """
    unpacker = import_module("zstandard").ZstdDecompressor()
    with unpacker.stream_reader(data, read_across_frames=True) as reader:
        return _bounded(reader.read(_allowed(size) + 1), size)


def unpack_zstd_file(source: IO[bytes], sink: IO[bytes], most: int) -> None:
    """Piece by piece. Raises Swollen after `most` bytes, ZstdError or EOFError for damaged ones,
    with what is whole written."""
    unpacker, done = import_module("zstandard").ZstdDecompressor(), 0
    with unpacker.stream_reader(source, read_across_frames=True, closefd=False) as reader:
        while piece := reader.read(_PIECE):
            done += len(piece)
            if done > most:
                raise Swollen(f"a packed file becomes more than the {most} bytes that it may")
            sink.write(piece)


def unpack_lz4(data: bytes, size: int = MOST) -> bytes:
    """See `unpack_zstd`; of several frames the first.

    Raises RuntimeError or ValueError for damaged bytes.
    """
    unpacker = import_module("lz4.frame").LZ4FrameDecompressor()
    raw = _bounded(bytes(unpacker.decompress(data, max_length=_allowed(size) + 1)), size)
    return _whole(raw, unpacker.eof)


def unpack_bz2(data: bytes, size: int = MOST) -> bytes:
    """See `unpack_lz4`. Raises OSError or ValueError for damaged bytes."""
    unpacker = bz2.BZ2Decompressor()
    raw = _bounded(unpacker.decompress(data, _allowed(size) + 1), size)
    return _whole(raw, unpacker.eof)


def bound_rosbags() -> None:
    """Let rosbags unpack by the functions above: its own believe whatever a chunk says."""
    mcap = import_module("rosbags.rosbag2.storage_mcap")
    getattr(mcap, "DECOMPRESSORS", {}).update(zstd=unpack_zstd, lz4=unpack_lz4)
    ros1 = import_module("rosbags.rosbag1.reader")
    getattr(ros1, "decompressors", {}).update(bz2=unpack_bz2, lz4=unpack_lz4)


def bound_reader(reader: Any, budget: Budget) -> None:
    """See that an open AnyReader of rosbags keeps to the bounds of a whole file. Raises Swollen."""
    for part in reader.readers:
        storage = getattr(part, "storage", part)
        for each in getattr(storage, "storages", [storage]):
            chunks = getattr(each, "chunks", [])
            if isinstance(chunks, dict):  # of ROS 1: one at a time, again where they interleave
                for place, chunk in chunks.items():
                    chunks[place] = chunk._replace(decompressor=budget.counted(chunk.decompressor))
            else:  # of an MCAP: all whose times overlap, each once
                kept = [c for c in chunks if not c.compression or c.uncompressed_size <= MOST]
                _check_together(kept)  # others are refused when it is their turn
                budget.spend(sum(chunk.uncompressed_size for chunk in kept))


def _check_together(chunks: Iterable[Any]) -> None:
    """Chunks of one moment are unpacked at once, to bring their messages into order."""
    marks: list[tuple[int, int, int]] = []
    for chunk in chunks:
        begin = chunk.message_start_time
        end = max(chunk.message_end_time, begin)
        size = max(chunk.uncompressed_size, chunk.compressed_size)
        marks += [(begin, 0, size), (end, 1, -size)]
    together = 0
    for _, _, size in sorted(marks):
        together += size
        if together > MOST_TOGETHER:
            raise Swollen(
                f"chunks of one moment claim {together} bytes together, more than the "
                f"{MOST_TOGETHER} that are held at once"
            )


def unpacked(chunk: Any) -> bytes:
    """The records of a Chunk of the package mcap. Raises Swollen, or as the functions above."""
    if not chunk.compression:
        return bytes(chunk.data)
    unpack = {"zstd": unpack_zstd, "lz4": unpack_lz4}.get(chunk.compression)
    if unpack is None:
        raise ValueError(f"a chunk is packed by {chunk.compression[:20]!r}")
    return unpack(chunk.data, chunk.uncompressed_size)


def _allowed(size: int) -> int:
    if size > MOST:
        raise Swollen(
            f"a packed chunk claims {size} bytes, more than the {MOST} that are unpacked at once"
        )
    return size


def _whole(raw: bytes, ended: bool) -> bytes:
    if not ended:
        raise ValueError("a packed chunk is cut short")
    return raw


def _bounded(raw: bytes, size: int) -> bytes:
    if len(raw) > size:
        raise Swollen(f"a packed chunk becomes more than the {size} bytes that it may")
    return raw
