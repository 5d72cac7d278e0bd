"""What it costs to refuse: messages of strangers and liars, against what it costs to make them.

A closed fleet with the default proof of work. Every row is one kind of flood, one transaction a
message, into an agent that has the map of one robot; the median of some
rounds, in microseconds of processor time. To send is what a process pays that only hands such
messages, made before, to Zenoh on loopback; to hear, what the other end pays until the message
could be looked at. Without Zenoh these two are left out.
"""

from __future__ import annotations

import socket
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from dagmap import Agent, Config, Cycle, GraphConfig, Identity, Rejected, Waiting
from dagmap.messages import Transactions, encode
from dagmap.payload import Payload
from dagmap.transaction import seal

COUNT, ROUNDS = 200, 5
SENT = 5000  # messages of a flood over the network
# Says what it paid, once the other end has said that all have come.
FLOODER = """
import sys, time, zenoh
port, size, count = map(int, sys.argv[1:])
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{port}"]')
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    data, control = bytes(size), zenoh.CongestionControl.BLOCK
    publisher = session.declare_publisher("flood", congestion_control=control)
    while not publisher.matching_status.matching:
        time.sleep(0.01)
    before = time.process_time()
    for _ in range(count):
        publisher.put(data)
    sys.stdin.readline()
    print(time.process_time() - before)
"""
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
    return [*map(with_network, rows), accepted(mine)]


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


def with_network(row: dict[str, Any]) -> dict[str, Any]:
    """What the network costs both ends besides."""
    return {**row, **over_network(row["bytes"])}


@cache
def over_network(size: int) -> dict[str, float]:
    """Microseconds a message of a flood, at the end that sends and at the one that hears."""
    try:
        import zenoh
    except ImportError:
        return {}
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        port = sock.getsockname()[1]
    config = zenoh.Config()
    for key, value in (
        ("mode", '"router"'),
        ("listen/endpoints", f'["tcp/127.0.0.1:{port}"]'),
        ("scouting/multicast/enabled", "false"),
    ):
        config.insert_json5(key, value)
    came, begun, heard = 0, 0.0, threading.Event()

    def hear(sample: zenoh.Sample) -> None:
        nonlocal came, begun
        sample.payload.to_bytes()
        came += 1
        if came == 1:
            begun = time.process_time()
        elif came == SENT:
            heard.set()

    argv = [sys.executable, "-c", FLOODER, str(port), str(size), str(SENT)]
    with zenoh.open(config) as session:
        session.declare_subscriber("flood", hear)
        with subprocess.Popen(
            argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as flooder:
            assert heard.wait(60)
            hearing = time.process_time() - begun
            said, _ = flooder.communicate("\n")
    return {
        "us to send": round(1e6 * float(said) / SENT, 1),
        "us to hear": round(1e6 * hearing / SENT, 1),
    }


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
