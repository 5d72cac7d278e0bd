"""Slow drift that a SLAM does not correct: what bending its path to another robot's map gains.

`python bench/drift.py`: two robots without a common frame walk through one simulated building. The
first one's poses are right; the second one's drift, and it closes no loop. What they see are points
of walls and boxes with a descriptor each. With `--data DIR` (a TUM RGB-D folder of one walk) also
the office: both robots have all of the walk, every other cycle each, and the second one's poses
drift; its descriptors and depths are the recorded ones.

Each with drift and without, bent (`[placing] drift`) and not. F-score, double walls, the error of
the second robot's path as the fleet has it, and what it sends.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from dagmap.config import Config, PlacingConfig, TransactionConfig
from dagmap.metrics import score, thin
from dagmap.model import Cycle, FrameId, pose_matrix
from dagmap.sim.fleet import Fleet
from dagmap.sim.odometry import Odometry
from dagmap.sim.odometry import pose_matrix as level
from dagmap.sim.scene import MotionConfig, Scene, SceneConfig, SensorConfig
from office import load
from placing import random_pose

Floats = npt.NDArray[np.float64]
NAMES = ("right", "drifting")
POINTS, APART = 400, 0.08  # seen in a cycle, at most; m between places that are known again
WRONG = 0.1  # of the points lie at 0.3 to 1.6 times their distance
Robots = dict[str, list[Cycle]]
Given = tuple[Robots, Robots, Floats, Floats]


def building(seed: int, drift: float, seconds: float) -> Given:
    """What robots hand in, where they truly were, all surfaces, and what of these was seen."""
    motion = MotionConfig(drift=drift, drift_yaw=drift / 10, loop_closures=False)
    sensor = SensorConfig(points=400, tracked=0.0, outliers=0.0, noise=0.0)
    scene = Scene(SceneConfig(rooms=(2, 1), room=5.0), sensor, motion, len(NAMES), seed)
    rng = np.random.default_rng(seed)
    for index in range(len(NAMES)):
        list(scene.robot(index).cycles(seconds))
    places = thin(np.concatenate([scene.robot(i).seen().points for i in range(len(NAMES))]), APART)
    described = rng.integers(0, 256, (len(places), 32)).astype(np.uint8)
    said, true, seen = {}, {}, []
    for index, name in enumerate(NAMES):
        odometry = Odometry(motion, rng)
        said[name], true[name] = [], []
        for step in range(math.ceil(seconds)):
            at = scene.robot(index).pose(float(step))
            odometry.step(at)
            rows = visible(scene, level(at), places, rng)
            local = (places[rows] - at[:3]) @ level(at)[:3, :3]
            wrong = rng.random(len(rows)) < WRONG
            factor = np.where(wrong, rng.uniform(0.3, 1.6, len(rows)), 1.0)
            factor += rng.normal(0.0, 0.01, len(rows)) / np.linalg.norm(local, axis=1)
            names = described[rows].copy()
            names[:, :3] ^= rng.integers(0, 256, (len(rows), 3)).astype(np.uint8)  # 12 bits
            true[name].append(Cycle(float(step), level(at), local, descriptors=names))
            pose = level(odometry.poses[-1].tolist()) if index else level(at)
            said[name].append(replace(true[name][-1], pose=pose, points=local * factor[:, None]))
            seen.append(places[rows])
    return said, true, scene.truth(0.02), thin(np.concatenate(seen))


def visible(
    scene: Scene, pose: Floats, places: Floats, rng: np.random.Generator
) -> npt.NDArray[np.int64]:
    """Rows of places in the picture that nothing hides."""
    local = (places - pose[:3, 3]) @ pose[:3, :3]
    far = np.linalg.norm(local, axis=1)
    wide = np.abs(local[:, 1:]) <= np.tan(np.radians((37.5, 27.5))) * local[:, :1]
    rows = np.flatnonzero((local[:, 0] > 0.3) & wide.all(axis=1) & (far < 5.0))
    rows = rng.permutation(rows)[: 2 * POINTS]
    ways = (places[rows] - pose[:3, 3]) / far[rows, None]
    depth, _ = scene.building.cast(pose[None, :3, 3], ways[None], 6.0)
    return np.asarray(rows[depth[0] >= far[rows] - 0.02][:POINTS], np.int64)


def office(
    folder: Path, cache: Path, seed: int, drift: float
) -> tuple[Robots, Robots, Floats, Floats]:
    """The same of a recorded walk."""
    walk = load(folder, cache)
    frames = [frame for robot in walk.robots for frame in robot]
    cycles = [replace(f.cycle(), stamp=0.3 * i) for i, f in enumerate(frames)]
    true = {name: cycles[index::2] for index, name in enumerate(NAMES)}
    said = dict(true)
    said["drifting"] = drifted(true["drifting"], drift, np.random.default_rng(seed))
    return said, true, walk.dense, thin(walk.placed())


def drifted(cycles: list[Cycle], drift: float, rng: np.random.Generator) -> list[Cycle]:
    """Each step off by a share of its length, in a direction that changes slowly."""
    bias, turn = rng.normal(size=3), rng.normal(size=3)
    out = [cycles[0]]
    for before, after in pairwise(cycles):
        step = np.linalg.inv(np.asarray(before.pose)) @ np.asarray(after.pose)
        length = float(np.linalg.norm(step[:3, 3]))
        step[:3, 3] += drift * length * bias
        angle = drift / 10 * length * turn
        step[:3, :3] = about(angle) @ step[:3, :3]
        keep = math.exp(-length / 5.0)
        bias, turn = (keep * x + math.sqrt(1 - keep**2) * rng.normal(size=3) for x in (bias, turn))
        out.append(replace(after, pose=np.asarray(out[-1].pose) @ step))
    return out


def about(turn: Floats) -> Floats:
    x, y, z = turn
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    u, _, vt = np.linalg.svd(np.eye(3) + cross)
    return np.asarray(u @ vt)


def run(
    said: Robots, true: Robots, reference: Floats, seen: Floats, drift: float, both: bool, seed: int
) -> dict[str, Any]:
    """One fleet to its end. drift: `[placing] drift` of the second robot, or of both."""
    config = Config(
        start_pose=None,
        transaction=TransactionConfig(proof_of_work_bits=0),
        placing=PlacingConfig(drift=drift),
    )
    fleet = Fleet(config)
    robots = [fleet.join(name) for name in NAMES]
    if not both:
        robots[0].agent.observing.drift.rate = 0.0
    start = random_pose(np.random.default_rng(1000 + seed))
    said = said | {NAMES[1]: [replace(c, pose=start @ np.asarray(c.pose)) for c in said[NAMES[1]]]}
    for _ in fleet.run(said):
        pass
    agent = robots[0].agent
    world, placed = agent.map, agent.consensus.frames
    ids = [robot.agent.identity.author for robot in robots]
    ends = [placed.get(FrameId(author)) for author in ids]
    if ends[0] is None or ends[1] is None or ends[0][0] != ends[1][0]:
        return {"placed": False}
    back = np.linalg.inv(pose_matrix(ends[0][1]))
    anchors = agent.consensus.authors[ids[1]].anchors
    path = [back @ pose_matrix(ends[1][1]) @ pose_matrix(anchors[n].pose) for n in sorted(anchors)]
    ways = zip(path, true[NAMES[1]], strict=True)
    off = [float(np.linalg.norm(at[:3, 3] - np.asarray(c.pose)[:3, 3])) for at, c in ways]
    nodes = world.positions[world.kept] @ back[:3, :3].T + back[:3, 3]
    found = score(nodes, reference, seen)
    return {
        "placed": True,
        "f_5_cm": round(found.f_score(0.05), 3),
        "double_walls": None if found.double_walls is None else round(found.double_walls, 3),
        "path_off_cm": [round(100 * float(x), 1) for x in (np.median(off), max(off))],
        "moved_anchors": sum(
            len(tx.payload.anchors) for tx in agent.ledger.chain(ids[1]).main
        ) - len(anchors),
        "sent": robots[1].bytes_sent,
        "one_digest": len({robot.agent.digest() for robot in robots}) == 1,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="the walk: a TUM RGB-D folder")
    parser.add_argument("--cache", type=Path, default=Path("out/quality"), help="for ORB points")
    parser.add_argument("--drift", type=float, default=0.02, help="m per m, standard deviation")
    parser.add_argument("--seconds", type=float, default=100.0)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--scenes", nargs="+", choices=("building", "office"))
    chosen = parser.parse_args()
    scenes: dict[str, Callable[[int, float], Given]] = {
        "building": lambda seed, drift: building(seed, drift, chosen.seconds)
    }
    if chosen.data:
        scenes["office"] = lambda seed, drift: office(chosen.data, chosen.cache, seed, drift)
    for name in chosen.scenes or scenes:
        for seed in range(chosen.seeds):
            for drift in (0.0, chosen.drift):
                given = scenes[name](seed, drift)
                for rate, both in ((0.0, False), (chosen.drift, False), (chosen.drift, True)):
                    row = {"scene": name, "seed": seed, "drift": drift, "bent": rate, "both": both}
                    print(json.dumps(row | run(*given, rate, both, seed)), flush=True)


if __name__ == "__main__":
    main()
