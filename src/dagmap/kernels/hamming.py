"""Nearest binary descriptors by Hamming distance, anywhere or only among points that lie near."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload

from ..model import Int32s, Int64s
from .jit import leaf

NONE = 1 << 20  # a distance that no two descriptors have


def count_bits(word: int) -> int:
    """How many of the 64 bits of a word are set."""
    return (int(word) & (1 << 64) - 1).bit_count()


@intrinsic  # type: ignore[untyped-decorator]
def _ctpop(_: Any, word: Any) -> Any:
    """The processor's own instruction, which numba has no name for."""

    def generate(_: Any, builder: ir.IRBuilder, __: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return types.int64(types.int64), generate


@overload(count_bits)  # type: ignore[untyped-decorator]
def _count_bits(word: Any) -> Any:
    def count(word: Any) -> Any:
        return _ctpop(word)

    return count


@leaf
def nearest(
    one: Int64s,
    other: Int64s,
    here: Int32s,
    there: Int32s,
    reach: int,
    best: Int64s,
    first: Int64s,
    second: Int64s,
    back: Int64s,
) -> None:
    """For descriptors (N, 4) of the one: the nearest of the other (M, 4), the first on a tie.

    best: (N,) its row, -1 where there is none; first, second: (N,) distance of the nearest and of
    the next; back: (M,) the nearest row of the one. here, there: (N, 3), (M, 3) mm: only points
    within `reach` mm of each other are compared; a negative one compares all.
    """
    closest = 2 * NONE
    for i in range(one.shape[0]):
        best[i], first[i], second[i] = -1, NONE, NONE
    for j in range(other.shape[0]):
        back[j], closest = -1, NONE
        for i in range(one.shape[0]):
            if reach >= 0:
                x = int(here[i, 0]) - int(there[j, 0])
                y = int(here[i, 1]) - int(there[j, 1])
                z = int(here[i, 2]) - int(there[j, 2])
                if x * x + y * y + z * z > reach * reach:
                    continue
            d = count_bits(one[i, 0] ^ other[j, 0]) + count_bits(one[i, 1] ^ other[j, 1])
            d += count_bits(one[i, 2] ^ other[j, 2]) + count_bits(one[i, 3] ^ other[j, 3])
            if d < closest:
                closest, back[j] = d, i
            if d < first[i]:
                second[i] = first[i]
                first[i], best[i] = d, j
            elif d < second[i]:
                second[i] = d
