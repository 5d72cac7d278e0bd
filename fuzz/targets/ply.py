"""`read_ply` and `read_cloud`: a map or a cloud that another program may have saved."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable
from random import Random

import numpy as np

from dagmap.io.clouds import read_cloud
from dagmap.io.export import PlyMap, read_ply, write_ply
from dagmap.io.ply import _CODES
from dagmap.model import DagmapError
from grammar import Flip
from targets import Target, npz
from targets._files import workplace, write

_FILE = workplace() / "map.ply"
_WORDS = (
    b"element",
    b"property",
    b"vertex",
    b"face",
    b"list",
    b"comment",
    b"0",
    b"-1",
    b"1",
    b"9" * 400,
    b"x",
    b"\xff",
    b"",
    b"format ascii 1.0",
    b"format binary_little_endian 1.0",
    b"ascii",
    b"nan",
    b"-inf",
    b"1e300",
    b"1.5",
    b"# 1",
)
_WORDS += tuple(_CODES)


def run(data: bytes) -> bool:
    write(_FILE, data)
    return sum([_taken(read) for read in (_map, _cloud)]) > 0


def _taken(read: Callable[[], None]) -> bool:
    try:
        read()
    except DagmapError as error:
        assert str(error).startswith(str(_FILE)) and "\n" not in str(error)
        return False
    return True


def _map() -> None:
    found = read_ply(_FILE)
    assert found.positions.shape == found.colors.shape == (len(found.hits), 3)


def _cloud() -> None:
    found = read_cloud(_FILE)
    assert found.positions.ndim == 2 and found.positions.shape[1] == 3
    assert found.positions.dtype == np.float64
    assert found.states is None or found.states.shape == (len(found.positions),)


def mutate(data: bytes, rng: Random, flip: Flip) -> bytes:
    """A word of the header becomes another; a line goes or comes twice; or bytes change.

    Arrays change as those of cycle streams.
    """
    if data[:2] == b"PK":
        return npz.mutate(data, rng, flip)
    head, end, body = data.partition(b"end_header\n")
    way = rng.randrange(5)
    if way == 0 or not end:
        return flip(data)
    lines = head.split(b"\n")
    i = rng.randrange(len(lines))
    if way == 1:
        lines.insert(i, rng.choice(lines))
    elif way == 2:
        del lines[i]
    elif way == 3:
        words = lines[i].split(b" ")
        words[rng.randrange(len(words))] = rng.choice(_WORDS)
        lines[i] = b" ".join(words)
    else:
        words = body.split(b" ")
        words[rng.randrange(len(words))] = rng.choice(_WORDS)
        body = flip(body) if rng.random() < 0.5 else b" ".join(words)
    return b"\n".join(lines) + end + body


def seeds() -> Iterable[bytes]:
    for count in (0, 2):
        column = np.arange(count)
        colors = np.zeros((count, 3), np.uint8)
        write_ply(_FILE, PlyMap(np.ones((count, 3)), colors, column % 3, column, column, column))
        yield _FILE.read_bytes()
    yield _FILE.read_bytes().replace(b"float", b"double") + bytes(64)
    yield _FILE.read_bytes().replace(b"end_header", b"element face 0\nend_header")
    head = (
        _FILE.read_bytes().partition(b"end_header\n")[0].replace(b"binary_little_endian", b"ascii")
    )
    yield head + b"end_header\n" + b"1 2.5 -3 0 128 255 1 5 6 7\n" * 2
    yield (
        b"ply\nformat ascii 1.0\nelement vertex 1\n"
        + b"".join(b"property float %s\n" % name for name in (b"x", b"y", b"z", b"state"))
        + b"end_header\n1 2 3 0\n"
    )
    start = b"ply\nformat ascii 1.0\nelement vertex %d\n" + b"".join(
        b"property %s %s\n" % pair
        for pair in zip((b"float",) * 3 + (b"int",), (b"x", b"y", b"z", b"state"), strict=True)
    )
    for lines in ((b"",), (b"1 2 3 4 5",), (b"1 2 3 x",), (b"1 2 3 nan",), (b"1 2 3 256",)):
        yield start % len(lines) + b"end_header\n" + b"\n".join(lines)
    yield start % 0 + b"end_header\n"
    yield start % 1 + b"end_header\n\n"
    points, pose = np.ones((2, 3)), np.eye(4)[None]
    for arrays in (
        {"positions": points, "states": np.zeros(2, np.uint8)},
        {"points": points.astype(np.float32)},
        {"points": points, "pose": pose, "offsets": np.array([0, 2])},
        {"points": points, "pose": pose, "offsets": np.array([0, 1])},
        {"points": points, "pose": pose, "offsets": np.zeros((2, 2))},
        {"points": points, "pose": pose * np.nan, "offsets": np.array([0, 2])},
        {"points": points.astype("U9")},
        {"points": points[0]},
        {"points": points, "states": np.zeros(3)},
        {"points": points, "states": np.full(2, 1e9)},
    ):
        packed = io.BytesIO()
        np.savez(packed, **arrays)  # type: ignore[arg-type]
        yield packed.getvalue()


ENCODERS = (
    "write_ply",
    "write_graph_npz",
    "prepare_out",
    "atomic_write",
    "_*result*",
    "_output_error",
    "MapLike.*",
)
PARSERS = {"dagmap.io.export": ENCODERS, "dagmap.io.ply": (), "dagmap.io.clouds": ()}
TARGET = Target(run, mutate, seeds, PARSERS, max_len=4096, generated=(b"",))
