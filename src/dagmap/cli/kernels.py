"""Compiling the kernels is slow once; this does it up front, on two cores, and says so."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from rich.console import Console

_OTHER_HALF = "from dagmap.cli.kernels import warm_fold; warm_fold()"


def warm_up(console: Console) -> float:
    """Run every kernel that an agent uses once. Returns the seconds it took."""
    from ..agent import Agent
    from ..config import Config, TransactionConfig
    from ..identity import Identity
    from ..model import Cycle

    started = time.perf_counter()
    if not _compiled_before():
        console.print("compiling the kernels: once after an installation, about fifteen seconds")
        with subprocess.Popen([sys.executable, "-c", _OTHER_HALF], stderr=subprocess.DEVNULL):
            warm_graph_and_codec()  # the other process leaves its half in numba's cache
    agent = Agent(
        Identity.from_seed(bytes(32)), Config(transaction=TransactionConfig(proof_of_work_bits=0))
    )
    points = np.zeros((12, 3))
    colors = np.zeros((12, 3), np.uint8)
    agent.observe(Cycle(0.0, np.eye(4), points, colors=colors), 0.0)
    agent.observe(Cycle(1.0, np.eye(4), points, ids=np.arange(12), colors=colors), 1.0)
    agent.observe(Cycle(2.0, np.eye(4), points[:0], removed=[3]), 4.0)
    agent.digest()
    return time.perf_counter() - started


def warm_graph_and_codec() -> None:
    """Compile what inserts features and what puts them on the wire."""
    from ..config import GraphConfig
    from ..graph import AdjacencyDag
    from ..kernels.ascendants import count_children
    from ..kernels.codec import decode_features, encode_features, morton_order
    from ..registration import match

    places = np.zeros((12, 3), np.int32)
    dag = AdjacencyDag(GraphConfig())
    ids = dag.insert(places[morton_order(places)])
    dag.withdraw(ids[-1:])
    dag.take(ids[-2:-1], 100, 100)
    starts, one = np.array([0, 12], np.int64), np.ones(1, np.uint8)
    parents, color = np.full((12, 2), -1, np.int64), np.zeros((12, 3), np.uint8)
    data = encode_features(places, parents, 0, starts, color, one)
    decode_features(data, 12, 2, 0, starts, one)
    count_children(one, parents, 1)
    match(np.zeros((2, 32), np.uint8), np.ones((2, 32), np.uint8))
    warm_surfaces()


def warm_surfaces() -> None:
    """Compile what lays surfaces on each other."""
    from ..kernels.voxels import nearest_facing, pass_through, tally

    shape, places = np.ones(3, np.int64), np.zeros((1, 3), np.int32)
    cell, out = np.zeros(1, np.int32), np.zeros(1, np.int64)
    pass_through(places, places, shape, 1, cell)
    tally(cell, shape, places, cell, places, 1, 1, out)
    nearest_facing(cell, shape, places, places, places, places, 1, 0, out)


def warm_fold() -> None:
    """Compile what folds features and walks their rays."""
    from ..config import FoldConfig
    from ..fold import Block, DefaultFold, RayEvidence
    from ..kernels.geometry import apply_pose, carry_segments
    from ..model import quantise_pose

    config, n = FoldConfig(), 12
    places, alive = np.full((n, 3), 500, np.int32), np.ones(n, np.bool_)
    starts, origins = np.array([0, n], np.int64), np.zeros((1, 3), np.int32)
    still = quantise_pose(np.eye(4))
    apply_pose(still, places, places.copy(), alive)
    carry_segments(np.stack([still, still])[None], starts, places, places.copy(), origins, alive)
    block = Block(
        author=0,
        base=0,
        xyz=places,
        alive=alive,
        starts=starts,
        cycle=np.zeros(1, np.int32),
        color=np.zeros((n, 3), np.uint8),
        colored=np.ones(1, np.bool_),
        parents=None,
        cores=np.zeros(0, np.int64),
        sightings=np.zeros(1, np.int64),
        sighting_cycle=np.ones(1, np.int32),
        origin=origins,
    )
    fold, rays = DefaultFold(config), RayEvidence(config.cell_mm, config.max_ray_mm)
    fold.apply(block)
    rays.walk(0, origins, starts, places, alive, 1)
    fold.evaluate(rays)
    fold.settled(0, places, 1)
    rays.walk(0, origins, starts, places, alive, -1)  # else the first fork would wait for it
    fold.undo(block)
    rays.walk(0, origins, starts, places, alive, -1)  # frees what has become zero


def _compiled_before() -> bool:
    """Whether an earlier process left compiled kernels on disk."""
    from ..kernels.jit import KERNELS

    caches = [k._cache for k in KERNELS if hasattr(k, "_cache")]  # none without a compiler
    paths = {str(path) for cache in caches if (path := getattr(cache, "cache_path", None))}
    return all(any(Path(path).glob("*.nbi")) for path in paths)
