"""Section 5: what a cycle costs, measured, and as the paper's equations and DAGmap's own model
predict it, against n(U), N_c and N_G; map completion against N_c and V_th; the cost of steering.

Writes out/overhead/overhead.json, and overhead.png where matplotlib is installed.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from dagmap import Agent, Config, Cycle, GraphConfig, Identity
from dagmap.config import IssuanceConfig, OverheadConfig
from dagmap.equations import Model, Size, Work
from dagmap.model import DagmapError
from dagmap.steering import Steering
from dagmap.sync import Echo, Peer
from scenes import surface

Row = dict[str, Any]
FEATURES = 1000  # N_f: of a cycle
LEARNT = 10_000  # n(U) up to which the models are fitted; beyond they predict
WANTED = (1, 8, 64)  # V_th
PEERS = (0, 3, 30)  # of the robot whose steering is measured
FITTED = ("l_dist_ns", "l_search_ns", "insert_us", "send_us", "merge_us")  # with the first row
OUT = Path("out/overhead")


def config(n_c: int = 2, v_th: int = 1) -> Config:
    graph = GraphConfig(n_c=n_c, v_th=v_th, reference_pitch=0.25, max_parent_distance=0.75)
    return Config(graph=graph, issuance=IssuanceConfig(repeats=0))


def cycles(count: int, seed: int = 1) -> Iterator[Cycle]:
    """A sensor that moves along a corridor, FEATURES points a cycle."""
    points = surface(count, seed) / 1000.0
    for i, start in enumerate(range(0, count, FEATURES)):
        batch, pose = points[start : start + FEATURES], np.eye(4)
        pose[:3, 3] = [batch[:, 0].min(), 2.0, 1.5]
        yield Cycle(float(i), pose, batch - pose[:3, 3])


class Robot:
    """An agent and what its cycles took of the processor."""

    def __init__(self, seed: int, n_c: int) -> None:
        self.agent = Agent(Identity.from_seed(bytes([seed]) * 32), config(n_c))
        self.n_c, self.before = n_c, Work()

    def work(self, cycle: Cycle, messages: list[bytes], now: float) -> tuple[list[bytes], Seen]:
        """One cycle: what it sends, and what it cost."""
        started = time.process_time()
        self.agent.observe(cycle, now)
        for message in messages:
            self.agent.receive(message, now)
        self.agent.tick(now)
        seconds = time.process_time() - started
        work = self.agent.steering.controller.work
        step, self.before = work.since(self.before), work.since(Work())
        said = [out.data for out in self.agent.outbox() if out.to is None]
        return said, Seen(step, Size(len(self.agent.observing.graph), self.n_c), seconds)


class Seen(NamedTuple):
    """A cycle of the robot that is watched."""

    work: Work
    size: Size
    seconds: float


def fly(most: int, n_c: int, others: int = 1, apart: bool = False) -> list[Seen]:
    """Cycles of a robot that maps until n(U) = most, and merges what so many others map.

    apart: it sends in every other cycle only, and merges in every third, so that the costs of
    inserting, sending and merging can be told apart.
    """
    robots = [Robot(1 + i, n_c) for i in range(1 + others)]
    first, views = robots[0], zip(*(cycles(most, 1 + i) for i in range(1 + others)), strict=True)
    heard: list[bytes] = []
    seen = []
    for now, (own, *theirs) in enumerate(views):
        first.agent.listening = apart and now % 2 == 0  # then nothing is issued
        messages, heard = ([], heard) if apart and now % 3 else (heard, [])
        seen.append(first.work(own, messages, float(now))[1])
        for robot, cycle in zip(robots[1:], theirs, strict=True):
            heard = heard + robot.work(cycle, [], float(now))[0]
    return seen


def predicted(
    flights: dict[tuple[int, int], list[Seen]],
    learn: Callable[..., bool],
    lessons: Iterable[Seen],
    further: Sequence[int] = (),
) -> list[Row]:
    """A row for decades of n(U) of each flight (N_c, N_G), and what both models make of it.

    learn: whether a cycle (n(U), N_c, N_G) is one that the models are fitted to.
    lessons: cycles beside these that they are fitted to, too.
    further: n(U) beyond a single flight, for which there is a prediction only.
    """
    models = {as_printed: Model(as_printed) for as_printed in (True, False)}
    for each in lessons:
        for model in models.values():
            model.add(*each)
    for (n_c, n_g), seen in flights.items():
        for each in seen:
            if learn(each.size.n_u, n_c, n_g):
                for model in models.values():
                    model.add(*each)
    rows = []
    for (n_c, n_g), seen in flights.items():
        picks = np.unique(np.geomspace(1, len(seen), 10).astype(int) - 1)
        for i in picks if len(flights) == 1 else [len(seen) - 1]:
            work, size, _ = seen[i]
            alike = seen[max(1, i - 4) : i + 5] if i else seen[:1]  # the first has nothing to merge
            around = [each.seconds for each in alike]
            row = {"n_u": size.n_u, "n_c": n_c, "n_g": n_g, "learnt": learn(size.n_u, n_c, n_g)}
            row["measured_ms"] = 1e3 * float(np.median(around))
            rows.append(row | _by_models(models, work, size))
    for n_u in further:
        row = {"n_u": n_u, "n_c": n_c, "n_g": n_g, "learnt": False, "measured_ms": None}
        rows.append(row | _by_models(models, work, Size(n_u, n_c)))
    found = models[True]
    costs = 1e9 * found.l_dist, 1e9 * found.l_search, *(1e6 * found.costs)
    rows[0] |= dict(zip(FITTED, costs, strict=True))
    return rows


def _by_models(models: dict[bool, Model], work: Work, size: Size) -> Row:
    return {
        "own_ms": 1e3 * models[True].own(work),
        "paper_printed_ms": 1e3 * models[True].paper(work, size),
        "paper_meant_ms": 1e3 * models[False].paper(work, size),
    }


def completion(n_c: int, v_th: int, count: int = 40) -> Row:
    """Cycles until a robot's map covers 95 % of a room that it looks at over and over."""
    rng = np.random.default_rng(4)
    wall = rng.uniform([2, -2, -1], [2.02, 2, 1], (4000, 3))
    agent = Agent(Identity.from_seed(bytes(32)), config(n_c, v_th))
    covered = []
    for i in range(count):
        points = wall[rng.choice(len(wall), 200, replace=False)] + rng.normal(0, 0.005, (200, 3))
        agent.observe(Cycle(float(i), np.eye(4), points), float(i))
        agent.tick(float(i))
        covered.append(len(np.unique(np.floor(agent.map.positions[:, 1:] / 0.1), axis=0)))
    everything = 40 * 20  # cells of the wall, 10 cm
    reached = [i + 1 for i, cells in enumerate(covered) if cells >= 0.95 * covered[-1]]
    return {
        "n_c": n_c,
        "v_th": v_th,
        "cycles_to_95": reached[0],
        "covered_at_end": covered[-1] / everything,
    }


