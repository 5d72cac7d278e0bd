"""Two robots with LiDAR: KISS-ICP says where each is, frame by frame, and an Agent shares the map.

    pip install 'dagmap[lidar]'
    python examples/kiss_icp/run.py

The scans are made here: a hall with pillars, and a LiDAR whose beams do not repeat. With
your own LiDAR, `scan` is your driver, `send` is your radio, and each robot is a process of its own.
"""

from __future__ import annotations

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP

from dagmap import Agent, Config, Cycle, FoldConfig, Identity, State

HALL = np.array([12.0, 9.0, 3.0])  # m
PILLARS = np.array([[4, 3], [8, 6], [3, 7], [9, 2]])  # m, each 0.4 m in radius
FOLD = FoldConfig(delta=0.1, cell=0.25, max_ray=15.0)  # a LiDAR's scale; alike on every robot
STARTS = {"red": (1.5, 1.5, 0.0), "green": (10.5, 7.5, np.pi)}  # x y m, yaw


def pose(x: float, y: float, yaw: float) -> np.ndarray:
    """(4, 4) of a robot that stands on the floor, its LiDAR 1 m above it."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, 1.0], [0, 0, 0, 1]])


def scan(sensor: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(12000, 3) m in the sensor frame: where beams meet a wall, floor, ceiling or pillar."""
    up, round_ = rng.uniform(-0.4, 0.4, 12_000), rng.uniform(0, 2 * np.pi, 12_000)
    beams = np.stack([np.cos(up) * np.cos(round_), np.cos(up) * np.sin(round_), np.sin(up)], -1)
    rays, origin = beams @ sensor[:3, :3].T, sensor[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = np.nanmin(np.maximum((HALL - origin) / rays, -origin / rays), axis=1)
        for pillar in PILLARS:
            to, flat = pillar - origin[:2], (rays[:, :2] ** 2).sum(axis=1)
            along = rays[:, :2] @ to
            root = along**2 - flat * (to @ to - 0.4**2)
            near = (along - np.sqrt(root)) / flat
            ranges = np.where((root > 0) & (along > 0), np.minimum(ranges, near), ranges)
    return beams * (ranges + rng.normal(0, 0.01, len(ranges)))[:, None]


class Robot:
    """A SLAM and an agent. What they have in common is one call a frame: `observe`."""

    def __init__(self, name: str, start: np.ndarray) -> None:
        settings = KISSConfig()
        settings.data.max_range, settings.data.deskew = 30.0, False
        settings.mapping.voxel_size = 0.2
        settings.registration.max_num_threads = 1
        self.slam = KissICP(settings)
        config = Config(name=name, start_pose=tuple(map(tuple, start.tolist())), fold=FOLD)
        self.agent = Agent(Identity.from_seed(name.encode().ljust(32, b"\0")), config)

    def take(self, points: np.ndarray, now: float) -> None:
        _, kept = self.slam.register_frame(points, np.zeros(len(points)))  # thinned to voxels
        self.agent.observe(Cycle(stamp=now, pose=self.slam.last_pose, points=kept), now=now)


def send(robots: dict[str, Robot], now: float) -> None:
    """Everybody hears everybody, until nobody has more to say."""
    for robot in robots.values():
        robot.agent.tick(now=now)
    while letters := [(r, out) for r in robots.values() for out in r.agent.outbox()]:
        for sender, letter in letters:
            for robot in robots.values():
                if robot is not sender:
                    robot.agent.receive(letter.data, now=now)


def run(frames: int = 30) -> tuple[dict[str, Robot], dict[str, float]]:
    """Drive. Returns the robots, and how far off each one's SLAM is at the end, in m."""
    rng = np.random.default_rng(1)
    robots = {name: Robot(name, pose(*start)) for name, start in STARTS.items()}
    off = {}
    for i in range(frames):
        for name, (x, y, yaw) in STARTS.items():
            way = 0.15 * i  # m: ahead, and slowly to the left
            truth = pose(x + way * np.cos(yaw), y + way * np.sin(yaw), yaw + 0.02 * i)
            robots[name].take(scan(truth, rng), now=0.1 * i)
            found = pose(x, y, yaw) @ robots[name].slam.last_pose
            off[name] = float(np.linalg.norm(found[:3, 3] - truth[:3, 3]))
        send(robots, now=0.1 * i)
    for step in range(40):  # what was paced goes out
        send(robots, now=0.1 * (frames + step))
    return robots, off


if __name__ == "__main__":
    robots, off = run()
    for name, robot in robots.items():
        counts = ", ".join(f"{robot.agent.map.count(s):,} {s.name.lower()}" for s in State)
        print(f"{name}: {off[name]:.2f} m off; {counts}; {robot.agent.digest().hex()[:16]}")
