"""What all readers share: the protocol, the options, and errors that name the file."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, TypeVar

from ...model import ConfigError, Cycle, CycleError, RecordingError
from ...quantising import quantise_cycle

_S = TypeVar("_S")
_T = TypeVar("_T")
_TOLD = 20  # things that were left out and are told of one by one


class Source(Protocol):
    """A recording. It can be iterated again, and gives the same cycles."""

    name: str  # the folder's name or the file's stem: what the robot is called
    notes: tuple[str, ...]  # where its poses come from, and what is only assumed of them
    skips: Skips

    def __len__(self) -> int:
        """Cycles that iterating gives."""

    def __iter__(self) -> Iterator[Cycle]:
        """The cycles, by stamp within each session. Raises RecordingError."""


@dataclass(frozen=True, slots=True)
class Options:
    """See `open_source`. Raises ConfigError where one is out of its range."""

    camera: Path | None = None
    max_features: int = 1000
    max_depth: float | None = None  # m
    topics: tuple[str, ...] = ()  # of a bag; what is not named is found by its type
    frame: str | None = None  # of a bag with tf: the frame that stands still
    same_frame: bool = False  # poses are those of the sensor, whatever their frames are called
    poses: Path | None = None  # a file of poses beside clouds
    voxel: float = 0.1  # m: of a cloud one point a voxel is kept
    keep_going: bool = False  # leave out what cannot be read, and say so in `skipped`
    body_poses: bool = False  # poses of a SLAM are the body's (IMU), not the camera's

    def __post_init__(self) -> None:
        if not 1 <= self.max_features <= 1 << 20:
            raise ConfigError(f"max_features = {self.max_features}, but 1 to 2^20 is wanted")
        if self.max_depth is not None and not self.max_depth > 0:
            raise ConfigError(f"max_depth = {self.max_depth}, but more than 0 m is wanted")
        if self.body_poses and self.same_frame:
            raise ConfigError("body_poses and same_frame contradict each other; say one of them")
        if not 0.001 <= self.voxel <= 1000:
            raise ConfigError(f"voxel = {self.voxel}, but 0.001 to 1000 m is wanted")


@dataclass(frozen=True, slots=True)
class Item:
    """A part of a recording: a topic, a folder, a table."""

    name: str
    kind: str
    count: int
    use: str = ""  # what it would be used for


@dataclass(frozen=True, slots=True)
class Description:
    """What `dagmap inspect` tells. cycles: None where they are not known; problem: why not."""

    kind: str
    items: tuple[Item, ...] = ()
    cycles: int | None = None
    problem: str | None = None
    notes: tuple[str, ...] = ()


def described(
    kind: str, items: tuple[Item, ...], opened: Callable[[], Source], *more: str
) -> Description:
    """What there is, with what opening it tells. more: notes that concern every one of its kind."""
    try:
        source = opened()
    except RecordingError as error:
        return Description(kind, items, None, str(error))
    return Description(kind, items, len(source), None, (*source.notes, *more))


@dataclass(slots=True)
class Skips:
    """What was left out of a recording, because `keep_going` says so; once, however often it is
    read."""

    keep_going: bool
    told: list[str] = field(default_factory=list)
    count: int = 0
    _known: set[int] = field(default_factory=set)

    def note(self, error: RecordingError) -> None:
        """Leave one thing out. Raises the error where that is not wanted."""
        if not self.keep_going:
            hint = "" if "--keep-going" in str(error) else "; --keep-going leaves it out"
            raise RecordingError(f"{error}{hint}") from None
        if hash(str(error)) in self._known:
            return
        self._known.add(hash(str(error)))
        self.count += 1
        if len(self.told) < _TOLD:
            self.told.append(str(error))


def kept(items: Iterable[_S], convert: Callable[[_S], _T], skips: Skips) -> Iterator[_T]:
    """What `convert` makes of lines, files or frames, but for those at which it raises
    RecordingError: these are skipped, or end it."""
    for item in items:
        try:
            found = convert(item)
        except RecordingError as error:
            skips.note(error)
            continue
        yield found


def folder_name(path: Path) -> str:
    """The last part of a path, also of `.` and `robot1/`; links keep their own name."""
    return Path(os.path.abspath(path)).name


def checked(cycle: Cycle, path: Path | str) -> Cycle:
    """The same cycle. Raises RecordingError naming the file where an agent would refuse it."""
    try:
        quantise_cycle(cycle)
    except CycleError as error:
        raise RecordingError(f"{path}: {error}") from None
    return cycle


def read_bytes(path: Path) -> bytes:
    """A whole file. Raises RecordingError where it is missing or cannot be read."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise RecordingError(f"{path}: missing; the recording needs it") from None
    except ValueError:  # a zero byte
        raise RecordingError(f"{path}: no file can have this name; correct the list") from None
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from None
