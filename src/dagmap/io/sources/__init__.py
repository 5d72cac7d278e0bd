"""Recordings as iterables of `Cycle`, whatever wrote them.

A further format is one more module in this folder, with a constant `UNDERSTANDS` (what to tell
people it reads) and two functions: `matches(path) -> bool`, which looks no further than names, and
`open(path, options) -> Source`. It is found by being there; a leading underscore hides a module.
`lacks(path) -> str`, where there is one, says of a folder that nobody reads what is missing of a
recording of this kind.
"""

from __future__ import annotations

import pkgutil
from importlib import import_module
from pathlib import Path
from typing import Protocol, cast

from ...model import RecordingError
from ._source import Description as Description
from ._source import Options as Options
from ._source import Source as Source
from .npz import save_cycles as save_cycles

__all__ = ["Description", "Options", "Source", "describe_source", "open_source", "save_cycles"]


class _Reader(Protocol):
    """What a module of this folder offers."""

    UNDERSTANDS: str

    def matches(self, path: Path) -> bool: ...
    def open(self, path: Path, options: Options) -> Source: ...


def open_source(
    path: Path | str,
    options: Options | None = None,
    *,
    camera: Path | None = None,
    max_features: int = 1000,
    max_depth: float | None = None,
) -> Source:
    """Open a recording with the first reader that knows its kind.

    camera: a camera.json to use instead of the recording's own.
    max_features: points that a frame gives at most.
    max_depth: metres beyond which a depth is not trusted; None: all are.
    options: these and more. A reader takes those that concern it. Raises RecordingError that names
    file, place and remedy; what can only be seen in a single frame is raised while iterating.
    """
    path = Path(path)
    options = options or Options(camera, max_features, max_depth)
    return _reader_of(path).open(path, options)


def describe_source(path: Path | str, options: Options | None = None) -> Description:
    """What is in a recording, and what of it would be used. Raises RecordingError."""
    path, options = Path(path), options or Options()
    reader = _reader_of(path)
    if hasattr(reader, "describe"):
        return cast(Description, reader.describe(path, options))
    source = reader.open(path, options)
    return Description(reader.UNDERSTANDS, cycles=len(source), notes=source.notes)


def _reader_of(path: Path) -> _Reader:
    if not path.exists():
        raise RecordingError(f"{path}: there is no such file or folder; check the path")
    readers = _readers()
    for reader in readers:
        if reader.matches(path):
            return reader
    for reader in readers:
        if path.is_dir() and (said := getattr(reader, "lacks", lambda _: "")(path)):
            raise RecordingError(f"{path}: {said}")
    known = " or ".join(reader.UNDERSTANDS for reader in readers)
    raise RecordingError(f"{path}: not a recording that DAGmap knows; it reads {known}")


def _readers() -> list[_Reader]:
    """All readers in order of their names."""
    names = sorted(module.name for module in pkgutil.iter_modules(__path__))
    modules = (import_module(f"{__name__}.{name}") for name in names if not name.startswith("_"))
    return [cast(_Reader, module) for module in modules]
