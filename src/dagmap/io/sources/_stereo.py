"""Stereo: two calibrated cameras become one rectified picture with the depth beneath it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...model import Floats, RecordingError, Uint8s
from ._poses import inverse
from ._rgbd import Camera
from ._source import read_bytes

_NEAREST = 0.4  # m: nearer things are not matched, which would cost time for every pixel
_MOST_DISPARITY = 512  # pixels, a whole number of sixteenths
# Where half a pixel of disparity would be more than a tenth of the depth, the depth is none.
_LEAST_DISPARITY = 5.0
_BLOCK = 7  # pixels, edge of what is compared
_MOST_PIXELS = 1 << 26
_LEAST_SIDE = 32  # pixels: in smaller pictures the matcher has no place to look
_LARGEST = 1e6  # of a number of a calibration, m or pixels
_MODELS = {
    "radial-tangential": False,
    "radtan": False,
    "plumb_bob": False,
    "none": False,
    "equidistant": True,
}


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """One camera of a rig, as its sensor.yaml says it.

    mounted: (4, 4), the camera in the body. k: (3, 3). distortion: (4,) or (5,), in OpenCV's
    order, of its fisheye model where `fisheye`.
    """

    mounted: Floats
    k: Floats
    distortion: Floats
    fisheye: bool
    size: tuple[int, int]  # width, height


def load_lens(path: Path) -> Lens:
    """Read a camera's sensor.yaml. Raises RecordingError that names what lacks or is wrong."""
    values = _entries(path)
    mounted = _numbers(path, values, "T_BS.data" if "T_BS.data" in values else "T_BS", (16,))
    pose = np.reshape(mounted, (4, 4))
    turn = pose[:3, :3]
    if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-3 or np.linalg.det(turn) < 0:
        raise RecordingError(f"{path}: T_BS holds no rotation; calibrate the camera anew")
    fx, fy, cx, cy = _numbers(path, values, "intrinsics", (4,))
    width, height = (int(number) for number in _numbers(path, values, "resolution", (2,)))
    if not (fx > 0 and fy > 0 and width > 0 and height > 0 and width * height <= _MOST_PIXELS):
        raise RecordingError(
            f"{path}: intrinsics {fx, fy} and resolution {width, height}; both more than 0 are "
            "wanted, and no more pixels than a picture can have"
        )
    model = values.get("distortion_model", "none").strip("'\" ")
    if model not in _MODELS or values.get("camera_model", "pinhole").strip("'\" ") != "pinhole":
        raise RecordingError(
            f"{path}: a pinhole camera with one of the distortion models {', '.join(_MODELS)} is "
            f"wanted, not {model[:40]!r}"
        )
    sizes = (4,) if _MODELS[model] else (0, 4, 5)
    bent = _numbers(
        path, {"distortion_coefficients": "", **values}, "distortion_coefficients", sizes
    )
    k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    return Lens(pose, k, np.array(bent or [0.0] * 4), _MODELS[model], (width, height))


def _entries(path: Path) -> dict[str, str]:
    """What the YAML of such files holds: `key: value`, lists in brackets, one level of indentation
    (`T_BS.data`). Brackets may go over lines."""
    try:
        text = read_bytes(path).decode()
    except UnicodeDecodeError:
        raise RecordingError(f"{path}: not a text file in UTF-8; write it anew") from None
    found: dict[str, str] = {}
    above = key = ""
    open_list = False
    for line in text.splitlines():
        line = line.partition("#")[0].rstrip()
        if open_list:
            found[key] += " " + line.strip()
            open_list = "]" not in line
            continue
        name, colon, value = line.partition(":")
        if not colon:
            continue
        inner = line[0] in " \t"
        above = above if inner else name.strip()
        key = f"{above}.{name.strip()}" if inner else above
        found[key] = value.strip()
        open_list = "[" in value and "]" not in value
    return found


def _numbers(path: Path, values: dict[str, str], key: str, sizes: tuple[int, ...]) -> list[float]:
    wanted = " or ".join(map(str, sizes))
    if key not in values:
        raise RecordingError(f"{path}: no {key}; a list of {wanted} numbers is wanted")
    try:
        numbers = [float(w) for w in values[key].replace(",", " ").strip("[] ").split()]
    except ValueError:
        numbers = [np.nan]
    if len(numbers) not in sizes or not all(abs(number) < _LARGEST for number in numbers):
        raise RecordingError(f"{path}: {key} is no list of {wanted} numbers that a camera can have")
    return numbers


