"""A folder of point clouds with the poses of their moments: KITTI, or any PCD or PLY files.

`velodyne/*.bin` (or `*.bin`, `*.pcd`, `*.ply` in the folder itself or in one called `clouds`,
`scans`, `pcd` or `ply`), in the order of their names; `poses.txt` in KITTI's format (12 numbers a
line) or in TUM's (stamp, place, quaternion); `times.txt` with a stamp a line; `calib.txt` with `Tr`
where KITTI's poses are those of its camera. Without poses: odometry by KISS-ICP.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

from ...model import Cycle, Floats, RecordingError, Uint8s
from ..ply import read_vertices
from ._cloud import doubles, thinned
from ._kiss import KissIcp
from ._pcd import read_pcd
from ._poses import inverse
from ._source import (
    Description,
    Item,
    Options,
    Skips,
    checked,
    folder_name,
    read_bytes,
    read_rows,
)
from ._trajectory import numbers, read_tum

UNDERSTANDS = "a folder of clouds (KITTI's .bin, .pcd or .ply; poses.txt)"
_FOLDERS = ("velodyne", "velodyne_points/data", "clouds", "scans", "pcd", "ply", ".")
_SUFFIXES = (".bin", ".pcd", ".ply")
_PERIOD = 0.1  # s between scans without stamps: what most LiDARs do
_WHOLE_KITTI = 4  # numbers of a point: x y z and the reflectance
_COLORS = ("red", "green", "blue")
_FITS = np.dtype([(name, "u1") for name in _COLORS])


def matches(path: Path) -> bool:
    """Whether this is a folder with clouds in one of the usual places."""
    return path.is_dir() and bool(_clouds(path))


def open(path: Path, options: Options) -> ScanFolder:  # noqa: A001
    """Open a folder of clouds. Raises RecordingError."""
    return ScanFolder(path, options)


def describe(path: Path, options: Options) -> Description:
    """The clouds, and where their poses come from."""
    clouds = _clouds(path)
    items = (
        Item(str(clouds[0].parent.relative_to(path)), clouds[0].suffix, len(clouds), "clouds"),
    )
    try:
        source = open(path, options)
    except RecordingError as error:
        return Description(UNDERSTANDS, items, None, str(error))
    return Description(UNDERSTANDS, items, len(source), None, source.notes)


class ScanFolder:
    """The clouds of a folder as cycles. dropped: clouds without a pose."""

    def __init__(self, path: Path, options: Options) -> None:
        self.name, self._path, self._options = folder_name(path), path, options
        self.skips = Skips(options.keep_going)
        clouds = _clouds(path)
        stamps = _stamps(path, clouds)
        file = path / "poses.txt" if options.poses is None else options.poses
        self.dropped = 0
        self.notes: tuple[str, ...] = (f"poses of {file}",)
        self._poses: list[Floats] | None = None
        if options.poses is None and not file.is_file():
            KissIcp.require(path)
            self.notes = ("no poses.txt: odometry by KISS-ICP",)
        else:
            stamps, clouds, self._poses = self._placed(file, stamps, clouds)
        self._stamps, self._clouds = stamps or _even(len(clouds)), clouds

    def __len__(self) -> int:
        return len(self._clouds)

    def __iter__(self) -> Iterator[Cycle]:
        odometry = KissIcp(self._options) if self._poses is None else None
        for i, (stamp, cloud) in enumerate(zip(self._stamps, self._clouds, strict=True)):
            try:
                points, colors = READERS[cloud.suffix.lower()](cloud)
                pose = self._poses[i] if self._poses is not None else np.eye(4)
                if odometry is not None:
                    pose = odometry.register(points, cloud)
                points, colors = thinned(points, colors, self._options)
                cycle = checked(Cycle(stamp, pose, points, colors=colors), cloud)
            except RecordingError as error:
                self.skips.note(error)
                continue
            yield cycle

    def _placed(
        self, file: Path, stamps: list[float] | None, clouds: list[Path]
    ) -> tuple[list[float], list[Path], list[Floats]]:
        """Stamps, clouds and poses where there are all three."""
        rows = read_rows(file)
        if rows and len(rows[0][1]) == 8:
            return self._by_stamp(file, stamps, clouds)
        poses = _kitti_poses(file, rows, self._path)
        if len(poses) != len(clouds):
            self.skips.note(
                RecordingError(
                    f"{file}: {len(poses)} poses for {len(clouds)} clouds; one a cloud is wanted, "
                    "in the order of the clouds' names"
                )
            )
        count = min(len(poses), len(clouds))
        self.dropped = len(clouds) - count
        return (stamps or _even(len(clouds)))[:count], clouds[:count], poses[:count]

    def _by_stamp(
        self, file: Path, stamps: list[float] | None, clouds: list[Path]
    ) -> tuple[list[float], list[Path], list[Floats]]:
        trajectory = read_tum(file)
        if stamps is None:
            raise RecordingError(
                f"{self._path}: {file.name} goes by stamps, but the clouds have none; name them by "
                "their stamps in s (1305031102.175304.pcd), or write times.txt, a stamp a line"
            )
        found = [(s, c, trajectory.at(s)) for s, c in zip(stamps, clouds, strict=True)]
        kept = [(s, c, pose) for s, c, pose in found if pose is not None]
        self.dropped = len(clouds) - len(kept)
        if not kept:
            raise RecordingError(
                f"{file}: none of {len(clouds)} clouds has a pose for its moment; check that both "
                "use the same clock"
            )
        return [s for s, _, _ in kept], [c for _, c, _ in kept], [p for _, _, p in kept]


def _clouds(path: Path) -> list[Path]:
    """The files of the first place and kind that has some, by the numbers in their names."""
    for folder in _FOLDERS:
        place = path / folder
        if place.is_dir() and not (folder == "." and (path / "rgb").is_dir()):  # a TUM folder
            for suffix in _SUFFIXES:
                found = [file for file in place.glob(f"[!.]*{suffix}") if file.is_file()]
                if found:
                    return sorted(found, key=_by_number)
    return []


def _by_number(file: Path) -> tuple[float, str]:
    number = re.search(r"\d+(\.\d+)?$", file.stem)
    return (float(number[0]) if number else -1.0, file.name)


def _even(count: int) -> list[float]:
    return [_PERIOD * i for i in range(count)]


def _stamps(path: Path, clouds: list[Path]) -> list[float] | None:
    """From times.txt, else from names such as 1305031102.175304; None where there are none."""
    file = path / "times.txt"
    if file.is_file():
        rows = read_rows(file)
        stamps = [numbers(file, number, words, 1)[0] for number, words in rows]
        if len(stamps) != len(clouds):
            raise RecordingError(
                f"{file}: {len(stamps)} stamps for {len(clouds)} clouds; one a line is wanted"
            )
        _require_rising(file, stamps)
        return stamps
    if all(re.fullmatch(r"\d+\.\d+", cloud.stem) for cloud in clouds):
        return [float(cloud.stem) for cloud in clouds]
    return None


def _require_rising(file: Path, stamps: list[float]) -> None:
    for i, (a, b) in enumerate(pairwise(stamps)):
        if b <= a:
            raise RecordingError(
                f"{file}: stamp {i + 2}, {b}, does not come after {a}; stamps must rise"
            )


def _kitti_poses(file: Path, rows: list[tuple[int, list[str]]], path: Path) -> list[Floats]:
    """(4, 4) each: of the LiDAR, where calib.txt says how it is mounted to KITTI's camera."""
    poses = []
    mounted = _calibration(path / "calib.txt")
    for number, words in rows:
        pose = np.eye(4)
        pose[:3] = np.reshape(numbers(file, number, words, 12), (3, 4))
        with np.errstate(over="ignore", invalid="ignore"):  # what is no pose is refused later
            poses.append(inverse(mounted) @ pose @ mounted)
    if not poses:
        raise RecordingError(f"{file}: no poses; 12 numbers (KITTI) or 8 (TUM) a line are wanted")
    return poses


