"""A whole agent: insert, seal, sign, encode, decode, verify, fold; what it holds in memory; the
cost of a transaction that comes late."""

from __future__ import annotations

import gc
import time
from typing import Any

import numpy as np

from dagmap import Agent, Config, Cycle, GraphConfig, Identity
from dagmap.consensus import Consensus
from dagmap.ledger import Ledger
from dagmap.transaction import parse, seal
from scenes import surface

CYCLE = 1000  # features a cycle
CONFIG = Config(graph=GraphConfig(reference_pitch=0.25, max_parent_distance=0.75))


def cycles(count: int, seed: int = 1) -> list[Cycle]:
    """A sensor that moves along a corridor and sees what is around it, in its own frame."""
    points = surface(count, seed) / 1000.0
    rng = np.random.default_rng(seed)
    out = []
    for i, start in enumerate(range(0, count, CYCLE)):
        batch = points[start : start + CYCLE]
        pose = np.eye(4)
        pose[:3, 3] = [batch[:, 0].min(), 2.0 + 2.0 * np.sin(batch[:, 0].min() / 7.0), 1.5]
        colors = rng.integers(0, 256, (len(batch), 3)).astype(np.uint8)
        out.append(Cycle(0.1 * i, pose, batch - pose[:3, 3], colors=colors))
    return out


def resident() -> int:
    """Bytes of this process in memory."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096


def whole_agent(count: int) -> list[dict[str, Any]]:
    stream = cycles(count)
    gc.collect()
    before = resident()
    agent = Agent(Identity.from_seed(bytes(32)), CONFIG)
    size = issued = 0
    started = time.perf_counter()
    for cycle in stream:
        agent.observe(cycle, cycle.stamp)
        agent.tick(cycle.stamp)
        size += sum(len(out.data) for out in agent.outbox())
    seconds = time.perf_counter() - started
    issued = agent.ledger.features(agent.identity.author)
    grown = resident() - before
    data = [tx.data for tx in agent.ledger]
    listener = Agent(Identity.from_seed(bytes([1]) * 32), CONFIG)
    started = time.perf_counter()
    for item in data:
        listener._through_the_door(item)
    listener.tick(0.0)
    heard = time.perf_counter() - started
    started = time.perf_counter()
    digest = listener.digest()
    digest_s = time.perf_counter() - started
    assert digest == agent.digest()
    return [
        {"name": "whole agent", "features": count, "rate": count / seconds, "issued": issued},
        {"name": "a listener: decode, verify, fold", "features": issued, "rate": issued / heard},
        {"name": "digest", "nodes": len(listener.map), "seconds": digest_s},
        {
            "name": "growth of the process, everything",
            "features": count,
            "bytes_per_feature": grown / count,
            "graph": agent.observing.graph.nbytes / count,
            "consensus": agent.consensus.nbytes / count,
            "ledger": sum(map(len, data)) / count,
            "wire_bytes_per_feature": size / issued,
        },
    ]


def late(count: int, thousand: int = 1000) -> list[dict[str, Any]]:
    """One transaction that sorts at the half, then many, one by one and folded once."""
    per = 250
    payloads = Agent(Identity.from_seed(bytes(32)), CONFIG)
    transactions = []
    for cycle in cycles(count):
        for part in range(0, CYCLE, per):
            rows = slice(part, part + per)
            quarter = Cycle(
                cycle.stamp + part / 1e5, cycle.pose, cycle.points[rows], colors=cycle.colors[rows]
            )
            payloads.observe(quarter, quarter.stamp)
    ledger = Ledger(CONFIG)
    for tx in payloads.ledger:
        again = parse(tx.data, CONFIG)
        ledger.add(again)
        transactions.append(again)
    features = sum(tx.features for tx in transactions)
    consensus = Consensus(CONFIG)
    for tx in transactions:
        consensus.add(tx)
    plain = _timed(consensus.advance)
    latecomer = chain(b"late one", len(transactions) // 2, 1)
    one = _timed(lambda: [consensus.add(tx) for tx in latecomer], consensus.advance)
    batch = chain(b"late many", 1, thousand)

    def one_by_one() -> None:
        for tx in batch:
            consensus.add(tx)

    many = _timed(one_by_one, consensus.advance)
    return [
        {"name": "plain fold with rays", "features": features, "seconds": plain,
         "rate": features / plain},
        {"name": "one transaction at the half", "features": features, "seconds": one,
         "ratio_to_plain": one / plain},
        {"name": f"{thousand} late ones, one by one", "features": features, "seconds": many,
         "ratio_to_plain": many / plain},
    ]  # fmt: skip


def chain(name: bytes, lamport: int, count: int) -> list[Any]:
    """Transactions of one author that claim Lamport times from `lamport` on."""
    robot = Agent(Identity.from_seed(name.ljust(32)), CONFIG)
    for cycle in cycles(CYCLE * count, seed=5)[:count]:
        thin = Cycle(cycle.stamp, cycle.pose, cycle.points[:250], colors=cycle.colors[:250])
        robot.observe(thin, thin.stamp)
    out, previous = [], None
    for i, tx in enumerate(robot.ledger):
        payload = parse(tx.data, CONFIG).payload
        data = seal(robot.identity, CONFIG, i, previous, lamport + i, (), payload)
        out.append(parse(data, CONFIG))
        previous = out[-1].id
    return out


def _timed(*steps: Any) -> float:
    started = time.perf_counter()
    for step in steps:
        step()
    return time.perf_counter() - started


def run(count: int = 1_000_000) -> list[dict[str, Any]]:
    """Rows: rates in features/s, memory in bytes a feature, seconds."""
    whole_agent(5 * CYCLE)  # compiled and warm
    return whole_agent(count) + late(count)
