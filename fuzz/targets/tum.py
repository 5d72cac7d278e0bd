"""A TUM RGB-D folder: lists, camera, pictures. An input is files one after the other."""

from __future__ import annotations

import json
import re
import shutil
import zlib
from collections.abc import Iterable
from pathlib import Path
from random import Random

import cv2
import numpy as np

from dagmap.io.sources import Options, tum
from dagmap.model import DagmapError
from grammar import Flip
from targets import Target
from targets._files import workplace
from targets._folders import change, pack, unpack

_HOME = workplace()
_NAME = re.compile(r"((rgb|depth)/)?[A-Za-z0-9._-]{1,60}\Z")
_WORDS = (
    "0",
    "1",
    "1.02",
    "-1",
    "nan",
    "1e400",
    "1e300",
    "1_0",
    "x",
    "#",
    ",",
    "",
    "rgb/1.png",
    "rgb",
    "a" * 300,
    "\0",
    "../x",
    "depth/1.png",
    "/",
    "\u0663",
    "9" * 5000,
    "\x1b[2J",
    "\u2028",
    "\n",
    "\r",
    "[" * 3000,
    "{}",
    '"fx": 1e999',
    "1" * 400,
    "null",
    "true",
    "\\ud800",
)


def run(data: bytes) -> bool:
    folder = _HOME / "walk"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    unpack(folder, data, _NAME)
    if not tum.matches(folder):
        return False
    salvaged, whole = (_taken(folder, keep_going) for keep_going in (True, False))
    assert whole is None or whole == salvaged
    return whole is not None


def _taken(folder: Path, keep_going: bool) -> int | None:
    """How many cycles came; None where the folder is refused."""
    try:
        source = tum.open(folder, Options(max_features=50, max_depth=10.0, keep_going=keep_going))
        count = sum(1 for _ in source)
    except DagmapError as error:
        assert str(folder) in str(error) and "\n" not in str(error) and len(str(error)) < 4000
        return None
    assert len(source) >= count and (count == len(source) > 0 or keep_going)
    return count


def mutate(data: bytes, rng: Random, flip: Flip) -> bytes:
    """A word of a list becomes another; or files come, go, change names and bytes."""
    return change(data, rng, flip, _WORDS)


def seeds() -> Iterable[bytes]:
    camera = {
        "fx": 20.0,
        "fy": 20.0,
        "cx": 20.0,
        "cy": 20.0,
        "width": 40,
        "height": 40,
        "depth_scale": 1000.0,
    }
    color = np.kron(
        np.random.default_rng(1).integers(0, 256, (5, 5), np.uint8), np.ones((8, 8), np.uint8)
    )
    png = [
        cv2.imencode(".png", picture)[1].tobytes()
        for picture in (color, np.full((40, 40), 2000, np.uint16))
    ]
    jpg = cv2.imencode(".jpg", color)[1].tobytes()
    start = [(b"camera.json", json.dumps(camera).encode())]
    truth = (b"groundtruth.txt", b"# stamp pose\n1 0 0 0 0 0 0 1\n1.5,0,0,1,0,0,0,1\n")
    pictures = [(b"rgb/1.0.png", png[0]), (b"depth/1.01.png", png[1])]
    yield pack([*start, truth, *pictures])
    listed = [
        (b"rgb.txt", b"1 rgb/1.0.png\n9 rgb/1.0.png\n"),
        (b"depth.txt", b"1.01 depth/1.01.png\n"),
    ]
    yield pack([*start, truth, *pictures, *listed])
    named = (b"associations.txt", b"1 rgb/1.jpg 1.0 depth/1.01.png\n")
    yield pack([*start, truth, named, (b"rgb/1.jpg", jpg), pictures[1]])
    yield pack([(b"rgb/", b""), (b"depth/", b"")])
    yield pack([*start, (b"rgb/", b""), (b"depth/", b"")])
    yield pack([*start, *pictures])  # no poses
    yield pack([*start, *pictures, (b"groundtruth.txt/", b"")])
    yield pack([*start, *pictures, truth, (b"associations.txt", b"1 rgb/1.0.png 1 " + b"x" * 300)])
    damaged = [(b"rgb/1.0.png", png[0]), (b"depth/1.01.png", jpg)]
    yield pack([*start, truth, *damaged])
    size = (100_000).to_bytes(4, "big")
    chunks = (b"IHDR" + 2 * size + bytes((8, 0, 0, 0, 0)), b"IDAT", b"IEND")
    parts = (len(c[4:]).to_bytes(4, "big") + c + zlib.crc32(c).to_bytes(4, "big") for c in chunks)
    huge = b"\x89PNG\r\n\x1a\n" + b"".join(parts)  # more pixels than OpenCV takes
    yield pack([*start, truth, (b"rgb/1.0.png", huge), pictures[1]])


PARSERS = {
    "dagmap.io.sources.tum": (),
    "dagmap.io.sources._rgbd": ("import_cv2",),
    "dagmap.io.sources._source": ("Options.*",),
    "dagmap.io.sources._lists": (),
}
TARGET = Target(run, mutate, seeds, PARSERS, max_len=16_384)
