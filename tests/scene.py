"""Small seeded worlds for tests: robots that look at walls, with ids, colours and mistakes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dagmap import Agent, Config, Cycle, GraphConfig, Identity
from dagmap.config import TransactionConfig

QUICK = Config(
    transaction=TransactionConfig(proof_of_work_bits=0),
    graph=GraphConfig(v_th=3, reference_pitch=0.25, max_parent_distance=0.75),
)


def secret(name: str) -> bytes:
    return name.encode().ljust(32, b"\0")


def agent(name: str, config: Config = QUICK) -> Agent:
    import msgspec

    return Agent(Identity.from_seed(secret(name)), msgspec.structs.replace(config, name=name))


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    out = np.eye(4)
    out[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    out[:3, 3] = x, y, z
    return out


def cycles(seed: int, count: int = 6, points: int = 40, churn: bool = True) -> Iterator[Cycle]:
    """A robot walks past a wall at x = 2 m. With churn, its SLAM repeats, removes and moves."""
    rng = np.random.default_rng(seed)
    wall = np.random.default_rng(7).uniform([2.0, -2.0, -1.0], [2.0, 2.0, 1.0], (300, 3))
    alive: list[int] = []
    for i in range(count):
        sensor = pose(0.1 * i, 0.2 * i - 0.5, 0.0, rng.uniform(-0.2, 0.2))
        seen = rng.choice(len(wall), points, replace=False)
        world = wall[seen] + rng.normal(0, 0.01, (points, 3))
        stray = rng.uniform(-2, 2, (max(points // 10, 1), 3))
        world[: len(stray)] = stray
        local = (world - sensor[:3, 3]) @ sensor[:3, :3]
        ids = np.array([1000 * i + j for j in range(points)], np.uint64)
        removed: list[int] = []
        moved = None
        if churn and i > 1:
            removed = [int(v) for v in rng.choice(alive, 3, replace=False)]
            alive = [v for v in alive if v not in removed]
            again = rng.choice(alive, 4, replace=False)
            ids[-4:] = again
            if i % 3 == 2:
                back = pose(0.1 * (i - 2) + 0.03, 0.2 * (i - 2) - 0.5, 0.01)
                moved = (np.array([float(i - 2)]), back[None])
        if churn:
            alive += [int(v) for v in ids if int(v) not in alive]
        colors = rng.integers(0, 256, (points, 3)).astype(np.uint8)
        yield Cycle(
            stamp=float(i),
            pose=sensor,
            points=local,
            ids=ids,
            colors=colors if i % 2 == 0 else None,
            moved=moved,
            removed=removed,
        )
