"""Everything that a SLAM hands in is checked and quantised here, once: metres become int32
millimetres, poses integer quaternions, stamps microseconds. Nothing behind it sees a float.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .model import DESCRIPTOR, Cycle, CycleError, Int32s, Uint8s, quantise_points, quantise_pose


@dataclass(frozen=True, slots=True, eq=False)
class QuantisedCycle:
    """A `Cycle` after checking: integers only. Poses are (7,) int32, see `quantise_pose`."""

    stamp: int  # microseconds
    pose: Int32s
    points: Int32s  # (N, 3) mm in the sensor frame
    ids: npt.NDArray[np.uint64] | None
    colors: Uint8s | None
    moved: tuple[tuple[int, Int32s], ...]
    removed: npt.NDArray[np.uint64]
    session: int
    descriptors: Uint8s | None  # (N, 32)


def quantise_cycle(cycle: Cycle) -> QuantisedCycle:
    """Check a cycle and turn it into integers. Raises CycleError; takes all of it or nothing."""
    stamp = quantise_stamp(cycle.stamp)
    where = f"cycle at {float(cycle.stamp):.6f} s"
    pose = quantise_pose(cycle.pose, f"{where}: pose")
    points = quantise_points(cycle.points, f"{where}: points")
    ids = None if cycle.ids is None else _ids(cycle.ids, f"{where}: ids")
    if ids is not None and len(ids) != len(points):
        raise CycleError(f"{where}: {len(ids)} ids for {len(points)} points; give one id a point")
    removed = _ids(() if cycle.removed is None else cycle.removed, f"{where}: removed")
    ordered = np.sort(removed)
    if (ordered[1:] == ordered[:-1]).any():
        raise CycleError(f"{where}: removed names an id twice; name each withdrawn id once")
    if not _is_session(cycle.session):
        raise CycleError(f"{where}: session {cycle.session!r} is not a number from 0 to 2^32 - 1")
    colors = _bytes(cycle.colors, (len(points), 3), f"{where}: colors")
    described = _bytes(cycle.descriptors, (len(points), DESCRIPTOR), f"{where}: descriptors")
    moved = _moved(cycle.moved, where)
    return QuantisedCycle(
        stamp, pose, points, ids, colors, moved, removed, int(cycle.session), described
    )


def quantise_stamp(stamp: float) -> int:
    """Seconds to whole microseconds. Raises CycleError where it is no finite number."""
    try:
        seconds = float(stamp)
    except (TypeError, ValueError):
        seconds = float("nan")
    if not abs(seconds) < 2.0**42:
        raise CycleError(f"stamp {stamp!r} is not a finite number of seconds")
    return round(seconds * 1e6)


def _ids(ids: npt.ArrayLike | Sequence[int], where: str) -> npt.NDArray[np.uint64]:
    array = _array(ids, where)
    if array.size == 0:
        return np.zeros(0, np.uint64)
    if array.ndim != 1 or array.dtype.kind not in "iu" or int(array.min()) < 0:
        raise CycleError(f"{where}: a list of whole numbers from 0 to 2^64 - 1 is wanted")
    return array.astype(np.uint64)


def _is_session(value: object) -> bool:
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    return whole and 0 <= int(value) < 1 << 32  # type: ignore[call-overload]


def _array(values: npt.ArrayLike, where: str) -> npt.NDArray[np.generic]:
    try:
        return np.asarray(values)
    except (TypeError, ValueError) as error:
        raise CycleError(f"{where}: not an array ({error})") from None


def _bytes(values: npt.ArrayLike | None, shape: tuple[int, int], where: str) -> Uint8s | None:
    """A column of bytes with one row a point, where there is one."""
    if values is None:
        return None
    array = _array(values, where)
    if array.size == 0 and shape[0] == 0:
        return np.zeros(shape, np.uint8)
    if array.shape != shape or array.dtype != np.uint8:
        what = where.rpartition(" ")[2]
        raise CycleError(
            f"{where}: {what} are {array.dtype} {array.shape}; {shape} uint8 is wanted"
        )
    return array.astype(np.uint8, copy=False)


def _moved(
    moved: tuple[npt.ArrayLike, npt.ArrayLike] | None, where: str
) -> tuple[tuple[int, Int32s], ...]:
    if moved is None:
        return ()
    try:
        given_stamps, given_poses = moved
        stamps, poses = np.asarray(given_stamps, np.float64), np.asarray(given_poses, np.float64)
    except (TypeError, ValueError) as error:
        raise CycleError(f"{where}: moved is not (stamps, poses) of numbers ({error})") from None
    if stamps.ndim != 1 or poses.shape != (len(stamps), 4, 4):
        raise CycleError(
            f"{where}: moved is {stamps.shape} stamps with {poses.shape} poses; "
            "(M,) and (M, 4, 4) are wanted"
        )
    out = tuple(
        (quantise_stamp(stamp), quantise_pose(pose, f"{where}: moved[{i}]"))
        for i, (stamp, pose) in enumerate(zip(stamps.tolist(), poses, strict=True))
    )
    if len({stamp for stamp, _ in out}) < len(out):
        raise CycleError(f"{where}: moved names a cycle twice; give its newest pose once")
    return out
