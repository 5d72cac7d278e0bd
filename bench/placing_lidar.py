"""Robots that share no frame and have no descriptors: how often and how well LiDARs are placed.

`python bench/placing_lidar.py`: each run draws a building (rooms of 4 to 25 m, all of one size,
with boxes in them), a LiDAR and two robots that walk through it, each with a SLAM frame of its
own: any turn, up to 20 m away. Some pairs walk in one building, some in two buildings with rooms of
the same size, and of some the second one's world is mirrored. A placement is false where it is
mirrored, of two buildings, or off by more than 30 cm or 3 degrees: half of the robots drift as they
walk, so that their maps are off by themselves.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from typing import Any, TypeVar, cast

import msgspec
import numpy as np

from dagmap.aligning import align
from dagmap.config import Config, PlacingConfig, TransactionConfig
from dagmap.model import Cycle
from dagmap.registration import Working
from dagmap.sim.scene import MotionConfig, Scene, SceneConfig, SensorConfig
from dagmap.surfels import survey
from placing import MIRROR, Floats, Start, Watch, random_pose, summary

T = TypeVar("T")
KINDS = ("overlap", "overlap", "apart", "mirrored")
FALSE_M, FALSE_DEGREES = 0.3, 3.0
SHARED_MM = 200  # edge of the voxels by which overlap is told: a LiDAR's points are sparse
MIRRORED = np.diag([-1.0, 1.0, 1.0, 1.0])


def moved(cycle: Cycle, frame: Floats, mirrored: bool) -> Cycle:
    """A cycle of a SLAM whose frame is another one, or that sees the world in a mirror."""
    points, pose, change = np.asarray(cycle.points), np.asarray(cycle.pose), cycle.moved
    if mirrored:
        points, pose = points @ MIRROR, MIRRORED @ pose @ MIRRORED
        change = change and (change[0], MIRRORED @ np.asarray(change[1]) @ MIRRORED)
    change = change and (change[0], frame @ np.asarray(change[1]))
    return replace(cycle, points=points, pose=frame @ pose, moved=change)


def drawn(rng: np.random.Generator) -> tuple[SceneConfig, SensorConfig, MotionConfig, float]:
    """A building, a sensor, how robots move, and for how many seconds."""
    hall = bool(rng.random() < 0.3)
    scene = SceneConfig(
        rooms=(1, int(rng.integers(1, 3))) if hall else (2, int(rng.integers(1, 3))),
        room=float(rng.choice([12.0, 25.0] if hall else [4.0, 5.0, 6.0])),
        height=float(rng.choice([3.0, 5.0])) if hall else 2.5,
        objects=int(rng.choice([6, 16] if hall else [3, 6, 12])),
        people=int(rng.choice([0, 0, 4])),
    )
    sensor = SensorConfig(
        kind="lidar",
        points=int(rng.choice([400, 800])),
        range=30.0,
        field=(75.0, float(rng.choice([30.0, 60.0, 60.0, 90.0]))),
        noise=float(rng.choice([0.01, 0.03])),
        outliers=float(rng.choice([0.0, 0.02, 0.1, 0.2])),
        tracked=0.0,
    )
    drift = float(rng.choice([0.0, 0.002]))
    motion = MotionConfig(speed=1.0 if hall else 0.5, drift=drift, drift_yaw=drift / 10)
    return scene, sensor, motion, 50.0


def voxels(cycles: list[Cycle]) -> set[bytes]:
    """The voxels of all points, in the frame of the building."""
    parts = [
        np.asarray(c.points) @ np.asarray(c.pose)[:3, :3].T + np.asarray(c.pose)[:3, 3]
        for c in cycles
    ]
    cells = np.floor(np.concatenate(parts) * (1000 / SHARED_MM)).astype(np.int32)
    return {row.tobytes() for row in np.unique(cells, axis=0)}


def warm() -> None:
    """Compile what is timed later."""
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 3000, (3000, 3))
    points[np.arange(3000), np.arange(3000) % 3] = 0.0
    seen = survey(points, np.full((3000, 3), 1500.0), np.arange(3000) % 4, 100.0)
    surfels = finished(seen)
    if surfels is not None:
        finished(align(surfels, surfels))


def finished(work: Working[T]) -> T:
    while True:
        try:
            next(work)
        except StopIteration as done:
            return cast(T, done.value)


def one_run(kind: str, seed: int, config: Config) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    building, sensor, motion, seconds = drawn(rng)
    starts, seen = {}, []
    for index, name in enumerate(("one", "two")):
        other = 10_000 if kind == "apart" and index else 0
        walker = Scene(building, sensor, motion, 2, seed + other).robot(index)
        cycles = list(walker.cycles(seconds))
        seen.append(voxels(cycles))
        frame = random_pose(rng)
        mirrored = kind == "mirrored" and index == 1
        starts[name] = Start(frame, [moved(cycle, frame, mirrored) for cycle in cycles])
    watch = Watch(config, starts)
    watch.run()
    errors = watch.errors().get(("one", "two"))
    off = errors is not None and (errors[0] > FALSE_M or errors[1] > FALSE_DEGREES)
    agents = [robot.agent for robot in watch.fleet.robots.values()]
    overlap = len(seen[0] & seen[1]) / min(map(len, seen))
    return {
        "kind": kind, "seed": seed, "overlap": round(overlap, 3) if kind == "overlap" else None,
        "scene": f"{building.rooms} of {building.room:g} m, {building.objects} boxes",
        "sensor": f"{sensor.points} points, {sensor.field[1]:g} degrees, "
        f"{sensor.noise * 100:g} cm, {sensor.outliers:g} wrong",
        "drift": motion.drift, "people": building.people, "seconds": seconds,
        "placed": errors is not None, "false": off or (errors is not None and kind != "overlap"),
        "metres": None if errors is None else round(errors[0], 4),
        "degrees": None if errors is None else round(errors[1], 3),
        "placed_at_s": watch.placed_at.get(("one", "two")),
        "one_digest": len({agent.digest() for agent in agents}) == 1,
        "why": sorted({reason for agent in agents for reason in agent.unplaced.values()}),
        "steps_p99_max_ms": watch.step_ms(),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=60, help="half overlap, a quarter each do not")
    parser.add_argument("--first", type=int, default=0, help="seed of the first run")
    parser.add_argument("--json", action="store_true", help="every run, as one JSON object")
    chosen = parser.parse_args()
    config = msgspec.structs.replace(
        Config(
            transaction=TransactionConfig(proof_of_work_bits=0),
            placing=PlacingConfig(surfaces=True),
        ),
        start_pose=None,
    )
    warm()
    runs = []
    for seed in range(chosen.first, chosen.first + chosen.runs):
        runs.append(one_run(KINDS[seed % len(KINDS)], seed, config))
        print(json.dumps(runs[-1]), file=sys.stderr, flush=True)
    found = {"summary": summary(runs)}
    print(json.dumps({**found, "runs": runs} if chosen.json else found, indent=2))


if __name__ == "__main__":
    main()
