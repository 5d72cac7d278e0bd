"""A COLMAP model: points3D and images, binary or text."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable
from random import Random

from dagmap.io.sources import colmap
from grammar import Flip
from targets import Target
from targets._files import workplace
from targets._folders import change, pack, read

_FOLDER = workplace() / "model"
_NAME = re.compile(r"(sparse/(0/)?)?[A-Za-z0-9._-]{1,60}\Z")
_EDGES = (0, 1, 2, 1 << 31, (1 << 32) - 1, 1 << 62, (1 << 64) - 1)


def run(data: bytes) -> bool:
    return read(colmap, _FOLDER, data, _NAME)


def mutate(data: bytes, rng: Random, flip: Flip) -> bytes:
    return change(data, rng, flip, special=_count)


def _count(body: bytes, rng: Random, flip: Flip) -> bytes:
    """A count becomes another: the first one, or what stands anywhere."""
    at = rng.choice((0, rng.randrange(max(len(body) - 7, 1))))
    return body[:at] + struct.pack("<Q", rng.choice(_EDGES)) + body[at + 8 :]


def _images(seen: tuple[int, ...], turn: float = 1.0, far: float = 1.0) -> bytes:
    out = struct.pack("<Q", 1) + struct.pack("<i7di", 1, turn, 0, 0, 0, 0, 0, far, 1) + b"a.png\0"
    return out + struct.pack("<Q", len(seen)) + b"".join(struct.pack("<2dQ", 1, 1, p) for p in seen)


def _points(place: float = 1.0) -> bytes:
    rows = (struct.pack("<Q3d3BdQ2i", i, place, 1, 2, 9, 9, 9, 0.5, 1, 1, 0) for i in range(1, 61))
    return struct.pack("<Q", 60) + b"".join(rows)


def seeds() -> Iterable[bytes]:
    seen = (*range(1, 61), 99, (1 << 64) - 1)
    yield pack([(b"images.bin", _images(seen)), (b"points3D.bin", _points())])
    yield pack([(b"sparse/0/images.bin", _images(seen[:3])), (b"sparse/0/points3D.bin", _points())])
    yield pack([(b"images.bin", _images(seen, 9.0)), (b"points3D.bin", _points())])
    yield pack([(b"images.bin", _images(seen)), (b"points3D.bin", _points(1e300))])
    yield pack([(b"images.bin", _images(seen)), (b"points3D.bin", _points(1e7))])
    yield pack([(b"images.bin", _images(seen, far=1e9)), (b"points3D.bin", _points())])
    yield pack([(b"images.bin", _images(seen)[:-9]), (b"points3D.bin", _points()[:-9])])
    endless = _images(())[:72] + b"a" * 5000
    yield pack([(b"images.bin", endless), (b"points3D.bin", _points())])
    yield pack([(b"images.bin", bytes(8)), (b"points3D.bin", bytes(8))])
    pictures = b"# images\n1 1 0 0 0 0 0 1 1 a b.png\n1 1 1 2 2 -1\n2 1 0 0 0 0 0 0 1 c.png\n\n"
    points = b"# points\n1 1 1 2 9 9 9 0.5 1 0\n\n2 1 1 3 300 -9 9 0.5\n"
    yield pack([(b"images.txt", pictures), (b"points3D.txt", points)])
    yield pack([(b"images.txt", b"1 2\n"), (b"points3D.txt", points)])
    yield pack([(b"images.txt", b"1 1 0 0 0 0 0 1 1 a\nx x x\n"), (b"points3D.txt", points)])
    yield pack([(b"images.txt", b"1 1 0 0 0 0 0 1 1 a"), (b"points3D.txt", b"1 2\n")])
    yield pack([(b"images.txt", b"")])
    yield pack([(b"images.bin", _images(seen))])
    more = pictures.replace(b"# images", b"# Number of images: 3, mean")
    yield pack([(b"images.txt", more), (b"points3D.txt", points)])


TARGET = Target(run, mutate, seeds, {"dagmap.io.sources.colmap": ()}, max_len=8192)
