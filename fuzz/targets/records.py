"""`decode_payload`: the records behind signature and work. What is read encodes and reads again."""

from __future__ import annotations

from collections.abc import Iterable
from random import Random

from dagmap.payload import decode_payload, encode_payload
from dagmap.wire import Refusal
from grammar import Flip
from targets import Target
from targets._wire import CONFIG, PAYLOAD, change, payloads


def run(data: bytes) -> bool:
    try:
        found = decode_payload(data, CONFIG.graph.n_p)
    except Refusal:
        return False
    once = encode_payload(found)
    again = encode_payload(decode_payload(once, CONFIG.graph.n_p))
    assert once == again and len(once) <= len(data), "encoding does not give what was read"
    return True


def mutate(data: bytes, rng: Random, flip: Flip) -> bytes:
    if rng.random() < 0.8:
        return flip(data)
    return change(data, PAYLOAD, rng, flip)


def seeds() -> Iterable[bytes]:
    unknown = b"\x63\x05later"
    return [*map(encode_payload, payloads()), unknown]


ENCODERS = ("encode_payload", "_encode_*", "Bundle.cores")
TARGET = Target(run, mutate, seeds, {"dagmap.payload": ENCODERS}, max_len=56_000)
