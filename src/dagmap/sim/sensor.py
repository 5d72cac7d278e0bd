"""Range sensors: where they look, how far they see, and how they err.

The sensor's frame: x ahead, y to the left, z up, metres.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from ..config import _Checked
from ..model import Bools, Floats

MIN_BASELINE = 0.01  # m: what a camera that turns on the spot is moved by all the same


class SensorConfig(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The table [sensor]."""

    kind: Literal["depth", "lidar", "mono", "stereo"] = "depth"
    points: int = 60  # per cycle, at most
    period: float = 1.0  # s between cycles
    range: float = 6.0  # m
    field: tuple[float, float] = (75.0, 55.0)  # degrees, across (a lidar: always 360) and up
    height: float = 1.0  # m above the floor
    noise: float = 0.01  # m along the ray, standard deviation; mono, stereo: see `pixel`
    pixel: float = 0.5  # mono, stereo: px of noise in the image, standard deviation
    focal: float = 500.0  # mono, stereo: px, the focal length
    baseline: float = 0.06  # stereo: m between the cameras
    outliers: float = 0.02  # share of new points that lie at 0.3 to 1.6 times their distance
    tracked: float = 0.2  # share of points, at most, that were seen in the cycle before
    colors: bool = False  # whether points have the colour of their surface

    def __post_init__(self) -> None:
        self._require_range("points", 1, 100_000)
        self._require_range("period", 0.001, 3600.0)
        self._require_range("range", 0.1, 200.0)
        fits = all(1.0 <= angle <= 150.0 for angle in self.field)
        self._require(fits, "field", "two angles from 1 to 150 degrees are wanted")
        self._require_range("height", 0.1, 1.9)
        self._require_range("noise", 0.0, 10.0)
        self._require_range("pixel", 0.0, 100.0)
        self._require_range("focal", 1.0, 1e5)
        self._require_range("baseline", MIN_BASELINE, 10.0)
        self._require_range("outliers", 0.0, 1.0)
        self._require_range("tracked", 0.0, 0.75)


class Sensor:
    """What a configured sensor does to rays; chance comes in as a generator."""

    def __init__(self, config: SensorConfig) -> None:
        self.config = config
        across, up = (math.radians(angle) / 2 for angle in config.field)
        self._up = up
        self._half = math.tan(across), math.tan(up)  # of a pinhole's image, at distance 1

    def rays(self, u: Floats, v: Floats) -> Floats:
        """(..., 3) directions of length 1: even over a pinhole's image, or over a lidar's angles.

        u, v: (...) chance from -1 to 1, across and up.
        """
        if self.config.kind == "lidar":
            azimuth, elevation = math.pi * u, self._up * v
            flat = np.cos(elevation)
            parts = flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)
            return np.stack(parts, axis=-1)
        y, z = self._half[0] * u, self._half[1] * v
        ahead = 1.0 / np.sqrt(1.0 + y * y + z * z)
        return np.stack([ahead, y * ahead, z * ahead], axis=-1)

    def in_view(self, points: Floats) -> Bools:
        """(...) whether points (..., 3) lie in the field of view, however far."""
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        if self.config.kind == "lidar":
            return np.asarray(np.abs(z) <= math.tan(self._up) * np.sqrt(x * x + y * y))
        across, up = self._half
        return np.asarray((x > 0) & (np.abs(y) <= across * x) & (np.abs(z) <= up * x))

    def measure(
        self, rays: Floats, depth: Floats, noise: Floats, baseline: Floats
    ) -> tuple[Floats, Bools]:
        """Distances (N, R) with noise, and which of them a SLAM keeps.

        rays: (N, R, 3). depth: (N, R) m along them. noise: (N, R) normal. baseline: (N,) m by
        which a single camera has moved to triangulate; two have theirs. Disparities have the noise,
        so depths have one that grows with depth^2 / baseline, and what comes out behind the camera
        or beyond twice the range is dropped.
        """
        if self.config.kind == "stereo":
            baseline = np.full_like(baseline, self.config.baseline)
        elif self.config.kind != "mono":
            measured = depth + self.config.noise * noise
            return measured, measured > 0
        ahead = depth * rays[..., 0]
        base = np.maximum(baseline, MIN_BASELINE)[:, None]
        inverse = 1.0 / ahead + noise * (self.config.pixel / (base * self.config.focal))
        kept = inverse * (2 * self.config.range) > 1.0
        return depth / np.where(kept, inverse * ahead, 1.0), kept


def displace(chance: Floats, share: float) -> tuple[Floats, Bools]:
    """Factors (...) on distances, and which of them are outliers: 0.3 to 0.85 or 1.15 to 1.6.

    chance: (2, ...) from 0 to 1. share: of outliers.
    """
    wrong, factor = chance[0] < share, 0.3 + chance[1]
    return np.where(wrong, np.where(factor < 0.85, factor, factor + 0.3), 1.0), wrong
