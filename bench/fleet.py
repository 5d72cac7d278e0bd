"""A fleet of real processes on loopback: processor time, delay, join, restart, a bad link.

Minutes, so `dagmap bench` runs it only by name. One part alone:
`python bench/fleet.py join --json`. Every robot has the default configuration; its SLAM
puts out ten cycles a second of 1,000 points, all of them new (the worst case).
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from agent import cycles
from dagmap import Agent, Config, Cycle, Identity
from dagmap.io.sources import save_cycles
from dagmap.io.store import Store
from fleet_robots import FLEET, Link, Robot, running, until

BY_NAME_ONLY = True
POINTS, HERTZ = 1000, 10
WARM = 5.0  # s until the kernels are loaded and everybody is connected
Row = dict[str, Any]


def run() -> list[Row]:
    """One row a number: what was measured, and what is wanted."""
    return [row for part in PARTS for row in measure(part)]


def measure(part: str, **more: Any) -> list[Row]:
    with tempfile.TemporaryDirectory() as folder:
        rows = PARTS[part](Path(folder), **more)
    return [{"part": part, **row} for row in rows]


def steady(folder: Path, seconds: float = 30.0) -> list[Row]:
    """Three robots that all reach each other: what each costs, and how fast news spreads."""
    robots: list[Robot] = []
    for i in range(3):
        others = tuple(robot.port for robot in robots)
        walk = record(folder / f"walk{i}.npz", seconds, i)
        robots.append(Robot(folder, f"robot{i}", others, walk))
    with running(*robots):
        for i, robot in enumerate(robots):  # each when it is ready: their cycles need not coincide
            robot.start("--wait-for", str(i))
        for robot in robots:
            robot.wait_for("observed")
        time.sleep(WARM)
        since = time.monotonic_ns()
        before, at = [robot.cpu() for robot in robots], time.monotonic()
        time.sleep(seconds - WARM - 2.0)
        passed = time.monotonic() - at
        spent = [robot.cpu() - first for robot, first in zip(robots, before, strict=True)]
        settle(robots, int(seconds * HERTZ))
        memory = max(robot.peak() for robot in robots)
    took = observe_ms(robots[0])
    delays = spread_ms(robots, since)
    return [
        row("processor share of a robot, most", max(spent) / passed, 0.25),
        row("sealed to folded on every robot, 95 % within, ms", quantile(delays, 95), 150),
        row("the same, median, ms", quantile(delays, 50)),
        row("the same, 99 %, ms", quantile(delays, 99)),
        row("of it within 150 ms", float(np.mean(delays <= 150)), 0.95),
        row("transactions", len(delays)),
        row("observe, median, ms", quantile(took, 50)),
        row("observe, 99 %, ms", quantile(took, 99)),
        row("memory, peak, MB", memory / 1e6),
    ]


def restart(folder: Path, features: int = 10**6) -> list[Row]:
    """A robot that holds a big map starts again: first without a checkpoint, then with one."""
    robot = Robot(folder, "robot")
    size, count = fill(robot, features)
    with running(robot):
        cold = robot.start().wait_for("started")
        digest = until(robot.status, "status")["digest"]
        robot.stop()
        kept = robot.ledger.with_name("checkpoint").stat().st_size
        warm = robot.start().wait_for("started")
        answer = until(robot.status, "status")
        assert answer["digest"] == digest and answer["transactions"] == count
        robot.stop()
    return [
        row("restart with a checkpoint, s", warm, 3.0),
        row("restart without, s", cold),
        row("ledger, MB", size / 1e6),
        row("checkpoint, MB", kept / 1e6),
    ]


def join(folder: Path, features: int = 10**6) -> list[Row]:
    """A robot with an empty ledger meets one that holds a big map."""
    giver = Robot(folder, "giver")
    joiner = Robot(folder, "joiner", (giver.port,))
    size, count = fill(giver, features)
    with running(giver, joiner):
        giver.start().wait_for("started")
        until(giver.status, "status")
        started = joiner.start().wait_for("started")

        def last() -> int:
            ends = [s["ended_ns"] for s in joiner.lines("step") if int(s["transactions"]) == count]
            return int(ends[-1]) if ends else 0

        took = (until(last, "the joiner", 0.2) - joiner.began) / 1e9
        answers = [robot.status() for robot in (giver, joiner)]
        assert answers[0]["digest"] == answers[1]["digest"]
        tables = answers[1]["traffic"]
        spent = sum(r["bytes"] for way in ("sent", "received") for r in tables[way].values())
        memory = joiner.peak()
    return [
        row("join, from the start of the process to one map, s", took, 10.0),
        row("of it until it listens, s", started),
        row("bytes on the link, times the ledger", spent / size, 1.10),
        row("memory of the joiner, peak, MB", memory / 1e6),
    ]


def stall(folder: Path, seconds: float = 20.0) -> list[Row]:
    """Two robots over 8 Mbit/s: first as it is, then with 500 ms of nothing every two seconds."""
    took: dict[float, list[float]] = {}
    pace: dict[float, float] = {}
    settled = 0.0
    for length in (0.0, 0.5):
        place = folder / str(length)
        place.mkdir()
        a = Robot(place, "a", recording=record(place / "a.npz", seconds, 1))
        link = Link(a.port, 1e6, length)
        b = Robot(place, "b", (link.port,), record(place / "b.npz", seconds, 2))
        with running(a, b):
            for robot in (a, b):
                robot.start("--wait-for", "1")
            settled = settle([a, b], int(seconds * HERTZ))
        link.close()
        took[length] = observe_ms(a) + observe_ms(b)
        pace[length] = max(interval_ms(a), interval_ms(b))
    with_, without = quantile(took[0.5], 99), quantile(took[0.0], 99)
    return [
        row("observe, 99 %, with stalls / without", with_ / without, 1.2),
        row("observe, 99 %, without stalls, ms", without),
        row("observe, 99 %, with stalls, ms", with_),
        row("between cycles, 99 %, without stalls, ms", pace[0.0]),
        row("between cycles, 99 %, with stalls, ms", pace[0.5]),
        row("from the last cycle to one map, with stalls, s", settled),
    ]


def record(path: Path, seconds: float, seed: int) -> Path:
    """A robot's walk along the corridor: points with ids and colours."""
    count = int(seconds * HERTZ)
    walk = cycles(count * POINTS, seed)
    save_cycles(path, (with_ids(cycle, i * POINTS) for i, cycle in enumerate(walk)))
    return path


