"""Ray evidence: in how many transactions of each author a ray crossed a cell, or a point ended there.

Sums commute, so this stays outside the fold's undo: what is withdrawn or moved walks again with -1.
"""

from __future__ import annotations

import hashlib
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from .kernels import rays
from .model import Bools, Int32s, Int64s, Uint8s

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
    """The array itself or a copy that is contiguous and writable: the one form kernels compile for."""
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
        top = np.zeros(rays.KEY + 4, np.int64)
        top[rays.FREE_BRICK : rays.FREE_WIDE + 1] = -1
        top[rays.KEY :] = hash_key(salt)
        small = np.zeros((0, 64), np.int8)
        self._bricks = rays.Bricks(
            top=top,
            buckets=np.full(64, -1, np.int32),
            brick=np.zeros((0, 6), np.int32),
            entry=np.zeros((0, 18), np.int32),
            small=small,
            word=small.view(np.int32),
            wide=np.zeros((0, 64), np.int32),
        )
        self._marks = _marks(np.zeros((0, 9), np.int32), np.zeros(0, np.uint8), np.zeros(0, np.int64))

    def __len__(self) -> int:
        return int(self._bricks.top[rays.LIVE])

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
        alive, last, done = plain(alive), np.full(len(xyz), -1, np.int64), 0
        self._bricks.top[[rays.ROWS, rays.CELLS]] = 0
        while (done := self._mark(origins, starts, xyz, alive, last, done)) < 2 * len(xyz):
            self._grow_bricks()
        self._commit(author, sign)

    def evidence(self, xyz: Int32s) -> tuple[Int32s, Int32s]:
        """Passes and ends, each (N, A), in the cell of each position (N, 3) mm."""
        shape = (len(xyz), self._authors)
        passes, ends = np.zeros(shape, np.int32), np.zeros(shape, np.int32)
        rays.read(self._bricks, self._cell, plain(xyz), passes, ends)
        return passes, ends

    def judge(
        self, say: tuple[int, int], seed: Int32s, first: Int32s, entries: Int32s
    ) -> tuple[Int32s, Int32s, Int32s]:
        """Hits, misses and witnesses (N,) of nodes, without arrays of (N, A); see `fold`."""
        hits, misses, witnesses = (np.zeros(len(seed), np.int32) for _ in range(3))
        rays.judge(
            self._bricks,
            self._cell,
            say[0],
            say[1],
            seed,
            first,
            entries,
            hits,
            misses,
            witnesses,
        )
        return hits, misses, witnesses

    def _mark(
        self, origins: Int32s, starts: Int64s, xyz: Int32s, alive: Bools, last: Int64s, begin: int
    ) -> int:
        held, marks, cell, limit = self._bricks, self._marks, self._cell, self._limit
        return rays.mark_all(held, marks, cell, limit, origins, starts, xyz, alive, last, begin)

    def _commit(self, author: int, sign: int) -> None:
        top, done = self._bricks.top, 0
        while not rays.find_entries(self._bricks, self._marks, author):
            entry = with_room(self._bricks.entry, int(top[rays.ENTRIES]) + 1)
            self._bricks = self._bricks._replace(entry=entry)
        while (done := rays.add_cells(self._bricks, self._marks, sign, done)) < top[rays.CELLS]:
            small = with_room(self._bricks.small, 2 * int(top[rays.SMALL]) + 1)
            wide = with_room(self._bricks.wide, int(top[rays.WIDE]) + 1)
            word = small.view(np.int32)
            self._bricks = self._bricks._replace(small=small, word=word, wide=wide)
        if self._marks.row[: top[rays.ROWS], rays.ZERO].any():
            rays.free_zeros(self._bricks, self._marks)

    def _grow_bricks(self) -> None:
        """Make room for what the longest ray marks."""
        held, top = self._bricks, self._bricks.top
        steps = 3 * (self._limit // self._cell + 2)
        rows = steps // 8 + 4
        self._marks = _marks(
            with_room(self._marks.row, int(top[rays.ROWS]) + rows),
            self._marks.bits,
            with_room(self._marks.cell, int(top[rays.CELLS]) + steps + 2),
        )
        held = held._replace(brick=with_room(held.brick, int(top[rays.BRICKS]) + rows))
        if len(held.buckets) < len(held.brick):
            buckets = 1 << (len(held.brick) - 1).bit_length()
            held = held._replace(buckets=np.full(buckets, -1, np.int32))
            rays.rebuild(held)
        self._bricks = held


def _marks(row: Int32s, bits: Uint8s, cell: Int64s) -> rays.Marks:
    """As many bits as the rows need, with those that there are; `word` views their memory."""
    if len(bits) < 128 * len(row):
        bits = with_room(bits, 128 * len(row))
    bits = bits[: len(bits) // 128 * 128]
    return rays.Marks(row, bits, bits.view(np.int64), cell)
