"""Columns that grow by doubling."""

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
