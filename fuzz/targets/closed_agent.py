"""`Agent.receive` in a closed fleet: strangers, certificates that come late, revocations, and forks
of the fleet key, in order and backwards.
"""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

from dagmap.messages import Head, Heads, Transactions, Want
from dagmap.payload import Payload, Revocation
from dagmap.transaction import id_of, seal
from grammar import Flip
from targets import Target
from targets._wire import AUTHORITY, CLOSED, ROBOTS, change
from targets.agent import TALK, run_in, talk, walk


def run(data: bytes) -> bool:
    return run_in(CLOSED, data)


def mutate(data: bytes, rng: Random, flip: Flip) -> bytes:
    return change(data, TALK, rng, flip, CLOSED)


def seeds() -> Iterator[bytes]:
    first, second, third = ROBOTS
    chain = walk(CLOSED)
    yield _said(*chain)
    yield _said(*reversed(chain))  # no certificate seen yet
    yield _said(*chain[1:])
    joined = Payload(certificate=second.certificate)
    start = seal(second, CLOSED, 0, None, 3, (id_of(chain[1]),), joined)
    fork = [seal(second, CLOSED, 1, id_of(start), 4 + i, (), Payload()) for i in range(2)]
    gone = [_revoked(0, None, first.author, 1), _revoked(0, None, second.author, 1)]
    yield _said(start, *chain, *fork)
    yield _said(gone[0], *chain, start)
    yield _said(*chain, start, *gone)  # a fork of the fleet key takes both back
    later = _revoked(1, id_of(gone[0]), first.author, 0)
    yield _said(*chain, later, gone[0], start, fork[0])
    yield _said(_revoked(0, None, third.author, 0), *chain)  # who hears it is revoked itself
    tip = id_of(gone[0])[:8]
    heads = (Head(first.author, 4, id_of(chain[-1])[:8]), Head(AUTHORITY.author, 1, tip))
    yield talk(
        Transactions((chain[0], gone[1])),
        Heads(3, ((third.author, 1, 5),), (*heads, Head(second.author, 1, tip, 0))),
        Want(((AUTHORITY.author, 0, 9),), (id_of(gone[1]),), (second.author,)),
        config=CLOSED,
    )


def _revoked(sequence: int, previous: bytes | None, author: bytes, count: int) -> bytes:
    said = Payload(revocations=(Revocation(author, count),))
    return seal(AUTHORITY, CLOSED, sequence, previous, sequence + 1, (), said)


def _said(*data: bytes) -> bytes:
    return talk(*(Transactions((item,)) for item in data), config=CLOSED)


TARGET = Target(run, mutate, seeds, {}, max_len=16_384)
