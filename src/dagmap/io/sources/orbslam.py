"""What ORB-SLAM3 has mapped, as text: the trajectory of its key frames and its map points.

A map to share at once: each key frame is a cycle, and has the points that are nearest to it of
those that lie before it. Which key frames saw a point is not in these files.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ...model import Cycle, Floats, RecordingError, Uint8s
from ._lists import read_rows
from ._source import Description, Item, Options, Skips, checked, folder_name, kept
from ._stereo import load_lens
from ._trajectory import doubts, read_tum
from .scans import READERS

UNDERSTANDS = (
    "a map of ORB-SLAM3 (KeyFrameTrajectory.txt and MapPoints.txt, .csv, .xyz, .ply, .pcd)"
)
_TRAJECTORIES = ("KeyFrameTrajectory.txt", "kf_*.txt")
_POINTS = {"mappoints", "referencemappoints", "pointcloud"}
_MOUNTED = ("mav0/cam0/sensor.yaml", "cam0/sensor.yaml", "sensor.yaml")  # EuRoC's, with T_BS
_TEXTS = (".txt", ".csv", ".xyz")
_CONE = np.cos(np.radians(50.0))  # half of a wide lens: what lies further aside was not seen
_BLOCK = 1 << 21  # pairs of a point and a key frame at a time
_NOBODY = -1


def matches(path: Path) -> bool:
    """Whether this is a folder with a trajectory of key frames and map points."""
    return path.is_dir() and _files(path) is not None


def lacks(path: Path) -> str:
    """What is missing of a map."""
    trajectories, points = _parts(path)
    if points and not trajectories:
        return f"no KeyFrameTrajectory.txt beside {points[0].name}; have ORB-SLAM3 save it"
    if trajectories and not points:
        return f"no MapPoints.txt beside {trajectories[0].name}; write a line `x y z` for each"
    return ""


def open(path: Path, options: Options) -> OrbSlamMap:  # noqa: A001
    """Open a map. Raises RecordingError."""
    return OrbSlamMap(path, options)


def describe(path: Path, options: Options) -> Description:
    """Key frames and points."""
    source = open(path, options)
    items = (
        Item(source.files[0].name, "poses of the camera", len(source), "cycles"),
        Item(source.files[1].name, "3D points", source.count, "points"),
    )
    notes = ("of a single camera the scale is ORB-SLAM3's own, not metres",)
    return Description("map of ORB-SLAM3", items, len(source), None, (*source.notes, *notes))


class OrbSlamMap:
    """The key frames of a map as cycles. files: the two; count: its points; dropped: of them,
    those that no key frame has before it."""

    def __init__(self, path: Path, options: Options) -> None:
        found = _files(path)
        if found is None:
            raise RecordingError(f"{path}: no KeyFrameTrajectory.txt and MapPoints.txt in it")
        self.name, self.files, self._options = folder_name(path), found, options
        self.skips = Skips(options.keep_going)
        self._stamps, self._poses = read_tum(found[0], self.skips).all()
        whose = self._bring_to_camera(path)
        points, colors = self._read(found[1])
        seen = np.isfinite(points).all(axis=1)
        self._points, self._colors = points[seen], None if colors is None else colors[seen]
        self.count = len(points)
        if not len(self._points):
            raise RecordingError(f"{found[1]}: no points; save the map after it has been built")
        self._owner = _owners(self._points, self._poses, options)
        self.dropped = int((self._owner == _NOBODY).sum()) + int((~seen).sum())
        self.notes = (f"{self.dropped} of {self.count} points before no key frame", *whose)

    def __len__(self) -> int:
        return len(self._stamps)

    def __iter__(self) -> Iterator[Cycle]:
        yield from kept(range(len(self)), self._cycle, self.skips)

    def _cycle(self, i: int) -> Cycle:
        pose, rows = self._poses[i], np.flatnonzero(self._owner == i)
        if len(rows) > self._options.max_features:
            most = self._options.max_features
            rows = rows[np.arange(most) * len(rows) // most]
        places = (self._points[rows] - pose[:3, 3]) @ pose[:3, :3]
        colors, ids = None if self._colors is None else self._colors[rows], rows.astype(np.uint64)
        cycle = Cycle(float(self._stamps[i]), pose, places, ids=ids, colors=colors)
        return checked(cycle, self.files[1])

    def _bring_to_camera(self, path: Path) -> tuple[str, ...]:
        """Poses of the body become those of the left camera; what to tell of them."""
        if not self._options.body_poses:
            return doubts(self.files[0], self._options.same_frame)
        places = [path / name for name in _MOUNTED]
        file = next((place for place in places if place.is_file()), None)
        if file is None:
            raise RecordingError(
                f"{places[0]}: missing; poses of the body (--body-poses) are brought to the camera "
                "by its T_BS, so copy EuRoC's sensor.yaml of cam0 to there"
            )
        self._poses = self._poses @ load_lens(file).mounted
        return (f"poses of the body, brought to the camera by {file}",)

    def _read(self, file: Path) -> tuple[Floats, Uint8s | None]:
        if file.suffix.lower() in READERS:
            return READERS[file.suffix.lower()](file)
        rows: list[list[float]] = []
        for row in read_rows(file):
            try:
                rows.append(_place(row.words))
            except ValueError:
                names = not rows and all(word.isalpha() for word in row.words)  # of the columns
                if not names:
                    self.skips.note(row.wrong("`x y z` is"))
        return np.array(rows, np.float64).reshape(-1, 3), None


def _place(words: list[str]) -> list[float]:
    """Raises ValueError where they do not begin with three numbers."""
    x, y, z = (float(word) for word in words[:3])
    return [x, y, z]


def _files(path: Path) -> tuple[Path, Path] | None:
    """The trajectory of the key frames and the points."""
    trajectories, points = _parts(path)
    return (trajectories[0], points[0]) if trajectories and points else None


def _parts(path: Path) -> tuple[list[Path], list[Path]]:
    trajectories = [file for name in _TRAJECTORIES for file in sorted(path.glob(name))]
    suffixes = {*_TEXTS, ".ply", ".pcd"}
    points = [
        file
        for file in sorted(path.iterdir())
        if file.suffix.lower() in suffixes and file.stem.lower().replace("_", "") in _POINTS
    ]
    return trajectories, points


def _owners(points: Floats, poses: Floats, options: Options) -> npt.NDArray[np.int64]:
    """(N,) for points (N, 3): the nearest of the key frames (M, 4, 4) that have it before them."""
    most = np.inf if options.max_depth is None else options.max_depth
    out = np.full(len(points), _NOBODY, np.int64)
    step = max(1, _BLOCK // len(poses))
    with np.errstate(over="ignore", invalid="ignore"):
        for i in range(0, len(points), step):
            away = points[i : i + step, None] - poses[None, :, :3, 3]
            distance = np.sqrt((away**2).sum(axis=2))
            depth = (away * poses[None, :, :3, 2]).sum(axis=2)
            seen = (depth > _CONE * distance) & (distance <= most)
            distance = np.where(seen, distance, np.inf)
            nearest = distance.argmin(axis=1)
            near = np.isfinite(distance[np.arange(len(nearest)), nearest])
            out[i : i + step][near] = nearest[near]
    return out
