"""Recordings that are folders: an input is files one after the other, each name and bytes."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

from dagmap import wire
from dagmap.io.sources import Options
from dagmap.model import DagmapError
from dagmap.wire import Reader, Refusal
from grammar import Flip, many, record, rest, sized, tree
from grammar import mutate as mutate_tree

_FILES = many(record(sized(rest), sized(rest)))
_BINARY = (b".png", b".jpg", b".bin", b".pcd", b".ply")
# Words of lists, poses and settings: numbers at and beyond every limit, and what is no number.
WORDS = ("0", "1", "-1", "2", "8", "1.02", "nan", "inf", "1e400", "1e300", "1e9", "1_0", "x", "#")
WORDS += (
    ",",
    "",
    "\0",
    "../x",
    "/",
    "\u0663",
    "9" * 5000,
    "9" * 19,
    "\x1b[2J",
    "\u2028",
    "\n",
    "\r",
)
WORDS += ("1 0 0 0 0 0 0 1", "a" * 300, "[", "]", ":", "[" * 3000, "\xff")


def read(reader: Any, folder: Path, data: bytes, allowed: re.Pattern[str]) -> bool:
    """Whether a reader (a module of `io.sources`) takes the folder that the input describes.

    A file `slam.txt` is given as poses; with a file `body`, poses are said to be the body's, with
    `same` the sensor's.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    unpack(folder, data, allowed)
    if not reader.matches(folder):
        assert "\n" not in getattr(reader, "lacks", lambda _: "")(folder)
        return False
    poses, body = folder / "slam.txt", (folder / "body").is_file()
    options = Options(
        max_features=50,
        max_depth=10.0,
        poses=poses if poses.is_file() else None,
        body_poses=body,
        same_frame=(folder / "same").is_file() and not body,
    )
    salvaged = _taken(reader, folder, replace(options, keep_going=True))
    whole = _taken(reader, folder, options)
    assert whole is None or (salvaged is not None and whole[0] == whole[1] == salvaged[0] > 0)
    return whole is not None


def _taken(reader: Any, folder: Path, options: Options) -> tuple[int, int] | None:
    """How many cycles came, and how many were promised; None where the folder is refused."""
    try:
        told = reader.describe(folder, options)
        source = reader.open(folder, options)
        count = sum(1 for _ in source)
    except DagmapError as error:
        assert str(folder) in str(error) and "\n" not in str(error) and len(str(error)) < 4000
        return None
    assert told.cycles == len(source) >= count
    return count, len(source)


def unpack(folder: Path, data: bytes, allowed: re.Pattern[str]) -> None:
    """Write the files. Names that lead out of the folder are left out."""
    reader, made = Reader(data), 0
    while reader.left and made < 16:
        try:
            name, body = reader.take(reader.number()), reader.take(reader.number())
        except Refusal:
            return
        made += 1
        text = name.decode("ascii", "replace")
        path = folder / text
        try:
            if text.endswith("/") and allowed.match(text[:-1]):
                path.mkdir(parents=True, exist_ok=True)
            elif allowed.match(text):
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(body)
        except OSError:  # a file where a folder is wanted, or the other way round
            continue


def change(
    data: bytes, rng: Random, flip: Flip, words: Iterable[str] = WORDS,
    special: Callable[[bytes, Random, Flip], bytes] | None = None,
) -> bytes:  # fmt: skip
    """A word of a text becomes another; or files come, go, change names and bytes.

    special: changes a binary file with insight, instead of `flip`.
    """
    if rng.random() < 0.3:
        root = tree(data, _FILES)
        mutate_tree(root, rng, flip)
        return root.dump()
    files = files_of(data)
    if not files:
        return flip(data)
    i = rng.randrange(len(files))
    name, body = files[i]
    parts = re.split(rb"([ \n,:]+)", body)
    if name.endswith(_BINARY) or len(parts) > 2000:
        made = special(body, rng, flip) if special and rng.random() < 0.7 else flip(body)
        return pack([*files[:i], (name, made), *files[i + 1 :]])
    j = rng.randrange(len(parts))
    if rng.random() < 0.2:  # a line goes or comes twice
        lines = body.splitlines(keepends=True) or [b""]
        k = rng.randrange(len(lines))
        lines[k : k + 1] = rng.choice(([], [lines[k], lines[k]]))
        return pack([*files[:i], (name, b"".join(lines)), *files[i + 1 :]])
    parts[j] = rng.choice((rng.choice(list(words)).encode(), rng.choice(parts), flip(parts[j])))
    return pack([*files[:i], (name, b"".join(parts)), *files[i + 1 :]])


def files_of(data: bytes) -> list[tuple[bytes, bytes]]:
    """The files of an input, as far as it can be read."""
    reader, files = Reader(data), []
    try:
        while reader.left:
            files.append((reader.take(reader.number()), reader.take(reader.number())))
    except Refusal:
        pass
    return files


def pack(files: Iterable[tuple[bytes, bytes]]) -> bytes:
    """Files as one input."""
    return b"".join(wire.number(len(part)) + part for file in files for part in file)
