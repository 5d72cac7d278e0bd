"""How fast the map consensus is: association, rays, undo, reading; and what it holds in memory.

Scans are seeded: robots drive through a furnished room (RGB-D, up to 4 m) or a hall (LiDAR, up to
20 m) and see 250 points a cycle, which is one block. Times are the processor's, the best of a few
runs; every rate stands beside a cKDTree of the same points built in the same run.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from dagmap.config import FoldConfig
from dagmap.evidence import RayEvidence
from dagmap.fold import Block, DefaultFold
from dagmap.model import Int32s

POINTS = 250  # of a block
ROBOTS = 3
NOISE_MM = 10.0


@dataclass(frozen=True)
class Site:
    """A box-shaped room with boxes in it, and the sensor that its robots carry."""

    name: str
    size: tuple[float, float, float]  # mm
    boxes: int
    reach: float  # mm
    spread: float  # half the horizontal angle of view, radians
    tilt: float  # half the vertical one
    speed: float  # mm a cycle


ROOM = Site("room, rays up to 4 m", (9000.0, 7000.0, 3000.0), 6, 4000.0, 0.6, 0.45, 60.0)
HALL = Site("hall, rays up to 20 m", (40000.0, 30000.0, 6000.0), 20, 20000.0, np.pi, 0.26, 150.0)


@dataclass(frozen=True)
class Scan:
    """A block and the place that it was seen from."""

    block: Block
    origin: Int32s  # (1, 3) mm


def scans(site: Site, cycles: int, seed: int = 1) -> list[Scan]:
    """`cycles` cycles of the robots in turn; feature and cycle numbers count up per robot."""
    rng = np.random.default_rng(seed)
    low, high = _boxes(site, rng)
    phase = rng.uniform(0.0, 2 * np.pi, (ROBOTS, 3))
    out = []
    for cycle in range(cycles):
        robot, number = cycle % ROBOTS, cycle // ROBOTS
        origin, heading = _pose(site, phase[robot], number)
        points = _seen(site, origin, heading, low, high, rng)
        out.append(Scan(_block(robot, number, points, origin, rng), origin.astype(np.int32)[None]))
    return out


def _boxes(site: Site, rng: np.random.Generator) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    size = np.array(site.size)
    low = rng.uniform(0.05, 0.9, (site.boxes, 3)) * size
    low[:, 2] = 0.0
    return low, low + rng.uniform(0.03, 0.08, (site.boxes, 3)) * size * (1, 1, 5)


def _pose(site: Site, phase: npt.NDArray[Any], cycle: int) -> tuple[npt.NDArray[Any], float]:
    """Where a robot is and looks on its loop through the site."""
    turn = cycle * site.speed / (site.size[0] + site.size[1])
    wave = np.sin(np.array([3 * turn, 2 * turn, 7 * turn]) + phase)
    origin = np.array(site.size) * (0.5 + np.array([0.35, 0.35, 0.1]) * wave)
    return np.floor(origin), float(phase[0] + 5 * turn)


def _seen(
    site: Site,
    origin: npt.NDArray[Any],
    heading: float,
    low: npt.NDArray[Any],
    high: npt.NDArray[Any],
    rng: np.random.Generator,
) -> Int32s:
    """POINTS points (n, 3) where rays in the field of view first meet a wall or a box."""
    around = heading + rng.uniform(-site.spread, site.spread, 4 * POINTS)
    up = rng.uniform(-site.tilt, site.tilt, 4 * POINTS)
    ray = np.stack([np.cos(around) * np.cos(up), np.sin(around) * np.cos(up), np.sin(up)], axis=1)
    with np.errstate(divide="ignore"):
        walls = np.where(ray > 0, np.array(site.size) - origin, -origin) / ray
        near = (low - origin)[:, None] / ray
        far = (high - origin)[:, None] / ray
    enter, leave = np.minimum(near, far).max(axis=2), np.maximum(near, far).min(axis=2)
    boxes = np.where((enter > 0) & (enter < leave), enter, np.inf).min(axis=0)
    length = np.minimum(walls.min(axis=1), boxes) + rng.normal(0.0, NOISE_MM, len(ray))
    good = np.flatnonzero((length > 200.0) & (length < site.reach))[:POINTS]
    return np.floor(origin + ray[good] * length[good, None] + 0.5).astype(np.int32)


def _block(
    robot: int, number: int, points: Int32s, origin: npt.NDArray[Any], rng: np.random.Generator
) -> Block:
    n = len(points)
    return Block(
        author=robot,
        base=number * POINTS,
        xyz=points,
        alive=np.ones(n, np.bool_),
        starts=np.array([0, n], np.int64),
        cycle=np.full(1, number, np.int32),
        color=rng.integers(0, 256, (n, 3), dtype=np.uint8),
        colored=np.ones(1, np.bool_),
        parents=None,
        cores=np.zeros(0, np.int64),
        sightings=np.zeros(0, np.int64),
        sighting_cycle=np.zeros(0, np.int32),
        origin=origin.astype(np.int32).reshape(1, 3),
    )


def _clock(step: Callable[[], object]) -> float:
    started = time.process_time()
    step()
    return time.process_time() - started


def _rates(site: Site, max_ray: float, cycles: int) -> list[dict[str, Any]]:
    """Association, rays, undo and reading of one site."""
    config = FoldConfig(max_ray=max_ray)
    seen = scans(site, cycles)
    points = sum(len(scan.block.xyz) for scan in seen)
    starts = [np.array([0, len(scan.block.xyz)], np.int64) for scan in seen]
    fold, rays = DefaultFold(config), RayEvidence(config.cell_mm, config.max_ray_mm)

    def associate() -> None:
        for scan in seen:
            fold.apply(scan.block)

    def walk() -> None:
        for scan, start in zip(seen, starts, strict=True):
            block = scan.block
            rays.walk(block.author, scan.origin, start, block.xyz, block.alive, +1)

    def undo() -> None:
        for scan in reversed(seen):
            fold.undo(scan.block)

    apply_s, walk_s, undo_s, redo_s = (_clock(s) for s in (associate, walk, undo, associate))
    read_s = _clock(lambda: fold.evaluate(rays))
    cloud = np.concatenate([scan.block.xyz for scan in seen])
    tree_s = _clock(lambda: cKDTree(cloud))
    nodes = len(fold)
    rows: list[dict[str, Any]] = [
        {"name": f"{site.name}: fold with rays", "rate": points / (apply_s + walk_s)},
        {"name": f"{site.name}: association alone", "rate": points / apply_s},
        {
            "name": f"{site.name}: undo and redo",
            "to_plain_association": (undo_s + redo_s) / apply_s,
        },
        {"name": f"{site.name}: reading the states", "rate": nodes / read_s},
        {
            "name": f"{site.name}: memory",
            "nodes": nodes,
            "fold_bytes_a_node": fold.nbytes / nodes,
            "rays_bytes_a_node_and_author": rays.nbytes / nodes / ROBOTS,
        },
    ]
    for row in rows:
        row["points"] = points
        if "rate" in row:
            row["to_ckdtree"] = row["rate"] / (points / tree_s)
    return rows + _octomap(site, seen, max_ray)


def _octomap(site: Site, seen: list[Scan], max_ray: float) -> list[dict[str, Any]]:
    """The same scans into an OctoMap of the same cells, where pyoctomap installs."""
    try:
        import pyoctomap
    except ImportError:
        return []
    tree = pyoctomap.OcTree(0.1)
    part = seen[: len(seen) // 10]

    def insert() -> None:
        for scan in part:
            origin = scan.origin[0] / 1000.0
            tree.insertPointCloud(scan.block.xyz / 1000.0, origin, max_ray)

    points = sum(len(scan.block.xyz) for scan in part)
    return [{"name": f"{site.name}: pyoctomap", "points": points, "rate": points / _clock(insert)}]


def run(cycles: int = 2000) -> list[dict[str, Any]]:
    """Rows: rates in points/s of the processor's time, bytes, and ratios."""
    _rates(ROOM, 4.0, 20)  # compiled and warm
    return _rates(ROOM, 4.0, cycles) + _rates(HALL, 20.0, cycles)
