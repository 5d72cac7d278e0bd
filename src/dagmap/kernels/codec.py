"""The columns of a bundle as bytes, by an adaptive binary range coder.

Format of n > 0 features (n = 0 is no bytes at all), feature by feature:

1. each parent: where it is (none; in this bundle; before it; or a further parent that is one of
   the first parent's own, where that is in this bundle; context: where the slot before is, for the
   first slot the first slot of the feature before), then the distance back to it (context: first
   slot or later), or the step from the last parent before the bundle (at first from `base`), or
   which of the first parent's it is, the first that it equals;
2. x, y, z as the difference to a neighbour: the first parent that lies in the same segment of this
   bundle, else the feature before in the segment, else zero; context: the bit length of the axis
   before;
3. where the segment is coloured: G, B - G, R - G as differences to that neighbour's, modulo 256
   from -128 to 127; context: the bit length of the channel before, for G the largest of the
   position's (an equal position is mostly the same pixel again).

A number is its bit length by adaptive models, then its sign (distances have none) and the bits
under the leading one, plain. Models start afresh in each bundle and learn fast.

The coder keeps 32 bits of low and range, as in LZMA, and moves a byte when the range is under 2^24.
It ends by writing all four bytes of low. So the decoder, which reads four bytes ahead, reads
exactly the bytes of a valid code and ends at difference zero: no valid code is the beginning of
another, and a decode is `ok` only for the very bytes that encoding its result gives.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..model import Int32s, Int64s, Uint8s
from .morton import morton_order
from .rangecoder import AT, DECODING, FAILED, FRESH, MAX_SLOTS, MODELS, STATE, walk

__all__ = ["decode_features", "encode_features", "morton_order"]

_MAX_NUMBER = 1 << 62  # issue numbers stay below, so that no distance leaves int64


class _Columns(NamedTuple):
    position: Int32s
    parents: Int64s
    color: Uint8s
    starts: Int64s
    colored: Uint8s


def _run(data: Uint8s, columns: _Columns, base: int, decoding: bool) -> tuple[int, bool]:
    """Walk; returns how many bytes were written or read, and whether all went well."""
    state = np.zeros(STATE, np.int64)
    state[DECODING] = decoding
    walk(state, np.full(MODELS, FRESH, np.int32), data, *columns, base)
    return int(state[AT]), not int(state[FAILED])


def encode_features(
    position: Int32s, parents: Int64s, base: int, starts: Int64s, color: Uint8s, colored: Uint8s
) -> Uint8s:
    """The columns of n features in issue order as bytes; feature i has issue number `base + i`.

    position: (n, 3) mm within +-2^29, in the frame of the anchor that the segment belongs to.
    parents: (n, P) issue numbers of the author, each in [0, base + i), or -1 for none; P <= 8.
    starts: (s + 1,) where each segment starts; the first is 0, the last n, none decreases.
    color: (n, 3) uint8, kept where `colored` (s,) of the segment is not zero.

    Raises ValueError where the columns break these bounds.
    """
    columns = _Columns(
        np.array(position, np.int32, order="C"),  # copies: the walk writes back what it codes
        np.array(parents, np.int64, order="C"),
        np.array(color, np.uint8, order="C"),
        np.array(starts, np.int64, order="C"),
        np.array(colored, np.uint8, order="C"),
    )
    n, slots = len(columns.position), columns.parents.shape[-1]
    shaped = columns.position.shape == columns.color.shape == (n, 3)
    if not shaped or columns.parents.shape != (n, slots) or slots > MAX_SLOTS:
        raise ValueError(f"codec: position, color must be (n, 3), parents (n, P <= {MAX_SLOTS})")
    if not _possible(n, base, columns.starts, columns.colored):
        raise ValueError(f"codec: base {base}, starts or colored do not suit {n} features")
    if n == 0:
        return np.zeros(0, np.uint8)
    # At worst 17 bits for a modelled bit (no chance is under 2^-16), and 1 for a plain one.
    data = np.empty(n * (34 * slots + 140) + 8, np.uint8)
    size, ok = _run(data, columns, base, False)
    if not ok:
        raise ValueError("codec: a position beyond +-2^29 mm, or a parent not before its child")
    return data[:size].copy()


def decode_features(
    data: Uint8s, n: int, slots: int, base: int, starts: Int64s, colored: Uint8s
) -> tuple[Int32s, Int64s, Uint8s, int, bool]:
    """Undo `encode_features`: (position, parents, color, bytes read, ok). Safe for any bytes.

    `slots` is P. `ok` is False, and the rest is meaningless, where a position leaves +-2^29, a
    parent lies before issue number 0, `data` is not exactly one code, or the numbers and segments
    given are not possible. Colours are 0 where the segment has none. Work and memory are bounded by
    n, which the caller bounds.
    """
    possible = 0 <= slots <= MAX_SLOTS and _possible(n, base, starts, colored)
    if not possible:
        n, slots = 0, 0
    columns = _Columns(
        np.zeros((n, 3), np.int32),
        np.full((n, slots), -1, np.int64),
        np.zeros((n, 3), np.uint8),
        np.array(starts, np.int64, order="C"),
        np.array(colored, np.uint8, order="C"),
    )
    consumed, ok = 0, possible and len(data) == 0
    if n > 0:
        consumed, ok = _run(np.array(data, np.uint8, order="C"), columns, base, True)
    return columns.position, columns.parents, columns.color, consumed, ok


def _possible(n: int, base: int, starts: Int64s, colored: Uint8s) -> bool:
    """Whether issue numbers stay in range, and the segments divide n features."""
    if n < 0 or not 0 <= base <= _MAX_NUMBER - n or len(colored) != len(starts) - 1:
        return False
    ends = int(starts[0]) == 0 and int(starts[-1]) == n
    return ends and bool((starts[1:] >= starts[:-1]).all())
