"""The decorator for functions that only kernels call.

They are inlined whole and do not count references to the arrays that pass through them, which
they may therefore neither make nor slice: counting is half the time of a small function. Nor do
they get wrappers for calls from Python: making those is a third of the time to compile one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

_OPTIONS = {
    "nogil": True,
    "forceinline": True,
    "_nrt": False,
    "error_model": "numpy",  # no test for division by zero
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}


def inner(function: F) -> F:
    """Compile into every kernel that calls it. Not cached by itself; its callers are."""
    return cast(F, numba.njit(**_OPTIONS)(function))
