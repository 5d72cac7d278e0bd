"""`decode_payload`: the records behind signature and work. What is read encodes and reads again."""

from __future__ import annotations

from collections.abc import Iterable
from random import Random

from dagmap.payload import decode_payload, encode_payload, first_certificate
from dagmap.text import printable
from dagmap.wire import Refusal
from grammar import Flip
from targets import Target
from targets._wire import CONFIG, PAYLOAD, change, payloads


def run(data: bytes) -> bool:
    first = _first(data)
    try:
        found = decode_payload(data, CONFIG.graph.n_p)
    except Refusal:
        return False
    assert first in (None, found.certificate), "the certificate that was looked for is another"
    assert found.robot is None or printable(found.robot)
    once = encode_payload(found)
    again = encode_payload(decode_payload(once, CONFIG.graph.n_p))
    assert once == again and len(once) <= len(data), "encoding does not give what was read"
    return True


def _first(data: bytes) -> bytes | None:
    try:
        return first_certificate(data)
    except Refusal:
        return None


def mutate(data: bytes, rng: Random, flip: Flip) -> bytes:
    if rng.random() < 0.8:
        return flip(data)
    return change(data, PAYLOAD, rng, flip)


def seeds() -> Iterable[bytes]:
    unknown = b"\x63\x05later"
    return [*map(encode_payload, payloads()), unknown, b"\x07\x40" + bytes(64)]


ENCODERS = ("encode_payload", "_encode_*", "Bundle.cores")
TARGET = Target(run, mutate, seeds, {"dagmap.payload": ENCODERS}, max_len=56_000)
