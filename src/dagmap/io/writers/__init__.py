"""The map in the formats of others.

A further format is one more module in this folder, with a constant `SUFFIXES` (names of files that
it writes), `ABOUT` (what to tell people) and a function `write(path, table, options)`. It is found
by being there; a leading underscore hides a module. Libraries are imported when they are needed.
"""

from __future__ import annotations

import pkgutil
from importlib import import_module
from pathlib import Path
from typing import Protocol, cast

from ...model import OutputError
from ..exported import MapTable
from ._writer import WriteOptions as WriteOptions

__all__ = ["WriteOptions", "formats", "write_map"]


class _Writer(Protocol):
    """What a module of this folder offers."""

    SUFFIXES: tuple[str, ...]
    ABOUT: str

    def write(self, path: Path, table: MapTable, options: WriteOptions) -> None: ...


def formats() -> dict[str, str]:
    """What each suffix stands for."""
    return {suffix: writer.ABOUT for writer in _writers() for suffix in writer.SUFFIXES}


def write_map(path: Path, table: MapTable, options: WriteOptions | None = None) -> None:
    """Write a map in the format that the file's suffix names.

    A file appears whole or not at all. Raises OutputError that names the file and the remedy.
    """
    suffix = path.suffix.lower()
    for writer in _writers():
        if suffix in writer.SUFFIXES:
            writer.write(path, table, options or WriteOptions())
            return
    known = ", ".join(sorted(formats()))
    raise OutputError(f"{path}: no format that DAGmap writes; name a file that ends in {known}")


def _writers() -> list[_Writer]:
    names = sorted(module.name for module in pkgutil.iter_modules(__path__))
    modules = (import_module(f"{__name__}.{name}") for name in names if not name.startswith("_"))
    return [cast(_Writer, module) for module in modules]
