"""The verified set: one signed chain per author, a waiting room, proofs of forks.

What is accepted is decided by the transaction and by what it refers to, never by when it arrives:
  - it waits until everything it refers to is known;
  - it continues its author's chain: previous id, sequence, feature count, Lamport time;
  - two transactions of one author with one number prove a fork. The lowest such number is the
    author's cut: from it on nothing of the author counts, whichever branch a robot saw first;
  - what the fleet key has revoked counts as little. Its revocations count like transactions: those
    of its chain, up to its own cut.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from .config import Config
from .identity import author_of
from .kernels.ascendants import count_children
from .model import AuthorId, Reason, TransactionId, Uint8s
from .transaction import Transaction
from .wire import Refusal

_NONE_YET = np.zeros(0, np.uint8)


@dataclass(slots=True)
class Chain:
    """What is known of one author: its transactions in sequence, and the proof of a fork."""

    main: list[Transaction] = field(default_factory=list)
    cut: int | None = None
    revoked: int | None = None
    proof: tuple[Transaction, Transaction] | None = None
    # of issued features; where it is to grow it is replaced
    children: Uint8s = field(default_factory=lambda: _NONE_YET)

    @property
    def limit(self) -> int | None:
        """The number from which on nothing counts: the cut, or where the author was revoked."""
        if self.revoked is None or self.cut is None:
            return self.cut if self.revoked is None else self.revoked
        return min(self.cut, self.revoked)

    @property
    def end(self) -> int:
        """The first number that does not count: the chain's length, or the limit."""
        limit, length = self.limit, len(self.main)
        return length if limit is None else min(limit, length)


@dataclass(slots=True)
class Outcome:
    """What one call of `Ledger.add` changed."""

    accepted: list[Transaction] = field(default_factory=list)
    refused: list[Refusal] = field(default_factory=list)
    forked: list[tuple[AuthorId, int]] = field(default_factory=list)
    revoked: list[tuple[AuthorId, int | None]] = field(default_factory=list)  # None: not any more
    missing: tuple[TransactionId, ...] | None = None  # the transaction waits for these


class Sizes(NamedTuple):
    """What a ledger holds."""

    accepted: int
    waiting: int
    waiting_bytes: int
    waited_for: int  # ids that waiting transactions lack


