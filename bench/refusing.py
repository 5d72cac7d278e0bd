"""What it costs to refuse: messages of strangers and liars, against what it costs to make them.

A closed fleet with the default proof of work. Every row is one kind of flood, one transaction a
message, into an agent that has the map of one robot; the median of some
rounds, in microseconds of processor time.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from dagmap import Agent, Config, Cycle, GraphConfig, Identity, Rejected, Waiting
from dagmap.messages import Transactions, encode
from dagmap.payload import Payload
from dagmap.transaction import seal

COUNT, ROUNDS = 200, 5
FLEET = Identity.from_seed(b"fleet".ljust(32, b"."))
CONFIG = Config(
    fleet_key=FLEET.public_key.hex(),
    graph=GraphConfig(reference_pitch=0.25, max_parent_distance=0.75),
)


def run() -> list[dict[str, Any]]:
    """One row a flood: microseconds to refuse a message and to make it, and its size in bytes."""
    honest, liar = enrolled(b"honest"), Identity.from_seed(b"liar".ljust(32, b"."))
    speaker, agent = Agent(honest, CONFIG), Agent(enrolled(b"listener"), CONFIG)
    points = np.random.default_rng(0).uniform(1, 2, (1000, 3))
    speaker.observe(Cycle(0.0, np.eye(4), points), 0.0)
    for out in speaker.outbox():
        agent.receive(out.data, 0.0)
    (mine,) = (tx.data for tx in speaker.ledger)
    payload = speaker.ledger.chain(honest.author).main[0].decode_again(CONFIG)

    def later(n: int) -> bytes:
        return seal(liar, CONFIG, 1, n.to_bytes(32, "big"), 2, (), payload)

    def stolen(n: int) -> bytes:
        return seal(liar, CONFIG, 0, None, 1 + n, (), payload)

    def forged(n: int) -> bytes:
        return mine[:-4] + n.to_bytes(4, "big")

    def lazy(n: int) -> bytes:
        return mine[:-68] + n.to_bytes(4, "big") + mine[-64:]

    def bare(n: int) -> bytes:
        return seal(liar, CONFIG, 0, None, 1 + n, (), Payload())

    kinds: dict[str, Callable[[int], bytes]] = {
        "a message held already": lambda n: mine,
        "a stranger's later transaction": later,
        "a stranger's first, no certificate": bare,
        "a stranger's first, a stolen certificate": stolen,
        "a robot's first, another signature": forged,
        "no proof of work": lazy,
    }
    rows = [measure(agent, name, make) for name, make in kinds.items()]
    return [*rows, accepted(mine)]


def enrolled(name: bytes) -> Identity:
    seed = name.ljust(32, b".")
    public_key = Identity.from_seed(seed).public_key
    return Identity.from_seed(seed, FLEET.certify(CONFIG.fleet_id, public_key, name.decode()))


def measure(agent: Agent, name: str, make: Callable[[int], bytes]) -> dict[str, Any]:
    costs, made = [], []
    for r in range(ROUNDS):
        numbers = range(r * COUNT, (r + 1) * COUNT)
        started = time.process_time()
        items = [make(n) for n in numbers]
        made.append((time.process_time() - started) / COUNT)
        data = [encode(Transactions((item,)), CONFIG, b"stranger") for item in items]
        started = time.process_time()
        events = [event for message in data for event in agent.receive(message, 0.0)]
        costs.append((time.process_time() - started) / COUNT)
        assert all(isinstance(event, (Rejected, Waiting)) for event in events)
    return row(name, len(items[0]), statistics.median(costs), statistics.median(made))


def accepted(data: bytes) -> dict[str, Any]:
    """The same transaction where it is welcome, for comparison."""
    costs = []
    message = encode(Transactions((data,)), CONFIG, b"stranger")
    for _ in range(20):
        agent = Agent(enrolled(b"listener"), CONFIG)
        started = time.process_time()
        agent.receive(message, 0.0)
        costs.append(time.process_time() - started)
    return row("accepted, 1,000 features", len(data), statistics.median(costs), None)


def row(name: str, size: int, cost: float, made: float | None) -> dict[str, Any]:
    return {
        "flood": name,
        "bytes": size,
        "us to refuse": round(1e6 * cost, 1),
        "us to make": None if made is None else round(1e6 * made, 1),
    }
