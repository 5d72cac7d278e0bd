"""Robots that do not keep to the rules. Each holds a valid key and an otherwise honest agent.

A liar stands between its SLAM and its agent (`cycle`) and between its agent and the network
(`send`); what it does follows from its seed.
"""

from __future__ import annotations

import random
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from itertools import count

import numpy as np

from .. import messages, transaction
from ..agent import Agent
from ..identity import Identity
from ..messages import Head, Heads, Transactions
from ..model import ConfigError, Cycle, Floats, Outgoing, Reason
from ..payload import Payload
from ..wire import Refusal

_BURST = 20  # messages that a noisy liar sends at a time
_PAUSE = 0.2  # s between two bursts, or liars that answer each other's noise would never stop
_CAPTURED = 500  # messages that a replayer keeps


class Honest:
    """Tells and sends what it should: the base of all liars."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)

    def cycle(self, cycle: Cycle, now: float) -> Cycle:
        return cycle

    def hear(self, data: bytes) -> None:
        """A message has arrived."""

    def send(self, agent: Agent, outgoing: list[Outgoing], now: float) -> list[Outgoing]:
        return outgoing


class Noisy(Honest, ABC):
    """Sends bursts of messages, with a pause after each: a radio has its limit, too."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self._rests_until = 0.0

    def send(self, agent: Agent, outgoing: list[Outgoing], now: float) -> list[Outgoing]:
        if not outgoing or now < self._rests_until:
            return outgoing
        self._rests_until = now + _PAUSE
        return outgoing + [self.noise(agent) for _ in range(_BURST)]

    @abstractmethod
    def noise(self, agent: Agent) -> Outgoing:
        """One of a burst."""


class Forger(Honest):
    """Invents a wall: adds points of one that is not there to every cycle."""

    WALL = ((1.0, 1.0, 0.2), (1.0, 3.0, 2.0))  # m, corners in the fleet frame

    def cycle(self, cycle: Cycle, now: float) -> Cycle:
        wall = np.array([[self.random.uniform(a, b) for a, b in zip(*self.WALL, strict=True)]
                         for _ in range(30)])  # fmt: skip
        return _with_points(cycle, np.concatenate([_points(cycle), _into_sensor(cycle, wall)]))


class Eraser(Honest):
    """Says of every point that it lies far behind where it is, so that rays cross what is real."""

    def cycle(self, cycle: Cycle, now: float) -> Cycle:
        return _with_points(cycle, _points(cycle) * 1.5)


class Splitter(Honest):
    """Surrounds what it sees with six copies, so that others' observations find many twins."""

    def cycle(self, cycle: Cycle, now: float) -> Cycle:
        points = _points(cycle)
        around = [[self.random.uniform(-0.06, 0.06) for _ in range(3)] for _ in range(6)]
        copies = [points + np.array(offset) for offset in around]
        return _with_points(cycle, np.concatenate([points, *copies]))


