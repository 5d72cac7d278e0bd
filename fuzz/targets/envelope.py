"""`transaction.parse`: signed by robots of the fuzzing's fleet, so that the payload is reached."""

from __future__ import annotations

from collections.abc import Iterable
from random import Random

from dagmap.config import Config
from dagmap.payload import Payload
from dagmap.transaction import MAX_SIZE, glance, id_of, parse, seal
from dagmap.wire import Refusal
from grammar import Flip
from targets import Target
from targets._wire import CONFIG, ROBOTS, TRANSACTION, change, payloads


def run(data: bytes) -> bool:
    try:
        check(data, CONFIG)
    except Refusal:
        return False
    return True


def check(data: bytes, config: Config) -> None:
    """Judge a transaction. Raises Refusal."""
    found = parse(data, config)
    assert glance(data) == (found.author, found.previous)
    assert found.data == data and found.id == id_of(data) and len(data) <= MAX_SIZE
    assert found.decode_again(config).features == found.features


def mutate(data: bytes, rng: Random, flip: Flip) -> bytes:
    return change(data, TRANSACTION, rng, flip)


def seeds() -> Iterable[bytes]:
    first, second, _ = ROBOTS
    out = [seal(first, CONFIG, 0, None, 1, (), sample) for sample in payloads()]
    references = (id_of(out[0]), id_of(out[1]))
    return [*out, seal(second, CONFIG, 9, id_of(out[2]), 77, references, Payload())]


ENCODERS = ("seal", "_work", "Transaction.*")
TARGET = Target(
    run,
    mutate,
    seeds,
    {"dagmap.transaction": ENCODERS},
    max_len=57_000,
    generated=(bytes(MAX_SIZE + 1),),
)
