"""Results on disk: the map as PLY, a robot's graph as npz, and the folder that they go into.

A file appears whole or not at all: everything is written beside its place and then renamed.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np
import numpy.typing as npt

from ..model import Bools, Floats, Int64s, OutputError, Uint8s
from .ply import read_vertices

# What `replay` writes, and so what --force may remove.
REPLAY_FILES = ("summary.json", "map.ply", "maps.png", "traffic.png", "report.html")
REPLAY_FOLDERS = {"ledgers": ("*.db", "*.db-wal", "*.db-shm"), "graph": ("*.npz",)}
_PART = ".part"  # ends the name of a file that is still being written

# The vertex properties of map.ply, in this order, with their names in the PLY header.
_VERTEX = (
    ("x", "<f4", "float"),
    ("y", "<f4", "float"),
    ("z", "<f4", "float"),
    ("red", "u1", "uchar"),
    ("green", "u1", "uchar"),
    ("blue", "u1", "uchar"),
    ("state", "u1", "uchar"),
    ("hits", "<u4", "uint"),
    ("misses", "<u4", "uint"),
    ("witnesses", "<u2", "ushort"),
)
_DTYPE = np.dtype([(name, code) for name, code, _ in _VERTEX])
_WHOLE = np.dtype([(name, code) for name, code, _ in _VERTEX if "u" in code])
_HEADER = "\n".join(
    [
        "ply",
        "format binary_little_endian 1.0",
        "comment DAGmap: metres in the fleet frame; state 0 confirmed, 1 tentative, 2 rejected",
        "element vertex {count}",
        *(f"property {kind} {name}" for name, _, kind in _VERTEX),
        "end_header\n",
    ]
)


class MapLike(Protocol):
    """What `write_ply` needs of a map: a `WorldMap` has it."""

    @property
    def positions(self) -> npt.NDArray[Any]:
        """(N, 3) metres in the fleet frame."""

    @property
    def colors(self) -> npt.NDArray[Any]:
        """(N, 3) uint8."""

    @property
    def states(self) -> npt.NDArray[Any]:
        """(N,) values of `State`."""

    @property
    def hits(self) -> npt.NDArray[Any]:
        """(N,) whole numbers."""

    @property
    def misses(self) -> npt.NDArray[Any]:
        """(N,) whole numbers."""

    @property
    def witnesses(self) -> npt.NDArray[Any]:
        """(N,) authors that have seen the node."""


@dataclass(frozen=True, slots=True, eq=False)
class PlyMap:
    """A map read back from `map.ply`: a `MapLike`."""

    positions: Floats
    colors: Uint8s
    states: Uint8s
    hits: Int64s
    misses: Int64s
    witnesses: Int64s


def write_ply(path: Path, world: MapLike) -> None:
    """Write every node of a map as binary little-endian PLY. Raises OutputError.

    Counts that do not fit their column are written as the largest that does.
    """
    vertices = np.zeros(len(world.positions), _DTYPE)
    for axis, name in enumerate(("x", "y", "z")):
        vertices[name] = world.positions[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = world.colors[:, channel]
    vertices["state"] = world.states
    for name in ("hits", "misses", "witnesses"):
        vertices[name] = np.minimum(
            np.asarray(getattr(world, name), np.int64), np.iinfo(_DTYPE[name]).max
        )
    with atomic_write(path) as file:
        file.write(_HEADER.format(count=len(vertices)).encode())
        file.write(vertices.tobytes())


def read_ply(path: Path) -> PlyMap:
    """Read a `map.ply`, also one that another program has saved again.

    Raises RecordingError naming the file and what is wrong.
    """
    names = [name for name, _, _ in _VERTEX]
    vertices = read_vertices(path, names, "give a map.ply that DAGmap wrote", _WHOLE)
    with np.errstate(invalid="ignore"):  # NaNs that signal stay what they are
        places = np.stack([vertices[name].astype(np.float64) for name in "xyz"], axis=1)
    return PlyMap(
        places,
        np.stack([vertices[name].astype(np.uint8) for name in ("red", "green", "blue")], axis=1),
        vertices["state"].astype(np.uint8),
        *(vertices[name].astype(np.int64) for name in ("hits", "misses", "witnesses")),
    )


def write_graph_npz(
    path: Path,
    ids: Int64s,
    positions: Floats,
    parents: Int64s,
    validity: Int64s,
    issued: Bools,
) -> None:
    """Write the adjacency DAG of one robot. Raises OutputError.

    ids (N,); positions (N, 3) metres; parents (N, n_p) ids, -1 where the parent is a lattice node
    or there is none; validity (N,); issued (N,) True where the feature was broadcast.
    """
    lengths = [len(column) for column in (ids, positions, parents, validity, issued)]
    if len(set(lengths)) != 1:
        raise ValueError(f"the columns of one graph must be equally long, these are {lengths}")
    with atomic_write(path) as file:
        np.savez_compressed(
            file,
            ids=ids,
            positions=positions,
            parents=parents,
            validity=validity,
            issued=issued,
        )


def prepare_out(path: Path, force: bool) -> Path:
    """Make the folder that `replay` writes into, with `ledgers` and `graph` in it.

    A folder with something in it is an error without `force`; with it, the files that a replay
    writes are removed and everything else stays. Raises OutputError.
    """
    path = Path(path)
    try:
        if path.exists() and not path.is_dir():
            raise OutputError(f"{path}: this is a file; name a folder for the results")
        if path.is_dir() and any(path.iterdir()):
            if not force:
                raise OutputError(
                    f"{path}: the folder is not empty; name another one, or add --force to "
                    "replace the results in it"
                )
            _remove_results(path)
        for folder in REPLAY_FOLDERS:
            (path / folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _output_error(path, error) from error
    with atomic_write(path / "ledgers" / "probe"):  # fails now rather than after the work
        pass
    (path / "ledgers" / "probe").unlink()
    return path


def _remove_results(path: Path) -> None:
    old = [path / name for name in REPLAY_FILES] + list(path.glob(f".*{_PART}"))
    for folder, patterns in REPLAY_FOLDERS.items():
        for pattern in (*patterns, f".*{_PART}"):
            old += (path / folder).glob(pattern)
    for file in old:
        if file.is_symlink() or file.is_file():
            file.unlink()


@contextmanager
def atomic_write(path: Path, mode: int = 0o666) -> Iterator[BinaryIO]:
    """Give a file to write to; it takes its name when the block ends well and is gone when not.

    What is no file (a pipe, a terminal, a device) is written to as it is, never replaced.
    mode: who may use it, less what the user's umask takes away.
    Raises OutputError that names the file and the remedy.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}{_PART}")
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            with path.open("wb") as stream:
                yield stream
            return
        handle = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode)
        with open(handle, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        raise _output_error(path, error) from error
    finally:
        with suppress(OSError):
            part.unlink()


def _output_error(path: Path, error: OSError) -> OutputError:
    reason = error.strerror or str(error)
    return OutputError(
        f"{path}: cannot be written ({reason}); make the place writable, free some space, or name "
        "another one"
    )
