"""`Agent.receive`, end to end: several messages to one robot, in order and backwards.

It never raises, holds and answers within bounds, and what arrived in another order gives the same
map.
"""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

import numpy as np

from dagmap import Agent, Cycle, messages, wire
from dagmap.config import Config
from dagmap.ledger import Ledger
from dagmap.messages import Head, Heads, Transactions, Want
from dagmap.payload import Payload
from dagmap.transaction import id_of, parse, seal
from dagmap.wire import Reader, Refusal
from grammar import Flip, many, sized
from targets import Target
from targets._wire import CONFIG, ROBOTS, TRANSACTION, change, message, payloads

TALK = many(sized(message(TRANSACTION)))
_MOST = 12  # messages of one input
_MOST_ANSWER = 4 * CONFIG.sync.chunk_bytes  # to one message: chunks, envelopes, a question


def run(data: bytes) -> bool:
    return run_in(CONFIG, data)


def run_in(config: Config, data: bytes) -> bool:
    """The messages of an input, to a robot in the fleet of this configuration."""
    said = []
    reader = Reader(data)
    try:
        while reader.left and len(said) < _MOST:
            said.append(reader.take(reader.number()))
    except Refusal:
        return False
    one, two = _told(config, said), _told(config, said[::-1])
    if _settled(one) and _settled(two):
        assert one.digest() == two.digest(), "the order of arrival shows in the map"
    return len(one.ledger) > 0


def _told(config: Config, said: list[bytes]) -> Agent:
    """An agent that has heard all of it three times, so that what was refused can come again."""
    agent = Agent(ROBOTS[2], config)
    for repeat in range(3):
        for item in said:
            agent.receive(item, float(repeat))
            answer = sum(len(out.data) for out in agent.outbox())
            assert answer < _MOST_ANSWER, f"{answer} bytes in answer to one message"
        agent.tick(float(repeat))
        for out in agent.outbox():
            messages.parse(out.data, config)
    agent.frame()
    assert np.isfinite(agent.map.positions).all() and isinstance(agent.robots, dict)
    return agent


def _settled(agent: Agent) -> bool:
    return not agent.ledger.missing()


def mutate(data: bytes, rng: Random, flip: Flip) -> bytes:
    return change(data, TALK, rng, flip)


def talk(*items: messages.Message, config: Config = CONFIG) -> bytes:
    """Messages as one input."""
    encoded = [messages.encode(item, config, ROBOTS[0].author) for item in items]
    return b"".join(wire.number(len(data)) + data for data in encoded)


def seeds() -> Iterator[bytes]:
    first, second, _ = ROBOTS
    chain = walk(CONFIG)
    yield talk(Transactions(tuple(chain)))
    yield talk(*(Transactions((data,)) for data in reversed(chain)))
    for sample in payloads():
        yield talk(Transactions((seal(first, CONFIG, 0, None, 1, (), sample),)))
    start = seal(first, CONFIG, 0, None, 1, (), Payload(name="a"))
    fork = [seal(first, CONFIG, 1, id_of(start), 2, (), Payload(name=n)) for n in "bc"]
    after = seal(second, CONFIG, 0, None, 3, (id_of(fork[1]),), Payload())
    yield talk(Transactions((start, *fork, after)))
    tip = id_of(start)[:8]
    yield talk(
        Transactions((start,)),
        Heads(
            3,
            ((ROBOTS[2].author, 1, 5),),
            (Head(first.author, 4, tip), Head(second.author, 1, tip, 1)),
        ),
        Transactions((), more=True),
        Want(((first.author, 0, 9),), (id_of(start), bytes(32)), (second.author,)),
    )


def walk(config: Config) -> list[bytes]:
    """What a robot says that sees, sees again, withdraws and moves."""
    agent, rng = Agent(ROBOTS[0], config), np.random.default_rng(5)
    points = rng.normal(0, 0.05, (14, 3)) + np.array([1.0, 0, 0])
    pose = np.eye(4)
    for i in range(3):
        agent.observe(
            Cycle(
                stamp=float(i),
                pose=pose,
                points=points,
                ids=np.arange(14) + 7 * i,
                moved=((0.0,), (pose,)) if i == 2 else None,
                removed=(2, 3) if i == 1 else None,
            ),
            float(i),
        )
    ledger: Ledger = agent.ledger
    return [parse(tx.data, config).data for tx in ledger]


TARGET = Target(run, mutate, seeds, {}, max_len=16_384)