def with_ids(cycle: Cycle, first: int) -> Cycle:
    ids = np.arange(first, first + len(cycle.points), dtype=np.uint64)
    return Cycle(cycle.stamp, cycle.pose, cycle.points, ids=ids, colors=cycle.colors)


def fill(robot: Robot, features: int) -> tuple[int, int]:
    """Give a robot the ledger of three others. Returns its bytes and its transactions."""
    config, rows = Config(fleet=FLEET), []
    for i in range(3):
        author = Agent(Identity.from_seed(bytes([i + 1]) * 32), config)
        for cycle in cycles(features // 3, i):
            author.observe(cycle, cycle.stamp)
            author.outbox()
        rows += list(author.ledger)
    rows.sort(key=lambda tx: tx.key)
    robot.ledger.parent.mkdir(mode=0o700)
    with Store.open(robot.ledger, config.fleet_id) as store:
        store.append_many((tx.id, tx.data) for tx in rows)
    return sum(len(tx.data) for tx in rows), len(rows)


def settle(robots: list[Robot], count: int) -> float:
    """Wait until all have taken all their cycles and hold one map; seconds from the first to it."""

    def done() -> bool:
        return all(len(robot.lines("observed")) == count for robot in robots)

    until(done, "all cycles", 0.5)
    over = time.monotonic()

    def equal() -> bool:
        answers = [robot.status() for robot in robots]
        digests = {answer.get("digest") for answer in answers}
        return len(digests) == 1 and not any(answer["lag"]["to_issue"] for answer in answers)

    until(equal, "one map", 0.2)
    return time.monotonic() - over


def spread_ms(robots: list[Robot], since: int) -> np.ndarray[Any, Any]:
    """From the step that sealed a transaction to the last robot's that has folded it, ms each.

    Left out is what was sealed before `since`, ns: not all robots were there.
    """
    sealed: dict[str, int] = {}
    folded: dict[str, list[int]] = {}
    for robot in robots:
        for step in robot.lines("step"):
            for id_ in filter(None, step["sealed"].split(",")):
                sealed[id_] = int(step["begun_ns"])
            for id_ in filter(None, step["folded"].split(",")):
                folded.setdefault(id_, []).append(int(step["ended_ns"]))
    assert all(len(folded[id_]) == len(robots) for id_ in sealed)
    late = ((max(folded[id_]) - when) / 1e6 for id_, when in sealed.items() if when >= since)
    return np.array(list(late))


def observe_ms(robot: Robot) -> list[float]:
    """What `Agent.observe` took, without the first cycles, which load kernels."""
    return [float(line["ms"]) for line in robot.lines("observed")[HERTZ:]]


def interval_ms(robot: Robot) -> float:
    """99 % of cycles were taken within this of the one before."""
    stamps = [datetime.fromisoformat(line["time"]) for line in robot.lines("observed")[HERTZ:]]
    gaps = [(b - a).total_seconds() * 1e3 for a, b in itertools.pairwise(stamps)]
    return quantile(gaps, 99)


def quantile(values: Any, percent: float) -> float:
    return float(np.percentile(values, percent))


def row(name: str, value: float, wanted: float | None = None) -> Row:
    return {"what": name, "measured": value, "wanted": "" if wanted is None else wanted}


PARTS: dict[str, Callable[..., list[Row]]] = {
    "steady": steady,
    "restart": restart,
    "join": join,
    "stall": stall,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}")
    parser.add_argument("--seconds", type=float, help="of steady and stall")
    parser.add_argument("--features", type=int, help="of restart and join")
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    wrong = [part for part in chosen.parts if part not in PARTS]
    if wrong:
        parser.error(f"no part {wrong[0]}; there are: {', '.join(PARTS)}")
    rows = []
    for part in chosen.parts or PARTS:
        name = "seconds" if part in ("steady", "stall") else "features"
        given = getattr(chosen, name)
        rows += measure(part, **({} if given is None else {name: given}))
    for each in [rows] if chosen.json else rows:
        text = json.dumps(each, indent=2 if chosen.json else None)
        sys.stdout.write(text + "\n")


if __name__ == "__main__":
    main()