def _calibration(file: Path) -> Floats:
    """`Tr` of a KITTI odometry calib.txt: from the LiDAR to the camera; the identity without it."""
    out = np.eye(4)
    if not file.is_file():
        return out
    for number, words in read_rows(file):
        if words[0] in ("Tr:", "Tr_velo_to_cam:"):
            out[:3] = np.reshape(numbers(file, number, words[1:], 12), (3, 4))
            return out
    raise RecordingError(
        f"{file}: no line `Tr:`, from the LiDAR to the camera; add it, or remove it"
    )


def _read_bin(path: Path) -> tuple[Floats, Uint8s | None]:
    data = read_bytes(path)
    if not data or len(data) % (4 * _WHOLE_KITTI):
        raise RecordingError(
            f"{path}: {len(data)} bytes are no whole number of points of 16 bytes (x y z "
            "reflectance, float32); it is cut short or of another format"
        )
    rows = np.frombuffer(data, "<f4").reshape(-1, _WHOLE_KITTI)
    return doubles(rows[:, :3]), None


def _read_ply(path: Path) -> tuple[Floats, Uint8s | None]:
    rows = read_vertices(path, tuple("xyz"), "copy or write it anew", _FITS)
    points = np.stack([doubles(rows[axis]) for axis in "xyz"], axis=1)
    if not set(_COLORS) <= set(rows.dtype.names or ()):
        return points, None
    return points, np.stack([rows[name].astype(np.uint8) for name in _COLORS], axis=1)


READERS = {".bin": _read_bin, ".pcd": read_pcd, ".ply": _read_ply}
