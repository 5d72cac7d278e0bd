"""Arrays out of a zip (`.npz`). NumPy's own reader evaluates Python in their headers, and raises or
warns whatever that does; and it takes the memory that a header claims before it reads.
"""

from __future__ import annotations

import math
import re
import zipfile
import zlib
from typing import IO, Any, Literal

import numpy as np
import numpy.typing as npt

BROKEN = (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, RuntimeError, MemoryError)
_DEFLATE = 1100  # deflate makes nothing smaller than by this factor
_HEADER_MOST = 10_000  # bytes
_FIELD = r"'(\w+)':('[^']*'|True|False|\([\d,]*\))"
_FIELDS = re.compile(rf"\{{{_FIELD}(?:,{_FIELD})*,?\}}")
_TYPE = re.compile(r"'([<>|=]?[biufcSUO]\d*)'")


def read_members(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """The arrays by name. Raises ValueError where one is packed in a way that is not read."""
    members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
    for name, info in members.items():
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(f"{name[:60]!r} is packed by method {info.compress_type}")
    return members


def read_layout(
    archive: zipfile.ZipFile, info: zipfile.ZipInfo, size: int
) -> tuple[tuple[int, ...], np.dtype[Any], bool]:
    """Shape, type, and whether a file of `size` bytes can hold that much."""
    with archive.open(info) as file:
        shape, dtype, _ = read_header(file)
        claimed = file.tell() + math.prod(shape) * dtype.itemsize
    packed = min(info.compress_size, size)
    return shape, dtype, claimed == info.file_size and claimed <= _DEFLATE * (packed + 64)


def read_header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any], Literal["C", "F"]]:
    """Shape, type and order. Raises ValueError."""
    size = {(1, 0): 2, (2, 0): 4}.get(np.lib.format.read_magic(file))
    length = _HEADER_MOST + 1 if size is None else int.from_bytes(file.read(size), "little")
    if length > _HEADER_MOST:
        raise ValueError("an array of another npy version")
    text = "".join(file.read(length).decode("latin-1").split())
    fields = dict(re.findall(_FIELD, text)) if _FIELDS.fullmatch(text) else {}
    kind = _TYPE.fullmatch(fields.get("descr", ""))
    shape, fortran = fields.get("shape", ""), fields.get("fortran_order")
    if kind is None or not shape.startswith("(") or fortran not in ("True", "False"):
        raise ValueError(f"{text[:80]!r} is no header of an array of numbers")
    try:
        dtype = np.dtype(kind[1])
    except TypeError:
        raise ValueError(f"an array of type {kind[1]}") from None
    lengths = tuple(int(n) for n in shape.strip("()").split(",") if n)
    return lengths, dtype, "F" if fortran == "True" else "C"


def read_array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> npt.NDArray[Any]:
    """An array of the zip. Raises ValueError, and what the zip does where it is damaged."""
    with archive.open(info) as file:
        shape, dtype, order = read_header(file)
        size = math.prod(shape) * dtype.itemsize
        data = bytearray(file.read(size))
        file.read(1)  # at the end the checksum is compared
    if len(data) < size:
        raise ValueError(f"{info.filename[:60]!r} ends early")
    return np.ndarray(shape, dtype, data, order=order)