class Ledger:
    """The transactions that a robot holds. `add` is the only way in."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.chains: dict[AuthorId, Chain] = {}
        self.changed: set[AuthorId] = set()  # whose chain did, since its reader cleared this
        self._known: dict[TransactionId, Transaction] = {}
        self._features: dict[TransactionId, int] = {}  # the author's features up to and with it
        self._waiting: OrderedDict[TransactionId, tuple[Transaction, set[TransactionId]]]
        self._waiting = OrderedDict()
        self._waited_for: dict[TransactionId, list[TransactionId]] = {}
        self._waiting_at: dict[tuple[AuthorId, int], TransactionId] = {}
        self._waiting_size = 0
        self._tips: set[TransactionId] = set()
        self._overfull: set[TransactionId] = set()  # kept, but never folded
        self._fleet = author_of(config.fleet_public_key) if config.closed else None
        self._certified = set() if self._fleet is None else {self._fleet}

    def __len__(self) -> int:
        return len(self._known)

    def __contains__(self, id_: TransactionId) -> bool:
        return id_ in self._known

    def __iter__(self) -> Iterator[Transaction]:
        """All accepted transactions, each after everything that it refers to."""
        return iter(self._known.values())

    def all(self) -> Iterator[Transaction]:
        """Everything that is held: accepted, waiting, and proofs of forks."""
        yield from self._known.values()
        yield from (tx for tx, _ in self._waiting.values())
        yield from (tx for chain in self.chains.values() for tx in chain.proof or ())

    def sizes(self) -> Sizes:
        waited_for = len(self._waited_for)
        return Sizes(len(self._known), len(self._waiting), self._waiting_size, waited_for)

    def holds(self, id_: TransactionId) -> bool:
        """Whether it is accepted or waiting, so that it need not be looked at again."""
        return id_ in self._known or id_ in self._waiting

    def chain(self, author: AuthorId) -> Chain:
        """An author's chain; an empty one, not kept, where nothing of the author is known."""
        return self.chains.get(author) or Chain()

    def find(self, id_: TransactionId) -> Transaction | None:
        """An accepted transaction, or one that is kept as proof of a fork."""
        if id_ in self._known:
            return self._known[id_]
        proofs = (chain.proof for chain in self.chains.values() if chain.proof is not None)
        return next((tx for pair in proofs for tx in pair if tx.id == id_), None)

    def counts(self, tx: Transaction) -> bool:
        """Whether an accepted transaction lies before its author's limit, if there is one."""
        limit = self.chain(tx.author).limit
        return (limit is None or tx.sequence < limit) and tx.id not in self._overfull

    def certified(self, author: AuthorId) -> bool:
        """Whether the fleet is open, or a certificate of the author has been seen."""
        return self._fleet is None or author in self._certified

    def worth_judging(self, id_: TransactionId, author: AuthorId) -> bool:
        """Whether a transaction that is not its author's first is to be looked at yet.

        In a closed fleet a stranger's is not: no certificate of the author was seen, and no
        certified robot refers to it. Such a one is not refused either: sync asks for it again once
        the author's first transaction is here.
        """
        return self.certified(author) or id_ in self._waited_for

    def features(self, author: AuthorId) -> int:
        """How many features the author's chain has issued."""
        main = self.chain(author).main
        return self._features[main[-1].id] if main else 0

    def tips(self, other_than: AuthorId, most: int) -> tuple[TransactionId, ...]:
        """Newest transactions of other authors that no known one refers to, ascending ids."""
        open_ends = (self._known[id_] for id_ in self._tips)
        others = [tx for tx in open_ends if tx.author != other_than and self.counts(tx)]
        others.sort(key=lambda tx: tx.key)
        return tuple(sorted(tx.id for tx in others[len(others) - min(most, len(others)) :]))

    def lamport_after(self, references: tuple[TransactionId, ...]) -> int:
        """The Lamport time of a transaction with these references, its previous one included."""
        return 1 + max((self._known[id_].lamport for id_ in references), default=0)

    def missing(self) -> tuple[TransactionId, ...]:
        """Ids to ask for: what waiting transactions lack, and where a proven fork begins lower."""
        lacking = [id_ for id_ in self._waited_for if not self.holds(id_)]
        for chain in self.chains.values():
            if chain.proof is None or chain.limit != chain.cut:
                continue  # revoked before its fork: where exactly it forked makes no difference
            if chain.proof[0].previous != chain.proof[1].previous:
                before = (tx.previous for tx in chain.proof if tx.previous is not None)
                lacking.extend(id_ for id_ in before if not self.holds(id_))
        return tuple(dict.fromkeys(lacking))

    def waiting_from(self) -> dict[AuthorId, int]:
        """The lowest sequence number that waits, by author."""
        lowest: dict[AuthorId, int] = {}
        for author, number in self._waiting_at:
            lowest[author] = min(number, lowest.get(author, number))
        return lowest

    def add(self, transaction: Transaction, again: bool = False) -> Outcome:
        """Take a transaction that is valid in itself, and whatever waited for it."""
        outcome = Outcome()
        queue = [transaction]
        while queue:
            tx = queue.pop(0)
            if self.holds(tx.id):
                continue
            if tx.sequence == 0 and self._fleet is not None:
                self._certified.add(tx.author)  # as many as the fleet key has enrolled
            self._note_fork(tx, outcome)
            refusal = self._admit(tx, outcome, first=tx is transaction, again=again)
            if refusal is not None:
                outcome.refused.append(refusal)
            elif tx.id in self._known:
                outcome.accepted.append(tx)
                queue.extend(self._released_by(tx.id))
            if tx.author == self._fleet:
                self._count_revocations(outcome)
        return outcome

    def _admit(self, tx: Transaction, outcome: Outcome, first: bool, again: bool) -> Refusal | None:
        """Accept, keep waiting, or refuse. Beyond a limit only what others refer to is accepted."""
        chain = self.chain(tx.author)
        limit = chain.limit
        beyond = limit is not None and tx.sequence >= limit
        if beyond and not again and tx.id not in self._waited_for:
            proof = chain.proof or ()
            if any(tx.id == kept.id for kept in proof):
                return None
            reason = Reason.FORK if limit == chain.cut else Reason.REVOKED
            return Refusal(reason, f"sequence {tx.sequence}, limit {limit}", tx.author)
        missing = tuple(dict.fromkeys(id_ for id_ in tx.refers_to if id_ not in self._known))
        if missing:
            self._wait(tx, missing)
            if first:
                outcome.missing = missing
            return None
        refusal = self._judge(tx)
        if refusal is None:
            self._accept(tx)
        return refusal

    def _judge(self, tx: Transaction) -> Refusal | None:
        """What the set says of a transaction whose references are all known."""
        previous = None if tx.previous is None else self._known[tx.previous]
        if previous is not None and (previous.author, previous.sequence + 1) != (
            tx.author,
            tx.sequence,
        ):
            return Refusal(Reason.CHAIN, "the previous id is not its predecessor's", tx.author)
        if any(self._known[id_].author == tx.author for id_ in tx.references):
            return Refusal(Reason.CHAIN, "refers to its own author twice", tx.author)
        if tx.lamport != self.lamport_after(tx.refers_to):
            return Refusal(Reason.LAMPORT, f"is {tx.lamport}", tx.author)
        before = 0 if tx.previous is None else self._features[tx.previous]
        payload = tx.payload
        if payload.bundle is not None and payload.bundle.base != before:
            return Refusal(Reason.CHAIN, "features are not numbered on", tx.author)
        if len(payload.retracted) and int(payload.retracted[-1]) >= before:
            return Refusal(Reason.CHAIN, "retracts what was never issued", tx.author)
        seen = (int(s.numbers[-1]) for s in payload.sightings if len(s.numbers))
        if max(seen, default=-1) >= before + tx.features:
            return Refusal(Reason.CHAIN, "sees again what was never issued", tx.author)
        return None

    def _accept(self, tx: Transaction) -> None:
        chain = self.chains.setdefault(tx.author, Chain())
        self.changed.add(tx.author)
        before = 0 if tx.previous is None else self._features[tx.previous]
        self._known[tx.id] = tx
        self._features[tx.id] = before + tx.features
        self._tips.difference_update(tx.refers_to)
        self._tips.add(tx.id)
        if self._continues(chain, tx):
            chain.main.append(tx)
            if not self._count_children(chain, tx):
                self._overfull.add(tx.id)

    @staticmethod
    def _continues(chain: Chain, tx: Transaction) -> bool:
        """Whether it is the next one of the main chain, not of another branch."""
        return tx.previous == (chain.main[-1].id if chain.main else None)

    def _count_children(self, chain: Chain, tx: Transaction) -> bool:
        bundle = tx.payload.bundle
        if bundle is None:
            return True
        end = bundle.base + len(bundle.position)
        if end > len(chain.children):
            grown = np.zeros(max(end, 2 * len(chain.children)), np.uint8)
            grown[: len(chain.children)] = chain.children
            chain.children = grown
        return bool(count_children(chain.children, bundle.parents, self.config.graph.n_c_max))

    def _count_revocations(self, outcome: Outcome) -> None:
        """Judge anew who is revoked from where on, by what counts of the fleet key's chain."""
        assert self._fleet is not None
        counts: dict[AuthorId, int] = {}
        fleet = self.chain(self._fleet)
        for tx in fleet.main[: fleet.end]:
            for gone in tx.payload.revocations:
                counts[gone.author] = min(gone.count, counts.get(gone.author, gone.count))
        for author in counts:
            self.chains.setdefault(author, Chain())
        for author, chain in self.chains.items():
            if chain.revoked != counts.get(author):
                chain.revoked = counts.get(author)
                outcome.revoked.append((author, chain.revoked))
                self.changed.add(author)

    def _note_fork(self, tx: Transaction, outcome: Outcome) -> None:
        """Two self-valid transactions with one number are the proof, whatever else is known."""
        chain = self.chain(tx.author)
        rival = self._rival(chain, tx)
        if rival is not None and (chain.cut is None or tx.sequence < chain.cut):
            chain = self.chains.setdefault(tx.author, chain)
            chain.cut, chain.proof = tx.sequence, (rival, tx)
            self.changed.add(tx.author)
            outcome.forked.append((tx.author, tx.sequence))

    def _rival(self, chain: Chain, tx: Transaction) -> Transaction | None:
        if tx.sequence < len(chain.main):
            other = chain.main[tx.sequence]
            return None if other.id == tx.id else other
        rival = self._waiting_at.get((tx.author, tx.sequence), tx.id)
        return None if rival == tx.id else self._waiting[rival][0]

    def _wait(self, tx: Transaction, missing: tuple[TransactionId, ...]) -> None:
        """Keep aside; the oldest leave where the room is full (they will be asked for again)."""
        self._waiting[tx.id] = (tx, set(missing))
        self._waiting_at.setdefault((tx.author, tx.sequence), tx.id)
        self._waiting_size += len(tx.data)
        for id_ in missing:
            self._waited_for.setdefault(id_, []).append(tx.id)
        limits = self.config.ledger
        while (
            len(self._waiting) > limits.waiting_transactions
            or self._waiting_size > limits.waiting_bytes
        ):
            self._leave(next(iter(self._waiting)))

    def _leave(self, id_: TransactionId) -> Transaction:
        tx, missing = self._waiting.pop(id_)
        self._waiting_size -= len(tx.data)
        if self._waiting_at.get((tx.author, tx.sequence)) == id_:
            del self._waiting_at[tx.author, tx.sequence]
        for lacking in missing:
            waiters = self._waited_for[lacking]
            waiters.remove(id_)
            if not waiters:
                del self._waited_for[lacking]
        return tx

    def _released_by(self, id_: TransactionId) -> list[Transaction]:
        """Transactions that waited for nothing but this one."""
        released = []
        for waiter in list(self._waited_for.get(id_, ())):
            tx, missing = self._waiting[waiter]
            if missing <= self._known.keys():
                released.append(self._leave(tx.id))
        return released
