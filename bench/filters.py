"""What `quality.py` compares: simple filters over all robots' points, and DAGmap itself.

A method takes a walk and gives candidate maps by their parameters; where it has several, the best
is taken per condition, with the truth at hand. DAGmap has one configuration and no such help.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import msgspec
import numpy as np
from scipy.spatial import cKDTree

from dagmap import Agent, Config, Identity
from dagmap.config import FoldConfig, TransactionConfig
from dagmap.messages import Transactions, encode
from dagmap.model import Accepted
from dagmap.sim.fleet import Fleet
from dagmap.sim.network import Link, Network
from dagmap.worldmap import WorldMap
from office import Points, Walk

VOXEL = 0.05  # m, of the voxel filters and of OctoMap
PERIOD = 1.0  # s between ticks after the walk, until everything is out
Candidates = Iterator[tuple[str, Points]]


def raw(walk: Walk) -> Candidates:
    yield "", walk.placed()


def seen_often(times: int) -> Callable[[Walk], Candidates]:
    """Points in voxels that hold at least so many of them."""

    def method(walk: Walk) -> Candidates:
        points = walk.placed()
        _, at = np.unique(np.floor(points / VOXEL), axis=0, return_inverse=True)
        yield "", points[np.bincount(at.ravel())[at.ravel()] >= times]

    return method


def statistical(walk: Walk) -> Candidates:
    """Statistical outlier removal: mean distance to k neighbours, against that of all points."""
    points = walk.placed()
    distances = cKDTree(points).query(points, 31)[0]
    for k in (5, 10, 20, 30):
        mean = distances[:, 1 : k + 1].mean(axis=1)
        for ratio in (-0.6, -0.4, -0.2, 0.0, 0.25, 0.5, 1.0, 2.0, 4.0):
            yield f"k {k}, ratio {ratio:g}", points[mean <= mean.mean() + ratio * mean.std()]


def radius(walk: Walk) -> Candidates:
    """Radius outlier removal: so many other points within a radius."""
    points = walk.placed()
    tree = cKDTree(points)
    for length in (0.025, 0.05, 0.075, 0.10, 0.15):
        others = tree.query_ball_point(points, length, return_length=True) - 1
        for least in (1, 2, 3, 4, 6, 8, 12, 16, 24, 32):
            yield f"{100 * length:g} cm, {least} others", points[others >= least]


def octomap(walk: Walk) -> Candidates:
    """Occupancy with rays, all parameters at OctoMap's defaults: points in occupied voxels."""
    import pyoctomap

    tree = pyoctomap.OcTree(VOXEL)
    for frame in sorted((f for robot in walk.robots for f in robot), key=lambda f: f.stamp):
        tree.insertPointCloud(frame.placed, frame.pose[:3, 3], -1.0)
    points = walk.placed()
    voxels, at = np.unique(np.floor(points / VOXEL), axis=0, return_inverse=True)
    nodes = [tree.search(centre) for centre in (voxels + 0.5) * VOXEL]
    occupied = [node is not None and tree.isNodeOccupied(node) for node in nodes]
    yield "", points[np.array(occupied, np.bool_)[at.ravel()]]


def dagmap(preset: str) -> Callable[[Walk], Candidates]:
    """The map that DAGmap's robots agree on."""

    def method(walk: Walk) -> Candidates:
        fold = FoldConfig(preset=preset)  # type: ignore[arg-type]
        world = fleet_map(walk, Config(fold=fold, transaction=TransactionConfig()))
        yield "", world.positions[world.kept]

    return method


def frames_found(walk: Walk) -> Candidates:
    """The same of robots that know roughly how their frames lie, and find it.

    What is left is where the whole lies: as far off as the start that counts, that of the lowest
    author. Nobody can tell how far that is, so it is taken away.
    """
    config = Config(transaction=TransactionConfig(proof_of_work_bits=0))
    fleet = Fleet(msgspec.structs.replace(config, start_sigma=0.05), Network(Link(), 0))
    names = [f"robot{1 + i}" for i in range(len(walk.robots))]
    cycles = zip(names, walk.robots, strict=True)
    for _ in fleet.run({name: (frame.cycle() for frame in robot) for name, robot in cycles}):
        pass
    agents = [fleet.robots[name].agent for name in names]
    world = agents[0].map
    authors = [agent.identity.author for agent in agents]
    yield "", world.positions[world.kept] - walk.offsets[authors.index(min(authors))]


def fleet_map(walk: Walk, config: Config) -> WorldMap:
    """The map that the robots agree on."""
    return listener(walk, config).map


def listener(walk: Walk, config: Config) -> Agent:
    """A robot that listens to all others, in the end.

    The robots' cycles come by their stamps. The map is a pure function of the transactions, so it
    does not matter that nobody else folds them.
    """
    config = msgspec.structs.replace(
        config, transaction=msgspec.structs.replace(config.transaction, proof_of_work_bits=0)
    )
    agent = Agent(Identity.from_seed(bytes(32)), config)
    robots = [Agent(Identity.from_seed(bytes([1 + i]) * 32), config) for i in range(3)]
    order = sorted(
        ((frame.stamp, i, frame) for i, robot in enumerate(walk.robots) for frame in robot),
        key=lambda item: item[:2],
    )
    for stamp, i, frame in order:
        _tell(agent, robots[i], robots[i].observe(frame.cycle(), now=stamp))
    now = order[-1][0]
    while any(robot.holds_back for robot in robots):
        now += PERIOD
        for robot in robots:
            _tell(agent, robot, robot.tick(now))
    return agent


def _tell(agent: Agent, robot: Agent, events: list[object]) -> None:
    me = robot.identity.author
    for event in events:
        if isinstance(event, Accepted):
            agent.receive(encode(Transactions((event.data,)), robot.config, me), 0.0)


METHODS: dict[str, Callable[[Walk], Candidates]] = {
    "raw union": raw,
    "voxel seen twice": seen_often(2),
    "voxel seen three times": seen_often(3),
    "statistical outlier removal, tuned": statistical,
    "radius outlier removal, tuned": radius,
    "OctoMap": octomap,
    "DAGmap paper": dagmap("paper"),
    "DAGmap default": dagmap("default"),
    "DAGmap default, frames found": frames_found,
}
