"""`transaction.parse` in a closed fleet: certificates, revocations, and the order of the checks."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from random import Random
from typing import Any
from unittest.mock import patch

from dagmap import transaction
from dagmap.model import Reason
from dagmap.payload import Payload, Revocation
from dagmap.transaction import id_of, seal
from dagmap.wire import Refusal
from grammar import Flip
from targets import Target
from targets._wire import AUTHORITY, CLOSED, ROBOTS, TRANSACTION, change, payloads
from targets.envelope import ENCODERS, check

_ORDER = (  # the cheap checks first, none twice
    "_work_holds",
    "first_certificate",
    "certificate_holds",
    "signature_holds",
    "decode_payload",
)
_LAST = {  # after what refuses a transaction, nothing of it is looked at
    Reason.CERTIFICATE: ("first_certificate", "certificate_holds"),
    Reason.PROOF_OF_WORK: ("_work_holds",),
    Reason.SIGNATURE: ("signature_holds",),
    Reason.STRUCTURE: ("decode_payload",),
}


def run(data: bytes) -> bool:
    calls: list[str] = []
    refusal = None
    with patch.multiple(transaction, **{name: _noted(name, calls) for name in _ORDER}):
        try:
            check(data, CLOSED)
        except Refusal as error:
            refusal = error
    if refusal is None:
        assert calls.pop() == "decode_payload"  # `check` decodes it again
    assert calls == [name for name in _ORDER if name in calls], "checks out of order"
    if refusal is not None and refusal.reason in _LAST:
        assert calls[-1] in _LAST[refusal.reason], f"{calls} for {refusal.reason.name}"
    return refusal is None


def _noted(name: str, calls: list[str]) -> Callable[..., Any]:
    real = getattr(transaction, name)

    def call(*arguments: Any) -> Any:
        calls.append(name)
        return real(*arguments)

    return call


def mutate(data: bytes, rng: Random, flip: Flip) -> bytes:
    return change(data, TRANSACTION, rng, flip, CLOSED)


def seeds() -> Iterable[bytes]:
    first, second, third = ROBOTS
    certified = [replace(sample, name=None, certificate=first.certificate) for sample in payloads()]
    out = [seal(first, CLOSED, 0, None, 1, (), sample) for sample in certified]
    yield from out
    previous, others = id_of(out[0]), (id_of(out[1]), id_of(out[2]))
    for sample in payloads()[:4]:
        yield seal(first, CLOSED, 1, previous, 77, others, sample)
    yield seal(second, CLOSED, 0, None, 1, (), Payload(certificate=first.certificate))
    yield seal(second, CLOSED, 0, None, 1, (), Payload(name="none"))
    yield seal(second, CLOSED, 1, previous, 2, (), Payload(certificate=second.certificate))
    both = Payload(name="profile", certificate=second.certificate)
    yield seal(second, CLOSED, 0, None, 1, (), both)
    gone = (Revocation(third.author, 1 << 40), Revocation(second.author, 3))
    yield seal(AUTHORITY, CLOSED, 0, None, 1, (), Payload(revocations=gone))
    yield seal(AUTHORITY, CLOSED, 4, previous, 5, (), Payload(revocations=gone[:1]))
    yield seal(AUTHORITY, CLOSED, 0, None, 1, (), Payload(name="fleet", revocations=gone))
    yield seal(AUTHORITY, CLOSED, 0, None, 1, (), Payload())
    itself = (Revocation(AUTHORITY.author, 0),)
    yield seal(AUTHORITY, CLOSED, 0, None, 1, (), Payload(revocations=itself))
    yield seal(first, CLOSED, 1, previous, 2, (), Payload(revocations=gone))


TARGET = Target(
    run,
    mutate,
    seeds,
    {"dagmap.transaction": ENCODERS},
    max_len=57_000,
    generated=(bytes(transaction.MAX_SIZE + 1),),
)
