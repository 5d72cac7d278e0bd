"""What `quality.py` measures on: a walk cut in three robots, and what may go wrong with it.

Everything is a function of the recording and a seed. Lengths are metres.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dagmap.io.sources import open_source
from dagmap.io.sources._lists import read_rows
from dagmap.io.sources._rgbd import Camera, import_cv2, load_camera
from dagmap.metrics import thin
from dagmap.model import Cycle

Points = npt.NDArray[np.float64]
ROBOTS = 3
EVERY = 3  # frames of the walk to a cycle
COARSE = 8  # pixels between the depths that are kept of a frame
FACTOR = (0.3, 1.6)  # along the ray, of a displaced point
PERSON_RADIUS, PERSON_ABOVE, PERSON_BELOW = 0.25, 0.15, 1.45  # m, about the height of the camera
WALKING = 1.0  # m/s
PEOPLE = 3


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One cycle of one robot."""

    stamp: float
    pose: Points  # (4, 4) sensor to fleet
    points: Points  # (N, 3) in the sensor frame
    depth: npt.NDArray[np.float32]  # every COARSE-th pixel either way, 0: unknown
    false: npt.NDArray[np.bool_]  # (N,) points that are not there: displaced, or of people
    descriptors: npt.NDArray[np.uint8] | None = None  # (N, 32) where the points are the recorded

    @property
    def placed(self) -> Points:
        """(N, 3) in the fleet frame."""
        return self.points @ self.pose[:3, :3].T + self.pose[:3, 3]

    def cycle(self) -> Cycle:
        return Cycle(self.stamp, self.pose, self.points, descriptors=self.descriptors)


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """robots: the frames of each. dense: all depth pictures. camera: of all of them.

    offsets: (3, 3) how far each robot's frame is off.
    """

    robots: tuple[tuple[Frame, ...], ...]
    dense: Points
    camera: Camera
    offsets: Points = field(default_factory=lambda: np.zeros((ROBOTS, 3)))

    def placed(self) -> Points:
        return np.concatenate([frame.placed for robot in self.robots for frame in robot])

    def map(self, change: object) -> Walk:
        """The walk with `change(robot, frame)` in the place of each frame."""
        robots = tuple(
            tuple(change(i, frame) for frame in robot)  # type: ignore[operator]
            for i, robot in enumerate(self.robots)
        )
        return replace(self, robots=robots)


def load(folder: Path, cache: Path) -> Walk:
    """The walk without any change; ORB points and clouds are kept in `cache`."""
    camera = load_camera(folder / "camera.json")
    kept = cache / f"{folder.resolve().name}-described.npz"
    if not kept.exists():
        cache.mkdir(parents=True, exist_ok=True)
        part = kept.with_suffix(".part.npz")
        np.savez_compressed(part, **_extract(folder, camera))
        part.replace(kept)
    with np.load(kept) as archive:
        held = {name: archive[name] for name in archive.files}
    frames = [
        Frame(
            float(held["stamp"][i]),
            held["pose"][i],
            held["points"][a:b],
            held["depth"][i],
            np.zeros(b - a, np.bool_),
            held["descriptors"][a:b],
        )
        for i, (a, b) in enumerate(zip(held["offsets"][:-1], held["offsets"][1:], strict=True))
    ]
    robots = tuple(
        tuple(frame for frame, who in zip(frames, held["robot"], strict=True) if who == robot)
        for robot in range(ROBOTS)
    )
    return Walk(robots, held["dense"], camera)


