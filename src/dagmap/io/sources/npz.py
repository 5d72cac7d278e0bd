"""The cycle stream: one `.npz` per robot, which any SLAM can be made to write.

C cycles, N points, M moved poses; (*) marks what may be left out:
`stamp (C,)` s; `pose (C, 4, 4)` sensor to the robot's SLAM frame; `points (N, 3)` float32 m in the
sensor frame; `offsets (C + 1,)` first point of each cycle; `ids (N,)` uint64 *; `colors (N, 3)`
uint8 *; `descriptors (N, 32)` uint8 *; `removed` ids and `removed_offsets (C + 1,)` *;
`moved_stamp (M,)`, `moved_pose (M, 4, 4)` and `moved_offsets (C + 1,)` *; `session (C,)` *;
`version`, 1 where it is left out.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ...model import DESCRIPTOR, Cycle, CycleError, Int64s, RecordingError
from ...quantising import quantise_cycle
from ..export import atomic_write
from ..npy import BROKEN, read_array, read_header, read_layout, read_members
from ._source import Options, Skips, checked, kept

UNDERSTANDS = "a cycle stream (.npz)"
VERSION = 1

_Array: TypeAlias = npt.NDArray[Any]
_Arrays: TypeAlias = dict[str, _Array]

# name: kinds of numbers, then the shape: C cycles, C + 1, or any length of its own (a letter)
_LAYOUT: dict[str, tuple[str, tuple[str | int, ...]]] = {
    "stamp": ("fiu", ("C",)),
    "pose": ("f", ("C", 4, 4)),
    "points": ("f", ("N", 3)),
    "offsets": ("iu", ("C+1",)),
    "ids": ("iu", ("N",)),
    "colors": ("u", ("N", 3)),
    "descriptors": ("u", ("N", DESCRIPTOR)),
    "removed": ("iu", ("R",)),
    "removed_offsets": ("iu", ("C+1",)),
    "moved_stamp": ("fiu", ("M",)),
    "moved_pose": ("f", ("M", 4, 4)),
    "moved_offsets": ("iu", ("C+1",)),
    "session": ("iu", ("C",)),
    "version": ("iu", ()),
}
_NEEDED = ("stamp", "pose", "points", "offsets")
_TOGETHER = (("removed", "removed_offsets"), ("moved_stamp", "moved_pose", "moved_offsets"))
_OFFSETS = {"offsets": "points", "removed_offsets": "removed", "moved_offsets": "moved_stamp"}


def matches(path: Path) -> bool:
    """Whether this is a file called `.npz`."""
    return path.is_file() and path.suffix.lower() == ".npz"


def open(path: Path, options: Options) -> CycleStream:  # noqa: A001
    """Open a cycle stream. Raises RecordingError."""
    return CycleStream(path, options)


class CycleStream:
    """The cycles of a file. All of it is checked before the first one comes out; what `keep_going`
    leaves out are whole cycles."""

    def __init__(self, path: Path, options: Options) -> None:
        self.name, self._path = path.stem, path
        self.skips = Skips(options.keep_going)
        self.notes: tuple[str, ...] = ()
        try:
            self._arrays = _load(path)
        except BROKEN as error:  # RecordingError is none of these
            raise RecordingError(
                f"{path}: truncated, damaged or no .npz file ({error}); copy or write it anew"
            ) from None
        _check_layout(path, self._arrays)
        self._kept = list(range(len(self._arrays["stamp"])))
        try:
            _check_values(path, self._arrays)
        except RecordingError as error:
            self.skips.note(error)
            self._kept = self._usable()
            if not self._kept:
                raise

    def __len__(self) -> int:
        return len(self._kept)

    def __iter__(self) -> Iterator[Cycle]:
        yield from kept(self._kept, self._checked, self.skips)

    def _checked(self, i: int) -> Cycle:
        return checked(self._cycle(i), self._path)

    def _usable(self) -> list[int]:
        """The cycles that an agent takes, by stamps that rise within their session."""
        found, last = [], dict[int, float]()
        for i in range(len(self._arrays["stamp"])):
            try:
                cycle = self._checked(i)
                if cycle.stamp <= last.get(cycle.session, -np.inf):
                    continue
            except (RecordingError, OverflowError):  # a number that no int64 holds
                continue
            last[cycle.session] = cycle.stamp
            found.append(i)
        return found

    def _cycle(self, i: int) -> Cycle:
        arrays = self._arrays
        points = _part(arrays, "offsets", i)
        removed, moved = _part(arrays, "removed_offsets", i), _part(arrays, "moved_offsets", i)
        return Cycle(
            stamp=float(arrays["stamp"][i]),
            pose=arrays["pose"][i],
            points=arrays["points"][points],
            ids=arrays["ids"][points] if "ids" in arrays else None,
            colors=arrays["colors"][points] if "colors" in arrays else None,
            moved=None
            if moved.start == moved.stop
            else (arrays["moved_stamp"][moved], arrays["moved_pose"][moved]),
            removed=None if removed.start == removed.stop else arrays["removed"][removed],
            session=int(arrays["session"][i]) if "session" in arrays else 0,
            descriptors=arrays["descriptors"][points] if "descriptors" in arrays else None,
        )


def _part(arrays: _Arrays, name: str, i: int) -> slice:
    """The rows of cycle i."""
    if name not in arrays:
        return slice(0, 0)
    return slice(int(arrays[name][i]), int(arrays[name][i + 1]))


def _load(path: Path) -> _Arrays:
    """The arrays. What they claim to be is checked before any memory is taken for them."""
    with zipfile.ZipFile(path) as archive:
        members = read_members(archive)
        _check_version(path, archive, members)
        _check_names(path, set(members))
        shapes: dict[str, tuple[int, ...]] = {}
        sizes: dict[str, int] = {}
        for name in sorted(members, key=list(_LAYOUT).index):
            shapes[name], dtype, holds = read_layout(archive, members[name], path.stat().st_size)
            _check_shape(path, name, shapes[name], dtype, sizes)
            if not holds:
                raise RecordingError(
                    f"{path}: {name} claims {shapes[name]} {dtype}, which is not what the file "
                    "holds; write it anew"
                )
        return {name: read_array(archive, info) for name, info in members.items()}


def _check_version(
    path: Path, archive: zipfile.ZipFile, members: dict[str, zipfile.ZipInfo]
) -> None:
    """Before all else, since another version may look different."""
    if "version" not in members:
        return
    with archive.open(members["version"]) as file:
        shape, dtype, _ = read_header(file)
    if shape != () or dtype.kind not in "iu":
        raise RecordingError(f"{path}: version is {shape} {dtype}; one whole number is wanted")
    version = int(read_array(archive, members["version"]))
    if version != VERSION:
        raise RecordingError(
            f"{path}: version {version} of the cycle stream; this DAGmap reads {VERSION}, "
            "install a newer one or write the file anew"
        )


def _check_names(path: Path, names: set[str]) -> None:
    missing = [name for name in _NEEDED if name not in names]
    if missing:
        raise RecordingError(f"{path}: no array {missing[0]}; a cycle stream needs {_NEEDED}")
    unknown = sorted(names - set(_LAYOUT))
    if unknown:
        raise RecordingError(
            f"{path}: unknown array {unknown[0][:60]!r}; known are {tuple(_LAYOUT)}"
        )
    for group in _TOGETHER:
        given = [name for name in group if name in names]
        if given and len(given) != len(group):
            raise RecordingError(f"{path}: {given[0]} alone; {group} belong together")


def _check_shape(
    path: Path, name: str, shape: tuple[int, ...], dtype: np.dtype[Any], sizes: dict[str, int]
) -> None:
    """Whether an array is as the layout has it, given the sizes (C, N, ...) found before."""
    kinds, layout = _LAYOUT[name]
    letters = {"f": "float", "i": "int", "u": "uint"}
    wanted = f"({', '.join(map(str, layout))}) {' or '.join(letters[kind] for kind in kinds)}"
    fits = dtype.kind in kinds and len(shape) == len(layout) and all(n >= 0 for n in shape)
    if name in ("colors", "descriptors"):
        fits, wanted = fits and dtype == np.uint8, wanted + "8"
    for size, length in zip(layout, shape, strict=False):
        known = sizes["C"] + 1 if size == "C+1" else size
        fits = fits and length == (
            known if isinstance(known, int) else sizes.setdefault(known, length)
        )
    if not fits:
        raise RecordingError(f"{path}: {name} is {shape} {dtype}; {wanted} is wanted")


def _check_layout(path: Path, arrays: _Arrays) -> None:
    """Whether each cycle has its rows."""
    if not len(arrays["stamp"]):
        raise RecordingError(f"{path}: an empty recording; it holds no cycle")
    for name, target in _OFFSETS.items():
        if name in arrays:
            _check_offsets(path, name, arrays[name], len(arrays[target]))


def _check_values(path: Path, arrays: _Arrays) -> None:
    for name in ("stamp", "pose", "points", "moved_stamp", "moved_pose"):
        bad = ~np.isfinite(arrays.get(name, np.zeros(0)))
        if bad.any():
            row = int(np.argwhere(bad)[0][0])
            cycle = int(np.searchsorted(arrays["offsets"], row, side="right")) - 1
            place = f" (cycle {cycle})" if name == "points" else ""
            raise RecordingError(f"{path}: {name}[{row}]{place} is not finite; drop it")
    for name in ("ids", "removed", "session"):
        if name in arrays and arrays[name].size and int(arrays[name].min()) < 0:
            raise RecordingError(f"{path}: {name} holds a negative number; they start at 0")
    _check_stamps(path, arrays)


def _check_offsets(path: Path, name: str, offsets: _Array, count: int) -> None:
    """Offsets rise from 0 to the number of rows. Compared as they are, before any conversion."""
    rising = bool((offsets[1:] >= offsets[:-1]).all())
    if int(offsets[0]) != 0 or int(offsets[-1]) != count or not rising:
        raise RecordingError(
            f"{path}: {name} run from {offsets[0]} to {offsets[-1]}; they must rise from 0 to "
            f"{count}, the number of rows"
        )


def _check_stamps(path: Path, arrays: _Arrays) -> None:
    sessions = arrays.get("session", np.zeros(len(arrays["stamp"]), np.int64)).tolist()
    last: dict[int, float] = {}
    for i, (session, stamp) in enumerate(zip(sessions, arrays["stamp"].tolist(), strict=True)):
        if stamp <= last.get(session, -np.inf):
            raise RecordingError(
                f"{path}: stamp[{i}] = {stamp} does not come after {last[session]}; stamps must "
                "rise within a session, sort the cycles or start a new session"
            )
        last[session] = stamp


def save_cycles(path: Path | str, cycles: Iterable[Cycle]) -> None:
    """Write a cycle stream that `open_source` reads back.

    Points are kept as float32, so to 8 micrometres at 100 m. Raises CycleError where an agent would
    refuse a cycle, or where only some cycles have ids or colours; OutputError where the file cannot
    be written. The file appears whole or not at all.
    """
    kept = list(cycles)
    for cycle in kept:
        quantise_cycle(cycle)
    points = [np.asarray(c.points, np.float32).reshape(-1, 3) for c in kept]
    removed = [_column(c.removed, np.uint64) for c in kept]
    moved = [((), ()) if c.moved is None else c.moved for c in kept]
    moved_stamps = [_column(stamps, np.float64) for stamps, _ in moved]
    arrays: _Arrays = {
        "version": np.array(VERSION),
        "stamp": np.array([float(c.stamp) for c in kept], np.float64),
        "pose": np.array([np.asarray(c.pose, np.float64) for c in kept]).reshape(-1, 4, 4),
        "points": np.concatenate([np.zeros((0, 3), np.float32), *points]),
        "offsets": _offsets(points),
        "session": np.array([c.session for c in kept], np.int64),
    }
    counts = [len(rows) for rows in points]
    arrays |= _optional("ids", np.zeros(0, np.uint64), [c.ids for c in kept], counts)
    arrays |= _optional("colors", np.zeros((0, 3), np.uint8), [c.colors for c in kept], counts)
    none = np.zeros((0, DESCRIPTOR), np.uint8)
    arrays |= _optional("descriptors", none, [c.descriptors for c in kept], counts)
    if any(len(rows) for rows in removed):
        arrays |= {"removed": np.concatenate(removed), "removed_offsets": _offsets(removed)}
    if any(len(rows) for rows in moved_stamps):
        poses = [np.asarray(poses, np.float64).reshape(-1, 4, 4) for _, poses in moved]
        arrays |= {
            "moved_stamp": np.concatenate(moved_stamps),
            "moved_pose": np.concatenate(poses),
            "moved_offsets": _offsets(moved_stamps),
        }
    with atomic_write(Path(path)) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as out:
        for name, array in arrays.items():
            with out.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


def _column(values: npt.ArrayLike | None, dtype: type[np.generic]) -> _Array:
    return np.asarray(() if values is None else values).astype(dtype).reshape(-1)


def _offsets(parts: list[_Array]) -> Int64s:
    return np.cumsum([0, *map(len, parts)], dtype=np.int64)


def _optional(
    name: str, empty: _Array, columns: list[npt.ArrayLike | None], counts: list[int]
) -> _Arrays:
    """A column that all cycles with points have, or none."""
    given = [column is not None for column, count in zip(columns, counts, strict=True) if count]
    if not any(given):
        return {}
    if not all(given):
        raise CycleError(f"{name}: some cycles have them and some do not; give all or none")
    rows = [np.asarray(column) for column, n in zip(columns, counts, strict=True) if n]
    return {name: np.concatenate([empty, *(row.astype(empty.dtype) for row in rows)])}
