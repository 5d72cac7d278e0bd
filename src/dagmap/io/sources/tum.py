"""A folder as the TUM RGB-D benchmark lays it out: pictures, depth, and the poses of a SLAM.

Without poses they are found by odometry; where that loses its way, a new session begins.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...model import Cycle, Floats, RecordingError
from ._lists import Row, read_rows, rising, stamped_files
from ._odometry import PictureOdometry
from ._poses import SLACK, nearest
from ._rgbd import FrontEnd, import_cv2, load_camera
from ._source import Options, Skips, checked, folder_name, kept
from ._trajectory import stamped_pose

UNDERSTANDS = "a TUM RGB-D folder (rgb/, depth/, camera.json, groundtruth.txt)"
_PARTS = ("rgb", "depth", "groundtruth.txt", "associations.txt", "rgb.txt", "depth.txt")


@dataclass(frozen=True, slots=True)
class _Frame:
    stamp: float  # of the depth picture, s
    color: Path
    depth: Path
    line: str = ""  # where it is named, for errors


def matches(path: Path) -> bool:
    """Whether this is a folder with any of the benchmark's parts."""
    return path.is_dir() and any((path / part).exists() for part in _PARTS)


def open(path: Path, options: Options) -> TumFolder:  # noqa: A001
    """Open a folder. Raises RecordingError."""
    return TumFolder(path, options)


class TumFolder:
    """The frames of a folder that have a pose, as cycles of ORB features with depth.

    dropped: frames that were left out because no pose lies within 20 ms of their depth.
    """

    def __init__(self, path: Path, options: Options) -> None:
        self.name = folder_name(path)
        self._path, self._options = path, options
        self.skips = Skips(options.keep_going)
        self.notes: tuple[str, ...] = ()
        for part in ("rgb", "depth"):
            if not (path / part).is_dir():
                raise RecordingError(
                    f"{path}: no folder {part}/; DAGmap needs pictures with depth, in rgb/ and "
                    "depth/"
                )
        own, named = path / "camera.json", options.camera
        if named is None and not own.exists():
            raise RecordingError(
                f"{path}: no camera parameters; put a camera.json into the folder or name one "
                "with --camera FILE"
            )
        self._camera = load_camera(own if named is None else named)
        self._cv2 = import_cv2(path)
        frames = _frames(path, self.skips)
        self._placed = self._with_poses(frames, path / "groundtruth.txt")
        self.dropped = len(frames) - len(self._placed)

    def __len__(self) -> int:
        return len(self._placed)

    def __iter__(self) -> Iterator[Cycle]:
        front = FrontEnd(self._cv2, self._camera, self._options)
        odometry = PictureOdometry(self._cv2, self._camera)

        def cycle(placed: tuple[_Frame, Floats | None]) -> Cycle:
            frame, pose = placed
            picture, metres = front.read(frame.color, frame.depth)
            pose = odometry.register(picture, metres) if pose is None else pose
            points, colors, described = front.of(picture, metres)
            session = max(odometry.session, 0)
            found = Cycle(
                frame.stamp, pose, points, colors=colors, session=session, descriptors=described
            )
            return checked(found, self._path)

        yield from kept(self._placed, cycle, self.skips)

    def _with_poses(self, frames: list[_Frame], file: Path) -> list[tuple[_Frame, Floats | None]]:
        """The frames that have a pose; without a file of poses all, to be found by odometry."""
        if not file.exists():
            self.notes = ("no groundtruth.txt: odometry by OpenCV",)
            return [(frame, None) for frame in frames]
        placed = _placed(frames, file, self.skips)
        if not placed:
            raise RecordingError(
                f"{self._path}: none of {len(frames)} frames has a pose within 20 ms in "
                "groundtruth.txt; check that both use the same clock"
            )
        return placed


def _frames(path: Path, skips: Skips) -> list[_Frame]:
    """All pairs of pictures by the stamp of the depth."""
    named = path / "associations.txt"
    listed = _associated(path, named, skips) if named.exists() else _matched(path, skips)
    frames = []
    for frame in listed:
        missing = [file for file in (frame.color, frame.depth) if not _is_file(file)]
        if missing:
            by = f", named in {frame.line}" if frame.line else ""
            skips.note(RecordingError(f"{missing[0]}: missing{by}; copy it or drop its frame"))
        else:
            frames.append(frame)
    if not frames:
        raise RecordingError(
            f"{path}: an empty recording; no picture in rgb/ has one in depth/ within 20 ms"
        )
    return frames


def _is_file(picture: Path) -> bool:
    try:
        return picture.is_file()
    except OSError:  # a name too long, a folder that may not be entered
        return False


def _associated(path: Path, file: Path, skips: Skips) -> list[_Frame]:
    """The frames that associations.txt names: stamp, rgb, stamp, depth."""

    def frame(row: Row) -> _Frame:
        if len(row.words) != 4:
            raise row.wrong("`stamp rgb stamp depth` is")
        color, depth = (path / name for name in row.words[1::2])
        _number(row.words[0], row.where)
        return _Frame(_number(row.words[2], row.where), color, depth, row.where)

    frames = kept(read_rows(file), frame, skips)
    return rising(((frame.stamp, frame.line, frame) for frame in frames), skips)


def _matched(path: Path, skips: Skips) -> list[_Frame]:
    """Each depth picture with the nearest colour picture, if each is the other's nearest."""
    colors, depths = (
        stamped_files(path / f"{part}.txt", "`stamp file`", path, path / part, _number, skips)
        for part in ("rgb", "depth")
    )
    if not colors or not depths:
        return []
    color_stamps = np.array([color.stamp for color in colors])
    depth_stamps = np.array([depth.stamp for depth in depths])
    frames = []
    for depth, i in zip(depths, nearest(color_stamps, depth_stamps), strict=True):
        back = nearest(depth_stamps, color_stamps[i : i + 1])[0]
        if abs(colors[i].stamp - depth.stamp) <= SLACK and depths[back] == depth:
            frames.append(_Frame(depth.stamp, colors[i].file, depth.file))
    return frames


def _placed(frames: list[_Frame], file: Path, skips: Skips) -> list[tuple[_Frame, Floats | None]]:
    """The frames with the pose nearest to their depth, where one lies within 20 ms."""
    stamps, poses = _trajectory(file, skips)
    closest = nearest(stamps, np.array([frame.stamp for frame in frames]))
    return [
        (frame, poses[i])
        for frame, i in zip(frames, closest, strict=True)
        if abs(stamps[i] - frame.stamp) <= SLACK
    ]


def _trajectory(file: Path, skips: Skips) -> tuple[Floats, Floats]:
    """Stamps (M,) and poses (M, 4, 4) of groundtruth.txt: stamp tx ty tz qx qy qz qw."""

    def placed(row: Row) -> tuple[float, str, tuple[float, Floats]]:
        stamp, pose = stamped_pose(row)
        return stamp, row.where, (stamp, pose)

    rows = rising(kept(read_rows(file), placed, skips), skips)
    if not rows:
        raise RecordingError(f"{file}: no poses; a line `stamp tx ty tz qx qy qz qw` each")
    return np.array([stamp for stamp, _ in rows]), np.array([pose for _, pose in rows])


def _number(word: str, line: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise RecordingError(f"{line}: {word[:40]!r} is not a finite number")
    return value
