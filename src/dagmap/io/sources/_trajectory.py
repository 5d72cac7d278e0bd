"""Files of poses: TUM's lines, which most SLAMs can write."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...model import RecordingError
from ._poses import Trajectory, matrix
from ._source import Row, Skips, read_rows, readable

_NANOSECONDS = 1e14  # what is larger is no stamp in s: ORB-SLAM3 writes EuRoC's ns as they are


def numbers(file: Path, number: int, words: list[str], count: int) -> list[float]:
    """The finite numbers of a line. Raises RecordingError where they are not `count`."""
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise RecordingError(f"{file}, line {number}: {count} finite numbers are wanted")
    return values


def doubts(file: Path, same: bool) -> tuple[str, ...]:
    """What is not known of whose poses a file holds, in words. same: that they are the camera's.

    ORB-SLAM3 saves the poses of the body in its EuRoC format (ns) if it is inertial, else those of
    the left camera, as always in TUM's (s).
    """
    if same or _first_stamp(file) <= _NANOSECONDS:
        return ()
    said = (
        f"the stamps of {file.name} are in ns, as ORB-SLAM3 saves them for EuRoC: its poses are "
        "taken for those of the left camera, but an inertial ORB-SLAM3 saves those of the body; "
        "say --body-poses (body_poses = true in a robot's file) if it was inertial, --same-frame "
        "if not"
    )
    return (said,)


def _first_stamp(file: Path) -> float:
    """Of the first line that begins with a number."""
    for _, words in read_rows(file):
        try:
            return float(words[0])
        except ValueError:
            continue
    return 0.0


def read_tum(file: Path, skips: Skips) -> Trajectory:
    """`stamp x y z qx qy qz qw` a line, the stamp in s, or in ns as ORB-SLAM3 writes it for EuRoC.

    Raises RecordingError.
    """
    out = Trajectory()

    def add(row: Row) -> None:
        stamp, *values = numbers(file, *row, 8)
        pose = matrix(np.array(values[:3]), np.array(values[3:]))
        if pose is None:
            raise RecordingError(f"{file}, line {row[0]}: the quaternion is not of length 1")
        out.add(stamp / 1e9 if stamp > _NANOSECONDS else stamp, pose)

    readable(read_rows(file), add, skips)
    if not len(out):
        raise RecordingError(f"{file}: no poses; a line `stamp x y z qx qy qz qw` each is wanted")
    return out
