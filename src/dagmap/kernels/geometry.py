"""Integer rigid motion: one function expands a quaternion, one applies it, rounding half up."""

from __future__ import annotations

from functools import lru_cache
from math import isqrt

import numpy as np

from ..model import LIMIT_MM, QUATERNION_ONE, Bools, Int32s, Int64s
from .jit import kernel

_HALF = QUATERNION_ONE >> 1
_SHIFT = 30
_LIMIT = LIMIT_MM


@kernel
def rotation(pose: Int32s) -> Int64s:
    """(9,) row-major rotation of scale 2^30 of a (7,) pose (w x y z of scale 2^30, mm)."""
    w, x, y, z = int(pose[0]), int(pose[1]), int(pose[2]), int(pose[3])
    one = 1 << 60
    half = 1 << 29
    r = np.empty(9, np.int64)
    r[0] = (one - 2 * (y * y + z * z) + half) >> 30
    r[1] = (2 * (x * y - w * z) + half) >> 30
    r[2] = (2 * (x * z + w * y) + half) >> 30
    r[3] = (2 * (x * y + w * z) + half) >> 30
    r[4] = (one - 2 * (x * x + z * z) + half) >> 30
    r[5] = (2 * (y * z - w * x) + half) >> 30
    r[6] = (2 * (x * z - w * y) + half) >> 30
    r[7] = (2 * (y * z + w * x) + half) >> 30
    r[8] = (one - 2 * (x * x + y * y) + half) >> 30
    return r


@kernel
def apply_pose(pose: Int32s, points: Int32s, out: Int32s, inside: Bools) -> None:
    """out = pose * points, (N, 3) mm. inside[i] is cleared where the result leaves +-2^29 mm."""
    r = rotation(pose)
    tx, ty, tz = int(pose[4]), int(pose[5]), int(pose[6])
    for i in range(points.shape[0]):
        x, y, z = int(points[i, 0]), int(points[i, 1]), int(points[i, 2])
        u = ((int(r[0]) * x + int(r[1]) * y + int(r[2]) * z + _HALF) >> _SHIFT) + tx
        v = ((int(r[3]) * x + int(r[4]) * y + int(r[5]) * z + _HALF) >> _SHIFT) + ty
        w = ((int(r[6]) * x + int(r[7]) * y + int(r[8]) * z + _HALF) >> _SHIFT) + tz
        if -_LIMIT <= u <= _LIMIT and -_LIMIT <= v <= _LIMIT and -_LIMIT <= w <= _LIMIT:
            out[i, 0] = u
            out[i, 1] = v
            out[i, 2] = w
        else:
            out[i, 0] = 0
            out[i, 1] = 0
            out[i, 2] = 0
            inside[i] = False


@kernel
def carry_segments(
    poses: Int32s, starts: Int64s, points: Int32s, out: Int32s, origins: Int32s, inside: Bools
) -> None:
    """Carry segments of points through two poses each: out = poses[k, 1] * (poses[k, 0] * points).

    poses: (k, 2, 7); zeros where a segment is left out: its rows of `inside` are cleared. starts:
    (k + 1,) of the segments. origins: (k, 3) is set to where (0, 0, 0) comes to.
    """
    at = np.ones(1, np.bool_)
    for k in range(starts.shape[0] - 1):
        begin, end = int(starts[k]), int(starts[k + 1])
        if not poses[k].any():
            inside[begin:end] = False
            continue
        origins[k] = 0
        apply_pose(poses[k, 0], points[begin:end], out[begin:end], inside[begin:end])
        apply_pose(poses[k, 1], out[begin:end], out[begin:end], inside[begin:end])
        apply_pose(poses[k, 0], origins[k : k + 1], origins[k : k + 1], at)
        apply_pose(poses[k, 1], origins[k : k + 1], origins[k : k + 1], at)


def carry(pose: Int32s, points: Int32s) -> tuple[Int32s, Bools]:
    """Points (N, 3) mm through a pose, and which of them stay within range."""
    out, inside = np.empty_like(points), np.ones(len(points), np.bool_)
    apply_pose(pose, points, out, inside)
    return out, inside


def compose(outer: Int32s, inner: Int32s) -> Int32s:
    """The pose that applies `inner`, then `outer`; the translation saturates at +-2^29 mm."""
    return np.array(_composed(tuple(outer.tolist()), tuple(inner.tolist())), np.int32)


@lru_cache(maxsize=4096)
def _composed(a: tuple[int, ...], b: tuple[int, ...]) -> tuple[int, ...]:
    w = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3]
    x = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2]
    y = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1]
    z = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0]
    quaternion = _normalised((w, x, y, z))
    return quaternion + _moved(a, b[4:])


def invert(pose: Int32s) -> Int32s:
    """The pose that undoes `pose`, to the rounding of a millimetre."""
    return np.array(_inverse(tuple(pose.tolist())), np.int32)


@lru_cache(maxsize=4096)
def _inverse(pose: tuple[int, ...]) -> tuple[int, ...]:
    w, x, y, z, *translation = pose
    back = (w, -x, -y, -z)
    return back + _moved((*back, 0, 0, 0), tuple(-t for t in translation))


def _moved(pose: tuple[int, ...], place: tuple[int, ...]) -> tuple[int, ...]:
    """One place through a pose, in Python's unbounded integers, saturating."""
    r, t = rotation(np.array(pose, np.int32)).tolist(), pose[4:]
    rows = (r[0:3], r[3:6], r[6:9])
    moved = (
        ((sum(a * b for a, b in zip(row, place, strict=True)) + _HALF) >> _SHIFT) + offset
        for row, offset in zip(rows, t, strict=True)
    )
    return tuple(max(-_LIMIT, min(_LIMIT, value)) for value in moved)


def _normalised(q: tuple[int, int, int, int]) -> tuple[int, ...]:
    """Scale to a norm of 2^30, rounding half up, so that chains of poses do not drift."""
    norm = isqrt(sum(c * c for c in q))
    return tuple((2 * c * QUATERNION_ONE + norm) // (2 * norm) for c in q)
