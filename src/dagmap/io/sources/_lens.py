"""What a CameraInfo says of a camera: its pinhole, and how the lens bends what it sees."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...model import Floats
from ._rgbd import Camera
from ._ros import Unusable

_PERSPECTIVE = ("plumb_bob", "rational_polynomial")
_FISHEYE = ("equidistant", "fisheye")
_COUNTS = (4, 5, 8, 12, 14)  # coefficients that OpenCV takes of the perspective models
_STEPS, _CLOSE = 50, 1e-9  # of the iteration that straightens, normalised units
_WIDEST = 10.0  # x or y by z, 84 degrees: what lies further aside has no depth to speak of
_LARGEST = 1e6  # pixels: no camera has more
_OFF = 0.1  # pixels: what does not bend back to its place has no ray
_DEPTH_UNITS = 1000.0  # a metre, by REP 118
# A part of a topic's name that begins so: image_rect_color, rgb/rect/image; but not direct.
_RECTIFIED = re.compile(r"(?:^|[^a-z])rect", re.IGNORECASE)


@dataclass(frozen=True, slots=True, eq=False)
class Distortion:
    """How a lens bends. coefficients: (N,), in OpenCV's order. fisheye: of OpenCV's model of that
    name (4 coefficients), which ROS calls equidistant."""

    model: str
    coefficients: Floats
    fisheye: bool

    def straight(self, cv2: Any, camera: Camera, places: Floats) -> Floats:
        """(N, 2) pixels where the pinhole alone sees what lies at pixels (N, 2) of the picture.

        NaN where the model cannot be turned back, which is so far outside of many lenses.
        """
        if not len(places):
            return places
        k = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
        ends = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _STEPS, _CLOSE)
        pixels = np.ascontiguousarray(places, np.float64)[:, None]
        if self.fisheye:
            flat = cv2.fisheye.undistortPoints(pixels, k, self.coefficients, criteria=ends)
            bent = cv2.fisheye.distortPoints(flat, k, self.coefficients)
        else:
            flat = cv2.undistortPoints(pixels, k, self.coefficients, criteria=ends)
            rays = np.concatenate([flat, np.ones((len(flat), 1, 1))], axis=2)
            none = np.zeros(3)
            bent, _ = cv2.projectPoints(rays, none, none, k, self.coefficients)
        with np.errstate(invalid="ignore", over="ignore"):
            good = np.hypot(*(bent[:, 0] - places).T) <= _OFF
            good &= (np.abs(flat[:, 0]) <= _WIDEST).all(axis=1)
            out = flat[:, 0] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        return np.where(good[:, None], out, np.nan)


def is_rectified(topic: str) -> bool:
    """Whether pictures are without distortion by the name of their topic, as image_proc has it."""
    return _RECTIFIED.search(topic) is not None


def lens_of(info: Any, rectified: bool) -> tuple[Camera, Distortion | None]:
    """The pinhole of a CameraInfo's pictures, and what bends them beside it, if anything does.

    Rectified pictures, and those of lenses that bend nothing, have the pinhole of P, raw ones that
    of K. The numbers are large letters in ROS 1. Raises Unusable.
    """
    k, p, d = (_numbers(info, name) for name in "kpd")
    width, height = int(info.width), int(info.height)
    flat = rectified or not d.any()
    pinhole = k[[0, 4, 2, 5]] if len(k) == 9 else np.zeros(4)
    if flat and len(p) == 12 and p.any():
        pinhole = p[[0, 5, 2, 6]]
    usable = (np.abs(pinhole) < _LARGEST).all() and (pinhole[:2] > 0).all()
    if not usable or not width * height:
        raise Unusable(
            f"the camera is not calibrated (K = {k.tolist()}, P = {p.tolist()}); calibrate it, or "
            "name a camera.json with --camera"
        )
    fx, fy, cx, cy = pinhole.tolist()
    camera = Camera(
        fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height, depth_scale=_DEPTH_UNITS
    )
    return camera, None if flat else _distortion(info, d)


def _distortion(info: Any, d: Floats) -> Distortion:
    model = str(info.distortion_model)
    fisheye = model in _FISHEYE
    if not fisheye and model not in _PERSPECTIVE:
        known = ", ".join((*_PERSPECTIVE, *_FISHEYE))
        raise Unusable(
            f"the distortion model {model[:40]!r} is none of {known}; record rectified pictures "
            "(image_rect_color), or name their camera.json with --camera"
        )
    wanted = (4,) if fisheye else _COUNTS
    if len(d) not in wanted or not np.isfinite(d).all():
        raise Unusable(
            f"D = {d[:20].tolist()}, but {model} has {' or '.join(map(str, wanted))} numbers; "
            "calibrate the camera anew, or name a camera.json with --camera"
        )
    return Distortion(model, d, fisheye)


def _numbers(info: Any, name: str) -> Floats:
    given = getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())
    return np.asarray(given, np.float64).reshape(-1)
