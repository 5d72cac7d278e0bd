"""Section 4.2: the signed envelope. Its bytes, id, proof of work and signature; the only judge
of whether bytes are a valid transaction in themselves. What the set decides is ledger.py's.

    version 1 | public key 32 | sequence | previous id 32 (if sequence > 0) | Lamport time |
    count, references 32 each ascending | payload size, payload | nonce 4 | signature 64
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from . import wire
from .config import Config
from .identity import Identity, author_of, certificate_holds, signature_holds
from .model import AuthorId, Reason, TransactionId
from .payload import (
    MAX_SEQUENCE,
    Payload,
    decode_payload,
    encode_payload,
    first_certificate,
)
from .wire import Reader, Refusal

VERSION = 1
MAX_SIZE = 56_000  # bytes, so that a message that carries one stays under 60 KB
MIN_SIZE = 105  # one that says nothing
MAX_LAMPORT = (1 << 48) - 1
_START = 1 + 32  # bytes: version and public key
_END = 4 + 64  # bytes: nonce and signature
_SIGNED = b"dagmap transaction 1\0"
_WORKED = b"dagmap work 1\0"


@dataclass(slots=True, eq=False)
class Transaction:
    """A transaction that is valid in itself. `data` are the exact bytes, hashed and relayed."""

    id: TransactionId
    data: bytes
    author: AuthorId
    sequence: int
    previous: TransactionId | None
    lamport: int
    references: tuple[TransactionId, ...]
    features: int
    payload: Payload
    body: tuple[int, int]  # where the payload stands in `data`

    def __repr__(self) -> str:
        name = f"{self.id.hex()[:8]} of {self.author.hex()[:8]}"
        return f"Transaction({name}, number {self.sequence}, {self.features} features)"

    @property
    def key(self) -> tuple[int, AuthorId, int]:
        """The canonical order: (Lamport time, author, sequence)."""
        return (self.lamport, self.author, self.sequence)

    @property
    def refers_to(self) -> tuple[TransactionId, ...]:
        """Everything that must be known first."""
        return self.references if self.previous is None else (self.previous, *self.references)

    def drop_columns(self) -> None:
        """Forget the decoded features; the bytes still hold them."""
        if self.payload.bundle is not None:
            self.payload = replace(self.payload, bundle=None)

    def decode_again(self, config: Config) -> Payload:
        """The whole payload anew from the bytes."""
        return decode_payload(self.data[slice(*self.body)], config.graph.n_p)


def id_of(data: bytes) -> TransactionId:
    """The id of a transaction: the BLAKE2b-256 of its exact bytes."""
    return hashlib.blake2b(data, digest_size=32).digest()


def signed_part(data: bytes, config: Config) -> bytes:
    """What the signature at the end of a transaction's bytes covers."""
    return _SIGNED + config.fleet_id + data[:-64]


def seal(
    identity: Identity,
    config: Config,
    sequence: int,
    previous: TransactionId | None,
    lamport: int,
    references: tuple[TransactionId, ...],
    payload: Payload,
) -> bytes:
    """Encode, work and sign. Raises ValueError where the result would exceed MAX_SIZE."""
    body = encode_payload(payload)
    head = bytes([VERSION]) + identity.public_key + wire.number(sequence) + (previous or b"")
    refs = wire.number(len(references)) + b"".join(sorted(references))
    unworked = head + wire.number(lamport) + refs + wire.number(len(body)) + body
    if len(unworked) + 68 > MAX_SIZE:
        raise ValueError(f"a transaction of {len(unworked) + 68} bytes; at most {MAX_SIZE} fit")
    unsigned = unworked + _work(config, unworked)
    return unsigned + identity.sign(_SIGNED + config.fleet_id + unsigned)


def glance(data: bytes) -> tuple[AuthorId, TransactionId | None]:
    """Author and previous id (None: it is the first) that bytes claim; nothing of it is proven.

    Raises Refusal where they cannot be read.
    """
    reader = Reader(data)
    author = author_of(reader.take(_START)[1:])
    return author, reader.take(32) if reader.number(MAX_SEQUENCE) else None


def parse(data: bytes, config: Config) -> Transaction:
    """Judge foreign bytes. Raises Refusal; the cheap checks come first, the payload last."""
    worked(data, config)
    return parse_worked(data, config)


def worked(data: bytes, config: Config) -> TransactionId:
    """The id of foreign bytes that were worked for. It is judged first of all, without reading
    on: a flood that has not worked costs one hash of its bytes. Raises Refusal."""
    if not MIN_SIZE <= len(data) <= MAX_SIZE:
        reason = Reason.MALFORMED if len(data) > MAX_SIZE else Reason.TRUNCATED
        raise Refusal(reason, f"transaction of {len(data)} bytes")
    if data[0] != VERSION:
        raise Refusal(Reason.VERSION, f"transaction version {data[0]}")
    if not _work_holds(_work_seed(config, data[:-_END]), data[-_END:-64], config):
        raise Refusal(Reason.PROOF_OF_WORK, fault=author_of(data[1:_START]))
    return id_of(data)


