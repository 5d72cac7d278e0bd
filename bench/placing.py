"""Robots that share no frame: how often, how well and how fast the office's robots are placed.

`python bench/placing.py --data DIR`: DIR is a TUM RGB-D folder of one walk. Each run cuts two
robots from random ranges of it (every third frame), gives each a random start pose and displaces
a random share of the points along their rays. Some pairs have no overlap, some see the second
robot's world in a mirror, with the descriptors of the world as it is. The last run is the walk cut
in three. A placement is false where it is off by more than 10 cm or 3 degrees, or mirrored.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from dagmap.config import Config, TransactionConfig
from dagmap.io.sources import open_source
from dagmap.model import Cycle, FrameId, pose_matrix
from dagmap.sim.fleet import Fleet
from dagmap.sim.network import Link, Network
from dagmap.sim.robot import Robot

Floats = npt.NDArray[np.float64]
EVERY = 3  # frames of the walk to a cycle
LENGTHS = (45, 125)  # frames of a range
OVERLAP, APART = 0.15, 0.01  # share of the smaller one's 5 cm voxels: more, and less
FACTOR = (0.3, 1.6)  # along the ray, of a displaced point
MIRROR = np.diag([-1.0, 1.0, 1.0])
FALSE_M, FALSE_DEGREES = 0.10, 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """Where a robot's SLAM believes the world to be."""

    frame: Floats  # (4, 4) the walk's frame in the robot's own
    cycles: list[Cycle]


def cloud(cycles: list[Cycle]) -> set[bytes]:
    """The 5 cm voxels of all points."""
    parts = [
        np.asarray(c.points) @ np.asarray(c.pose)[:3, :3].T + np.asarray(c.pose)[:3, 3]
        for c in cycles
    ]
    cells = np.floor(np.concatenate(parts) / 0.05).astype(np.int32)
    return {row.tobytes() for row in np.unique(cells, axis=0)}


def shared(one: set[bytes], other: set[bytes]) -> float:
    """Share of the smaller one's voxels that the other has too."""
    return len(one & other) / max(1, min(len(one), len(other)))


