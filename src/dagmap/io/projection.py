"""One view onto a map for all figures: from above at a slant, walls along the edges of the page.

Where "up" is, nobody says: SLAM frames have any axis up. The rule, which needs no knowledge of the
sensor: robots roam about much more than they rise and sink, so up is the axis along which the
sensor positions vary least; where they do not span a plane (a robot that stood or drove along a
line), the axis along which the points vary least. Which end of it is up: cameras have y down,
LiDARs and vehicles z up, so the mean of the sensor axis that is most nearly parallel to it decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..model import Floats

ELEVATION = np.radians(58.0)  # 90 degrees would be straight down
_FLAT = 0.35  # spread of sensor positions, least to middle, below which they span a plane


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """An orthographic view. axes: (3, 3) rows right, up on the page, towards the viewer."""

    axes: Floats

    def project(self, points: Floats) -> Floats:
        """(N, 3) metres to (N, 2) metres on the page, true to scale along the page."""
        return np.asarray(points @ self.axes[:2].T, np.float64)

    def far_to_near(self, points: Floats) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        """The order in which points are painted, so that near ones lie on top."""
        return np.argsort(points @ self.axes[2], kind="stable")


def choose_view(points: Floats, poses: Floats) -> View:
    """A view for points (N, 3) that were seen from sensor poses (C, 4, 4), both in one frame."""
    up = _up(points, poses)
    return View(_slanted(up, _heading(points, up)))


def _up(points: Floats, poses: Floats) -> Floats:
    up, spread = _least_axis(poses[:, :3, 3])
    if not (spread[1] > 0 and spread[0] < _FLAT * spread[1]):
        up, _ = _least_axis(_without_outliers(points))
    if len(poses) == 0:
        return up
    along = poses[:, :3, :3].mean(axis=0).T @ up  # the mean of each sensor axis along `up`
    axis = int(np.argmax(np.abs(along)))
    sign = -along[axis] if axis == 1 else along[axis]
    return -up if sign < 0 else up


def _least_axis(positions: Floats) -> tuple[Floats, Floats]:
    """The principal axis of least spread (z where there is none) and the three spreads, rising."""
    if len(positions) < 3:
        return np.array([0.0, 0.0, 1.0]), np.zeros(3)
    values, vectors = np.linalg.eigh(np.cov(positions.T))
    if values[2] <= 0:  # all in one spot
        return np.array([0.0, 0.0, 1.0]), np.zeros(3)
    axis = vectors[:, 0]
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])  # else the solver chooses the sign
    return axis, np.sqrt(np.maximum(values, 0.0))


def _heading(points: Floats, up: Floats) -> Floats:
    """The horizontal direction for the long edge of the page: that of the least bounding box."""
    helper = np.eye(3)[int(np.argmin(np.abs(up)))]
    east = np.cross(helper, up)
    east /= np.linalg.norm(east)
    north = np.cross(up, east)
    flat = _without_outliers(points) @ np.stack([east, north]).T
    if len(flat) < 3:
        return east
    angles = np.radians(np.arange(90.0))
    right = np.stack([np.cos(angles), np.sin(angles)])
    sides = [np.ptp(flat @ side, axis=0) for side in (right, np.stack([-right[1], right[0]]))]
    best = int(np.argmin(sides[0] * sides[1]))
    angle = angles[best] + (np.pi / 2 if sides[1][best] > sides[0][best] else 0.0)
    return np.asarray(np.cos(angle) * east + np.sin(angle) * north, np.float64)


def _without_outliers(points: Floats) -> Floats:
    """Points within the middle 98 % along each axis: SLAM noise flies far."""
    if len(points) < 100:
        return points
    low, high = np.percentile(points, (1.0, 99.0), axis=0)
    inside = ((points >= low) & (points <= high)).all(axis=1)
    return np.asarray(points[inside], np.float64)


def _slanted(up: Floats, right: Floats) -> Floats:
    back = np.cross(up, right)
    page_up = np.sin(ELEVATION) * back + np.cos(ELEVATION) * up
    towards = np.sin(ELEVATION) * up - np.cos(ELEVATION) * back
    return np.stack([right, page_up, towards])
