"""The paper's claim of 4.3: "when the transaction broadcaster and the receiver are reversed, the
same result appears". Algorithm 2 as printed is run both ways on random pairs of bundles."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from dagmap.config import FoldConfig, GraphConfig
from dagmap.evidence import RayEvidence
from dagmap.fold import Block, PaperFold
from dagmap.graph import AdjacencyDag

CONFIG = FoldConfig(preset="paper")
GRAPH = GraphConfig(v_th=3, reference_pitch=0.25, max_parent_distance=0.75)


def bundle(author: int, points: npt.NDArray[np.int32]) -> Block | None:
    """The first bundle that becomes valid when a robot inserts these points."""
    dag = AdjacencyDag(GRAPH)
    ids = dag.insert(points)
    valid = ids[dag.validity() > GRAPH.v_th]
    if not len(valid):
        return None
    rows, _ = dag.bundle(int(valid[-1]), len(points))
    numbers = np.full(len(points), -1, np.int64)
    numbers[rows] = np.arange(len(rows))
    parents = dag.parents(rows)
    n = len(rows)
    return Block(
        author=author,
        base=0,
        xyz=dag.positions(rows),
        alive=np.ones(n, np.bool_),
        starts=np.array([0, n], np.int64),
        cycle=np.zeros(1, np.int32),
        color=np.zeros((n, 3), np.uint8),
        colored=np.zeros(1, np.bool_),
        parents=np.where(parents >= 0, numbers[parents], -1),
        cores=np.array([n - 1], np.int64),
        sightings=np.zeros(0, np.int64),
        sighting_cycle=np.zeros(0, np.int32),
        origin=np.zeros((1, 3), np.int32),
    )


def merged(first: Block, second: Block) -> tuple[list[int], ...]:
    """Nodes, hits and misses after the one has received the other, each sorted."""
    fold = PaperFold(CONFIG)
    fold.apply(first)
    fold.apply(second)
    rays = RayEvidence(CONFIG.cell_mm, CONFIG.max_ray_mm)
    verdict = fold.evaluate(rays)
    hits, misses = np.sort(verdict.hits).tolist(), np.sort(verdict.misses).tolist()
    return [len(fold)], hits, misses


def run(pairs: int = 2000) -> list[dict[str, Any]]:
    """Share of pairs where both ways agree: of all, and of those with a hit one way or the other.

    Two robots insert noisy views (8 mm) of 40 points of a wall, of which a share is in common.
    Places cannot agree where something hits: the node stays where the receiver saw it.
    """
    rows = []
    for shared in (1.0, 0.6, 0.2):
        rng = np.random.default_rng(7)
        outcomes: list[tuple[bool, ...]] = []
        while len(outcomes) < pairs:
            wall = rng.uniform([0, 0, 0], [20, 2000, 1500], (40, 3))
            other = np.where(rng.random(40)[:, None] < shared, wall, wall + np.array([0, 0, 2500]))
            views = [wall, other + rng.normal(0, 8, (40, 3))]
            blocks = [bundle(i, rng.permutation(v).astype(np.int32)) for i, v in enumerate(views)]
            if blocks[0] is None or blocks[1] is None:
                continue
            forth, back = merged(blocks[0], blocks[1]), merged(blocks[1], blocks[0])
            hit = bool(sum(forth[1]) or sum(back[1]))
            same = tuple(a == b for a, b in zip(forth[:3], back[:3], strict=True))
            outcomes.append((hit, *same, all(same)))
        table = np.array(outcomes)
        for name, part in (("all", table), ("with a hit", table[table[:, 0]])):
            shares = part[:, 1:].mean(axis=0).tolist() if len(part) else [float("nan")] * 4
            columns = ("same_node_count", "same_hits", "same_misses", "same_in_all_three")
            row = dict(zip(columns, shares, strict=True))
            rows.append({"name": f"{shared:.0%} in common, {name}", "pairs": len(part), **row})
    return rows
