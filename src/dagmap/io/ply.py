"""Vertices of a PLY file, binary little endian or ASCII, whichever program wrote it."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from ..model import RecordingError

_CODES = {  # every scalar type that a PLY header may name
    b"char": "i1",
    b"int8": "i1",
    b"uchar": "u1",
    b"uint8": "u1",
    b"short": "<i2",
    b"int16": "<i2",
    b"ushort": "<u2",
    b"uint16": "<u2",
    b"int": "<i4",
    b"int32": "<i4",
    b"uint": "<u4",
    b"uint32": "<u4",
    b"float": "<f4",
    b"float32": "<f4",
    b"double": "<f8",
    b"float64": "<f8",
}
_MAX_LINE = 1000  # bytes of a header line
_BINARY, _ASCII = b"binary_little_endian", b"ascii"


def read_vertices(
    path: Path, wanted: Sequence[str], remedy: str, fits: np.dtype[np.void]
) -> npt.NDArray[np.void]:
    """The vertices as rows of a structured array that has at least the columns `wanted`.

    fits: types whose range the values of these columns keep to, in whatever type they are stored.
    Raises RecordingError naming the file, what is wrong, and the remedy.
    """
    try:
        with open(path, "rb") as file:
            rows = _read(file, wanted)
        for name in set(fits.names or ()) & set(rows.dtype.names or ()):
            _check_fit(name, rows[name], fits[name])
        return rows
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror}); check the path") from None
    except _Unusable as fault:
        raise RecordingError(f"{path}: no usable map: {fault}; {remedy}") from None


class _Unusable(Exception):
    """What is wrong with the file."""


def _read(file: BinaryIO, wanted: Sequence[str]) -> npt.NDArray[np.void]:
    form, dtype, count = _read_header(file, wanted)
    if form == _ASCII:
        rows = _parse(file, dtype, count)
    else:
        body = file.read(min(count * dtype.itemsize, os.fstat(file.fileno()).st_size))
        rows = np.frombuffer(body[: len(body) // dtype.itemsize * dtype.itemsize], dtype)
    if len(rows) < count:
        raise _Unusable(f"{count} nodes are promised, {len(rows)} are there")
    return rows


def _parse(file: BinaryIO, dtype: np.dtype[np.void], count: int) -> npt.NDArray[Any]:
    lines = [line for _, line in zip(range(count), file, strict=False)]
    if not b"".join(lines).strip():
        return np.zeros(0, dtype)
    try:
        table = np.loadtxt(io.BytesIO(b"".join(lines)), np.float64, comments=None, ndmin=2)
        if table.shape[1] != len(dtype.names or ()):
            raise ValueError(f"{table.shape[1]} numbers in a line")
    except ValueError as error:
        raise _Unusable(f"a line of its vertices is wrong ({error})") from None
    rows = np.zeros(len(table), dtype)
    for column, name in enumerate(dtype.names or ()):
        _check_fit(name, table[:, column], dtype[name])
        with np.errstate(over="ignore"):  # beyond float32: infinite
            rows[name] = table[:, column]
    return rows


def _check_fit(name: str, values: npt.NDArray[Any], kind: np.dtype[Any]) -> None:
    """Fractions are let through, and lost: programs store whole numbers as floats."""
    if kind.kind in "iu":
        low, high = np.iinfo(kind).min, np.iinfo(kind).max
        if not ((values >= low) & (values <= high)).all():
            raise _Unusable(f"{name} holds something else than numbers from {low} to {high}")


def _read_header(file: BinaryIO, wanted: Sequence[str]) -> tuple[bytes, np.dtype[np.void], int]:
    """The format, the layout and the number of vertices; leaves the file at the first vertex."""
    lines = [file.readline(_MAX_LINE).split()]
    while lines[0] == [b"ply"] and lines[-1] not in ([b"end_header"], []) and len(lines) < 200:
        lines.append(file.readline(_MAX_LINE).split())
    if lines[-1] != [b"end_header"]:
        raise _Unusable("it has no PLY header")
    form = next((f for f in (_BINARY, _ASCII) if [b"format", f, b"1.0"] in lines), None)
    if form is None:
        raise _Unusable("it is neither in binary little endian nor in ASCII")
    elements = [line for line in lines if line[0] == b"element"]
    if not elements or elements[0][1:2] != [b"vertex"] or not elements[0][-1].isdigit():
        raise _Unusable("the vertices do not come first")
    end = lines.index(elements[1]) if len(elements) > 1 else len(lines)
    fields = [line[1:] for line in lines[:end] if line[0] == b"property"]
    if any(len(field) != 2 or field[0] not in _CODES for field in fields):
        raise _Unusable("its vertices hold something else than numbers")
    names = [field[1].decode("ascii", "replace") for field in fields]
    missing = [name for name in wanted if names.count(name) != 1]
    if missing or len(set(names)) != len(names):
        raise _Unusable(f"its vertices lack {', '.join(missing) or 'unique names'}")
    dtype = np.dtype([(name, _CODES[kind]) for name, (kind, _) in zip(names, fields, strict=True)])
    return form, dtype, int(elements[0][-1][:15])
