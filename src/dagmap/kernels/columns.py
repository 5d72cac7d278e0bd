"""Columns that grow by doubling; sorted ones without repetitions."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

D = TypeVar("D", bound=np.generic)


def grown(column: npt.NDArray[D], rows: int, fill: Any) -> npt.NDArray[D]:
    """The column itself where it has enough rows, else a copy of at least twice the size."""
    if rows <= len(column):
        return column
    bigger = np.full((max(rows, 2 * len(column), 64), *column.shape[1:]), fill, column.dtype)
    bigger[: len(column)] = column
    return bigger


def distinct(values: npt.NDArray[D]) -> npt.NDArray[D]:
    """What `np.unique` gives of integers, which from numpy 2.3 on hashes and takes ten times as
    long for many."""
    ordered: npt.NDArray[D] = np.sort(values)
    fresh = np.ones(len(ordered), np.bool_)
    fresh[1:] = ordered[1:] != ordered[:-1]
    return ordered[fresh]
