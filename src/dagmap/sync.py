"""Spreading, repair after loss, the late joiner: all three are heads, wants and bounded answers.

Robots announce how far they hold every author's chain. Whoever lacks something asks one robot
that has it; the answer is cut into chunks and the asker asks on. A newcomer does the same with an
empty ledger, so robots that never meet converge through those that do.

Announcements are not signed, so anybody may promise anything in any name. Whoever has given
transactions is asked before those who only promise, and of these ever more at a time as long as
nothing comes. So promises that are not kept delay an answer, and cannot keep it away.
"""

from __future__ import annotations

import heapq
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import filterfalse
from typing import NamedTuple

from .config import Config
from .ledger import Ledger
from .messages import MAX_ECHOES, MAX_MESSAGE, Head, Heads, Message, Transactions, Want
from .model import AuthorId, TransactionId

_HEADS = 1800  # that a message has room for
_ROOM = MAX_MESSAGE - 64  # for transactions in a message
_SMALL = 2048  # bytes for transactions in a message of a robot whose traffic is capped
_LIVE = 5  # announcement periods without a word after which a robot counts as gone
_SELDOM = 20  # announcement periods that a robot with little room may let pass between two
_LATE = 3  # announcement periods that an echo may take before that means something
_UNREAD = 8  # retry periods that an answer gets on top while messages wait to be read
_WIDEST = 64  # robots that are asked the same at a time, once nobody keeps what was promised
Post = tuple[Message, AuthorId | None]


@dataclass(slots=True)
class Peer:
    """Another robot as it was last heard."""

    heads: dict[AuthorId, Head] = field(default_factory=dict)
    token: int = 0
    heard: float = 0.0
    gap: float = 0.0  # s between its last two announcements
    delay: float | None = None  # s, one way, smoothed
    echo: Echo | None = None  # the last one
    gave: bool = False  # transactions that were lacking here; and no question since was in vain
    in_vain: int = 0  # questions since then


class Echo(NamedTuple):
    """A token that came back."""

    token: int
    delay: float  # s, one way
    at: float  # s: when it came, less how long the other held it


class Asked(NamedTuple):
    """A question for a range of an author's chain."""

    held: int  # where the range begins, or how far the answer has come
    end: int
    until: float  # s, when it is overdue
    whom: frozenset[AuthorId]
    sure: bool  # one of them has given before
    widest: int  # so many may be asked before it is overdue


