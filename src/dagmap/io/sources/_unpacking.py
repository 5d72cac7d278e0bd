"""Chunks of bags are unpacked within bounds: a few kilobytes may claim, or become, any size."""

from __future__ import annotations

import bz2
from importlib import import_module
from typing import Any

MOST = 1 << 27  # bytes of one packed chunk; recorders make chunks of a message or some megabytes


class Swollen(Exception):
    """A packed chunk claims, or becomes, more than it may."""


def unpack_zstd(data: bytes, size: int = MOST) -> bytes:
    """What is packed, in one frame or several. size: bytes that it promises to be.

    Raises Swollen before memory is taken for more than that, ZstdError for damaged bytes.
    """
    unpacker = import_module("zstandard").ZstdDecompressor()
    with unpacker.stream_reader(data, read_across_frames=True) as reader:
        return _bounded(reader.read(_allowed(size) + 1), size)


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
