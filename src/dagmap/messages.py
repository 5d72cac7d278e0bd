"""What robots say to each other, as bytes: parse or reject.

    "DM" | version 1 | kind 1 | fleet 8 | fold parameters 8 | sender 8 | body | CRC-32 4

The sender is a hint (whom to answer), never a proof: only transactions are signed. Other robots'
heads are hints too; a false one costs a bounded question.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, TypeAlias

from . import wire
from .config import Config
from .model import AuthorId, Reason, TransactionId
from .transaction import MAX_SIZE as MAX_TRANSACTION
from .transaction import MIN_SIZE as MIN_TRANSACTION
from .transaction import Transaction, parse_worked, worked
from .wire import Reader, Refusal

VERSION = 1
MAX_MESSAGE = 60_000  # bytes
MAX_ECHOES = 8
_HEAD = 28
_MAGIC = b"DM"


class Kind(IntEnum):
    """Message kinds of version 1. The numbers are the wire's."""

    TRANSACTIONS = 1
    HEADS = 2
    WANT = 3


@dataclass(frozen=True, slots=True)
class Transactions:
    """Exact bytes of transactions. `more`: the answer was cut here, ask on."""

    data: tuple[bytes, ...]
    more: bool = False


class Head(NamedTuple):
    """The end of an author's chain as the sender holds it; `cut` where it holds a fork proof."""

    author: AuthorId
    length: int  # transactions of the chain that count
    tip: bytes  # first 8 bytes of the id of the last one, zeros where there is none
    cut: int | None = None  # from where nothing counts: the sender holds the proof


@dataclass(frozen=True, slots=True)
class Heads:
    """An announcement. Tokens measure the delay: each comes back with how long it was held."""

    token: int
    echoes: tuple[tuple[AuthorId, int, int], ...]  # (whose token, token, held microseconds)
    heads: tuple[Head, ...]


@dataclass(frozen=True, slots=True)
class Want:
    """A question: ranges of chains (author, first, end exclusive), ids, proofs of forks."""

    ranges: tuple[tuple[AuthorId, int, int], ...] = ()
    ids: tuple[TransactionId, ...] = ()
    proofs: tuple[AuthorId, ...] = ()


Message: TypeAlias = Transactions | Heads | Want


def encode(message: Message, config: Config, sender: AuthorId) -> bytes:
    """The bytes of a message. Raises ValueError where they would exceed MAX_MESSAGE."""
    kind, body = _encode_body(message)
    head = _MAGIC + bytes([VERSION, kind]) + config.fleet_id + config.parameters_id + sender
    data = head + body
    if len(data) + 4 > MAX_MESSAGE:
        raise ValueError(f"a message of {len(data) + 4} bytes; at most {MAX_MESSAGE} fit")
    return data + zlib.crc32(data).to_bytes(4, "little")


def parse(data: bytes, config: Config) -> tuple[AuthorId, Message]:
    """Read foreign bytes as (sender, message). Raises Refusal, nothing else."""
    if len(data) > MAX_MESSAGE:
        raise Refusal(Reason.MALFORMED, f"message of {len(data)} bytes")
    if len(data) < _HEAD + 4:
        raise Refusal(Reason.TRUNCATED, f"message of {len(data)} bytes")
    if zlib.crc32(data[:-4]).to_bytes(4, "little") != data[-4:]:
        raise Refusal(Reason.CHECKSUM)
    if data[:2] != _MAGIC or data[2] != VERSION:
        raise Refusal(Reason.VERSION, f"message version {data[2]}")
    sender = data[20:28]
    if data[4:12] != config.fleet_id:
        raise Refusal(Reason.FLEET, f"id {data[4:12].hex()}", sender)
    if data[12:20] != config.parameters_id:
        raise Refusal(Reason.PARAMETERS, f"id {data[12:20].hex()}", sender)
    try:
        return sender, _decode_body(data[3], Reader(data[_HEAD:-4]), config)
    except Refusal as refusal:
        raise Refusal(refusal.reason, refusal.detail, sender) from None


