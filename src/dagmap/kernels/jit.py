"""One decorator for all kernels: compiled once, cached on disk where a directory is writable.

Trap: numba notices a change in a cached kernel's own file, not in a callee of another file. After
editing a helper that other files call, run `make clean-cache`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

KERNELS: list[Any] = []  # every kernel that has been imported, as numba's dispatchers


def kernel(function: F) -> F:
    """Compile for integers: no fastmath, no parallel reduction, no bounds surprises."""
    try:
        compiled = numba.njit(cache=True, nogil=True)(function)
    except RuntimeError:  # no directory for the cache is writable: compile anew in each process
        compiled = numba.njit(cache=False, nogil=True)(function)
    KERNELS.append(compiled)
    return cast(F, compiled)
