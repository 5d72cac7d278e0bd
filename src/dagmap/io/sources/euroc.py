"""An EuRoC folder (`mav0/cam0`, `mav0/cam1`, sensor.yaml): stereo through OpenCV.

Poses are those of `state_groundtruth_estimate0/`, of a TUM file that is named, or those of odometry
by OpenCV where there is neither; where that loses its way, a new session begins.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from ...model import Cycle, Floats, RecordingError, Uint8s
from . import orbslam
from ._lists import Row, Stamped, read_rows, stamped_files
from ._odometry import PictureOdometry
from ._poses import Trajectory, matrix, nearest
from ._rgbd import FrontEnd, decode, import_cv2
from ._source import Description, Item, Options, Skips, checked, described, folder_name, kept
from ._stereo import Lens, Stereo, load_lens
from ._trajectory import doubts, read_tum

UNDERSTANDS = "an EuRoC folder (mav0/cam0, mav0/cam1, their sensor.yaml)"
_TRUTH = "state_groundtruth_estimate0"
_SLACK = 5_000_000  # ns: cameras of one moment; a hand-held rig moves millimetres meanwhile
_MOST_NS = 1 << 62


@dataclass(frozen=True, slots=True)
class _Pair:
    left: Stamped  # whole ns
    right: Stamped
    pose: Floats | None  # of the rectified left camera


def matches(path: Path) -> bool:
    """Whether this is a folder with the cameras of such a recording, or one with them in mav0/."""
    mav = _mav(path) if path.is_dir() else None
    if mav is None:
        return False
    return (mav / "cam0" / "data").is_dir() or not orbslam.matches(path)  # a map and its T_BS


def open(path: Path, options: Options) -> EurocFolder:  # noqa: A001
    """Open a folder. Raises RecordingError."""
    return EurocFolder(path, options)


def describe(path: Path, options: Options) -> Description:
    """The cameras, and where the poses come from."""
    mav = _mav(path) or path
    counts = {name: _count(mav / name / "data") for name in ("cam0", "cam1")}
    items = tuple(Item(name, "pictures", n, "stereo") for name, n in counts.items())
    return described(UNDERSTANDS, items, partial(open, path, options))


class EurocFolder:
    """The pairs of pictures as cycles of ORB features with the depth of the stereo.

    dropped: pictures of the left camera without one of the right, or without a pose.
    """

    def __init__(self, path: Path, options: Options) -> None:
        self.name = folder_name(path)
        self._mav = _mav(path) or path
        if self.name == "mav0":
            self.name = folder_name(path / "..")
        self._path, self._options = path, options
        self.skips = Skips(options.keep_going)
        lenses = self._lens("cam0"), self._lens("cam1")
        self._cv2 = import_cv2(path)
        self._sizes = [lens.size for lens in lenses]
        self._stereo = Stereo(self._cv2, *lenses, self._mav)
        left, right = (_pictures(self._mav / name, self.skips) for name in ("cam0", "cam1"))
        pairs = _paired(left, right, self._mav)
        poses, self.notes = self._poses(lenses[0])
        self._pairs = [_Pair(a, b, None) for a, b in pairs]
        if poses is not None:
            placed = ((a, b, poses.at(a.stamp / 1e9)) for a, b in pairs)
            self._pairs = [
                _Pair(a, b, pose @ self._in_tracked) for a, b, pose in placed if pose is not None
            ]
            if not self._pairs:
                raise RecordingError(
                    f"{self._path}: none of {len(pairs)} pairs of pictures has a pose for its "
                    "moment; check that poses and pictures use the same clock"
                )
        self.dropped = len(left) - len(self._pairs)

    def __len__(self) -> int:
        return len(self._pairs)

    def __iter__(self) -> Iterator[Cycle]:
        front = FrontEnd(self._cv2, self._stereo.camera, self._options)
        odometry = PictureOdometry(self._cv2, self._stereo.camera)

        def cycle(pair: _Pair) -> Cycle:
            left, right = self._read(pair.left, 0), self._read(pair.right, 1)
            picture, metres = self._stereo.rectified(left, right)
            pose = odometry.register(picture, metres) if pair.pose is None else pair.pose
            points, colors, described = front.of(picture, metres)
            found = Cycle(
                pair.left.stamp / 1e9, pose, points, colors=colors,
                session=max(odometry.session, 0), descriptors=described,
            )  # fmt: skip
            return checked(found, pair.left.file)

        yield from kept(self._pairs, cycle, self.skips)

    def _lens(self, name: str) -> Lens:
        folder = self._mav / name
        file = folder / "sensor.yaml"
        if not (folder / "data").is_dir():
            raise RecordingError(
                f"{folder}: no folder data/ with pictures; stereo wants cam0/data and cam1/data"
            )
        if not file.is_file():
            raise RecordingError(
                f"{file}: missing; the calibration of the camera stands there (T_BS, intrinsics, "
                "resolution, distortion_coefficients)"
            )
        return load_lens(file)

    def _poses(self, lens: Lens) -> tuple[Trajectory | None, tuple[str, ...]]:
        """Poses by stamp, and what to tell of them; where what they track has the rectified camera
        is then in `_in_tracked`: ground truth tracks the body, and so does an inertial SLAM, others
        track the left camera."""
        self._in_tracked = self._stereo.mounted
        options, named = self._options, self._options.poses
        if named is not None:
            said = f"poses of {named}"
            if options.body_poses:
                return read_tum(named, self.skips), (f"{said}, those of the body",)
            self._in_tracked = np.linalg.inv(lens.mounted) @ self._stereo.mounted
            return read_tum(named, self.skips), (said, *doubts(named, options.same_frame))
        file = self._mav / _TRUTH / "data.csv"
        if file.is_file():
            return _truth(file, self.skips), (f"poses of {_TRUTH}",)
        return None, (f"no {_TRUTH}: odometry by OpenCV",)

    def _read(self, picture: Stamped, camera: int) -> Uint8s:
        found = decode(self._cv2, picture.file, self._cv2.IMREAD_COLOR)
        width, height = self._sizes[camera]
        if found.shape[:2] != (height, width):
            raise RecordingError(
                f"{picture.file}: {found.shape[1]} x {found.shape[0]} pixels, but sensor.yaml says "
                f"{width} x {height}; use the calibration of these pictures"
            )
        return found.astype(np.uint8, copy=False)


def _mav(path: Path) -> Path | None:
    for place in (path / "mav0", path):
        if (place / "cam0").is_dir() and ((place / "cam1").is_dir() or place.name == "mav0"):
            return place
    return None


def _count(folder: Path) -> int:
    return sum(1 for _ in folder.iterdir()) if folder.is_dir() else 0


def _pictures(camera: Path, skips: Skips) -> list[Stamped]:
    """From data.csv, else from the names of the files, which are stamps in ns."""
    data = camera / "data"
    found = stamped_files(camera / "data.csv", "`stamp in ns,file`", data, data, _ns, skips)
    if not found:
        raise RecordingError(f"{camera}: an empty recording; no pictures are named or there")
    return found


def _paired(left: list[Stamped], right: list[Stamped], mav: Path) -> list[tuple[Stamped, Stamped]]:
    """Each left picture with the nearest right one, if each is the other's nearest."""
    stamps = [np.array([float(p.stamp - left[0].stamp) for p in part]) for part in (left, right)]
    there, back = nearest(stamps[1], stamps[0]), nearest(stamps[0], stamps[1])
    gaps = [abs(right[there[i]].stamp - a.stamp) for i, a in enumerate(left)]
    pairs = [
        (a, right[there[i]])
        for i, a in enumerate(left)
        if gaps[i] <= _SLACK and back[there[i]] == i
    ]
    if not pairs:
        raise RecordingError(
            f"{mav}: cam0 and cam1 are not synchronised: the nearest of their {len(left)} and "
            f"{len(right)} pictures are {min(gaps) / 1e6:.0f} ms apart, 5 ms at most are wanted; "
            "stereo needs pictures of one moment"
        )
    return pairs


def _truth(file: Path, skips: Skips) -> Trajectory:
    """Poses of the body: stamp in ns, place, quaternion with w first, and what follows."""

    def placed(row: Row) -> tuple[int, Floats]:
        pose = None
        if len(row.words) >= 8:
            try:
                x, y, z, qw, qx, qy, qz = (float(word) for word in row.words[1:8])
                pose = matrix(np.array([x, y, z]), np.array([qx, qy, qz, qw]))
            except ValueError:
                pose = None
        if pose is None:
            raise RecordingError(
                f"{row.where}: `stamp x y z qw qx qy qz` is wanted, the quaternion of length 1"
            )
        return _ns(row.words[0], row.where), pose

    out = Trajectory()
    for stamp, pose in kept(read_rows(file), placed, skips):
        out.add(stamp / 1e9, pose)
    if not len(out):
        raise RecordingError(f"{file}: no poses; remove the file for odometry by OpenCV")
    return out


def _ns(word: str, line: str) -> int:
    if not (word.isascii() and word.isdecimal() and len(word) < 20 and int(word) < _MOST_NS):
        raise RecordingError(f"{line}: {word[:40]!r} is no stamp in ns")
    return int(word)
