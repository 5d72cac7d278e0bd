"""A folder of point clouds with the poses of their moments: KITTI, or any PCD or PLY files.

`velodyne/*.bin` (or `*.bin`, `*.pcd`, `*.ply` in the folder itself or in one called `clouds`,
`scans`, `pcd` or `ply`), in the order of their names; `poses.txt` in KITTI's format (12 numbers a
line) or in TUM's (stamp, place, quaternion); `times.txt` with a stamp a line; `calib.txt` with `Tr`
where KITTI's poses are those of its camera. Without poses: odometry by KISS-ICP.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from ...model import Cycle, Floats, RecordingError, Uint8s
from ..ply import read_vertices
from ._cloud import doubles, thinned
from ._kiss import KissIcp
from ._lists import Row, read_rows, rising
from ._pcd import read_pcd
from ._poses import inverse
from ._source import (
    Description,
    Item,
    Options,
    Skips,
    checked,
    described,
    folder_name,
    kept,
    read_bytes,
)
from ._trajectory import read_tum

UNDERSTANDS = "a folder of clouds (KITTI's .bin, .pcd or .ply; poses.txt)"
_FOLDERS = ("velodyne", "velodyne_points/data", "clouds", "scans", "pcd", "ply", ".")
_SUFFIXES = (".bin", ".pcd", ".ply")
_PERIOD = 0.1  # s between scans without stamps: what most LiDARs do
_WHOLE_KITTI = 4  # numbers of a point: x y z and the reflectance
_COLORS = ("red", "green", "blue")
_T = TypeVar("_T")
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
    return described(UNDERSTANDS, items, partial(open, path, options))


class ScanFolder:
    """The clouds of a folder as cycles. dropped: clouds without a pose."""

    def __init__(self, path: Path, options: Options) -> None:
        self.name, self._path, self._options = folder_name(path), path, options
        self.skips = Skips(options.keep_going)
        stamps, clouds = _stamps(path, _clouds(path), self.skips)
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

        def cycle(i: int) -> Cycle:
            cloud = self._clouds[i]
            points, colors = READERS[cloud.suffix.lower()](cloud)
            pose = self._poses[i] if self._poses is not None else np.eye(4)
            if odometry is not None:
                pose = odometry.register(points, cloud)
            points, colors = thinned(points, colors, self._options)
            return checked(Cycle(self._stamps[i], pose, points, colors=colors), cloud)

        yield from kept(range(len(self)), cycle, self.skips)

    def _placed(
        self, file: Path, stamps: list[float] | None, clouds: list[Path]
    ) -> tuple[list[float], list[Path], list[Floats]]:
        """Stamps, clouds and poses where there are all three."""
        rows = read_rows(file)
        if rows and len(rows[0].words) == 8:
            return self._by_stamp(file, stamps, clouds)
        self._require_mounted(clouds)
        poses = _kitti_poses(file, rows, self._path, self.skips)
        pairs = _aligned(file, "poses", len(poses), clouds, self.skips)
        self.dropped = len(clouds) - len(pairs)
        stamps = stamps or _even(len(clouds))
        at = dict(zip(clouds, stamps, strict=True))
        return [at[c] for c, _ in pairs], [c for c, _ in pairs], [poses[i] for _, i in pairs]

    def _require_mounted(self, clouds: list[Path]) -> None:
        """KITTI's poses are those of its camera."""
        file = self._path / "calib.txt"
        kitti = clouds[0].suffix == ".bin" and clouds[0].parent.name == "velodyne"
        if kitti and not file.is_file() and not self._options.same_frame:
            raise RecordingError(
                f"{file}: missing; KITTI's poses are those of its camera, so copy the sequence's "
                "calib.txt (Tr: from the LiDAR to it), or say --same-frame if the poses are the "
                "LiDAR's"
            )

    def _by_stamp(
        self, file: Path, stamps: list[float] | None, clouds: list[Path]
    ) -> tuple[list[float], list[Path], list[Floats]]:
        trajectory = read_tum(file, self.skips)
        if stamps is None:
            raise RecordingError(
                f"{self._path}: {file.name} goes by stamps, but the clouds have none; name them by "
                "their stamps in s (1305031102.175304.pcd), or write times.txt, a stamp a line"
            )
        found = [(s, c, trajectory.at(s)) for s, c in zip(stamps, clouds, strict=True)]
        placed = [(s, c, pose) for s, c, pose in found if pose is not None]
        self.dropped = len(clouds) - len(placed)
        if not placed:
            raise RecordingError(
                f"{file}: none of {len(clouds)} clouds has a pose for its moment; check that both "
                "use the same clock"
            )
        return [s for s, _, _ in placed], [c for _, c, _ in placed], [p for _, _, p in placed]


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


def _stamps(path: Path, clouds: list[Path], skips: Skips) -> tuple[list[float] | None, list[Path]]:
    """From times.txt, else from names such as 1305031102.175304; None where there are none. And the
    clouds that have one."""
    file = path / "times.txt"
    if file.is_file():
        stamps = _in_order(read_rows(file), lambda row: row.numbers(1)[0], skips)
        pairs = _aligned(file, "stamps", len(stamps), clouds, skips)
        rows = ((stamps[i], f"{file}, stamp {i + 1}", (stamps[i], cloud)) for cloud, i in pairs)
        found = rising(rows, skips)
        if not found:
            raise RecordingError(f"{file}: no stamps; one a line is wanted, or remove the file")
        return [stamp for stamp, _ in found], [cloud for _, cloud in found]
    if all(re.fullmatch(r"\d+\.\d+", cloud.stem) for cloud in clouds):
        return [float(cloud.stem) for cloud in clouds], clouds
    return None, clouds


def _in_order(rows: list[Row], convert: Callable[[Row], _T], skips: Skips) -> list[_T]:
    """Of lines that count by their number: those before the first that cannot be read."""
    found: list[_T] = []
    try:
        for row in rows:
            found.append(convert(row))
    except RecordingError as error:
        skips.note(error)
    return found


def _aligned(
    file: Path, what: str, count: int, clouds: list[Path], skips: Skips
) -> list[tuple[Path, int]]:
    """Clouds with the number of their line. Where there are not as many lines as clouds, the number
    in the cloud's name counts, as KITTI has it."""
    if count == len(clouds):
        return [(cloud, i) for i, cloud in enumerate(clouds)]
    fault = RecordingError(
        f"{file}: {count} {what} for {len(clouds)} clouds; one a cloud is wanted, in the order of "
        "the clouds' names"
    )
    if all(re.fullmatch(r"\d{1,9}", cloud.stem) for cloud in clouds):
        skips.note(fault)
        return [(cloud, int(cloud.stem)) for cloud in clouds if int(cloud.stem) < count]
    if count > len(clouds):
        raise fault  # which cloud is missing cannot be told
    skips.note(fault)
    return [(cloud, i) for i, cloud in enumerate(clouds[:count])]


def _kitti_poses(file: Path, rows: list[Row], path: Path, skips: Skips) -> list[Floats]:
    """(4, 4) each: of the LiDAR, where calib.txt says how it is mounted to KITTI's camera."""
    poses = []
    mounted = _calibration(path / "calib.txt")
    for values in _in_order(rows, lambda row: row.numbers(12), skips):
        pose = np.eye(4)
        pose[:3] = np.reshape(values, (3, 4))
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
    for row in read_rows(file):
        if row.words[0] in ("Tr:", "Tr_velo_to_cam:"):
            out[:3] = np.reshape(row.numbers(12, first=1), (3, 4))
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