def _extract(folder: Path, camera: Camera) -> dict[str, npt.NDArray[np.generic]]:
    """Every third frame of three ranges with its ORB points, and the cloud of all depths."""
    cycles = list(open_source(folder))
    depths = {float(words[2]): folder / words[3] for _, words in _rows(folder)}
    bounds = [len(cycles) // ROBOTS + (r < len(cycles) % ROBOTS) for r in range(ROBOTS)]
    ends = np.cumsum(bounds)
    cv2 = import_cv2(folder)
    dense, coarse, chosen, owner = [np.zeros((0, 3))], [], [], []
    for i, cycle in enumerate(cycles):
        picture = cv2.imread(str(depths[cycle.stamp]), cv2.IMREAD_UNCHANGED) / camera.depth_scale
        pose = np.asarray(cycle.pose, np.float64)
        dense.append(thin(_unproject(picture[::4, ::4], camera, 4) @ pose[:3, :3].T + pose[:3, 3]))
        robot = int(np.searchsorted(ends, i, side="right"))
        if (i - (ends[robot] - bounds[robot])) % EVERY == 0:
            chosen.append(cycle)
            owner.append(robot)
            coarse.append(picture[::COARSE, ::COARSE].astype(np.float32))
    starts = {r: chosen[owner.index(r)].stamp for r in range(ROBOTS)}
    points = [np.asarray(cycle.points, np.float64) for cycle in chosen]
    return {
        "stamp": np.array([c.stamp - starts[r] for c, r in zip(chosen, owner, strict=True)]),
        "pose": np.array([c.pose for c in chosen], np.float64),
        "points": np.concatenate(points),
        "descriptors": np.concatenate([np.asarray(cycle.descriptors) for cycle in chosen]),
        "offsets": np.cumsum([0, *map(len, points)]),
        "robot": np.array(owner),
        "depth": np.array(coarse),
        "dense": thin(np.concatenate(dense)),
    }


def _rows(folder: Path) -> list[tuple[int, list[str]]]:
    return read_rows(folder / "associations.txt")


def _unproject(depth: Points, camera: Camera, step: int) -> Points:
    v, u = np.nonzero(depth)
    z = depth[v, u]
    x = (u * step - camera.cx) / camera.fx * z
    return np.stack([x, (v * step - camera.cy) / camera.fy * z, z], axis=1)


def displaced(walk: Walk, share: float, rng: np.random.Generator) -> Walk:
    """A share of the points moved along their rays."""

    def change(_: int, frame: Frame) -> Frame:
        chosen = rng.random(len(frame.points)) < share
        factor = np.where(chosen, rng.uniform(*FACTOR, len(chosen)), 1.0)
        return replace(frame, points=frame.points * factor[:, None], false=frame.false | chosen)

    return walk.map(change)


def shifted(walk: Walk, length: float, rng: np.random.Generator) -> Walk:
    """Each robot's frame is off by `length` in a random direction."""
    directions = rng.normal(size=(ROBOTS, 3))
    offsets = length * directions / np.linalg.norm(directions, axis=1, keepdims=True)

    def change(robot: int, frame: Frame) -> Frame:
        pose = frame.pose.copy()
        pose[:3, 3] += offsets[robot]
        return replace(frame, pose=pose)

    return replace(walk.map(change), offsets=offsets)


def peopled(walk: Walk, rng: np.random.Generator) -> Walk:
    """People walk along the robots' paths, where there is room; all robots see the same ones.

    A person is an upright cylinder. It hides what is behind it, and gives as many points as its
    share of the picture would.
    """
    path = np.concatenate([[f.pose[:3, 3] for f in robot] for robot in walk.robots])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    starts = rng.uniform(0, along[-1], PEOPLE)
    up = _up(walk)

    def change(_: int, frame: Frame) -> Frame:
        at = (starts + WALKING * frame.stamp) % along[-1]
        people = np.stack([np.interp(at, along, path[:, axis]) for axis in range(3)], axis=1)
        pixels = rng.uniform([0, 0], [walk.camera.width, walk.camera.height], (1000, 2))
        rays = _rays(pixels, walk.camera)
        z = _meets(rays, frame.pose, people, up)
        rows, columns = (pixels[:, ::-1] // COARSE).astype(int).T
        behind = frame.depth[rows, columns]
        seen = np.isfinite(z) & ((behind == 0) | (z < behind)) & (z > 0.3)
        hidden = _meets(frame.points / frame.points[:, 2:], frame.pose, people, up)
        kept = frame.points[~(hidden < frame.points[:, 2])]
        points = np.concatenate([kept, rays[seen] * z[seen, None]])
        false = np.arange(len(points)) >= len(kept)
        return replace(frame, points=points, false=false, descriptors=None)

    return walk.map(change)


def _up(walk: Walk) -> Points:
    """Cameras are held level on the whole: up is against the mean of their y axes."""
    up = -np.mean([f.pose[:3, 1] for robot in walk.robots for f in robot], axis=0)
    return np.asarray(up / np.linalg.norm(up))


def _rays(pixels: Points, camera: Camera) -> Points:
    """(N, 3) directions with z = 1."""
    x = (pixels[:, 0] - camera.cx) / camera.fx
    return np.stack([x, (pixels[:, 1] - camera.cy) / camera.fy, np.ones(len(x))], axis=1)


def _meets(rays: Points, pose: Points, people: Points, up: Points) -> Points:
    """(N,) depth at which each ray meets the first person, infinity where it meets none."""
    best = np.full(len(rays), np.inf)
    directions = rays @ pose[:3, :3].T
    rise = directions @ up
    flat = directions - rise[:, None] * up
    for person in people:
        to = person - pose[:3, 3]
        height, to = to @ up, to - (to @ up) * up
        a, b = (flat**2).sum(axis=1), flat @ to
        root = b**2 - a * (to @ to - PERSON_RADIUS**2)
        z = (b - np.sqrt(np.maximum(root, 0))) / a
        meets = z * rise - height
        hit = (root > 0) & (z > 0) & (meets < PERSON_ABOVE) & (meets > -PERSON_BELOW)
        best = np.where(hit, np.minimum(best, z), best)
    return best


def rotating(walk: Walk, rng: np.random.Generator) -> Walk:
    """The second robot turns on the spot instead: it sees what lies around, from one place."""
    middle = walk.robots[1][len(walk.robots[1]) // 2].pose
    up, cloud = _up(walk), walk.placed()
    frames = []
    for i, frame in enumerate(walk.robots[1]):
        pose = middle.copy()
        pose[:3, :3] = _about(up, 2 * np.pi * i / len(walk.robots[1])) @ middle[:3, :3]
        local = (cloud - pose[:3, 3]) @ pose[:3, :3]
        points = local[list(_visible(local, walk.camera))]
        points = points[rng.permutation(len(points))[: len(frame.points)]]
        noise = rng.normal(0, 0.002, len(points)) * points[:, 2]  # of a depth camera, about
        points = points * (1 + noise)[:, None]
        false = np.zeros(len(points), bool)
        frames.append(replace(frame, pose=pose, points=points, false=false, descriptors=None))
    return replace(walk, robots=(walk.robots[0], tuple(frames), walk.robots[2]))


def _about(axis: Points, angle: float) -> Points:
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def _visible(local: Points, camera: Camera) -> Iterator[int]:
    """Rows in the picture that nothing hides, by a depth buffer of COARSE pixels."""
    z = np.where(local[:, 2] > 0.3, local[:, 2], np.nan)
    u, v = camera.fx * local[:, 0] / z + camera.cx, camera.fy * local[:, 1] / z + camera.cy
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    rows = np.flatnonzero(inside)
    cell = (v[rows] // COARSE).astype(int) * camera.width + (u[rows] // COARSE).astype(int)
    nearest = np.full(int(cell.max(initial=0)) + 1, np.inf)
    np.minimum.at(nearest, cell, z[rows])
    yield from rows[z[rows] < nearest[cell] + 0.1].tolist()
