"""Clouds of points as files: what `evaluate` compares, whichever program wrote them."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..model import Floats, RecordingError, Uint8s
from .npy import BROKEN, read_array, read_layout, read_members
from .ply import read_vertices

_FITS = np.dtype([("state", "u1")])
_NAMES = ("positions", "points")  # of an array (N, 3) in an .npz, whichever there is
_ARRAYS = (*_NAMES, "states", "pose", "offsets")


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """positions: (N, 3) m. states: (N,) values of `State`, None where the file has none."""

    positions: Floats
    states: Uint8s | None


def read_cloud(path: Path) -> Cloud:
    """Read a PLY (x y z, and state where there is one) or an NPZ, told apart by their content.

    An NPZ holds `positions` or `points` (N, 3) m, and may hold `states` (N,); a cycle stream is
    put together by its poses. Raises RecordingError that names the file and what is wrong.
    """
    try:
        with open(path, "rb") as file:
            head = file.read(4)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror}); check the path") from None
    if head[:2] == b"PK":
        return _read_npz(path)
    if head[:3] == b"ply":
        return _read_ply(path)
    raise RecordingError(f"{path}: neither a PLY nor an NPZ; convert the cloud into one of them")


def _read_ply(path: Path) -> Cloud:
    vertices = read_vertices(path, ("x", "y", "z"), "give a PLY with x, y and z in metres", _FITS)
    names = vertices.dtype.names or ()
    states = vertices["state"].astype(np.uint8) if "state" in names else None
    with np.errstate(invalid="ignore"):  # NaNs that signal stay what they are
        return Cloud(np.stack([vertices[n].astype(np.float64) for n in "xyz"], axis=1), states)


def _read_npz(path: Path) -> Cloud:
    try:
        arrays = _load(path)
    except BROKEN as error:
        raise RecordingError(f"{path}: damaged or no .npz file ({error}); write it anew") from None
    points = next((arrays[name] for name in _NAMES if name in arrays), None)
    if points is None or points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise RecordingError(f"{path}: no array positions or points of the shape (N, 3) in metres")
    if "pose" in arrays:
        return Cloud(_placed(path, points, arrays), None)
    states = arrays.get("states")
    if states is not None and states.shape != (len(points),):
        raise RecordingError(f"{path}: states {states.shape} for {len(points)} points; one each")
    if states is not None and not ((states >= 0) & (states <= 255)).all():
        raise RecordingError(f"{path}: states that are none; whole numbers up to 255 are wanted")
    return Cloud(points.astype(np.float64), None if states is None else states.astype(np.uint8))


def _load(path: Path) -> dict[str, npt.NDArray[Any]]:
    """The arrays that a cloud may have."""
    with zipfile.ZipFile(path) as archive:
        members = read_members(archive)
        found = {name: members[name] for name in _ARRAYS if name in members}
        for name, info in found.items():
            shape, dtype, holds = read_layout(archive, info, path.stat().st_size)
            if not holds or dtype.kind not in "fiu":
                raise ValueError(f"{name} claims {shape} {dtype}")
        return {name: read_array(archive, info) for name, info in found.items()}


def _placed(path: Path, points: npt.NDArray[Any], arrays: dict[str, npt.NDArray[Any]]) -> Floats:
    """The points of a cycle stream in the SLAM's frame."""
    poses, offsets = arrays["pose"], arrays.get("offsets", np.zeros(0, np.int64))
    ends = offsets.ndim == 1 and offsets.dtype.kind in "iu" and [0, *offsets, len(points)]
    if (
        not ends
        or ends != sorted(ends)
        or ends[-2] != ends[-1]
        or poses.shape != (len(ends) - 3, 4, 4)
    ):
        raise RecordingError(f"{path}: pose, offsets and points do not belong together")
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is found by its values
        parts = [
            points[a:b] @ pose[:3, :3].T + pose[:3, 3]
            for pose, a, b in zip(poses, offsets[:-1], offsets[1:], strict=True)
        ]
    return np.concatenate([np.zeros((0, 3)), *parts])
