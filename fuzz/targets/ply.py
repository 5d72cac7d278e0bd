"""`read_ply`: a map that another program may have saved again."""

from __future__ import annotations

from collections.abc import Iterable
from random import Random

import numpy as np

from dagmap.io.export import _CODES, PlyMap, read_ply, write_ply
from dagmap.model import DagmapError
from grammar import Flip
from targets import Target
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
)
_WORDS += tuple(_CODES)


def run(data: bytes) -> bool:
    write(_FILE, data)
    try:
        found = read_ply(_FILE)
    except DagmapError as error:
        assert str(error).startswith(str(_FILE)) and "\n" not in str(error)
        return False
    assert found.positions.shape == found.colors.shape == (len(found.hits), 3)
    return True


def mutate(data: bytes, rng: Random, flip: Flip) -> bytes:
    """A word of the header becomes another; a line goes or comes twice; or bytes change."""
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
        body = flip(body)
    return b"\n".join(lines) + end + body


def seeds() -> Iterable[bytes]:
    for count in (0, 2):
        column = np.arange(count)
        colors = np.zeros((count, 3), np.uint8)
        write_ply(_FILE, PlyMap(np.ones((count, 3)), colors, column % 3, column, column, column))
        yield _FILE.read_bytes()
    yield _FILE.read_bytes().replace(b"float", b"double") + bytes(64)
    yield _FILE.read_bytes().replace(b"end_header", b"element face 0\nend_header")


ENCODERS = (
    "write_ply",
    "write_graph_npz",
    "prepare_out",
    "atomic_write",
    "_*result*",
    "_output_error",
    "MapLike.*",
)
TARGET = Target(run, mutate, seeds, {"dagmap.io.export": ENCODERS}, max_len=4096, generated=(b"",))
