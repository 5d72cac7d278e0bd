"""Promise 1: the map is a pure function of the set of accepted transactions.

Runs of robots whose SLAMs repeat, remove and move points are delivered in any order, duplicated,
in pieces, with folding in between. Every robot must end with one digest: that of a fold from
scratch. A fold in the order of arrival, planted here, must be caught by the same test.
"""

from __future__ import annotations

import random
from functools import lru_cache

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dagmap import Agent, Config, FoldConfig, Identity
from dagmap.consensus import Consensus
from dagmap.contribution import Key
from dagmap.ledger import Ledger
from dagmap.messages import Transactions, encode
from dagmap.transaction import Transaction, parse
from scene import QUICK, agent, cycles, secret

PAPER = msgspec.structs.replace(QUICK, fold=FoldConfig(preset="paper"))


@lru_cache(maxsize=16)
def run(seed: int, config: Config = QUICK, robots: int = 3) -> tuple[bytes, ...]:
    """Transactions of robots that map side by side and hear each other half of the time."""
    rng = random.Random(seed)
    agents = [agent(f"robot {i}", config) for i in range(robots)]
    streams = [list(cycles(10 * seed + i, count=5)) for i in range(robots)]
    for step in range(5):
        for robot, stream in zip(agents, streams, strict=True):
            robot.observe(stream[step], float(step))
            for out in robot.outbox():
                for other in agents:
                    if other is not robot and rng.random() < 0.5:
                        other.receive(out.data, float(step))
    everything = {tx.id: tx.data for robot in agents for tx in robot.ledger}
    return tuple(everything.values())


def from_scratch(transactions: tuple[bytes, ...], config: Config = QUICK) -> bytes:
    """The digest of one ordered fold without an undo."""
    ledger, consensus = Ledger(config), Consensus(config)
    for data in transactions:
        ledger.add(parse(data, config))
    for tx in sorted(ledger, key=lambda tx: tx.key):
        consensus.add(tx)
    return consensus.digest()


def deliver(order: list[bytes], rng: random.Random, config: Config = QUICK) -> Agent:
    """One robot that gets these in this order, in random handfuls, folding now and then."""
    robot = agent("listener", config)
    at = 0
    while at < len(order):
        handful = order[at : at + rng.randint(1, 4)]
        at += len(handful)
        robot.receive(encode(Transactions(tuple(handful)), config, b"somebody"), float(at))
        if rng.random() < 0.4:
            robot.consensus.advance(rng.choice([None, 1, 60]))
    return robot


def holds(order: list[bytes], rng: random.Random, truth: bytes, config: Config = QUICK) -> bool:
    """The promise for one delivery."""
    robot = deliver(order, rng, config)
    return len(robot.ledger) == len(set(order)) and robot.digest() == truth


@pytest.mark.parametrize("config", [QUICK, PAPER], ids=["default", "paper"])
@given(rng=st.randoms(use_true_random=False), seed=st.integers(0, 4))
@settings(max_examples=25, deadline=None)
def test_any_delivery_ends_with_one_digest(config: Config, rng: random.Random, seed: int) -> None:
    transactions = run(seed, config)
    order = [*transactions, *rng.choices(transactions, k=6)]
    rng.shuffle(order)
    assert holds(order, rng, from_scratch(transactions, config), config)


def test_the_digest_tells_maps_apart() -> None:
    digests = {from_scratch(run(seed)) for seed in range(4)}
    assert len(digests) == 4
    assert from_scratch(run(0)) != from_scratch(run(0)[:-1])


@given(st.randoms(use_true_random=False))
@settings(max_examples=15, deadline=None)
def test_digest_and_map_depend_on_no_key_and_no_table(rng: random.Random) -> None:
    transactions = run(2)
    one = Agent.restore(Identity.from_seed(secret("x")), QUICK, transactions)
    shuffled = list(transactions)
    rng.shuffle(shuffled)
    two = Agent.restore(Identity.from_seed(secret("y")), QUICK, shuffled)
    assert one.digest() == two.digest()


def test_a_fold_in_order_of_arrival_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    """Algorithm 2 as printed folds what comes as it comes."""
    transactions = run(1)
    truth = from_scratch(transactions)
    arrivals: dict[bytes, int] = {}

    def arrival(tx: Transaction) -> Key:
        return (arrivals.setdefault(tx.id, len(arrivals)), tx.author, tx.sequence)

    monkeypatch.setattr(Transaction, "key", property(arrival))
    caught = 0
    for seed in range(10):
        arrivals.clear()
        rng = random.Random(seed)
        order = list(transactions)
        rng.shuffle(order)
        caught += not holds(order, rng, truth)
    assert caught >= 5


def test_late_transactions_cost_one_undo_for_all_of_them() -> None:
    transactions = run(3)
    ordered = sorted((parse(data, QUICK) for data in transactions), key=lambda tx: tx.key)
    late = [tx for tx in ordered if tx.author == ordered[2].author]
    early = [tx for tx in ordered if tx.author != ordered[2].author]
    behind = sum(tx.key > late[0].key for tx in early)
    consensus = Consensus(QUICK)
    for tx in early:
        consensus.add(tx)
    assert consensus.advance()[1] == len(early)
    for tx in late:
        consensus.add(tx)
    undone, applied = consensus.advance()
    assert 0 < undone == behind < len(early) and applied == behind + len(late)
    assert not consensus.pending and consensus.digest() == from_scratch(transactions)
