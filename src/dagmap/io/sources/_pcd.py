"""Points of a PCD file: ascii, binary, or compressed as PCL does it."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from ...model import Floats, RecordingError, Uint8s
from ._cloud import doubles
from ._source import read_bytes

_MOST_HEADER = 100  # lines
_LETTERS = {"F": "f", "U": "u", "I": "i"}
_MOST_SMALLER = 300  # LZF makes nothing smaller than by this factor


def read_pcd(path: Path) -> tuple[Floats, Uint8s | None]:
    """(N, 3) m and (N, 3) RGB or None. Raises RecordingError that names what is wrong."""
    try:
        return _parse(read_bytes(path))
    except (ValueError, IndexError, KeyError, OverflowError, TypeError) as error:
        raise RecordingError(
            f"{path}: damaged, cut short, or no PCD ({error}); copy or write it anew"
        ) from None


def _parse(data: bytes) -> tuple[Floats, Uint8s | None]:
    head, at = _header(data)
    count = int(head["POINTS"][0] if "POINTS" in head else head["WIDTH"][0])
    if count < 0:
        raise ValueError(f"{count} points are promised")
    kind, names = _layout(head)
    if any(axis not in names for axis in "xyz"):
        raise ValueError(f"its fields are {' '.join(names)}; x y z are wanted")
    form = head["DATA"][0]
    if form == "ascii":
        rows = _ascii(data[at:], kind, count)
    elif form == "binary":
        if len(data) - at < count * kind.itemsize:
            raise ValueError(
                f"{count} points are promised, {(len(data) - at) // kind.itemsize} are there"
            )
        rows = np.frombuffer(data, kind, count, at)
    elif form == "binary_compressed":
        rows = _compressed(data, at, kind, count)
    else:
        raise ValueError(f"its data is {form[:20]!r}")
    points = np.stack([doubles(rows[axis]).reshape(count) for axis in "xyz"], axis=1)
    color = next((name for name in ("rgb", "rgba") if name in names), None)
    if color is None or kind[color].itemsize != 4:
        return points, None
    packed = np.ascontiguousarray(rows[color]).view(np.uint32).reshape(count)
    return points, np.stack([packed >> 16, packed >> 8, packed], axis=1).astype(np.uint8)


def _header(data: bytes) -> tuple[dict[str, list[str]], int]:
    """Its words by their names, and where the points begin."""
    head: dict[str, list[str]] = {}
    at = 0
    for _ in range(_MOST_HEADER):
        end = data.find(b"\n", at, at + 10_000)
        if end < 0:
            break
        words = data[at:end].decode("latin-1").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            head[words[0]] = words[1:]
            if words[0] == "DATA":
                return head, at
    raise ValueError("its header has no line DATA")


def _layout(head: dict[str, list[str]]) -> tuple[np.dtype[Any], list[str]]:
    names = head["FIELDS"]
    counts = [int(n) for n in head.get("COUNT", ["1"] * len(names))]
    fields: list[Any] = []
    for i, (name, size, letter, count) in enumerate(
        zip(names, head["SIZE"], head["TYPE"], counts, strict=True)
    ):
        code = f"<{_LETTERS[letter]}{int(size)}"
        if not 0 < count <= 10_000:
            raise ValueError(f"field {name} has {count} numbers")
        name = f"_{i}" if name == "_" else name  # padding
        fields.append((name, code) if count == 1 else (name, code, (count,)))
    return np.dtype(fields), [field[0] for field in fields]


def _ascii(data: bytes, kind: np.dtype[Any], count: int) -> np.ndarray:
    lines = data.split(b"\n", count)[:count]
    if not b"".join(lines).strip():
        lines = []
    if len(lines) < count or not count:
        raise ValueError(f"{count} points are promised, {len(lines)} are there")
    table = np.loadtxt(io.BytesIO(b"\n".join(lines)), np.float64, comments=None, ndmin=2)
    if len(table) < count:
        raise ValueError(f"{count} points are promised, {len(table)} are there")
    rows, column = np.zeros(count, kind), 0
    for name in kind.names or ():
        width = int(np.prod(kind[name].shape, dtype=np.int64))
        rows[name] = table[:, column : column + width].reshape(rows[name].shape)
        column += width
    return rows


def _compressed(data: bytes, at: int, kind: np.dtype[Any], count: int) -> np.ndarray:
    """Field after field, each for all points, packed by LZF."""
    packed, size = (int(n) for n in np.frombuffer(data, "<u4", 2, at))
    body = data[at + 8 : at + 8 + packed]
    if len(body) < packed or size != count * kind.itemsize or size > _MOST_SMALLER * packed:
        raise ValueError(f"{count} points are promised, {len(body)} packed bytes are there")
    plain, start = unpack_lzf(body, size), 0
    rows = np.zeros(count, kind)
    for name in kind.names or ():
        part = kind[name]
        end = start + count * part.itemsize
        rows[name] = np.frombuffer(plain[start:end], part.base).reshape(rows[name].shape)
        start = end
    return rows


def unpack_lzf(data: bytes, size: int) -> bytes:
    """Marc Lehmann's LZF. Raises ValueError where it does not give `size` bytes."""
    out, at = bytearray(), 0
    while at < len(data):
        control = data[at]
        at += 1
        if control < 32:
            out += data[at : at + control + 1]
            at += control + 1
            continue
        length, high = control >> 5, control & 31
        if length == 7:
            length += data[at]
            at += 1
        back = (high << 8 | data[at]) + 1
        at += 1
        start, length = len(out) - back, length + 2
        if start < 0 or len(out) + length > size:
            raise ValueError("its packed points refer to what is not there")
        if back >= length:
            out += out[start : start + length]
        else:  # it repeats what it is just writing
            piece = bytes(out[start:])
            out += (piece * (length // back + 1))[:length]
    if len(out) != size:
        raise ValueError(f"{size} bytes are promised, {len(out)} unpacked")
    return bytes(out)