class WrongFrame(Honest):
    """Has a frame turned by ten degrees about the fleet's origin and moved by half a metre."""

    def cycle(self, cycle: Cycle, now: float) -> Cycle:
        c, s = np.cos(np.radians(10)), np.sin(np.radians(10))
        wrong = np.array([[c, -s, 0, 0.3], [s, c, 0, -0.4], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        moved = cycle.moved
        if moved is not None:
            moved = (moved[0], wrong @ np.asarray(moved[1], np.float64))
        return replace(cycle, pose=wrong @ np.asarray(cycle.pose, np.float64), moved=moved)


class Outsider(Honest):
    """Reports true points, but from a place far behind it, so that walls lie in between.

    Where it is the first that sees a place, what ends at those walls speaks against the place.
    """

    BACK = 4.5  # m

    def cycle(self, cycle: Cycle, now: float) -> Cycle:
        pose = np.array(cycle.pose, np.float64)
        points = _points(cycle)
        ahead = np.array([*pose[:2, 0], 0.0])
        back = self.BACK * ahead / max(float(np.linalg.norm(ahead)), 1e-9)
        pose[:3, 3] -= back
        return replace(_with_points(cycle, points + back @ pose[:3, :3]), pose=pose, moved=None)


class Forker(Honest):
    """Signs a second transaction with the same number and shows each half of the fleet one."""

    def send(self, agent: Agent, outgoing: list[Outgoing], now: float) -> list[Outgoing]:
        others, out = sorted(agent.sync.peers), []
        for sent in outgoing:
            own = _own(agent, sent) if len(others) > 1 else []
            out += [Outgoing(sent.data, whom) for whom in others[1::2]] if own else [sent]
            for tx in own:
                rival = _sealed(agent, tx.sequence, tx.previous, tx.lamport, tx.references)
                out += [_packed(agent, rival, whom) for whom in others[::2]]
        return out


class BackDater(Honest):
    """Refers to nobody and speaks late, so that what it says sorts before what others hold."""

    LATE = 3.0  # s

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self._held: deque[tuple[float, Outgoing]] = deque()

    def send(self, agent: Agent, outgoing: list[Outgoing], now: float) -> list[Outgoing]:
        vars(agent.ledger)["tips"] = lambda me, most: ()
        self._held.extend((now + self.LATE, sent) for sent in outgoing)
        due = []
        while self._held and self._held[0][0] <= now:
            due.append(self._held.popleft()[1])
        return due


class EarlyOutsider(BackDater):
    """An outsider that refers to nobody, so that it is the first that sees a place."""

    LATE = 0.0

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self._outsider = Outsider(seed)

    def cycle(self, cycle: Cycle, now: float) -> Cycle:
        return self._outsider.cycle(cycle, now)


class FalseDater(Honest):
    """Claims Lamport times, low and high, that do not follow from its references; no true ones."""

    def send(self, agent: Agent, outgoing: list[Outgoing], now: float) -> list[Outgoing]:
        out = []
        for sent in outgoing:
            own = _own(agent, sent)
            for tx in own:
                false = self.random.choice([1, max(1, tx.lamport - 1), tx.lamport + 1, 1 << 40])
                if false != tx.lamport:
                    args = (tx.sequence, tx.previous, false, tx.references)
                    out.append(_packed(agent, _sealed(agent, *args)))
            if not own:
                out.append(sent)
        return out


class Flooder(Noisy):
    """Sends transactions without end that refer to what does not exist, to fill every room."""

    def noise(self, agent: Agent) -> Outgoing:
        number, previous = self.random.randrange(1000, 1 << 30), self.random.randbytes(32)
        return _packed(agent, _sealed(agent, number, previous, 7, ()))


class Replayer(Noisy):
    """Sends messages of its own and of others, which it has captured, again and again."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self._captured: deque[bytes] = deque(maxlen=_CAPTURED)

    def hear(self, data: bytes) -> None:
        self._captured.append(data)

    def send(self, agent: Agent, outgoing: list[Outgoing], now: float) -> list[Outgoing]:
        self._captured.extend(sent.data for sent in outgoing)
        return super().send(agent, outgoing, now)

    def noise(self, agent: Agent) -> Outgoing:
        return Outgoing(self.random.choice(self._captured))


class ManyNamed(Noisy):
    """Invents senders, each of which announces chains of robots that do not exist."""

    HEADS = 20  # of one invented sender

    def noise(self, agent: Agent) -> Outgoing:
        heads = tuple(_invented(self.random) for _ in range(self.HEADS))
        message = Heads(self.random.randrange(1 << 30), (), heads)
        return Outgoing(messages.encode(message, agent.config, self.random.randbytes(8)))


class Promiser(Noisy):
    """Promises in ever new names more of everybody's chain than there is, and never gives it."""

    def noise(self, agent: Agent) -> Outgoing:
        heads = tuple(Head(author, 1 << 39, bytes(8)) for author in agent.ledger.chains)
        message = Heads(self.random.randrange(1 << 30), (), heads)
        return Outgoing(messages.encode(message, agent.config, self.random.randbytes(8)))


class WrongProver(Honest):
    """Spoils signatures and, where it is asked for, work, and speaks in the name of others."""

    def send(self, agent: Agent, outgoing: list[Outgoing], now: float) -> list[Outgoing]:
        out = list(outgoing)
        for sent in outgoing:
            for tx in _own(agent, sent):
                spoilt = bytearray(tx.data)
                spoilt[-self.random.randrange(1, 65)] ^= 1 << self.random.randrange(8)
                out.append(_packed(agent, bytes(spoilt)))
                if agent.config.transaction.proof_of_work_bits:
                    out.append(_packed(agent, _unworked(agent, tx.data)))
        return out + [_packed(agent, data) for data in self._in_the_name_of_others(agent)]

    def _in_the_name_of_others(self, agent: Agent) -> Iterator[bytes]:
        """Continues the chain of another robot, with its public key and a signature of its own."""
        victims = sorted(a for a in agent.ledger.chains if a != agent.identity.author)
        if not victims or self.random.random() > 0.2:
            return
        last = agent.ledger.chain(self.random.choice(victims)).main[-1]
        args = (last.sequence + 1, last.id, last.lamport + 1, ())
        yield _sealed(agent, *args, Impostor(agent.identity, last.data[1:33]))


class Impostor(Identity):
    """Signs with one key and shows another."""

    def __init__(self, true: Identity, shown: bytes) -> None:
        self._true = true
        self.public_key, self.author = shown, true.author

    def sign(self, message: bytes) -> bytes:
        return self._true.sign(message)


class Babbler(Honest):
    """Random bytes, and messages with random bytes changed."""

    def send(self, agent: Agent, outgoing: list[Outgoing], now: float) -> list[Outgoing]:
        out = list(outgoing)
        for sent in outgoing:
            out.append(Outgoing(self.random.randbytes(self.random.randrange(200))))
            spoilt = bytearray(sent.data)
            for _ in range(self.random.randrange(1, 4)):
                spoilt[self.random.randrange(len(spoilt))] = self.random.randrange(256)
            out.append(Outgoing(bytes(spoilt)))
        return out


class Withholder(Honest):
    """Announces all it has, but sends transactions to one robot only, answers to others too."""

    def send(self, agent: Agent, outgoing: list[Outgoing], now: float) -> list[Outgoing]:
        friend = min(agent.sync.peers, default=None)
        out = []
        for sent in outgoing:
            if not _is(agent, sent, Transactions):
                out.append(sent)
            elif friend is not None:
                out.append(Outgoing(sent.data, friend))
        return out


class Braggart(Honest):
    """Announces longer chains than there are, and one of nobody, with each of its announcements."""

    def send(self, agent: Agent, outgoing: list[Outgoing], now: float) -> list[Outgoing]:
        if not any(_is(agent, sent, Heads) for sent in outgoing):
            return outgoing  # to boast in answer to a boast would never end
        heads = tuple(
            Head(author, chain.end + self.random.randrange(1, 1 << 20), self.random.randbytes(8))
            for author, chain in agent.ledger.chains.items()
        )
        boast = Heads(self.random.randrange(1 << 30), (), (*heads, _invented(self.random)))
        data = messages.encode(boast, agent.config, agent.identity.author)
        return [*outgoing, Outgoing(data)]


LIARS: dict[str, type[Honest]] = {
    "forger": Forger,
    "eraser": Eraser,
    "splitter": Splitter,
    "wrong-frame": WrongFrame,
    "outsider": Outsider,
    "early-outsider": EarlyOutsider,
    "forker": Forker,
    "back-dater": BackDater,
    "false-dater": FalseDater,
    "flooder": Flooder,
    "replayer": Replayer,
    "wrong-prover": WrongProver,
    "babbler": Babbler,
    "withholder": Withholder,
    "braggart": Braggart,
    "many-named": ManyNamed,
    "promiser": Promiser,
}


def make_liar(kind: str, seed: int) -> Honest:
    """A liar by its name. Raises ConfigError with the names that there are."""
    if kind not in LIARS:
        raise ConfigError(f"liar {kind!r} is unknown; one of {', '.join(sorted(LIARS))} is wanted")
    return LIARS[kind](seed)


def _is(agent: Agent, sent: Outgoing, kind: type) -> bool:
    return isinstance(messages.parse(sent.data, agent.config)[1], kind)


def _invented(chance: random.Random) -> Head:
    """The end of a chain of a robot that does not exist."""
    return Head(chance.randbytes(8), chance.randrange(1, 99), bytes(8))


def _unworked(agent: Agent, data: bytes) -> bytes:
    """A transaction with a nonce that the work was not done for."""
    spoilt, at = bytearray(data), len(data) - 68
    for nonce in count():
        spoilt[at : at + 4] = nonce.to_bytes(4, "little")
        try:
            transaction.parse(bytes(spoilt), agent.config)
        except Refusal as refusal:
            if refusal.reason is Reason.PROOF_OF_WORK:
                break
    return bytes(spoilt)


def _own(agent: Agent, sent: Outgoing) -> list[transaction.Transaction]:
    """The liar's own transactions in a message that it broadcasts."""
    _, parsed = messages.parse(sent.data, agent.config)
    if not isinstance(parsed, Transactions) or sent.to is not None:
        return []
    held = (agent.ledger.find(transaction.id_of(data)) for data in parsed.data)
    return [tx for tx in held if tx is not None and tx.author == agent.identity.author]


def _sealed(
    agent: Agent,
    sequence: int,
    previous: bytes | None,
    lamport: int,
    references: tuple[bytes, ...],
    identity: Identity | None = None,
) -> bytes:
    """An empty transaction with these numbers."""
    signer = identity or agent.identity
    args = (sequence, previous, lamport, references, Payload())
    return transaction.seal(signer, agent.config, *args)


def _packed(agent: Agent, data: bytes, to: bytes | None = None) -> Outgoing:
    me = agent.identity.author
    return Outgoing(messages.encode(Transactions((data,)), agent.config, me), to)


def _points(cycle: Cycle) -> Floats:
    return np.asarray(cycle.points, np.float64).reshape(-1, 3)


def _into_sensor(cycle: Cycle, points: Floats) -> Floats:
    pose = np.asarray(cycle.pose, np.float64)
    return np.asarray((points - pose[:3, 3]) @ pose[:3, :3])


def _with_points(cycle: Cycle, points: Floats) -> Cycle:
    """The cycle with other points, which no longer have ids or colours."""
    return replace(cycle, points=points, ids=None, colors=None, removed=None)
