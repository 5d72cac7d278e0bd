"""What changes the past: a loop closure, mass withdrawal, transactions that come late.

Measured are the bytes sent, the longest call of the agent meanwhile, and the whole fold again
against a plain one (bytes to map) of all transactions from the first that is concerned.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from agent import CONFIG, CYCLE, chain, cycles
from dagmap import Agent, Config, Cycle, Identity
from dagmap.config import FoldConfig, IssuanceConfig
from dagmap.consensus import Consensus
from dagmap.ledger import Ledger
from dagmap.transaction import Transaction, parse

HALL = msgspec.structs.replace(CONFIG, fold=FoldConfig(max_ray=20.0))
SILENT = msgspec.structs.replace(CONFIG, issuance=IssuanceConfig(features_per_second=0.1))
NOTHING = np.zeros((0, 3))
TOTAL, MOVED = 300_000, 100_000


class Stopwatch:
    """The longest and the summed processor time of some calls, ms and s."""

    def __init__(self) -> None:
        self.longest = self.total = 0.0

    def __call__(self, call: Callable[..., object], *args: object) -> None:
        started = time.process_time()
        call(*args)
        took = time.process_time() - started
        self.longest, self.total = max(self.longest, 1000 * took), self.total + took


def mapped(config: Config, total: int) -> tuple[Agent, list[Cycle]]:
    """A robot that has seen so many points, with ids, and has said all of them; and its cycles."""
    agent, seen = Agent(Identity.from_seed(bytes(32)), config), []
    for i, cycle in enumerate(cycles(total)):
        ids = np.arange(i * CYCLE, i * CYCLE + len(cycle.points), dtype=np.uint64)
        seen.append(replace(cycle, ids=ids))
        agent.observe(seen[-1], cycle.stamp)
        agent.tick(cycle.stamp)
    agent.settle()
    agent.outbox()
    return agent, seen


def bent(seen: list[Cycle], moved: int) -> Cycle:
    """An empty cycle that moves those of the last `moved` points, the later the further."""
    last = seen[-(moved // CYCLE) :]
    poses = []
    for i, cycle in enumerate(last):
        poses.append(np.array(cycle.pose))
        poses[-1][:3, 3] += np.array([0.3, 0.2, 0.1]) * (i + 1) / len(last)
    stamps = [cycle.stamp for cycle in last]
    return Cycle(seen[-1].stamp + 0.1, np.eye(4), NOTHING, moved=(stamps, poses))


def followed(name: str, agent: Agent, cycle: Cycle) -> dict[str, Any]:
    """Hand the cycle in, and tick until all is out and folded."""
    observe, tick = Stopwatch(), Stopwatch()
    now, ticks = cycle.stamp, 0
    observe(agent.observe, cycle, now)
    while agent.holds_back or not agent.settled:
        now, ticks = now + 0.05, ticks + 1
        tick(agent.tick, now)
    sent = [out.data for out in agent.outbox()]
    return {
        "name": name,
        "longest_observe_ms": observe.longest,
        "longest_tick_ms": tick.longest,
        "ticks": ticks,
        "seconds": observe.total + tick.total,
        "bytes": sum(map(len, sent)),
    }


def plain(config: Config, data: list[bytes], first: int) -> float:
    """Seconds of a fold of the transactions from `first` on, on top of those before."""
    ledger, consensus = Ledger(config), Consensus(config)
    parsed = [parse(item, config) for item in data]
    for tx in parsed:
        ledger.add(tx)
        tx.drop_columns()
    _add(consensus, config, parsed[:first])
    consensus.advance()
    watch = Stopwatch()
    watch(lambda: (_add(consensus, config, parsed[first:]), consensus.advance()))
    return watch.total


def _add(consensus: Consensus, config: Config, transactions: Iterable[Transaction]) -> None:
    for tx in transactions:
        tx.payload = tx.decode_again(config)
        consensus.add(tx)


def closure(config: Config, name: str, total: int, moved: int) -> dict[str, Any]:
    agent, seen = mapped(config, total)
    data = [tx.data for tx in agent.ledger]
    first = len(data) - moved * len(data) // total
    row = followed(name, agent, bent(seen, moved))
    base = plain(config, data, first)
    return row | {"plain_seconds": base, "ratio": row["seconds"] / base}


def withdrawn(config: Config, name: str, total: int, gone: int) -> dict[str, Any]:
    agent, seen = mapped(config, total)
    ids = np.arange(total - gone, total, dtype=np.uint64)
    cycle = Cycle(seen[-1].stamp + 0.1, np.eye(4), NOTHING, removed=ids)
    return followed(name, agent, cycle)


def unissued(name: str, count: int, closing: Callable[[list[Cycle]], Cycle]) -> dict[str, Any]:
    """Points of which hardly any has gone out: the adjacency DAG is what changes."""
    agent, seen = mapped(SILENT, count)
    cycle, watch, ticks = closing(seen), Stopwatch(), 0
    watch(agent.observe, cycle, cycle.stamp)
    longest = watch.longest
    while agent.observing.rearranging:
        ticks += 1
        watch(agent.tick, cycle.stamp)
    row = {"longest_observe_ms": longest, "longest_tick_ms": watch.longest, "ticks": ticks}
    return {"name": name, **row, "seconds": watch.total}


def late(name: str, total: int, count: int, lamport: int) -> dict[str, Any]:
    """So many transactions of 250 points by another, dated from `lamport` on, a tick after each."""
    agent, _ = mapped(CONFIG, total)
    tick, receive = Stopwatch(), Stopwatch()
    changes, version = 0, agent.consensus.version
    for tx in chain(b"late", lamport, count):
        receive(agent.take, tx.data)
        tick(agent.tick, 1e6)
        changes, version = changes + (agent.consensus.version != version), agent.consensus.version
    while not agent.settled:
        tick(agent.tick, 1e6)
    return {
        "name": name,
        "longest_observe_ms": receive.longest,
        "longest_tick_ms": tick.longest,
        "seconds": tick.total,
        "new_maps": changes,
    }


def run(total: int = TOTAL, moved: int = MOVED) -> list[dict[str, Any]]:
    """Rows: ms of the longest call (of `take` where it is transactions that come), seconds, bytes.

    `seconds` is all calls together, `plain_seconds` a plain fold from bytes on, `ratio` of the two.
    """
    for config in (CONFIG, HALL):  # compiled and warm
        closure(config, "", 4 * CYCLE, 2 * CYCLE)
    withdrawn(CONFIG, "", 4 * CYCLE, 2 * CYCLE)
    unissued("", 4 * CYCLE, lambda seen: bent(seen, 2 * CYCLE))
    gc.collect()
    gc.freeze()  # as `dagmap agent` does
    return [
        closure(CONFIG, f"closure, {moved:,} of {total:,} points, rays of 5 m", total, moved),
        closure(CONFIG, f"closure of all {total:,}", total, total),
        closure(HALL, f"closure, {moved:,} points, rays of 20 m", total, moved),
        withdrawn(CONFIG, f"removed: {moved:,} issued points", total, moved),
        unissued(
            f"removed: {moved:,} points not issued",
            moved,
            lambda seen: Cycle(
                seen[-1].stamp + 0.1,
                np.eye(4),
                NOTHING,
                removed=np.arange(moved, dtype=np.uint64),
            ),
        ),
        unissued(f"moved: {moved:,} points not issued", moved, lambda seen: bent(seen, moved)),
        late("a thousand late transactions of 250 points, one by one", total, 1000, 1),
        late(f"a newcomer with {moved:,} points from Lamport time 1", total, moved // 250, 1),
    ]
