"""`messages.parse`: what any stranger may send. Messages that are read encode to the same bytes."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from random import Random

from dagmap import messages
from dagmap.messages import MAX_MESSAGE, Head, Heads, Transactions, Want
from dagmap.wire import Refusal
from grammar import Flip, rest
from targets import Target
from targets._wire import CONFIG, ROBOTS, change, message

_MESSAGE = message(rest)


def run(data: bytes) -> bool:
    claimed = messages.kind_of(data), messages.sender_of(data)
    try:
        sender, found = messages.parse(data, CONFIG)
    except Refusal:
        return False
    assert claimed[0] is not None and claimed[1] == sender
    assert messages.encode(found, CONFIG, sender) == data, "two spellings of one message"
    return True


def mutate(data: bytes, rng: Random, flip: Flip) -> bytes:
    """Mostly bytes between the head and the checksum, which is made right again: that is fast."""
    if rng.random() < 0.03:
        return change(data, _MESSAGE, rng, flip)
    if rng.random() < 0.03:
        return flip(data)
    inner = data[:28] + flip(data[28:-4])
    return inner + zlib.crc32(inner).to_bytes(4, "little")


def seeds() -> Iterable[bytes]:
    me, other, third = (robot.author for robot in ROBOTS)
    samples = (
        Transactions(()),
        Transactions((b"one" * 35, bytes(300)), more=True),
        Transactions((b"short",)),
        Heads(0, (), ()),
        Heads(
            1 << 40,
            ((other, 3, 250_000), (third, 0, 0)),
            (Head(me, 5, b"tip tip "), Head(other, 0, bytes(8)), Head(third, 9, b"tip tip ", 4)),
        ),
        Want(),
        Want(((me, 0, 1), (me, 0, 2))),
        Want(((me, 0, 1), (other, 300, 70_000)), (bytes(32), b"i" * 32), (third,)),
    )
    return [messages.encode(sample, CONFIG, me) for sample in samples]


ENCODERS = ("encode", "_encode_body", "_encode_heads")
TARGET = Target(
    run,
    mutate,
    seeds,
    {"dagmap.messages": ENCODERS, "dagmap.wire": ("number", "signed")},
    max_len=61_000,
    generated=(bytes(MAX_MESSAGE + 1),),
)
