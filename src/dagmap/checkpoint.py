"""A folded state as bytes, so that a restart need not verify and fold the whole ledger again.

    MAC 32 | size of the head 4 | head: what it belongs to | the ledger and the fold, pickled

Only what the robot's own key has authenticated is ever unpickled. A checkpoint says which
transactions it stands for; one that does not match what the store holds is not used, and costs
nothing but the time that it would have saved. Transactions are not in it: it refers to the store's.
"""

from __future__ import annotations

import hashlib
import io
import pickle
from collections.abc import Mapping, Sequence
from itertools import islice
from typing import cast

import msgspec

from . import __version__
from .config import Config
from .consensus import Consensus
from .identity import Identity
from .ledger import Ledger
from .model import TransactionId

# Of what is pickled: any change to the classes of the ledger or the fold counts it up. Between
# releases the fold itself may change: what another release has folded is never taken over.
VERSION = 10


class _Head(msgspec.Struct, frozen=True):
    version: int
    release: str
    config: bytes
    count: int  # transactions of the store, from its beginning
    stored: bytes  # BLAKE2b-256 over their ids, in the store's order


def save(
    ledger: Ledger, consensus: Consensus, identity: Identity, stored: Sequence[TransactionId]
) -> bytes:
    """The state after the transactions with these ids: all that were accepted, as stored."""
    head = msgspec.msgpack.encode(_head(ledger.config, stored))
    out = io.BytesIO()
    _Pickler(out, ledger, set(stored)).dump((ledger, consensus))
    body = len(head).to_bytes(4, "little") + head + out.getbuffer()
    return _mac(identity, body) + body


def load(
    data: bytes, identity: Identity, config: Config, transactions: Mapping[TransactionId, bytes]
) -> tuple[Ledger, Consensus, int] | None:
    """The state and how many of the store's transactions (in its order) it stands for.

    None where it is damaged, of another robot, version or configuration, of another store, or of
    classes that are not here any more; and where it holds what the store never got: to go on from
    that would leave a gap in the store.
    """
    body = memoryview(data)[32:]
    if len(data) < 36 or data[:32] != _mac(identity, body):
        return None
    size = int.from_bytes(body[:4], "little")
    try:
        head = msgspec.msgpack.decode(body[4 : 4 + size], type=_Head)
        if head != _head(config, list(islice(transactions, head.count))):
            return None
        unpickler = _Unpickler(io.BytesIO(body[4 + size :]), transactions)
        ledger, consensus = cast("tuple[Ledger, Consensus]", unpickler.load())
        whole = all(tx.id in transactions for tx in ledger)
    except Exception:  # noqa: BLE001 - what another version has written may fail in any way
        return None
    return (ledger, consensus, head.count) if whole else None


def _head(config: Config, stored: Sequence[TransactionId]) -> _Head:
    over_all = hashlib.blake2b(b"".join(stored), digest_size=32).digest()
    return _Head(VERSION, __version__, msgspec.json.encode(config), len(stored), over_all)


def _mac(identity: Identity, body: bytes | memoryview) -> bytes:
    key = identity.secret(b"dagmap checkpoint")
    return hashlib.blake2b(body, digest_size=32, key=key).digest()


class _Pickler(pickle.Pickler):
    """Names transactions that are stored by their ids, and leaves their bytes out."""

    def __init__(self, file: io.BytesIO, ledger: Ledger, stored: set[TransactionId]) -> None:
        super().__init__(file, protocol=5)
        self._ids = {id(tx.data): tx.id for tx in ledger.all() if tx.id in stored}

    def persistent_id(self, thing: object) -> TransactionId | None:
        return self._ids.get(id(thing)) if type(thing) is bytes else None


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, transactions: Mapping[TransactionId, bytes]) -> None:
        super().__init__(file)
        self._transactions = transactions

    def persistent_load(self, id_: TransactionId) -> bytes:
        return self._transactions[id_]