def steering(peers: int, period: float = 1.0, ticks: int = 20, count: int = 300) -> Row:
    """What the controller and the model take of a cycle of so many seconds, with so many peers."""
    limits = OverheadConfig(fleet_bytes_per_second=1e5, cycle_share=0.8)
    limited = msgspec.structs.replace(config(), overhead=limits)
    agent = Agent(Identity.from_seed(bytes(32)), limited)
    steered, others = Steering(limited, agent.identity.author), agent.sync.peers
    spent = 0.0
    for i in range(count):
        echo = Echo(i, 0.01, i * period)
        others.update({bytes([n]) * 8: Peer({}, i, i * period, echo=echo) for n in range(peers)})
        started = time.process_time()
        steered.controller.work.inserted += 1000
        steered.controller.work.merged += 1000 * peers
        steered.controller.took(0.1)
        steered.controller.cycle(i * period, 1000 * i, 0, 0)
        steered.controller.announced(i * period, i, steered.shaper.sent)
        for tick in range(ticks):
            now = (i + tick / ticks) * period
            steered.look(agent.sync, now)
            steered.allowance(now)
            steered.shaper.release(now)
        spent += time.process_time() - started
    cost = 1e3 * spent / count
    return {
        "name": "steering",
        "peers": peers,
        "ms_a_cycle": cost,
        "share_of_a_1_s_cycle": cost / 1e3 / period,
    }


