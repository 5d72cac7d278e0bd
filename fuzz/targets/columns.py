"""The range coder's decoder, as plain Python so that it is instrumented too.

What it takes, the encoder writes to the same bytes.
"""

from __future__ import annotations

from collections.abc import Iterable
from random import Random
from unittest.mock import patch

import numpy as np

from dagmap import wire
from dagmap.kernels import rangecoder
from dagmap.kernels.codec import decode_features, encode_features
from dagmap.payload import MAX_NUMBER, Bundle
from dagmap.wire import Reader, Refusal
from grammar import Flip, counted, number, record, rest
from targets import Target
from targets._wire import bundle, change

_MOST = 16  # features and segments: in plain Python a feature takes a millisecond
_COLUMNS = record(number, number, number, counted(record(number, number)), rest)


def run(data: bytes) -> bool:
    reader = Reader(data)
    try:  # as `payload._decode_bundle` reads them, and beyond what it lets through
        slots, base, n = reader.number(9), reader.number(MAX_NUMBER << 23), reader.number(_MOST)
        rows = [(reader.number(_MOST), reader.number(1)) for _ in range(reader.number(_MOST))]
    except Refusal:
        return False
    starts = np.array([0, *(start for start, _ in rows)], np.int64)
    colored = np.array([color for _, color in rows], np.uint8)
    code = np.frombuffer(reader.take(reader.left), np.uint8)
    position, parents, color, used, ok = decode_features(code, n, slots, base, starts, colored)
    if ok:
        again = encode_features(position, parents, base, starts, color, colored)
        assert again.tobytes() == code.tobytes() and used == len(code), "two codes for one bundle"
    return ok


def mutate(data: bytes, rng: Random, flip: Flip) -> bytes:
    """The frame around the code changes, or the columns do and are encoded anew."""
    if rng.random() < 0.6:
        return change(data, _COLUMNS, rng, flip)
    slots, base = rng.choice((0, 1, 2, 2, 3, 5, 8)), rng.choice((0, 40, MAX_NUMBER))
    count, segments = rng.randrange(1, 9), rng.randrange(1, 4)
    return written(bundle(rng, max(count, segments), segments, base, max(slots, 2)), slots)


def written(columns: Bundle, slots: int) -> bytes:
    """The bytes that `run` takes for these columns, of which `slots` parents are kept."""
    rows = list(zip(columns.starts[1:].tolist(), columns.colored.tolist(), strict=True))
    parents = columns.parents[:, :slots]
    code = encode_features(
        columns.position, parents, columns.base, columns.starts, columns.color, columns.colored
    )
    head = [
        slots,
        columns.base,
        len(columns.position),
        len(rows),
        *(v for row in rows for v in row),
    ]
    return b"".join(map(wire.number, head)) + code.tobytes()


def seeds() -> Iterable[bytes]:
    for seed in range(24):
        slots = (2, 2, 3, 8, 1, 0)[seed % 6]
        base = (0, 40, MAX_NUMBER)[seed % 3]
        yield written(bundle(Random(seed), 3 + seed % 10, 1 + seed % 3, base, max(slots, 2)), slots)
    yield bytes((9, 0, 1, 1, 1, 0))  # nine parents
    yield _remainder()
    few = bundle(Random(0), 2, 1)
    few.parents[:] = [[5, -1], [few.base, 5]]
    with patch.object(rangecoder, "_shared", lambda *_: -1):  # has no effect on compiled kernels
        yield written(few, 2)


def _remainder() -> bytes:
    """A code in the remainder of a division, where no encoder goes: the decoder must say so."""
    state, models = (
        np.zeros(rangecoder.STATE, np.int64),
        np.full(rangecoder.MODELS, rangecoder.FRESH, np.int32),
    )
    data = np.zeros(32, np.uint8)
    rangecoder._begin(state, data)
    zeros = [(axis, 0) for _ in range(4) for axis in (2, 3, 4)]  # four points at zero
    for axis, length in [*zeros, (2, 14)]:  # then the next one's x
        state[rangecoder._LENGTH] = 0
        rangecoder._length(state, models, data, axis, length)
    state[0] += state[1] - 1  # low to the end of its interval
    rangecoder._end(state, data)
    head = (0, 0, 5, 1, 5, 0)  # no parents, base 0, five features in one segment without colour
    return bytes(head) + data[: state[rangecoder.AT]].tobytes()


PARSERS = {"dagmap.kernels.codec": ("encode_features",), "dagmap.kernels.rangecoder": ()}
TARGET = Target(run, mutate, seeds, PARSERS, max_len=1024, pure=True)
