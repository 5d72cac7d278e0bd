"""What the ids that a SLAM gives to its points stand for."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .kernels import idtable
from .model import Int64s

UNKNOWN = idtable.EMPTY  # of an id that names nothing


class Naming:
    """A number for each id of a session. No answer depends on the salt.

    A dict of Python does the same; but 100,000 look-ups in one cost a robot's cycle 50 ms.
    """

    def __init__(self, salt: int = 0) -> None:
        self._salt = salt & ((1 << 62) - 1)
        self._count = 0
        self._keys, self._values = _empty(64)

    def __len__(self) -> int:
        return self._count

    def get(self, ids: npt.NDArray[np.uint64]) -> Int64s:
        """(N,) what each id names, or UNKNOWN."""
        out = np.empty(len(ids), np.int64)
        idtable.get(self._keys, self._values, self._salt, _signed(ids), out)
        return out

    def put(self, ids: npt.NDArray[np.uint64], numbers: Int64s) -> None:
        """From now on each id names its number; of equal ids the last counts."""
        while 2 * (self._count + len(ids)) > len(self._keys):
            self._resize(2 * len(self._keys))
        self._count += idtable.put(self._keys, self._values, self._salt, _signed(ids), numbers)

    def take(self, ids: npt.NDArray[np.uint64]) -> Int64s:
        """(N,) what each id named, or UNKNOWN; from now on they name nothing."""
        out = np.empty(len(ids), np.int64)
        self._count -= idtable.take(self._keys, self._values, self._salt, _signed(ids), out)
        return out

    def _resize(self, slots: int) -> None:
        used = self._values != idtable.EMPTY
        keys, values = self._keys[used], self._values[used]
        self._keys, self._values = _empty(slots)
        idtable.put(self._keys, self._values, self._salt, keys, values)


def _empty(slots: int) -> tuple[Int64s, Int64s]:
    return np.zeros(slots, np.int64), np.full(slots, idtable.EMPTY, np.int64)


def _signed(ids: npt.NDArray[np.uint64]) -> Int64s:
    return np.ascontiguousarray(ids, np.uint64).view(np.int64)
