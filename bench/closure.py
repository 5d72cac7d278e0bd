"""A loop closure: what is sent, the longest call meanwhile, and the re-fold against a plain one."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from agent import CYCLE, CONFIG, cycles
from dagmap import Agent, Config, Cycle, Identity
from dagmap.consensus import Consensus
from dagmap.transaction import parse


def plain_fold(agent: Agent, first: int) -> float:
    consensus = Consensus(agent.config)
    parsed = [parse(tx.data, agent.config) for tx in agent.ledger]
    a = time.perf_counter()
    for tx in parsed[:first]:
        consensus.add(tx)
    consensus.advance()
    b = time.perf_counter()
    for tx in parsed[first:]:
        consensus.add(tx)
    consensus.advance()
    c = time.perf_counter()
    print("plain: before", b - a, "after", c - b)
    a = time.perf_counter()
    for tx in parsed[first:]:
        tx.decode_again(agent.config)
    print("decode", time.perf_counter() - a)
    return c - b


def main(total=300_000, moved=100_000):
    stream = cycles(total)
    n = moved // CYCLE
    agent = Agent(Identity.from_seed(bytes(32)), CONFIG)
    times = []
    k = 0
    for c in stream:
        c = Cycle(
            c.stamp,
            c.pose,
            c.points,
            ids=np.arange(k, k + len(c.points), dtype=np.uint64),
            colors=c.colors,
        )
        k += len(c.points)
        t = time.perf_counter()
        agent.observe(c, c.stamp)
        t1 = time.perf_counter()
        agent.tick(c.stamp)
        times.append((t1 - t, time.perf_counter() - t1))
    print("normal observe/tick max", np.array(times).max(0), "median", np.median(times, 0))
    agent.outbox()
    last = len(stream)
    stamps = [c.stamp for c in stream[-n:]]
    poses = []
    for i, c in enumerate(stream[-n:]):
        p = np.array(c.pose)
        p[:3, 3] += [0.3 * i / n, 0.2 * i / n, 0.1]
        poses.append(p)
    first = next(
        i
        for i, tx in enumerate(agent.ledger)
        if tx.payload.anchors and tx.payload.anchors[-1].cycle >= last - n
    )
    t = time.perf_counter()
    agent.observe(
        Cycle(stream[-1].stamp + 0.1, np.eye(4), np.zeros((0, 3)), moved=(stamps, poses)), 1e4
    )
    print("observe closure", time.perf_counter() - t)
    print("bytes", sum(len(o.data) for o in agent.outbox()))
    t = time.perf_counter()
    agent.tick(1e4)
    t1 = time.perf_counter()
    print("tick", t1 - t, agent.consensus.pending)
    agent._advance()
    print("refold", time.perf_counter() - t)
    plain_fold(agent, first)
    # profile parts
    con = agent.consensus
    keys = [c.key for c in con.contributions()][first:]
    t = time.perf_counter()
    con._restale(keys)
    con._undo()
    print("undo", time.perf_counter() - t)
    cs = [con._contributions[k] for k in keys]
    t = time.perf_counter()
    for c in cs:
        con._walk(c, -1)
    print("walk -1", time.perf_counter() - t)
    t = time.perf_counter()
    for c in cs:
        c.place(con.placement, con._config)
    print("place", time.perf_counter() - t)
    t = time.perf_counter()
    for c in cs:
        con._walk(c, 1)
    print("walk +1", time.perf_counter() - t)
    con._stale.clear()
    t = time.perf_counter()
    con.advance()
    print("apply", time.perf_counter() - t)
    gone = np.arange(total - moved, total, dtype=np.uint64)
    t = time.perf_counter()
    agent.observe(Cycle(stream[-1].stamp + 0.2, np.eye(4), np.zeros((0, 3)), removed=gone), 1e4 + 1)
    print("observe removed", time.perf_counter() - t, sum(len(o.data) for o in agent.outbox()))
    t = time.perf_counter()
    agent._advance()
    print("refold", time.perf_counter() - t)


main(20_000, 10_000)
print()
main()
