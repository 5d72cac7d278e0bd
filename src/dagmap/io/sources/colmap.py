"""COLMAP models, text or binary: each picture is a cycle, its points are those that it shows.

A model has no metre and no clock: lengths are the model's own, stamps count the pictures in the
order of their names, a second each.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from ...model import Cycle, Floats, RecordingError, Uint8s
from ._poses import inverse, matrix
from ._source import Description, Item, Options, Skips, checked, folder_name, kept, read_bytes

UNDERSTANDS = "a COLMAP model (points3D and images, .bin or .txt)"
_PLACES = (".", "sparse/0", "sparse")
_PARTS, _SUFFIXES = ("points3D", "images"), (".bin", ".txt")
_NO_POINT = np.uint64(2**64 - 1)
_MOST_NAME = 4096  # bytes
_SCALE = "lengths are the model's own: scale it to metres first (model_aligner)"
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True, eq=False)
class _Picture:
    name: str
    pose: Floats  # of the camera in the model
    seen: npt.NDArray[np.uint64]  # ids of points


@dataclass(frozen=True, slots=True, eq=False)
class _Points:
    """Ascending ids (N,), places (N, 3), RGB (N, 3), mean error of reprojection (N,) in pixels."""

    ids: npt.NDArray[np.uint64]
    places: Floats
    colors: Uint8s
    errors: Floats


def matches(path: Path) -> bool:
    """Whether this is a folder of a model, or of a project with one in sparse/0; or binary half of
    one, which nobody else should take for clouds."""
    return path.is_dir() and (_model(path) is not None or bool(_half(path, _SUFFIXES[:1])))


def lacks(path: Path) -> str:
    """What is missing of a model."""
    return _half(path)


def open(path: Path, options: Options) -> ColmapModel:  # noqa: A001
    """Open a model. Raises RecordingError."""
    return ColmapModel(path, options)


def describe(path: Path, options: Options) -> Description:
    """Pictures and points."""
    model = open(path, options)
    items = (
        Item("images", "poses", len(model), "cycles"),
        Item("points3D", "3D points", model.count, "points"),
    )
    return Description("COLMAP model", items, len(model), None, model.notes)


class ColmapModel:
    """The pictures of a model as cycles. count: its points."""

    def __init__(self, path: Path, options: Options) -> None:
        self.name, self._options = folder_name(path), options
        self.skips = Skips(options.keep_going)
        self.notes: tuple[str, ...] = (_SCALE,)
        found = _model(path)
        if found is None:
            raise RecordingError(f"{path}: {_half(path)}")
        folder, suffix = found
        self._path = folder
        read_images, read_points = (_images_bin, _points_bin)
        if suffix == ".txt":
            read_images, read_points = (_images_txt, _points_txt)
        pictures = _all(read_images(folder / f"images{suffix}"), self.skips)
        self._pictures = sorted(pictures, key=lambda picture: picture.name)
        rows = sorted(_all(read_points(folder / f"points3D{suffix}"), self.skips))
        if not rows or not pictures:
            raise RecordingError(f"{folder}: {len(pictures)} pictures, {len(rows)} points; no map")
        self._points = _Points(
            np.array([row[0] for row in rows], np.uint64),
            np.array([row[1] for row in rows], np.float64),
            np.array([row[2] for row in rows], np.uint8),
            np.array([row[3] for row in rows], np.float64),
        )
        self.count = len(rows)

    def __len__(self) -> int:
        return len(self._pictures)

    def __iter__(self) -> Iterator[Cycle]:
        yield from kept(range(len(self)), self._cycle, self.skips)

    def _cycle(self, i: int) -> Cycle:
        picture = self._pictures[i]
        rows, back = self._rows(picture), inverse(picture.pose)
        with np.errstate(over="ignore", invalid="ignore"):  # what is too far is refused below
            places = self._points.places[rows] @ back[:3, :3].T + back[:3, 3]
        ids, colors = self._points.ids[rows], self._points.colors[rows]
        cycle = Cycle(float(i), picture.pose, places, ids=ids, colors=colors)
        return checked(cycle, self._path / picture.name)

    def _rows(self, picture: _Picture) -> npt.NDArray[np.int64]:
        """The points that a picture shows; of too many those with the smallest error."""
        points = self._points
        ids = np.unique(picture.seen)
        at = np.minimum(np.searchsorted(points.ids, ids), len(points.ids) - 1)
        rows = at[points.ids[at] == ids]
        if self._options.max_depth is not None:
            with np.errstate(over="ignore", invalid="ignore"):
                distance = np.linalg.norm(points.places[rows] - picture.pose[:3, 3], axis=1)
            rows = rows[distance <= self._options.max_depth]
        if len(rows) > self._options.max_features:
            best = np.argsort(points.errors[rows], kind="stable")[: self._options.max_features]
            rows = np.sort(rows[best])
        return np.asarray(rows)


_Row: TypeAlias = tuple[int, tuple[float, ...], tuple[int, ...], float]  # id, place, RGB, error


def _model(path: Path) -> tuple[Path, str] | None:
    for place in _PLACES:
        for suffix in _SUFFIXES:
            if all((path / place / f"{name}{suffix}").is_file() for name in _PARTS):
                return path / place, suffix
    return None


def _half(path: Path, suffixes: tuple[str, ...] = _SUFFIXES) -> str:
    """What lacks where there is one part of a model without the other."""
    for place in _PLACES:
        for suffix in suffixes:
            there = [n for n in _PARTS if (path / place / f"{n}{suffix}").is_file()]
            if len(there) == 1:
                lacking = _PARTS[1 - _PARTS.index(there[0])]
                return f"no {lacking}{suffix} beside {there[0]}{suffix}; export the model anew"
    return ""


def _all(items: Iterator[_T], skips: Skips) -> list[_T]:
    """What comes before the first thing that cannot be read."""
    found: list[_T] = []
    try:
        found.extend(items)
    except RecordingError as error:
        skips.note(error)
    return found


class _Bytes:
    """A binary file that is read from its beginning. Raises RecordingError where it ends early."""

    def __init__(self, path: Path) -> None:
        self.path, self._data, self._at = path, read_bytes(path), 0

    def take(self, form: str) -> tuple[float, ...]:
        return struct.unpack(form, self.raw(struct.calcsize(form)))

    def raw(self, size: int) -> bytes:
        data = self._data[self._at : self._at + size]
        if len(data) < size:
            raise RecordingError(
                f"{self.path}: cut short: {size} bytes are promised at {self._at}, {len(data)} are "
                "there; copy it anew"
            )
        self._at += size
        return data

    def name(self) -> str:
        end = self._data.find(b"\0", self._at, self._at + _MOST_NAME)
        if end < 0:
            raise RecordingError(f"{self.path}: a name without an end at {self._at}; copy it anew")
        name = self._data[self._at : end].decode("utf-8", "replace")
        self._at = end + 1
        return name


def _images_bin(path: Path) -> Iterator[_Picture]:
    file = _Bytes(path)
    for _ in range(int(file.take("<Q")[0])):
        _, *pose, _ = file.take("<i7di")
        name, count = file.name(), int(file.take("<Q")[0])
        rows = np.frombuffer(file.raw(24 * count), [("xy", "<f8", 2), ("point", "<u8")])
        yield _picture(f"{path}: picture {name!r}", name, pose, rows["point"])


def _points_bin(path: Path) -> Iterator[_Row]:
    file = _Bytes(path)
    for _ in range(int(file.take("<Q")[0])):
        id_, x, y, z, red, green, blue, error, track = file.take("<Q3d3BdQ")
        file.raw(8 * int(track))
        yield int(id_), (x, y, z), (int(red), int(green), int(blue)), error


def _images_txt(path: Path) -> Iterator[_Picture]:
    """Two lines each; the second one may be empty."""
    lines, count = _lines(path), 0
    for number, line in lines:
        where, words = f"{path}, line {number}", line.split()
        if len(words) < 10:
            raise RecordingError(f"{where}: `id qw qx qy qz tx ty tz camera name` is wanted")
        number, line = next(lines, (number + 1, ""))
        seen = line.split()[2::3]
        try:
            pose = [float(word) for word in words[1:8]]
            ids = np.array([int(word) % 2**64 for word in seen], np.uint64)
        except ValueError as error:
            raise RecordingError(f"{where}: {error}") from None
        yield _picture(where, " ".join(words[9:]), pose, ids)
        count += 1
    _check_count(path, count)


def _points_txt(path: Path) -> Iterator[_Row]:
    count = 0
    for number, line in _lines(path):
        words = line.split()
        if not words:
            continue
        try:
            x, y, z, error = (float(words[i]) for i in (1, 2, 3, 7))
            red, green, blue = (min(max(int(word), 0), 255) for word in words[4:7])
            yield int(words[0]) % 2**64, (x, y, z), (red, green, blue), error
            count += 1
        except (ValueError, IndexError):
            raise RecordingError(
                f"{path}, line {number}: `id x y z r g b error track` is wanted"
            ) from None
    _check_count(path, count)


def _check_count(path: Path, count: int) -> None:
    """COLMAP says in a comment how many there are: a text may end early at the end of a line."""
    said = re.search(rb"^# Number of (?:images|points): (\d{1,18})\b", read_bytes(path), re.M)
    if said and count < int(said[1]):
        raise RecordingError(
            f"{path}: {int(said[1])} are promised, {count} are there; it is cut short, copy it anew"
        )


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Without comments; empty lines mean something in images.txt."""
    text = read_bytes(path).decode("utf-8", "replace")
    for number, line in enumerate(text.splitlines(), 1):
        if not line.startswith("#"):
            yield number, line


def _picture(where: str, name: str, numbers: list[float], seen: npt.NDArray[np.uint64]) -> _Picture:
    """COLMAP says where the world is in the camera, quaternion w first."""
    w, x, y, z, *place = numbers
    pose = matrix(np.array(place), np.array([x, y, z, w]))
    if pose is None:
        raise RecordingError(f"{where}: the rotation is no unit quaternion; export the model anew")
    shown = "".join(c if c.isprintable() else "?" for c in name)  # it stands in errors
    return _Picture(shown, inverse(pose), seen[seen != _NO_POINT])