def random_pose(rng: np.random.Generator) -> Floats:
    quaternion = rng.normal(size=4)
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    out = np.eye(4)
    out[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    out[:3, 3] = rng.uniform(-20, 20, 3)
    return out


def started(
    cycles: list[Cycle], rng: np.random.Generator, noise: float, mirrored: bool, points: int
) -> Start:
    """A robot at a random start pose, with a share of its points displaced."""
    frame, out = random_pose(rng), []
    for cycle in cycles:
        pose, place = np.array(cycle.pose), np.asarray(cycle.points)[:points]
        moved = rng.random(len(place)) < noise
        place = place * np.where(moved, rng.uniform(*FACTOR, len(place)), 1.0)[:, None]
        if mirrored:
            place = place @ MIRROR
            pose[:3, :3] = MIRROR @ pose[:3, :3] @ MIRROR
            pose[:3, 3] = MIRROR @ pose[:3, 3]
        described = np.asarray(cycle.descriptors)[:points]
        stamp = float(cycle.stamp) - float(cycles[0].stamp)
        out.append(Cycle(stamp, frame @ pose, place, descriptors=described))
    return Start(frame, out)


class Watch:
    """A fleet of robots that share no frame, and when each pair of them was placed."""

    def __init__(self, config: Config, starts: dict[str, Start]) -> None:
        self.fleet = Fleet(config, Network(Link(), 0))
        self.starts, self.placed_at = starts, dict[tuple[str, str], float]()
        self.slowest = 0.0
        for name in starts:
            self._timed(self.fleet.join(name))

    def _timed(self, robot: Robot) -> None:
        step = robot.agent.placing.step

        def timed(*arguments: Any) -> Any:
            begun = time.perf_counter()
            found = step(*arguments)
            self.slowest = max(self.slowest, time.perf_counter() - begun)
            return found

        robot.agent.placing.step = timed  # type: ignore[method-assign]

    def run(self) -> None:
        for _ in self.fleet.run({name: iter(start.cycles) for name, start in self.starts.items()}):
            for ends in self._pairs():
                if ends not in self.placed_at and self._relative(*ends) is not None:
                    self.placed_at[ends] = self.fleet.now

    def errors(self) -> dict[tuple[str, str], tuple[float, float]]:
        """Of each placed pair: mean m over the first one's path, and degrees."""
        out = {}
        for one, other in self._pairs():
            found = self._relative(one, other)
            if found is None:
                continue
            truth = self.starts[other].frame @ np.linalg.inv(self.starts[one].frame)
            off = np.linalg.inv(truth) @ found
            path = np.array([np.asarray(c.pose)[:3, 3] for c in self.starts[one].cycles])
            metres = np.linalg.norm(path @ off[:3, :3].T + off[:3, 3] - path, axis=1).mean()
            cosine = np.clip((np.trace(off[:3, :3]) - 1) / 2, -1, 1)
            out[one, other] = (float(metres), float(np.degrees(np.arccos(cosine))))
        return out

    def _pairs(self) -> Iterator[tuple[str, str]]:
        names = list(self.starts)
        return ((a, b) for i, a in enumerate(names) for b in names[i + 1 :])

    def _relative(self, one: str, other: str) -> Floats | None:
        """(4, 4) the first one's frame in the other's, by what the first one holds."""
        robots = self.fleet.robots
        frames = robots[one].agent.consensus.frames
        ends = [frames.get(FrameId(robots[name].agent.identity.author)) for name in (one, other)]
        if ends[0] is None or ends[1] is None or ends[0][0] != ends[1][0]:
            return None
        return np.asarray(np.linalg.inv(pose_matrix(ends[1][1])) @ pose_matrix(ends[0][1]))


def pick(
    walk: list[Cycle], rng: np.random.Generator, apart: bool
) -> tuple[list[Cycle], list[Cycle], float]:
    """Two disjoint ranges of the walk that overlap, or that do not."""
    while True:
        low, high = (15, 45) if apart else LENGTHS
        sizes = rng.integers(low, high + 1, 2)
        starts = [int(rng.integers(0, len(walk) - size)) for size in sizes]
        ranges = [walk[s : s + n : EVERY] for s, n in zip(starts, sizes.tolist(), strict=True)]
        a, b = sorted(zip(starts, sizes.tolist(), strict=True))
        if a[0] + a[1] > b[0]:
            continue
        overlap = shared(cloud(ranges[0]), cloud(ranges[1]))
        if (overlap < APART) if apart else (overlap > OVERLAP):
            return ranges[0], ranges[1], overlap


def one_run(walk: list[Cycle], kind: str, seed: int, config: Config) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    first, second, overlap = pick(walk, rng, kind == "apart")
    noise = float(rng.choice([0.0, 0.1, 0.2, 0.4]))
    starts = {
        "one": started(first, rng, noise, False, config.placing.points),
        "two": started(second, rng, noise, kind == "mirrored", config.placing.points),
    }
    watch = Watch(config, starts)
    watch.run()
    errors = watch.errors().get(("one", "two"))
    false = errors is not None and (
        kind == "mirrored" or errors[0] > FALSE_M or errors[1] > FALSE_DEGREES
    )
    return {
        "kind": kind, "seed": seed, "noise": noise, "overlap": round(overlap, 3),
        "placed": errors is not None, "false": false,
        "metres": None if errors is None else round(errors[0], 4),
        "degrees": None if errors is None else round(errors[1], 3),
        "placed_at_s": watch.placed_at.get(("one", "two")),
        "slowest_step_ms": round(1000 * watch.slowest, 1),
    }  # fmt: skip


def three(walk: list[Cycle], config: Config) -> dict[str, Any]:
    """The walk cut in three, as bench/quality.py cuts it, every point of it in the map."""
    bounds = [len(walk) // 3 + (r < len(walk) % 3) for r in range(3)]
    ends = np.cumsum(bounds).tolist()
    rng = np.random.default_rng(0)
    starts = {
        f"robot{r + 1}": started(walk[end - n : end : EVERY], rng, 0.0, False, 1 << 20)
        for r, (end, n) in enumerate(zip(ends, bounds, strict=True))
    }
    watch = Watch(config, starts)
    watch.run()
    robots = watch.fleet.robots.values()
    described = [
        sum(44 * len(k.position) for tx in chain.main for k in tx.payload.described)
        for chain in next(iter(robots)).agent.ledger.chains.values()
    ]
    return {
        "placed": {f"{a}-{b}": [round(x, 4) for x in e] for (a, b), e in watch.errors().items()},
        "placed_at_s": {f"{a}-{b}": round(at, 1) for (a, b), at in watch.placed_at.items()},
        "shared_20_percent_at_s": {
            f"{a}-{b}": when(starts[a], starts[b]) for a, b in watch.placed_at
        },
        "one_digest": len({robot.agent.digest() for robot in robots}) == 1,
        "described_bytes": described,
        "sent_bytes": [robot.bytes_sent for robot in robots],
        "slowest_step_ms": round(1000 * watch.slowest, 1),
    }


def when(one: Start, other: Start) -> float | None:
    """Seconds into the recording at which the maps share 20 % of the smaller one's voxels."""
    seen: list[set[bytes]] = [set(), set()]
    back = [np.linalg.inv(start.frame) for start in (one, other)]
    for pair in zip(one.cycles, other.cycles, strict=False):
        for cells, cycle, frame in zip(seen, pair, back, strict=True):
            cells |= cloud([replace(cycle, pose=frame @ np.asarray(cycle.pose))])
        if shared(*seen) >= 0.2:
            return round(float(pair[0].stamp), 1)
    return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="the walk: a TUM RGB-D folder")
    parser.add_argument("--runs", type=int, default=100, help="a fifth each apart and mirrored")
    parser.add_argument("--json", action="store_true", help="every run, as one JSON object")
    chosen = parser.parse_args()
    config = msgspec.structs.replace(
        Config(transaction=TransactionConfig(proof_of_work_bits=0)), start_pose=None
    )
    walk = list(open_source(chosen.data))
    kinds = ["apart", "mirrored", "overlap", "overlap", "overlap"]
    runs = []
    for seed in range(chosen.runs):
        runs.append(one_run(walk, kinds[seed % len(kinds)], seed, config))
        print(json.dumps(runs[-1]), file=sys.stderr)
    found = {"walk": three(walk, config), "summary": summary(runs)}
    print(json.dumps({**found, "runs": runs} if chosen.json else found, indent=2))


def summary(runs: list[dict[str, Any]]) -> dict[str, Any]:
    out = {}
    for kind in sorted({run["kind"] for run in runs}):
        mine = [run for run in runs if run["kind"] == kind]
        right = [run for run in mine if run["placed"] and not run["false"]]
        out[kind] = {
            "runs": len(mine),
            "placed": sum(run["placed"] for run in mine),
            "false": sum(run["false"] for run in mine),
            "metres_median_max": _median_max([run["metres"] for run in right]),
            "degrees_median_max": _median_max([run["degrees"] for run in right]),
        }
    return out


def _median_max(values: list[float]) -> list[float] | None:
    return [round(float(np.median(values)), 4), round(max(values), 4)] if values else None


if __name__ == "__main__":
    main()
