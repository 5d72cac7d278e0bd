"""The three decorators for kernels: `kernel`, `leaf` and `inner`. Integers only, no fastmath.

Compiled once, cached on disk where a directory is writable. Trap: numba notices a change in a
cached kernel's own file, not in a callee of another file. After editing a helper that other files
call, run `make clean-cache`: a stale cache can crash the process.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

KERNELS: list[Any] = []  # every cached kernel that has been imported, as numba's dispatchers
_UNCOUNTED = {"nogil": True, "_nrt": False}
_INLINED = {
    **_UNCOUNTED,
    "forceinline": True,
    "error_model": "numpy",  # no test for division by zero
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}


def kernel(function: F) -> F:
    """A function that Python calls."""
    return _cached(function, nogil=True)


def leaf(function: F) -> F:
    """A function that only reads and writes the arrays it is given: no reference counting.

    Functions that hand arrays to each other some twenty times a feature otherwise spend two thirds
    of their time on atomic counts (measured on the codec: 0.44 against 1.5 M features/s).
    """
    return _cached(function, **_UNCOUNTED)


def inner(function: F) -> F:
    """A function that only kernels call: inlined whole, nothing counted, no wrappers for Python.

    It may neither make nor slice arrays. Not cached by itself; its callers are.
    """
    return cast(F, numba.njit(**_INLINED)(function))


def _cached(function: F, **options: bool) -> F:
    try:
        compiled = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no directory for the cache is writable: compile anew in each process
        compiled = numba.njit(cache=False, **options)(function)
    KERNELS.append(compiled)
    return cast(F, compiled)