class Stereo:
    """The rectified left camera of two, and the depth of its pixels.

    camera: its pinhole. mounted: (4, 4), its pose in the body. baseline: m.
    """

    def __init__(self, cv2: Any, left: Lens, right: Lens, path: Path) -> None:
        self._cv2 = cv2
        across = inverse(right.mounted) @ left.mounted  # the left camera in the right one
        self.baseline = float(np.linalg.norm(across[:3, 3]))
        if not 0.001 <= self.baseline <= 100:
            raise RecordingError(
                f"{path}: the cameras are {self.baseline:.3g} m apart by their T_BS; 1 mm to 100 m "
                "are wanted"
            )
        if left.size != right.size:
            raise RecordingError(
                f"{path}: cam0 has {left.size} pixels, cam1 {right.size}; both alike are wanted"
            )
        if min(left.size) < _LEAST_SIDE:
            raise RecordingError(
                f"{path}: pictures of {left.size[0]} x {left.size[1]} pixels by sensor.yaml; "
                f"{_LEAST_SIDE} x {_LEAST_SIDE} at least are wanted"
            )
        # Turning both into one plane asks for no lens; what the lens does goes into the maps.
        turned = cv2.stereoRectify(
            left.k, None, right.k, None, left.size, across[:3, :3], across[:3, 3:].copy(),
            flags=cv2.CALIB_ZERO_DISPARITY, alpha=-1,
        )  # fmt: skip
        turns, projection = turned[:2], turned[2]
        if not np.isfinite(projection).all() or abs(turned[3][0, 3]) < abs(turned[3][1, 3]):
            raise RecordingError(
                f"{path}: the cameras do not stand side by side by their T_BS; DAGmap wants a left "
                "(cam0) and a right one (cam1)"
            )
        self._maps = [
            self._map(lens, turn, projection)
            for lens, turn in zip((left, right), turns, strict=True)
        ]
        focal, (width, height) = float(projection[0, 0]), left.size
        self.camera = Camera(
            fx=focal, fy=focal, cx=float(projection[0, 2]), cy=float(projection[1, 2]),
            width=width, height=height, depth_scale=1.0,
        )  # fmt: skip
        self.mounted = left.mounted.copy()
        self.mounted[:3, :3] = left.mounted[:3, :3] @ turns[0].T
        # Where the rig is upside down or cam0 is the right one, disparities are negative.
        if turned[3][0, 3] > 0:
            raise RecordingError(
                f"{path}: cam0 is the right camera by T_BS; swap the folders cam0 and cam1"
            )
        self._matcher = self._make_matcher(focal * self.baseline)

    def rectified(self, left: Uint8s, right: Uint8s) -> tuple[Uint8s, Floats]:
        """The left picture (H, W, 3) BGR without distortion, its depths (H, W) m, 0 for none."""
        cv2 = self._cv2
        flat = [
            cv2.remap(picture, *maps, cv2.INTER_LINEAR)
            for picture, maps in zip((left, right), self._maps, strict=True)
        ]
        one, other = (cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) for picture in flat)
        disparity = self._refined(one, other, self._matcher.compute(one, other))
        good = disparity >= _LEAST_DISPARITY
        metres = np.zeros(disparity.shape)
        metres[good] = self.camera.fx * self.baseline / disparity[good]
        return flat[0], metres

    def _refined(self, left: Uint8s, right: Uint8s, found: npt.NDArray[np.int16]) -> Floats:
        """(H, W) pixels to a fraction: what the matcher finds, in sixteenths, leans to whole ones.

        The least squares of the brightness around each pixel, as Lucas and Kanade do it, twice.
        """
        cv2, window = self._cv2, (_BLOCK, _BLOCK)
        disparity = start = found.astype(np.float32) / 16
        wanted = left.astype(np.float32)
        v, u = np.indices(disparity.shape, np.float32)
        for _ in range(2):
            seen = cv2.remap(right.astype(np.float32), u - disparity, v, cv2.INTER_LINEAR)
            slope = cv2.Sobel(seen, cv2.CV_32F, 1, 0, ksize=1) / 2
            weight = cv2.boxFilter(slope * slope, -1, window) + 1.0  # grey levels squared: noise
            step = cv2.boxFilter(slope * (seen - wanted), -1, window) / weight
            disparity = np.clip(disparity + step, start - 0.5, start + 0.5)
        return np.where(found > 0, disparity, 0).astype(np.float64)

    def _map(self, lens: Lens, turn: Floats, projection: Floats) -> tuple[Any, Any]:
        make = self._cv2.initUndistortRectifyMap
        if lens.fisheye:
            make = self._cv2.fisheye.initUndistortRectifyMap
        new = projection[:, :3]
        made = make(lens.k, lens.distortion, turn, new, lens.size, self._cv2.CV_32FC1)
        return made[0], made[1]

    def _make_matcher(self, scale: float) -> Any:
        """scale: focal length times baseline, pixels times metres."""
        most = int(min(scale / _NEAREST, self.camera.width / 2, _MOST_DISPARITY))
        return self._cv2.StereoSGBM_create(
            minDisparity=0,
            numDisparities=max(16, -(-most // 16) * 16),
            blockSize=_BLOCK,
            P1=8 * _BLOCK**2,
            P2=32 * _BLOCK**2,
            disp12MaxDiff=1,  # what the right picture does not confirm is left out
            uniquenessRatio=10,
            speckleWindowSize=50,
            speckleRange=1,
        )