def kind_of(data: bytes) -> Kind | None:
    """The kind that a message's head names, before anything of it is checked."""
    kind = data[3] if len(data) > 3 else 0
    return Kind(kind) if kind in Kind.__members__.values() else None


def sender_of(data: bytes) -> AuthorId:
    """The sender that a message's head names: a hint. Shorter than 8 bytes where it is cut."""
    return data[_HEAD - 8 : _HEAD]


def _encode_body(message: Message) -> tuple[Kind, bytes]:
    if isinstance(message, Transactions):
        parts = [wire.number(len(data)) + data for data in message.data]
        return Kind.TRANSACTIONS, bytes([message.more]) + b"".join(parts)
    if isinstance(message, Heads):
        return Kind.HEADS, _encode_heads(message)
    ranges = (a + wire.number(first) + wire.number(end - first) for a, first, end in message.ranges)
    return Kind.WANT, b"".join(
        (
            wire.number(len(message.ranges)),
            *ranges,
            wire.number(len(message.ids)),
            *message.ids,
            wire.number(len(message.proofs)),
            *message.proofs,
        )
    )


def _encode_heads(message: Heads) -> bytes:
    out = [wire.number(message.token), wire.number(len(message.echoes))]
    for author, token, held in message.echoes:
        out.append(author + wire.number(token) + wire.number(held))
    for head in message.heads:
        cut = b"" if head.cut is None else wire.number(head.cut)
        out.append(head.author + wire.number(2 * head.length + bool(cut)) + head.tip + cut)
    return b"".join(out)


def _decode_body(kind: int, body: Reader, config: Config) -> Message:
    if kind == Kind.TRANSACTIONS:
        return _decode_transactions(body)
    if kind == Kind.HEADS:
        return _decode_heads(body)
    if kind == Kind.WANT:
        return _decode_want(body)
    raise Refusal(Reason.MALFORMED, f"message of kind {kind}")


def _decode_transactions(body: Reader) -> Transactions:
    more = body.number(1) == 1
    data = []
    while body.left:
        size = body.number(MAX_TRANSACTION)
        if size < MIN_TRANSACTION:
            raise Refusal(Reason.MALFORMED, f"transaction of {size} bytes")
        data.append(body.take(size))
    return Transactions(tuple(data), more)


def _decode_heads(body: Reader) -> Heads:
    token, echoes = body.number(), []
    for _ in range(body.number(MAX_ECHOES)):
        echoes.append((body.take(8), body.number(), body.number()))
    heads = []
    while body.left:
        author, packed = body.take(8), body.number(1 << 41)
        tip = body.take(8)
        heads.append(Head(author, packed >> 1, tip, body.number(1 << 40) if packed & 1 else None))
    return Heads(token, tuple(echoes), tuple(heads))


def _decode_want(body: Reader) -> Want:
    ranges = []
    for _ in range(body.number(body.left)):
        author, first, count = body.take(8), body.number(1 << 40), body.number(1 << 40)
        ranges.append((author, first, first + count))
    ids = tuple(body.take(32) for _ in range(body.number(body.left)))
    proofs = tuple(body.take(8) for _ in range(body.number(body.left)))
    body.end()
    for named in (ids, proofs, [author for author, _, _ in ranges]):
        if len(set(named)) < len(named):  # it would cost more than it gives
            raise Refusal(Reason.MALFORMED, "a question that asks for the same twice")
    return Want(tuple(ranges), ids, proofs)


@dataclass(frozen=True, slots=True)
class Parsers:
    """How foreign bytes are judged: pure functions, so agents of one process may share results.

    transaction: the judge of those whose proof of work holds.
    """

    message: Callable[[bytes, Config], tuple[AuthorId, Message]] = parse
    worked: Callable[[bytes, Config], TransactionId] = worked
    transaction: Callable[[bytes, Config], Transaction] = parse_worked
