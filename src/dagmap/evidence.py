"""Ray evidence: in how many transactions of an author a ray crossed a cell, or a point ended there.

Sums commute, so this stays outside the fold's undo: what is withdrawn or moved walks again with -1.
"""

from __future__ import annotations

import hashlib
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from .kernels import bricks, judging, rays
from .model import Bools, Int32s, Int64s

D = TypeVar("D", bound=np.generic)

_MAX_RAY_MM = 1 << 17  # up to these two, crossing times stay within int64
_MAX_CELL_MM = 1 << 15


def hash_key(salt: int) -> Int64s:
    """(4,) secret multipliers and offset, 1 to 2^31 - 2, of the kernels' hashes."""
    seed = (salt & ((1 << 128) - 1)).to_bytes(16, "little")
    numbers = np.frombuffer(hashlib.blake2b(seed, digest_size=32).digest(), "<u8")
    return (1 + numbers % ((1 << 31) - 2)).astype(np.int64)


def with_room(column: npt.NDArray[D], rows: int) -> npt.NDArray[D]:
    """The column itself where it has enough rows, else a copy with a quarter more than it needs.

    Spare rows are zero and cost no memory before they are written.
    """
    if rows <= len(column):
        return column
    bigger = np.zeros((rows + rows // 4 + 16, *column.shape[1:]), column.dtype)
    bigger[: len(column)] = column
    return bigger


def plain(array: npt.NDArray[D]) -> npt.NDArray[D]:
    """The array, or a contiguous and writable copy: the one form that kernels are compiled for."""
    return array if array.flags.carray else np.array(array, order="C")


class RayEvidence:
    """Passes and ends per cell and author. Cell of a coordinate: floor(mm / cell_mm).

    In one call of `walk` a cell counts at most once, however many rays cross it. The results depend
    neither on the order of the calls nor on the salt. `len()`: bricks (8^3 cells) with evidence.
    """

    def __init__(self, cell_mm: int, max_ray_mm: int, salt: int = 0) -> None:
        if not 1 <= cell_mm <= _MAX_CELL_MM or not 0 <= max_ray_mm <= _MAX_RAY_MM:
            raise ValueError(f"cell {cell_mm} mm or ray {max_ray_mm} mm is out of range")
        self._cell, self._limit = cell_mm, max_ray_mm
        self._authors = 0
        key = hash_key(salt)
        top = np.concatenate([np.zeros(bricks.KEY, np.int64), key])
        top[bricks.FREE_BRICK : bricks.FREE_WIDE + 1] = -1
        small = np.zeros((16, 64), np.int8)
        self._bricks = bricks.Bricks(
            top=top,
            buckets=np.full(64, -1, np.int32),
            brick=np.zeros((0, 5), np.int32),
            entry=np.zeros((0, 18), np.int32),
            small=small,
            word=small.view(np.int32),
            wide=np.zeros((0, 64), np.int32),
        )
        self._marks = _marks(64, 1024, np.concatenate([np.zeros(rays.KEY, np.int64), key]))

    def __getstate__(self) -> dict[str, object]:
        """For a checkpoint: without the marks of a call, and without the second view of `small`."""
        bricks_ = self._bricks._replace(word=np.zeros((0, 0), np.int32))
        return vars(self) | {"_bricks": bricks_, "_marks": self._marks.top}

    def __setstate__(self, state: dict[str, Any]) -> None:
        held = state["_bricks"]
        restored = {
            "_bricks": held._replace(word=held.small.view(np.int32)),
            "_marks": _marks(64, 1024, state["_marks"]),
        }
        vars(self).update(state | restored)

    def __len__(self) -> int:
        return int(self._bricks.top[bricks.LIVE])

    @property
    def authors(self) -> int:
        """A: one more than the highest author index that has walked."""
        return self._authors

    @property
    def nbytes(self) -> int:
        """Memory of the evidence; the marks of a call come on top, see `marks_nbytes`."""
        return sum(array.nbytes for array in self._bricks) - self._bricks.word.nbytes

    @property
    def marks_nbytes(self) -> int:
        """Memory for the marks of one call, as large as the largest call so far needed."""
        return sum(array.nbytes for array in self._marks) - self._marks.word.nbytes

    def walk(
        self,
        author: int,
        origins: Int32s,
        starts: Int64s,
        xyz: Int32s,
        alive: Bools,
        sign: int,
    ) -> None:
        """Add `sign` (+1, -1) where the rays of one transaction passed and where they ended.

        origins: (s, 3) mm, positions of the sensor; segment k of the points, starts[k] to
        starts[k + 1] (s + 1,), was seen from origins[k]. xyz: (n, 3) mm, alive: (n,); all in the
        fleet frame. A ray longer than max_ray_mm is cut there. -1 takes an earlier +1 back.
        """
        if not alive.any():
            return
        self._authors = max(self._authors, author + 1)
        origins, starts, xyz = plain(origins), plain(starts), plain(xyz)
        alive, at = plain(alive), np.zeros(2, np.int64)
        while True:
            lacking = bricks.walk(
                self._bricks,
                self._marks,
                self._cell,
                self._limit,
                author,
                origins,
                starts,
                xyz,
                alive,
                sign,
                at,
            )
            if lacking == bricks.DONE:
                return
            self._grow(lacking)

    def evidence(self, xyz: Int32s) -> tuple[Int32s, Int32s]:
        """Passes and ends, each (N, A), in the cell of each position (N, 3) mm."""
        shape = (len(xyz), self._authors)
        passes, ends = np.zeros(shape, np.int32), np.zeros(shape, np.int32)
        bricks.read(self._bricks, self._cell, plain(xyz), passes, ends)
        return passes, ends

    def judge(
        self, say: Int64s, seed: Int32s, origin: Int32s, first: Int32s, entries: Int32s
    ) -> tuple[Int32s, Bools]:
        """(N, 7) hits, witnesses, against, distance, passed, ended and hidden of nodes, without
        arrays of (N, A), and (E,) which entries are denied; see `kernels.judging.judge`."""
        out, denied = np.zeros((len(seed), 7), np.int32), np.zeros(len(entries), np.bool_)
        part, touched = np.zeros((self._authors, 4), np.int32), np.zeros(self._authors, np.int32)
        solid = np.zeros((int(self._bricks.top[bricks.BRICKS]), 64), np.uint8)
        judging.judge(
            self._bricks,
            self._cell,
            self._limit,
            say,
            seed,
            origin,
            first,
            entries,
            part,
            touched,
            solid,
            out,
            denied,
        )
        return out, denied

    def _grow(self, lacking: int) -> None:
        """Make the room that a walk lacks."""
        if lacking == bricks.LISTING:
            steps = 3 * (self._limit // self._cell + 2)  # of the longest ray
            rows, cells = len(self._marks.row) + steps // 8 + 4, len(self._marks.cell) + steps + 2
            self._marks = _marks(rows, cells, self._marks.top)
        elif lacking == bricks.FINDING:
            self._grow_bricks()
        else:
            held, top = self._bricks, self._bricks.top
            small = with_room(held.small, 2 * int(top[bricks.SMALL]) + 1)
            wide = with_room(held.wide, int(top[bricks.WIDE]) + 1)
            self._bricks = held._replace(small=small, word=small.view(np.int32), wide=wide)

    def _grow_bricks(self) -> None:
        """Make room for a brick and an entry for each row of the marks."""
        held, rows = self._bricks, int(self._marks.top[rays.ROWS])
        held = held._replace(
            brick=with_room(held.brick, int(held.top[bricks.BRICKS]) + rows),
            entry=with_room(held.entry, int(held.top[bricks.ENTRIES]) + rows),
        )
        if len(held.buckets) < len(held.brick):
            buckets = 1 << (len(held.brick) - 1).bit_length()
            held = held._replace(buckets=np.full(buckets, -1, np.int32))
            bricks.rebuild(held)
        self._bricks = held


def _marks(rows: int, cells: int, top: Int64s) -> rays.Marks:
    """Room for half as many rows and cells again; nothing is marked."""
    rows, cells = rows + rows // 2, cells + cells // 2
    bits = np.zeros(64 * rows, np.uint8)
    return rays.Marks(
        top=top,
        table=np.zeros(1 << (2 * rows).bit_length(), np.int32),
        row=np.zeros((rows, 12), np.int32),
        bits=bits,
        word=bits.view(np.int64),
        cell=np.zeros(cells, np.int64),
        block=np.zeros((rows, 8), np.int32),
    )