def parse_worked(data: bytes, config: Config) -> Transaction:
    """Judge foreign bytes whose work holds. Raises Refusal."""
    reader = Reader(data)
    public_key = reader.take(_START)[1:]
    author = author_of(public_key)
    try:
        return _parse(reader, data, public_key, author, config)
    except Refusal as refusal:
        raise Refusal(refusal.reason, refusal.detail, author) from None


def _parse(
    reader: Reader, data: bytes, public_key: bytes, author: AuthorId, config: Config
) -> Transaction:
    """What follows the public key."""
    sequence = reader.number(MAX_SEQUENCE)
    previous = reader.take(32) if sequence else None
    lamport = reader.number(MAX_LAMPORT)
    count = reader.number(config.transaction.max_references)
    references = tuple(reader.take(32) for _ in range(count))
    if any(a >= b for a, b in pairwise(references)):
        raise Refusal(Reason.MALFORMED, "references are not ascending")
    size = reader.number(len(data))
    place = (reader.at, reader.at + size)
    body = reader.take(size)
    signature = reader.take(_END)[4:]
    reader.end()
    certified = sequence == 0 and config.closed and public_key != config.fleet_public_key
    certificate = first_certificate(body) if certified else None
    if certificate is not None and not certificate_holds(
        certificate, config.fleet_public_key, config.fleet_id, public_key
    ):
        raise Refusal(Reason.CERTIFICATE, "the fleet key has not signed it for this robot")
    if not signature_holds(public_key, signature, signed_part(data, config)):
        raise Refusal(Reason.SIGNATURE)
    payload = decode_payload(body, config.graph.n_p)
    _check_standing(payload, sequence, public_key, config)
    _check_structure(payload, config)
    return Transaction(
        id_of(data),
        data,
        author,
        sequence,
        previous,
        lamport,
        references,
        payload.features,
        payload,
        place,
    )


def _check_standing(payload: Payload, sequence: int, public_key: bytes, config: Config) -> None:
    """Which records an author may sign at all.

    In a closed fleet the certificate stands in a robot's first transaction, and names it; the
    fleet key revokes, and says nothing else; nobody else does. An open fleet has neither.
    """
    if config.closed and public_key == config.fleet_public_key:
        others = replace(payload, revocations=())
        if not payload.revocations or encode_payload(others):
            raise Refusal(Reason.STRUCTURE, "the fleet key signs revocations and nothing else")
        if author_of(public_key) in (gone.author for gone in payload.revocations):
            raise Refusal(Reason.STRUCTURE, "the fleet key revokes itself")
        return
    if payload.revocations:
        raise Refusal(Reason.STRUCTURE, "a revocation that is not the fleet key's")
    if payload.certificate is not None and not (config.closed and sequence == 0):
        raise Refusal(Reason.STRUCTURE, "a certificate where none belongs")
    if payload.name is not None and config.closed:
        raise Refusal(Reason.STRUCTURE, "a profile: in a closed fleet the certificate names robots")


def _check_structure(payload: Payload, config: Config) -> None:
    """At most N_p different parents and, inside the bundle, at most n_c_max children each.

    That parents come earlier holds by construction: the wire has distances back.
    """
    if payload.bundle is None:
        return
    parents = np.sort(payload.bundle.parents, axis=1)
    if ((parents[:, 1:] == parents[:, :-1]) & (parents[:, 1:] >= 0)).any():
        raise Refusal(Reason.STRUCTURE, "a feature names a parent twice")
    inside = parents[parents >= payload.bundle.base] - payload.bundle.base
    if len(inside) and int(np.bincount(inside).max()) > config.graph.n_c_max:
        raise Refusal(Reason.STRUCTURE, f"a feature has more than {config.graph.n_c_max} children")


def _work_seed(config: Config, unworked: bytes) -> bytes:
    return hashlib.blake2b(_WORKED + config.fleet_id + unworked, digest_size=32).digest()


def _work_holds(seed: bytes, nonce: bytes, config: Config) -> bool:
    bits = config.transaction.proof_of_work_bits
    work = hashlib.blake2b(seed + nonce, digest_size=8).digest()
    return int.from_bytes(work, "big") >> (64 - bits) == 0


def _work(config: Config, unworked: bytes) -> bytes:
    """Hashcash: the first nonce whose hash begins with the wanted number of zero bits."""
    seed = _work_seed(config, unworked)
    nonce = 0
    while not _work_holds(seed, nonce.to_bytes(4, "little"), config):
        nonce += 1
    return nonce.to_bytes(4, "little")
