"""How the default consensus judges what other sensors see: a depth camera's room, a LiDAR's hall.

`python bench/other_sensors.py`: the scans of `bench/fold.py`, folded directly, with and without
displaced points; the doubt learned, and 36 bits for all. Printed are the shares of true and of
displaced points whose node is rejected, and the F-score within 5 delta / 3 of what is there, seen
by every third true point. Minutes.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from dagmap.config import FoldConfig
from dagmap.evidence import RayEvidence
from dagmap.fold import DefaultFold
from dagmap.metrics import nearest
from dagmap.model import Bools, Floats, State
from fold import HALL, ROBOTS, ROOM, Scan, Site, scans

CASES: tuple[tuple[Site, int, float, float, float], ...] = (
    # cycles, delta, cell, max_ray in m
    (ROOM, 272, 0.03, 0.10, 4.0),
    (HALL, 600, 0.20, 0.50, 20.0),
    (HALL, 600, 0.10, 0.30, 20.0),
)
FACTOR = (0.3, 1.6)  # along the ray, of a displaced point
DENSE = 36  # bits


def displaced(scan: Scan, share: float, rng: np.random.Generator) -> tuple[Scan, Bools]:
    """The scan with a share of its points moved along their rays, and which ones."""
    rays = scan.block.xyz - scan.origin
    wrong = rng.random(len(rays)) < share
    factor = np.where(wrong, rng.uniform(*FACTOR, len(rays)), 1.0)[:, None]
    xyz = np.floor(scan.origin + rays * factor + 0.5).astype(np.int32)
    return replace(scan, block=replace(scan.block, xyz=xyz)), wrong


def judged(seen: list[Scan], config: FoldConfig) -> tuple[Bools, Floats]:
    """Of each point, scan by scan, whether its node is rejected; (N, 3) m nodes that are not."""
    fold, rays = DefaultFold(config), RayEvidence(config.cell_mm, config.max_ray_mm)
    for scan in seen:
        block = scan.block
        starts = np.array([0, len(block.xyz)], np.int64)
        rays.walk(block.author, scan.origin, starts, block.xyz, block.alive, +1)
        fold.apply(block)
    verdict, columns = fold.evaluate(rays), fold.columns()
    rejected = verdict.states == State.REJECTED
    places = columns.seed + columns.offset / columns.count[:, None]
    of = [fold.feature_nodes(robot) for robot in range(ROBOTS)]
    nodes = np.concatenate(
        [of[b.author][b.base : b.base + len(b.xyz)] for b in (scan.block for scan in seen)]
    )
    return rejected[nodes], places[~rejected] / 1000.0


def rows(cycles: float) -> Iterator[dict[str, object]]:
    for site, count, delta, cell, max_ray in CASES:
        clean = scans(site, int(cycles * count))
        true = np.concatenate([scan.block.xyz for scan in clean])[::3] / 1000.0
        for share in (0.0, 0.1, 0.4):
            rng = np.random.default_rng(1)
            pairs = [displaced(scan, share, rng) for scan in clean]
            wrong = np.concatenate([chosen for _, chosen in pairs])
            for doubt in (None, DENSE):
                config = FoldConfig(delta=delta, cell=cell, max_ray=max_ray, doubt=doubt)
                rejected, kept = judged([scan for scan, _ in pairs], config)
                within = 5 * delta / 3
                precision = float((nearest(kept, true) <= within).mean())
                recall = float((nearest(true, kept) <= within).mean())
                yield {
                    "site": site.name, "points": len(wrong), "delta": delta, "cell": cell,
                    "displaced": share, "doubt": doubt or "learned",
                    "true_rejected": round(float(rejected[~wrong].mean()), 3),
                    "displaced_rejected": round(float(rejected[wrong].mean()), 3) if share else 0.0,
                    "f": round(2 * precision * recall / max(precision + recall, 1e-9), 3),
                }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--share", type=float, default=1.0, help="of the cycles, for a quick look")
    for row in rows(parser.parse_args().share):
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
