"""Clouds of points as files: what `evaluate` compares, whichever program wrote them."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..model import Floats, RecordingError, Uint8s
from .ply import read_vertices

_BROKEN = (zipfile.BadZipFile, OSError, ValueError, EOFError)
_NAMES = ("positions", "points")  # of an array (N, 3) in an .npz, whichever there is


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
    vertices = read_vertices(path, ("x", "y", "z"), "give a PLY with x, y and z in metres")
    names = vertices.dtype.names or ()
    states = vertices["state"].astype(np.uint8) if "state" in names else None
    return Cloud(np.stack([vertices[n].astype(np.float64) for n in "xyz"], axis=1), states)


def _read_npz(path: Path) -> Cloud:
    try:
        with open(path, "rb") as file, np.load(file) as archive:
            wanted = {*_NAMES, "states", "pose", "offsets"}
            arrays = {name: archive[name] for name in wanted & set(archive.files)}
    except _BROKEN as error:
        raise RecordingError(f"{path}: damaged or no .npz file ({error}); write it anew") from None
    points = next((arrays[name] for name in _NAMES if name in arrays), None)
    if points is None or points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise RecordingError(f"{path}: no array positions or points of the shape (N, 3) in metres")
    if "pose" in arrays:
        return Cloud(_placed(path, points, arrays), None)
    states = arrays.get("states")
    if states is not None and states.shape != (len(points),):
        raise RecordingError(f"{path}: states {states.shape} for {len(points)} points; one each")
    return Cloud(points.astype(np.float64), None if states is None else states.astype(np.uint8))


def _placed(path: Path, points: npt.NDArray[Any], arrays: dict[str, npt.NDArray[Any]]) -> Floats:
    """The points of a cycle stream in the SLAM's frame."""
    poses, offsets = arrays["pose"], arrays.get("offsets", np.zeros(0, np.int64))
    if poses.shape != (len(offsets) - 1, 4, 4) or (len(offsets) and offsets[-1] != len(points)):
        raise RecordingError(f"{path}: pose, offsets and points do not belong together")
    parts = [
        points[a:b] @ pose[:3, :3].T + pose[:3, 3]
        for pose, a, b in zip(poses, offsets[:-1], offsets[1:], strict=True)
    ]
    return np.concatenate([np.zeros((0, 3)), *parts])
