"""A hash table from ids to numbers: open addressing, linear probing, at most half full."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np

from ..model import Int64s
from .jit import inner, leaf

EMPTY = -(1 << 62)  # value of a slot that nothing is in
_MASK = (1 << 31) - 1
_K1, _K2 = 0x5BD1E995, 0x6C8E9CF5
_wide = cast(Callable[[Any], int], np.int64)


@inner
def _home(key: int, salt: int, mask: int) -> int:
    """The slot in which a key would like to be."""
    h = ((key ^ salt) & _MASK) * _K1
    h = ((key >> 31 ^ salt >> 31 ^ h >> 31 ^ h) & _MASK) * _K2
    return (h >> 31 ^ h ^ key >> 62) & mask


@inner
def _slot(keys: Int64s, values: Int64s, salt: int, key: int) -> int:
    """Where a key is, or the empty slot where it would be."""
    mask = keys.shape[0] - 1
    slot = _home(key, salt, mask)
    while values[slot] != EMPTY and keys[slot] != key:
        slot = (slot + 1) & mask
    return slot


@leaf
def get(keys: Int64s, values: Int64s, salt: int, wanted: Int64s, out: Int64s) -> None:
    """Values of `wanted` (N,) into `out`, EMPTY where there is none."""
    for i in range(wanted.shape[0]):
        out[i] = values[_slot(keys, values, salt, _wide(wanted[i]))]


@leaf
def put(keys: Int64s, values: Int64s, salt: int, new: Int64s, what: Int64s) -> int:
    """Enter keys with their values, the last of equal ones; half of the slots must stay empty.

    Returns how many keys are new.
    """
    count = 0
    for i in range(new.shape[0]):
        slot = _slot(keys, values, salt, _wide(new[i]))
        count += values[slot] == EMPTY
        keys[slot] = new[i]
        values[slot] = what[i]
    return count


@leaf
def take(keys: Int64s, values: Int64s, salt: int, gone: Int64s, out: Int64s) -> int:
    """Take keys out, their values into `out`; what was pushed past them moves up.

    Returns how many were there.
    """
    count, mask = 0, keys.shape[0] - 1
    for i in range(gone.shape[0]):
        hole = _slot(keys, values, salt, _wide(gone[i]))
        out[i] = values[hole]
        if values[hole] == EMPTY:
            continue
        count += 1
        at = (hole + 1) & mask
        while values[at] != EMPTY:
            behind = (at - _home(_wide(keys[at]), salt, mask)) & mask
            if behind >= (at - hole) & mask:
                keys[hole] = keys[at]
                values[hole] = values[at]
                hole = at
            at = (at + 1) & mask
        values[hole] = EMPTY
    return count
