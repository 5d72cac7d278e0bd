"""A folder of clouds: KITTI's .bin, PCD, PLY; poses, stamps, calibration."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable
from random import Random

import numpy as np

from dagmap.io.sources import scans
from grammar import Flip
from targets import Target
from targets._files import workplace
from targets._folders import WORDS, change, pack, read

_FOLDER = workplace() / "drive"
_NAME = re.compile(r"((velodyne|clouds|pcd|rgb)/)?[A-Za-z0-9._-]{1,60}\Z")
_WORDS = (b"FIELDS", b"SIZE", b"TYPE", b"COUNT", b"WIDTH", b"HEIGHT", b"POINTS", b"DATA", b"ascii")
_WORDS += (b"binary", b"binary_compressed", b"x", b"rgb", b"rgba", b"_", b"0", b"-1", b"1", b"2")
_WORDS += (b"4", b"8", b"F", b"U", b"I", b"Z", b"10001", b"9" * 30, b"9" * 5000, b"nan", b"\xff")


def run(data: bytes) -> bool:
    return read(scans, _FOLDER, data, _NAME)


def mutate(data: bytes, rng: Random, flip: Flip) -> bytes:
    return change(data, rng, flip, WORDS, _header)


def _header(body: bytes, rng: Random, flip: Flip) -> bytes:
    """A word of the header of a cloud becomes another; or one of its points changes."""
    head, end, rest = body.partition(b"DATA ")
    if not end or rng.random() < 0.2:
        return flip(body)
    lines = (head + end + rest.partition(b"\n")[0]).split(b"\n")
    i = rng.randrange(len(lines))
    words = lines[i].split(b" ")
    words[rng.randrange(len(words))] = rng.choice(_WORDS)
    lines[i] = b" ".join(words)
    return b"\n".join(lines) + b"\n" + rest.partition(b"\n")[2]


def _pcd(form: str, points: np.ndarray, color: str = "", packed: bytes = b"") -> bytes:
    names, n = "x y z" + (f" {color}" if color else ""), 4 if color else 3
    head = f"# .PCD v0.7\nVERSION 0.7\nFIELDS {names}\nSIZE {'4 ' * n}\nTYPE {'F ' * n}\n"
    head += f"COUNT {'1 ' * n}\nWIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\nDATA {form}\n"
    rows = np.column_stack([points, *([np.zeros(len(points))] if color else [])]).astype("<f4")
    if form == "ascii":
        text = io.StringIO()
        np.savetxt(text, rows, "%g")
        return head.encode() + text.getvalue().encode()
    return head.encode() + (packed or rows.tobytes())


def _lzf(points: np.ndarray, *refer: bytes) -> bytes:
    """Packed without saving anything; or a beginning, and references to it for the rest."""
    plain = points.astype("<f4").T.tobytes()
    pieces = [plain[i : i + 32] for i in range(0, len(plain), 32)]
    body = b"".join(bytes((len(piece) - 1,)) + piece for piece in pieces)
    body = b"".join(refer) if refer else body
    return np.array([len(body), len(plain)], "<u4").tobytes() + body


def seeds() -> Iterable[bytes]:
    points = np.random.default_rng(1).uniform(1, 3, (8, 3)).astype(np.float32)
    same = np.ones((8, 3), np.float32)
    kitti = np.column_stack([points, np.zeros(8)]).astype("<f4").tobytes()
    row = b"1 0 0 0 0 1 0 0 0 0 1 0\n"
    bins = [(b"velodyne/000000.bin", kitti), (b"velodyne/000001.bin", kitti)]
    calibration = (b"calib.txt", b"P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
    yield pack([*bins, (b"poses.txt", 2 * row), calibration, (b"times.txt", b"0\n0.1\n")])
    yield pack([*bins, (b"poses.txt", row), (b"calib.txt", b"P0: 1\n")])
    yield pack([*bins, (b"poses.txt", row)])
    lidar = (b"same", b"")
    yield pack([*bins, (b"poses.txt", 2 * row), lidar])
    yield pack([*bins, (b"poses.txt", row + b"1 x\n" + row), lidar, (b"times.txt", b"0\n1\n2\n")])
    named = [(b"a.bin", kitti), (b"b.bin", kitti)]
    yield pack([*named, (b"poses.txt", row)])
    yield pack([*named, (b"poses.txt", 3 * row)])
    yield pack([*bins, (b"poses.txt", b"#\n"), (b"times.txt", b"0\n0\n")])
    yield pack([*bins, (b"poses.txt", b"#\n")])
    yield pack([*bins, (b"poses.txt", 2 * row), (b"times.txt", b"0\n")])
    many = np.random.default_rng(2).uniform(-3, 3, (120, 4)).astype("<f4").tobytes()
    yield pack([(b"0.bin", many), (b"1.bin", many)])
    yield pack([(b"0.bin", bytes(32)), (b"poses.txt", row)])
    signal = b"\x01\x00\x80\x7f" * 4  # NaNs that signal
    yield pack([(b"0.bin", signal), (b"poses.txt", row)])
    yield pack([*bins])  # odometry, which wants more points
    tum = b"# stamp\n1 0 0 0 0 0 0 1\n1.5 0 0 1 0 0 0 1\n"
    yield pack([*bins, (b"poses.txt", tum)])
    yield pack([*bins, (b"poses.txt", tum), (b"times.txt", b"1\n1.2\n")])
    yield pack([*bins, (b"poses.txt", tum), (b"times.txt", b"8\n9\n")])
    yield pack([*bins, (b"poses.txt", b"1 0 0 0 0 0 0 9\n"), (b"times.txt", b"1\n1.2\n")])
    yield pack([*bins, (b"poses.txt", b"1 0 0 0 0 0 0 x\n"), (b"times.txt", b"1\n1.2\n")])
    yield pack([*bins, (b"poses.txt", b"2e18 0 0 0 0 0 0 1\n"), (b"times.txt", b"1\n1.2\n")])
    poses = (b"poses.txt", tum)
    for form in ("ascii", "binary"):
        yield pack([(b"1.0.pcd", _pcd(form, points)), poses])
        yield pack([(b"clouds/1.0.pcd", _pcd(form, points, "rgb")), poses])
    one = b"\x03" + np.float32(1).tobytes()
    for refer in ((one, bytes((7 << 5, 83, 3))), (one * 8, bytes((7 << 5, 23, 31)) * 2)):
        yield pack(
            [(b"1.0.pcd", _pcd("binary_compressed", same, packed=_lzf(same, *refer))), poses]
        )
    yield pack([(b"1.0.pcd", _pcd("binary_compressed", points, packed=_lzf(points))), poses])
    short = _pcd("binary", points)
    yield pack([(b"1.0.pcd", short[:-9]), poses])
    yield pack([(b"1.0.pcd", short.replace(b"DATA", b"DATE")), poses])
    yield pack([(b"1.0.pcd", short.replace(b"binary", b"other")), poses])
    yield pack([(b"1.0.pcd", short.replace(b"FIELDS x", b"FIELDS a")), poses])
    yield pack([(b"1.0.pcd", short.replace(b"COUNT 1", b"COUNT 0")), poses])
    yield pack([(b"1.0.pcd", short.replace(b"POINTS 8", b"POINTS -8")), poses])
    yield pack([(b"1.0.pcd", _pcd("ascii", points).replace(b"POINTS 8", b"POINTS 9")), poses])
    yield pack([(b"1.0.pcd", _pcd("ascii", points) + b"\n\n\n"), poses])
    yield pack([(b"1.0.pcd", _pcd("ascii", points[:0])), poses])
    blank = _pcd("ascii", points).partition(b"DATA ascii\n")
    yield pack([(b"1.0.pcd", blank[0] + blank[1] + b"1 2 3\n" * 6 + b"#\n\n"), poses])
    damaged = _lzf(same)[:8] + b"\xff" * (len(_lzf(same)) - 8)
    yield pack([(b"1.0.pcd", _pcd("binary_compressed", same, packed=damaged)), poses])
    yield pack([(b"1.0.pcd", _pcd("binary_compressed", same, packed=_lzf(same)[:-3])), poses])
    few = np.array([4, 96], "<u4").tobytes() + b"\x02abc"
    yield pack([(b"1.0.pcd", _pcd("binary_compressed", same, packed=few)), poses])
    ply = b"ply\nformat ascii 1.0\nelement vertex 1\n"
    ply += b"".join(b"property float %c\n" % axis for axis in b"xyz")
    rgb = b"".join(b"property uchar %s\n" % name for name in (b"red", b"green", b"blue"))
    yield pack([(b"1.0.ply", ply + b"end_header\n1 2 3\n"), poses])
    yield pack([(b"1.0.ply", ply + rgb + b"end_header\n1 2 3 4 5 6\n"), poses])
    yield pack([(b"velodyne/0.bin", kitti[:-3]), (b"poses.txt", row)])
    yield pack([(b"rgb/1.png", b""), (b"0.bin", kitti)])


PARSERS = {
    "dagmap.io.sources.scans": (),
    "dagmap.io.sources._pcd": (),
    "dagmap.io.sources._cloud": (),
}
TARGET = Target(run, mutate, seeds, PARSERS, max_len=8192)