def measure(most: int, further: Sequence[int] = ()) -> dict[str, list[Row]]:
    """Cycles against n(U), N_c and N_G; see `predicted`."""
    fly(4000, 2)  # compiled and warm
    lessons = fly(LEARNT, 2, apart=True)
    degrees = {(n_c, 2): fly(min(most, 10_000), n_c) for n_c in (2, 3, 4, 6, 8)}
    fleets = {(2, 1 + n): fly(min(most, 4_000), 2, n) for n in (1, 3, 7, 15, 31)}
    return {
        "n_u": predicted(
            {(2, 2): fly(most, 2)}, lambda n_u, n_c, n_g: n_u <= LEARNT, lessons, further
        ),
        "n_c": predicted(degrees, lambda n_u, n_c, n_g: n_c <= 3, lessons),
        "n_g": predicted(fleets, lambda n_u, n_c, n_g: n_g <= 4, lessons),
    }


def run(most: int | None = None) -> list[Row]:
    """Rows. n(U) is measured up to 10^6, or to DAGMAP_BENCH_MOST (10^7 takes minutes and 3 GB), and
    predicted up to 10^7."""
    most = most or _asked()
    found = measure(most, [n_u for n_u in (10**6, 3 * 10**6, 10**7) if n_u > most])
    found["completion"] = [completion(n_c, v_th) for v_th in WANTED for n_c in (2, 4, 8)]
    rows, costs = [], []
    for name, part in found.items():
        for row in part:
            rows.append({"against": name, **{k: v for k, v in row.items() if k not in FITTED}})
        if FITTED[0] in part[0]:  # a table of their own: beside the others they would not fit
            costs.append({"learnt_from": name, **{key: part[0][key] for key in FITTED}})
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "overhead.json").write_text(json.dumps(found, indent=1) + "\n")
    draw(found, OUT / "overhead.png")
    written = {"written": ", ".join(sorted(str(path) for path in OUT.glob("overhead.*")))}
    return [*rows, *costs, *(steering(peers) for peers in PEERS), written]


def _asked() -> int:
    """How far is measured."""
    text = os.environ.get("DAGMAP_BENCH_MOST", "1000000")
    if not text.isdecimal() or int(text) < FEATURES:
        raise DagmapError(
            f"DAGMAP_BENCH_MOST = {text!r}: a number of features is wanted, {FEATURES} at least"
        )
    return int(text)


def draw(found: dict[str, list[Row]], path: Path) -> None:
    """Predictions and measurements; nothing where matplotlib is missing."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return
    figure = Figure(figsize=(9, 6.5), layout="constrained")
    axes = figure.subplots(2, 2)
    for axis, key in zip(axes.flat, ("n_u", "n_c", "n_g"), strict=False):
        draw_costs(axis, key, found[key])
    axes[0, 0].legend()
    for v_th in WANTED:
        rows = [row for row in found["completion"] if row["v_th"] == v_th]
        x, y = [row["n_c"] for row in rows], [row["cycles_to_95"] for row in rows]
        axes[1, 1].plot(x, y, "o-", label=f"V_th = {v_th}")
    axes[1, 1].set_title("cycles until 95 % of the final map")
    axes[1, 1].set_xlabel("N_c")
    axes[1, 1].set_ylim(bottom=0)
    axes[1, 1].legend()
    figure.savefig(path, dpi=100)


def draw_costs(axis: Any, key: str, rows: list[Row]) -> None:
    """S of a cycle against n_u, n_c or n_g: measured, and as the models predict it."""
    lines = {
        "measured_ms": ("measured", "black", "o-"),
        "own_ms": ("a cost per feature", "#2166d1", "--"),
        "paper_printed_ms": ("Eq. (2) to (5) as printed", "#d7301f", "--"),
        "paper_meant_ms": ("with 2^(2 log n) in Eq. (5)", "#e08214", ":"),
    }
    for column, (name, color, style) in lines.items():
        pairs = [(row[key], row[column]) for row in rows if row[column] is not None]
        axis.plot(*zip(*pairs, strict=True), style, color=color, label=name, markersize=3)
    if key == "n_u":
        axis.set_xscale("log")
        axis.set_yscale("log")
    else:
        axis.set_ylim(bottom=0)
    axis.set_title(f"S of a cycle of {FEATURES} features, ms")
    axis.set_xlabel({"n_u": "n(U) of a robot", "n_c": "N_c", "n_g": "N_G, robots"}[key])