class Sync:
    """Keeps this robot's ledger and the others' alike. Time comes in as `now`, seconds."""

    def __init__(self, ledger: Ledger, config: Config, me: AuthorId) -> None:
        self._ledger, self._config, self._me = ledger, config.sync, me
        self.peers: OrderedDict[AuthorId, Peer] = OrderedDict()
        self._next_announcement: float | None = None
        self._heads: dict[AuthorId, Head] = {}
        self._ends: set[Head] = set()  # the same
        self._token = 0
        self._sent_at: OrderedDict[int, float] = OrderedDict()
        self._asked: OrderedDict[AuthorId, Asked] = OrderedDict()  # about whose chain
        self._asked_ids: dict[TransactionId, float] = {}  # id: not to be asked for before
        self._sure_next = False  # ids are asked of those who gave and of all, by turns

    def tick(self, now: float, unread: bool = False) -> Iterator[Post]:
        """Announcements that are due, and questions for what waiting transactions lack.

        unread: messages lie here that were not looked at. They may be the answers.
        """
        if self._next_announcement is None or now >= self._next_announcement:
            self._next_announcement = now + self._config.announce_period
            yield from self._announce(now)
        grace = _UNREAD * self._config.retry_period if unread else 0.0
        yield from self._ask_again(now - grace)
        yield from self._ask_for_missing(now - grace)

    def heard(self, sender: AuthorId, message: Heads, now: float) -> Iterator[Post]:
        """An announcement: remember it, measure the delay, ask for what is lacking here."""
        if sender == self._me:
            return
        peer = self._peer(sender)
        if message.token != peer.token:
            peer.heads.clear()  # an announcement of several messages has one token
            peer.gap = now - peer.heard if peer.token else 0.0
        peer.token, peer.heard = message.token, now
        self._held()
        waiting, held = self._ledger.waiting_from(), self._ends
        heads = message.heads[: self._config.heads_remembered]
        for head in filterfalse(held.__contains__, heads):  # few are news, mostly
            if len(peer.heads) < self._config.heads_remembered and self._promises(head, waiting):
                peer.heads[head.author] = head
        for whose, token, kept in message.echoes:
            if whose == self._me and token in self._sent_at:
                delay = max(0.0, now - self._sent_at[token] - kept / 1e6) / 2
                peer.echo = Echo(token, delay, now - kept / 1e6)
                peer.delay = delay if peer.delay is None else 0.75 * peer.delay + 0.25 * delay
        yield from self._ask(sender, peer, now)

    def answered(
        self, sender: AuthorId, message: Transactions, now: float, news: bool = True
    ) -> Iterator[Post]:
        """Transactions came (they are in the ledger by now): ask on where the answer was cut.

        news: some of them were lacking here.
        """
        peer = self.peers.get(sender)
        if peer is not None and news:
            peer.gave, peer.in_vain = True, 0
        for author, asked in list(self._asked.items()):
            length = len(self._ledger.chain(author).main)
            if length >= asked.end:
                del self._asked[author]
            elif length > asked.held:  # the answer is coming: what is left of it gets its time too
                until = now + self._patience(peer or Peer())
                self._asked[author] = asked._replace(held=length, until=until, widest=1)
        if message.more and peer is not None:
            for author in peer.heads:
                self._asked.pop(author, None)
            yield from self._ask(sender, peer, now)

    def promised(self, author: AuthorId) -> bool:
        """Whether a robot has announced more of an author than is here. It need not be true."""
        heads = (peer.heads.get(author) for peer in self.peers.values())
        return any(head is not None and self._wanted(head, {}) is not None for head in heads)

    def live(self, now: float) -> dict[AuthorId, Peer]:
        """The robots that were heard of late: one with little room announces itself seldom."""
        period = self._config.announce_period
        return {
            author: peer
            for author, peer in self.peers.items()
            if now - peer.heard <= _LIVE * min(max(period, peer.gap), _SELDOM * period)
        }

    def unsaid(self, token: int) -> None:
        """An announcement was left out, so nobody will echo its token."""
        self._sent_at.pop(token, None)

    def delay(self, now: float) -> float | None:
        """What a message from here takes at least, s one way; None where nobody knows.

        Measured by the tokens that the others echo; where none came back for long, by how long.
        That of the nearest robot: a slow link of another one is not this one's to relieve.
        """
        live = self.live(now).values()
        echoes = [peer.echo for peer in live if peer.echo is not None]
        if not echoes:
            return None
        last = max(echo.token for echo in echoes)
        fresh = [echo.delay for echo in echoes if echo.token > last - _LIVE]
        unechoed = next((at for token, at in self._sent_at.items() if token > last), now)
        usual = max(self._config.announce_period, min(peer.gap for peer in live))
        overdue = (now - unechoed - _LATE * usual) / 2
        return max(min(fresh), overdue)

    def asked(self, sender: AuthorId, message: Want, room: int | None = None) -> Iterator[Post]:
        """Answer a question, up to `chunk_bytes`, or `room` bytes where these are fewer."""
        most = self._config.chunk_bytes if room is None else min(room, self._config.chunk_bytes)
        found: list[bytes] = []
        size, more = 0, False
        for data in self._found(message) if most > 0 else ():
            size += len(data)
            if size > most and found:
                more = True
                break
            found.append(data)
        packed = list(_packed(found, _ROOM if room is None else min(_ROOM, _SMALL)))
        for i, data_ in enumerate(packed):
            yield Transactions(data_, more and i == len(packed) - 1), sender

    def _found(self, message: Want) -> Iterator[bytes]:
        for author in message.proofs:
            for tx in self._ledger.chain(author).proof or ():
                yield tx.data
        for id_ in message.ids[: self._config.ids_per_question]:
            known = self._ledger.find(id_)
            if known is not None:
                yield known.data
        chains = [self._ledger.chain(author).main for author, _, _ in message.ranges]
        found = (
            map(main.__getitem__, range(a, min(b, len(main))))  # nothing is copied
            for main, (_, a, b) in zip(chains, message.ranges, strict=True)
        )
        for tx in heapq.merge(*found, key=lambda tx: tx.key):  # causes first
            yield tx.data

    def _peer(self, sender: AuthorId) -> Peer:
        peer = self.peers.setdefault(sender, Peer())
        self.peers.move_to_end(sender)
        while len(self.peers) > self._config.peers_remembered:
            others = (id_ for id_, other in self.peers.items() if not other.gave and id_ != sender)
            del self.peers[next(others, next(iter(self.peers)))]
        return peer

    def _announce(self, now: float) -> Iterator[Post]:
        heads = [head for head in self._held().values() if head.length or head.cut is not None]
        self._token += 1
        self._sent_at[self._token] = now
        while len(self._sent_at) > 64:
            self._sent_at.popitem(last=False)
        recent = list(self.peers.items())[-MAX_ECHOES:]
        echoes = tuple((id_, p.token, max(0, round((now - p.heard) * 1e6))) for id_, p in recent)
        for first in range(0, max(len(heads), 1), _HEADS):
            yield Heads(self._token, echoes, tuple(heads[first : first + _HEADS])), None

    def _held(self) -> dict[AuthorId, Head]:
        """The ends of the chains as they stand here."""
        for author in sorted(self._ledger.changed):
            chain = self._ledger.chain(author)
            tip = _tip(chain.main[chain.end - 1].id if chain.end else b"")
            head = Head(author, chain.end, tip, chain.cut)
            self._ends.discard(self._heads.get(author, head))
            self._ends.add(head)
            self._heads[author] = head
        self._ledger.changed.clear()
        return self._heads

    def _ask_again(self, now: float) -> Iterator[Post]:
        """Where an answer is overdue, ask others that have promised the same."""
        late = {author for author, asked in self._asked.items() if now >= asked.until}
        for author in sorted(late):
            self._in_vain(author)
        for sender, peer in self._surest() if late else ():
            heads = {author: peer.heads[author] for author in late & peer.heads.keys()}
            for post in self._ask(sender, peer, now, heads):
                self.peers.move_to_end(sender)
                yield post

    def _surest(self) -> list[tuple[AuthorId, Peer]]:
        """Those first who gave, or were in vain least; of these who was not asked for longest."""
        return sorted(self.peers.items(), key=lambda item: (not item[1].gave, item[1].in_vain))

    def _turn_of(
        self, sender: AuthorId, peer: Peer, author: AuthorId, lacking: tuple[int, int], now: float
    ) -> bool:
        """Whether it is a robot's turn to be asked about an author; then it counts as asked."""
        asked = self._asked.get(author)
        if asked is not None and asked.whom and now >= asked.until:
            self._in_vain(author)
            asked = self._asked[author]
        whom = frozenset() if asked is None else asked.whom
        if asked is not None and whom:  # the answer may still come
            more = peer.gave or len(whom) < asked.widest
            if asked.sure or sender in whom or not more:
                return False
        widest = 1 if asked is None else asked.widest
        until = now + self._patience(peer)
        self._asked[author] = Asked(*lacking, until, whom | {sender}, peer.gave, widest)
        self._asked.move_to_end(author)
        return True

    def _in_vain(self, author: AuthorId) -> None:
        """A question was not answered: nobody of those asked is sure any more."""
        asked = self._asked[author]
        for id_ in sorted(asked.whom & self.peers.keys()):
            peer = self.peers[id_]
            peer.gave, peer.in_vain = False, peer.in_vain + 1
        widest = 1 if asked.sure else min(2 * asked.widest, _WIDEST)
        self._asked[author] = asked._replace(whom=frozenset(), sure=False, widest=widest)

    def _ask(
        self, sender: AuthorId, peer: Peer, now: float, heads: dict[AuthorId, Head] | None = None
    ) -> Iterator[Post]:
        ranges, proofs = [], []
        waiting = self._ledger.waiting_from()
        for head in (peer.heads if heads is None else heads).values():
            if self._proves(head):
                proofs.append(head.author)
            wanted = self._wanted(head, waiting)
            if wanted is not None and self._turn_of(sender, peer, head.author, wanted, now):
                if len(self._asked) > 2 * self._config.heads_remembered:
                    self._asked.popitem(last=False)
                ranges.append((head.author, *wanted))
        if ranges or proofs:
            most = self._config.ids_per_question
            yield Want(tuple(ranges), (), tuple(proofs[:most])), sender

    def _patience(self, peer: Peer) -> float:
        """How long an answer may take, s: a few round trips, where they were measured."""
        longest = self._config.retry_period
        return longest if peer.delay is None else min(longest, max(0.3, 8 * peer.delay))

    def _promises(self, head: Head, waiting: Mapping[AuthorId, int]) -> bool:
        return self._proves(head) or self._wanted(head, waiting) is not None

    def _proves(self, head: Head) -> bool:
        """Whether a head announces a fork that is not known here, and could be judged."""
        if head.cut is None or not (head.cut == 0 or self._ledger.certified(head.author)):
            return False
        cut = self._ledger.chain(head.author).cut
        return cut is None or head.cut < cut

    def _wanted(self, head: Head, waiting: Mapping[AuthorId, int]) -> tuple[int, int] | None:
        """The range of an author's chain that a head promises and that is lacking here."""
        chain = self._ledger.chain(head.author)
        mine = len(chain.main)
        if 0 < head.length <= mine:
            differs = _tip(chain.main[head.length - 1].id) != head.tip
            counts = chain.limit is None or head.length <= chain.limit
            return (head.length - 1, head.length) if differs and counts else None
        end = head.length if chain.limit is None else min(head.length, chain.limit)
        end = min(end, waiting.get(head.author, end))
        return (mine, end) if end > mine else None

    def _ask_for_missing(self, now: float) -> Iterator[Post]:
        """By id, one robot after the other, not at once: most are only late."""
        missing = self._ledger.missing()
        for id_ in self._asked_ids.keys() - set(missing):
            del self._asked_ids[id_]
        due = []
        for id_ in missing:
            self._asked_ids.setdefault(id_, now + self._config.retry_period / 4)
        oldest = sorted(self._asked_ids, key=self._asked_ids.__getitem__)
        for id_ in oldest[: self._config.ids_per_question]:
            if now >= self._asked_ids[id_]:  # longest due first: junk cannot keep others out
                self._asked_ids[id_] = now + self._config.retry_period
                due.append(id_)
        if due and self.peers:
            self._sure_next = not self._sure_next
            whom = self._surest()[0][0] if self._sure_next else next(iter(self.peers))
            self.peers.move_to_end(whom)
            yield Want((), tuple(due)), whom


def _tip(id_: bytes) -> bytes:
    return id_[:8].ljust(8, b"\0")


def _packed(data: Iterable[bytes], room: int) -> Iterator[tuple[bytes, ...]]:
    """As many transactions as fit into each message of `room` bytes, at least one."""
    batch: list[bytes] = []
    size = 0
    for item in data:
        if batch and size + len(item) + 9 > room:
            yield tuple(batch)
            batch, size = [], 0
        batch.append(item)
        size += len(item) + 9
    if batch:
        yield tuple(batch)
