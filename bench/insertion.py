"""How fast features enter the adjacency DAG, in usual and in the worst orders; what they hold.

Times are the processor's, one core, the median of some rounds; every rate stands beside a cKDTree
of the same points built in the same run (where scipy is installed).
"""

from __future__ import annotations

import importlib
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from dagmap import AdjacencyDag, GraphConfig
from dagmap.model import LIMIT_MM
from scenes import FRAME, Points, surface

SMALL, LARGE, CRAFTED = 100_000, 1_000_000, 20_000
ROUNDS = 3
SALT = 0x1B5A_0F37_C2D9_4E61  # of an agent: a secret that comes from its key

Row = dict[str, Any]


def config(pitch: float = 0.25, n_c: int = 2) -> GraphConfig:
    """N_p = 2 and a reach of three pitches."""
    return GraphConfig(n_p=2, n_c=n_c, reference_pitch=pitch, max_parent_distance=3 * pitch)


def run(small: int = SMALL, large: int = LARGE, crafted: int = CRAFTED) -> list[Row]:
    """Rows of rates in features/s. `growth` is time per feature over that of the first row."""
    rng = np.random.default_rng(2)
    few, many = surface(small), surface(large)
    line = np.zeros((large, 3), np.int32)
    line[:, 0] = np.arange(large) * 1_000_000 // large
    rows = [
        measure("scan order", few),
        measure("scan order", many),
        measure("random order", rng.permutation(few)),
        measure("random order", rng.permutation(many)),
        measure("scan order, pitch 5 cm (the default)", many, config(0.05)),
        measure("all equal", np.full((large, 3), 77, np.int32)),
        measure("one cubic decimetre, N_c = 3", scattered(large, 50), config(n_c=3)),
        measure("a line of a kilometre", line),
        measure("over the whole range", scattered(large, LIMIT_MM)),
        measure(f"over the whole range, {crafted}", scattered(crafted, LIMIT_MM)),
        measure(f"collisions crafted for another salt, {crafted}", colliding(crafted)),
        measure(f"collisions crafted for this salt, {crafted}", colliding(crafted), salt=0),
    ]
    for row in rows:
        row["growth"] = row["seconds_per_feature"] / rows[0]["seconds_per_feature"]
    return rows + afterwards(many)


def measure(name: str, points: Points, graph: GraphConfig | None = None, salt: int = SALT) -> Row:
    """Insertion of all points in one call, into an empty graph."""
    dag = AdjacencyDag(graph or config(), salt)
    dag.insert(points[:100])  # compiled and warm
    times = []
    for _ in range(ROUNDS):
        dag = AdjacencyDag(graph or config(), salt)
        times.append(seconds(lambda: dag.insert(points)))
    row = rated(name, len(points), statistics.median(times))
    row["bytes_per_node"] = dag.nbytes / len(points)
    row["ratio_to_ckdtree"] = row["rate"] * tree_seconds(points) / len(points)
    return row


def afterwards(points: Points) -> list[Row]:
    """What else a robot does with its graph: a cycle at a time, issue, withdraw, move N_c."""
    dag = AdjacencyDag(config(), SALT)
    count = len(points)
    parts = np.split(points, range(FRAME, count, FRAME))
    times = {"a cycle of 250 at a time": seconds(lambda: [dag.insert(part) for part in parts])}
    cores = np.flatnonzero(dag.validity() > 8)[::-1]
    times["bundles of all valid ones"] = seconds(lambda: dag.take(cores, 2048, count))
    leaving = np.flatnonzero(~dag.issued())
    times["N_c from 2 to 3"] = seconds(lambda: setattr(dag, "n_c", 3))
    rows = [rated(name, count, spent) for name, spent in times.items()]
    spent = seconds(lambda: dag.withdraw(leaving))
    return [*rows, rated("withdrawal of what was not issued", len(leaving), spent)]


def scattered(count: int, reach: int) -> Points:
    """Points anywhere within +-reach mm."""
    return np.random.default_rng(3).integers(-reach, reach, (count, 3)).astype(np.int32)


def colliding(count: int, pitch: int = 250) -> Points:
    """Centres of cells that an attacker who knows the salt 0 puts into a 512th of the table."""
    rng = np.random.default_rng(4)
    found: list[Points] = []
    while sum(map(len, found)) < count:
        nodes = rng.integers(-LIMIT_MM // pitch + 1, LIMIT_MM // pitch, (count, 3)) * pitch
        h = np.zeros(count, np.int64)
        for axis, factor in enumerate((0x5BD1E995, 0x6C8E9CF5, 0x7FEB352D)):
            h = ((nodes[:, axis] - pitch // 2 ^ h >> 31 ^ h) & (1 << 31) - 1) * factor
        slots = (h >> 31 ^ h) & (1 << 17) - 1
        found.append(nodes[slots < 256].astype(np.int32))
    return np.concatenate(found)[:count]


def rated(name: str, count: int, spent: float) -> Row:
    return {
        "name": name,
        "features": count,
        "rate": count / spent,
        "seconds_per_feature": spent / count,
    }


def seconds(call: Callable[[], object]) -> float:
    started = time.process_time()
    call()
    return time.process_time() - started


def tree_seconds(points: Points) -> float:
    try:
        build = importlib.import_module("scipy.spatial").cKDTree
    except ImportError:
        return float("nan")
    return seconds(lambda: build(points))
