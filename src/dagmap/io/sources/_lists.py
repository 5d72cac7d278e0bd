"""Texts of a recording: a row a line, of which some may be damaged; and lists of stamped files."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple, TypeVar

from ...model import RecordingError
from ._source import Skips, kept, read_bytes

_T = TypeVar("_T")


class Row(NamedTuple):
    """A line that is not empty."""

    file: Path
    number: int  # from 1
    words: list[str]

    @property
    def where(self) -> str:
        """Where it stands, for errors."""
        return f"{self.file}, line {self.number}"

    def wrong(self, wanted: str) -> RecordingError:
        """The error of a line that is not as it should be, with its first words, none of them
        long. wanted: what is, with the verb."""
        said = ", ".join(repr(word[:30]) for word in self.words[:8])
        more = ", ..." if len(self.words) > 8 else ""
        return RecordingError(f"{self.where}: {wanted} wanted, not [{said}{more}]")

    def numbers(self, count: int, first: int = 0, names: str = "") -> list[float]:
        """The finite numbers from a word on. Raises RecordingError where they are not `count`.

        names: of the numbers, for the error.
        """
        try:
            values = [float(word) for word in self.words[first:]]
        except ValueError:
            values = []
        if len(values) != count or not all(map(math.isfinite, values)):
            raise self.wrong(f"{count} finite numbers{names and f' ({names})'} are")
        return values


class Stamped(NamedTuple):
    """A file of one moment. where: what names it, for errors."""

    stamp: float  # in the unit of the list
    file: Path
    where: str


def read_rows(path: Path) -> list[Row]:
    """Rows of a text file, parted by blanks or commas; `#` is a comment. Raises RecordingError."""
    try:
        text = read_bytes(path).decode()
    except UnicodeDecodeError:
        raise RecordingError(f"{path}: not a text file in UTF-8; write it anew") from None
    lines = ((number, line.strip()) for number, line in enumerate(text.splitlines(), 1))
    rows = (Row(path, n, line.replace(",", " ").split()) for n, line in lines if line[:1] != "#")
    return [row for row in rows if row.words]


def rising(items: Iterable[tuple[float, str, _T]], skips: Skips) -> list[_T]:
    """Of (stamp, where it stands, item) those whose stamp comes after the one before."""
    found: list[_T] = []
    last = -math.inf
    for stamp, where, item in items:
        if stamp <= last:
            skips.note(
                RecordingError(
                    f"{where}: the stamp {stamp} does not come after {last}; stamps must rise, "
                    "sort the lines and drop doubles"
                )
            )
            continue
        last = stamp
        found.append(item)
    return found


def stamped_files(
    listed: Path,
    wanted: str,
    base: Path,
    folder: Path,
    stamp_of: Callable[[str, str], float],
    skips: Skips,
) -> list[Stamped]:
    """The files that `listed` names, a stamp and a name below `base` a row; without it those of
    `folder`, whose names are their stamps. By rising stamps.

    wanted: how a row is to look, for errors. stamp_of: of a word, which knows where it stands.
    """

    def by_row(row: Row) -> Stamped:
        outside = base == folder and "/" in row.words[-1]
        if len(row.words) != 2 or outside:
            raise row.wrong(f"{wanted} is")
        return Stamped(stamp_of(row.words[0], row.where), base / row.words[1], row.where)

    def by_name(file: Path) -> Stamped:
        remedy = f"name files by their stamps, or write {listed.name}"
        return Stamped(stamp_of(file.stem, f"{file} ({remedy})"), file, str(file))

    if listed.is_file():
        found = list(kept(read_rows(listed), by_row, skips))
    else:
        files = (f for f in folder.iterdir() if f.is_file() and not f.name.startswith("."))
        found = sorted(kept(files, by_name, skips))
    return rising(((each.stamp, each.where, each) for each in found), skips)
