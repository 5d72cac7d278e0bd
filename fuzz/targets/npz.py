"""The cycle stream: the zip around it, the headers of its arrays, and their values."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterable
from random import Random

import numpy as np

from dagmap.io.sources import Options, npz, save_cycles
from dagmap.model import Cycle, DagmapError
from grammar import Flip
from targets import Target
from targets._files import workplace

_FILE = workplace() / "robot.npz"
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
_DATE = (1980, 1, 1, 0, 0, 0)
_HEADERS = (
    b"'<f8'",
    b"'<f4'",
    b"'>f8'",
    b"'|u1'",
    b"'<u8'",
    b"'|O'",
    b"'<U9'",
    b"'<f2'",
    b"'<f16'",
    b"'<i8'",
    b"True",
    b"()",
    b"(1,)",
    b"(0, 3)",
    b"(-1,)",
    b"(3, 3)",
    b"(9223372036854775808,)",
    b"(1, 4, 4)",
    b"[('a', '<f8')]",
    b"{[]: 1}",
    b"('<f8',)",
    b"('<f8', (2, 2))",
    b"'(",
    b"(" * 300,
    b"\\",
    b"'\\d'",
    b"1L",
)


def run(data: bytes) -> bool:
    _FILE.write_bytes(data)
    assert npz.matches(_FILE), "not recognised by its name"
    salvaged, whole = (_taken(Options(keep_going=keep_going)) for keep_going in (True, False))
    assert whole is None or whole == salvaged
    return whole is not None


def _taken(options: Options) -> int | None:
    """How many cycles came; None where the file is refused."""
    try:
        source = npz.open(_FILE, options)
        count = sum(1 for _ in source)
    except DagmapError as error:
        assert str(error).startswith(str(_FILE)) and "\n" not in str(error)
        return None
    assert len(source) >= count and (count == len(source) > 0 or options.keep_going)
    return count


def mutate(data: bytes, rng: Random, flip: Flip) -> bytes:
    """An array's header or values change inside a zip that stays sound; or bytes of the zip do."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [(info.filename, archive.read(info)) for info in archive.infolist()]
    except Exception:  # noqa: BLE001 - no zip that could be kept sound
        return flip(data)
    if not members or rng.random() < 0.2:
        return flip(data)
    i = rng.randrange(len(members))
    name, body = members[i]
    way = rng.randrange(8)
    if way == 0:
        del members[i]
    elif way == 1:
        members[i] = (rng.choice(members)[0], body)
    elif way == 2:
        members[i] = (name, rng.choice(members)[1])
    else:
        members[i] = (name, _array(body, rng, flip))
    return _zip(members, rng)


def _array(body: bytes, rng: Random, flip: Flip) -> bytes:
    """Another header (its length kept right), or other values behind it."""
    size = 10 + int.from_bytes(body[8:10], "little")
    head, values, way = body[10:size], body[size:], rng.randrange(5)
    if way == 0:
        head = flip(head)
    elif way == 1:
        parts = head.split(b": ")
        j = rng.randrange(len(parts))
        old, comma, after = parts[j].rpartition(b", '")
        parts[j] = rng.choice(_HEADERS) + comma + after if comma else rng.choice(_HEADERS) + b"}"
        head = b": ".join(parts)
        del old
    elif way == 2:
        at = 8 * rng.randrange(len(values) // 8 + 1)
        number = rng.choice((0.0, -1.0, np.nan, np.inf, 1e308, -1e200, 1e9, 1e-320))
        whole = rng.choice((0, 1, 2, -1, 1 << 32, (1 << 63) - 1, -(1 << 63)))
        new = np.array(number if rng.random() < 0.5 else whole).tobytes()
        values = values[:at] + new + values[at + 8 :]
    elif way == 3:
        values = flip(values)
    else:
        return flip(body)
    return body[:8] + len(head).to_bytes(2, "little", signed=False) + head + values


def _zip(members: list[tuple[str, bytes]], rng: Random) -> bytes:
    out = io.BytesIO()
    method = rng.choice(_METHODS) if rng.random() < 0.1 else zipfile.ZIP_STORED
    with zipfile.ZipFile(out, "w", method) as archive:
        for name, body in dict(members).items():
            archive.writestr(zipfile.ZipInfo(name, _DATE), body[: 1 << 16], method)
    return out.getvalue()


def seeds() -> Iterable[bytes]:
    pose, points = np.eye(4), np.array([[1.0, 0, 0], [2, 0, 0]])
    plain = [Cycle(0.0, pose, points)]
    full = [
        Cycle(0.0, pose, points, ids=[1, 2], colors=np.zeros((2, 3), np.uint8)),
        Cycle(1.0, pose, points[:0], removed=[1], moved=((0.0,), (pose,))),
        Cycle(0.5, pose, points[:1], ids=[1], colors=np.zeros((1, 3), np.uint8), session=1),
    ]
    for cycles in (plain, full):
        save_cycles(_FILE, cycles)
        with zipfile.ZipFile(_FILE) as archive:
            members = [(info.filename, archive.read(info)) for info in archive.infolist()]
        yield _FILE.read_bytes() if cycles is plain else _zip(members, Random(0))
        yield _zip(members, Random(0))
    save_cycles(_FILE, [])
    yield _FILE.read_bytes()
    header = b"{'descr': '<i8', 'fortran_order': False, 'shape': ()}"
    short = b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header
    yield _zip([("version.npy", short)], Random(0))


ENCODERS = ("save_cycles", "_column", "_offsets", "_optional")
PARSERS = {"dagmap.io.sources.npz": ENCODERS, "dagmap.io.npy": ()}
TARGET = Target(run, mutate, seeds, PARSERS, max_len=16_384)
