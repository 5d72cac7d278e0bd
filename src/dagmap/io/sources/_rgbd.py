"""The RGB-D front end: ORB features of a picture with the depth beneath them."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from ...model import DESCRIPTOR, Floats, RecordingError, Uint8s
from ._source import Options, read_bytes

_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8\xff"

# (N, 2) pixels of a picture -> where a pinhole sees the same, NaN for nowhere.
Straight = Callable[[Floats], Floats]


class Camera(msgspec.Struct, frozen=True, kw_only=True):
    """A pinhole camera without distortion: pixels, and units of the depth picture per metre."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    depth_scale: float


def load_camera(path: Path) -> Camera:
    """Read a camera.json. Raises RecordingError that names the key that lacks or is wrong."""
    keys = ", ".join(Camera.__struct_fields__)
    try:
        camera = msgspec.json.decode(read_bytes(path), type=Camera)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise RecordingError(f"{path}: {error}; an object with {keys} is wanted") from None
    for key in ("fx", "fy", "width", "height", "depth_scale"):
        value = getattr(camera, key)
        if not 0 < value < math.inf:  # a whole number may be too large for a float
            raise RecordingError(f"{path}: {key} = {value}; more than 0 is wanted")
    return camera


def import_cv2(path: Path) -> Any:
    """OpenCV, loaded when a recording of pictures is opened. Raises RecordingError without it."""
    try:
        import cv2
    except ImportError:
        raise RecordingError(
            f"{path}: pictures are read with OpenCV, which is not installed; "
            "pip install 'dagmap[rgbd]'"
        ) from None
    return cv2


class FrontEnd:
    """Turns a colour picture and a depth picture into points in the camera frame.

    The same pictures give the same points in the same order: ORB has no randomness, what it finds
    is put in order here, and OpenCV's generator is seeded in case that ever changes.
    straight: what takes the distortion out of places in raw pictures; None: there is none.
    """

    def __init__(
        self, cv2: Any, camera: Camera, options: Options, straight: Straight | None = None
    ) -> None:
        self._cv2, self._camera, self._options = cv2, camera, options
        self._straight = straight
        cv2.setRNGSeed(0)
        self._orb = cv2.ORB_create(nfeatures=options.max_features)

    def read(self, color: Path, depth: Path) -> tuple[Uint8s, Floats]:
        """A picture (H, W, 3) BGR and its depths (H, W) m. Raises RecordingError that names it."""
        return self._color(color), self._depth(depth)

    def of(self, picture: Uint8s, metres: Floats) -> tuple[Floats, Uint8s, Uint8s]:
        """(N, 3) metres, (N, 3) RGB and (N, 32) ORB descriptors of at most `max_features` features
        with a valid depth, the strongest first.

        Depth and colour are those of the pixel that the feature rounds to; a depth of 0 or NaN, or
        beyond `max_depth`, is none.
        """
        place, descriptors = self._detect(picture)
        pixel = np.floor(place + 0.5).astype(np.int64)
        pixel = np.clip(pixel, 0, (self._camera.width - 1, self._camera.height - 1))
        z = metres[pixel[:, 1], pixel[:, 0]]
        most = self._options.max_depth
        valid = (z > 0) & (z <= (np.inf if most is None else most))
        if self._straight is not None:
            place = self._straight(place)
            valid &= np.isfinite(place).all(axis=1)
        place, pixel, z = place[valid], pixel[valid], z[valid]
        x = (place[:, 0] - self._camera.cx) * z / self._camera.fx
        y = (place[:, 1] - self._camera.cy) * z / self._camera.fy
        colors = picture[pixel[:, 1], pixel[:, 0], ::-1].copy()
        return np.stack([x, y, z], axis=1), colors, descriptors[valid]

    def _detect(self, picture: Uint8s) -> tuple[Floats, Uint8s]:
        """(N, 2) places and (N, 32) descriptors of the strongest features, strongest first."""
        gray = self._cv2.cvtColor(picture, self._cv2.COLOR_BGR2GRAY)
        features, described = self._orb.detectAndCompute(gray, None)
        found = sorted((-k.response, k.pt[1], k.pt[0], i) for i, k in enumerate(features))
        found = found[: self._options.max_features]  # ORB may give more where they tie
        rows = [i for *_, i in found]
        place = np.array([(x, y) for _, y, x, _ in found], np.float64).reshape(-1, 2)
        none = np.zeros((0, DESCRIPTOR), np.uint8)
        return place, none if described is None else described[rows]

    def _color(self, path: Path) -> Uint8s:
        picture = decode(self._cv2, path, self._cv2.IMREAD_COLOR)
        self._check_size(path, picture)
        return picture.astype(np.uint8, copy=False)

    def _depth(self, path: Path) -> Floats:
        picture = decode(self._cv2, path, self._cv2.IMREAD_UNCHANGED)
        if picture.ndim != 2 or picture.dtype != np.uint16:
            raise RecordingError(
                f"{path}: {picture.dtype} {picture.shape} is no depth picture; one channel of 16 "
                "bits is wanted"
            )
        self._check_size(path, picture)
        return picture / self._camera.depth_scale

    def _check_size(self, path: Path, picture: npt.NDArray[Any]) -> None:
        wanted = (self._camera.height, self._camera.width)
        if picture.shape[:2] != wanted:
            raise RecordingError(
                f"{path}: {picture.shape[1]} x {picture.shape[0]} pixels, but the camera has "
                f"{wanted[1]} x {wanted[0]}; name the right one with --camera FILE"
            )


def decode(cv2: Any, path: Path, flags: int) -> npt.NDArray[Any]:
    """The picture in a file, as OpenCV reads it with these flags. Raises RecordingError."""
    data = read_bytes(path)
    if not complete(data):
        raise RecordingError(
            f"{path}: the picture is truncated or damaged; copy it anew, or drop its frame"
        )
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        picture = None
    if picture is None:
        raise RecordingError(
            f"{path}: OpenCV cannot read this as a picture; copy it anew, or drop its frame"
        )
    return np.asarray(picture)


def complete(data: bytes) -> bool:
    """Whether PNG or JPEG bytes are all there: OpenCV returns what is left without a word."""
    if data.startswith(_PNG):
        return _complete_png(data)
    if data.startswith(_JPEG):
        return data.rfind(b"\xff\xd9") > data.rfind(b"\xff\xda")  # the end after the last scan
    return len(data) > 0


def _complete_png(data: bytes) -> bool:
    """Whether every chunk up to IEND is there and has its checksum."""
    at = len(_PNG)
    while at + 12 <= len(data):
        end = at + 12 + int.from_bytes(data[at : at + 4], "big")
        if zlib.crc32(data[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            return False
        if data[at + 4 : at + 8] == b"IEND":
            return True
        at = end
    return False
