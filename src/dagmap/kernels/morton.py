"""The order in which neighbours in space come near each other in the list."""

from __future__ import annotations

import numpy as np

from ..model import Int32s, Int64s
from .jit import leaf


@leaf
def _spread(value: int) -> int:
    """20 bits to every third bit."""
    value = (value | (value << 32)) & 0x1F00000000FFFF
    value = (value | (value << 16)) & 0x1F0000FF0000FF
    value = (value | (value << 8)) & 0x100F00F00F00F00F
    value = (value | (value << 4)) & 0x10C30C30C30C30C3
    return (value | (value << 2)) & 0x1249249249249249


@leaf
def _morton_keys(points: Int32s, keys: Int64s, blocks: Int64s) -> bool:
    """Keys within blocks of 2^20 mm, and the blocks; True where all lie in one block."""
    one = True
    for i in range(points.shape[0]):
        key = 0
        for axis in range(3):
            shifted = int(points[i, axis]) + (1 << 19)
            key |= _spread(shifted & 0xFFFFF) << (2 - axis)
            blocks[axis, i] = shifted >> 20
            one = one and int(blocks[axis, i]) == int(blocks[axis, 0])
        keys[i] = key
    return one


def morton_order(points: Int32s) -> Int64s:
    """(N,) stable permutation that sorts (N, 3) mm within +-2^29 along a Z curve.

    Blocks of 2^20 mm, centred on the origin, come in order of (x, y, z); within a block the 60-bit
    Morton code counts, x highest. Equal points keep their order.
    """
    n = len(points)
    keys, blocks = np.empty(n, np.int64), np.empty((3, n), np.int64)
    if _morton_keys(np.array(points, np.int32, order="C"), keys, blocks):
        return np.argsort(keys, kind="stable")
    return np.lexsort((keys, blocks[2], blocks[1], blocks[0]))
