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
    warm_up()
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
    times, graph = [], graph or config()
    for _ in range(ROUNDS):
        dag = AdjacencyDag(graph, salt)
        times.append(seconds(dag.insert, points))
    row = rated(name, len(points), statistics.median(times))
    row["bytes_per_node"] = dag.nbytes / len(points)
    row["ratio_to_ckdtree"] = row["rate"] * tree_seconds(points) / len(points)
    return row


def afterwards(points: Points) -> list[Row]:
    """What else a robot does with its graph: a cycle at a time, issue, move N_c, withdraw."""
    parts = np.split(points, range(FRAME, len(points), FRAME))
    rows = [rated("a cycle of 250 at a time", len(points), seconds(cycles, parts))]
    rows.append(rated("the same, and issue what is valid", len(points), seconds(cycles, parts, 8)))
    dag = AdjacencyDag(config(), SALT)
    dag.insert(points)
    rows.append(rated("N_c from 2 to 3", len(points), seconds(setattr, dag, "n_c", 3)))
    leaving = np.random.default_rng(5).permutation(len(points))[: len(points) // 100]
    rows.append(rated("one in 100 withdrawn", len(leaving), seconds(dag.withdraw, leaving)))
    return rows


def warm_up() -> None:
    """Every kernel once, so that nothing is compiled or loaded while the clock runs."""
    dag = AdjacencyDag(config(), SALT)
    ids = dag.insert(np.zeros((FRAME, 3), np.int32))
    dag.take(ids[:9], 2, 9)
    dag.n_c = 3
    dag.withdraw(ids[9:20])


def cycles(parts: list[Points], v_th: int | None = None) -> None:
    """A robot's day: features come in cycles, and those above V_th go out with their ascendants."""
    dag = AdjacencyDag(config(), SALT)
    for part in parts:
        ids = dag.insert(part)
        if v_th is not None:
            dag.take(ids[dag.validity(ids) > v_th][::-1], 2048, 1 << 40)


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


def seconds(call: Callable[..., object], *arguments: object) -> float:
    started = time.process_time()
    call(*arguments)
    return time.process_time() - started


def tree_seconds(points: Points) -> float:
    try:
        build = importlib.import_module("scipy.spatial").cKDTree
    except ImportError:
        return float("nan")
    return seconds(build, points)
