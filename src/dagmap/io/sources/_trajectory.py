"""Files of poses: TUM's lines, which most SLAMs can write."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from ...model import Floats, RecordingError
from ._lists import Row, read_rows
from ._poses import Trajectory, matrix
from ._source import Skips, kept

_NANOSECONDS = 1e14  # what is larger is no stamp in s: ORB-SLAM3 writes EuRoC's ns as they are


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
    for row in read_rows(file):
        try:
            return float(row.words[0])
        except ValueError:
            continue
    return 0.0


def stamped_pose(row: Row) -> tuple[float, Floats]:
    """Stamp in s and (4, 4) pose of `stamp x y z qx qy qz qw`. Raises RecordingError."""
    stamp, *values = row.numbers(8, names="stamp x y z qx qy qz qw")
    pose = matrix(np.array(values[:3]), np.array(values[3:]))
    if pose is None:
        length = math.hypot(*values[3:])
        raise RecordingError(f"{row.where}: a quaternion of length {length:.3g}; 1 is wanted")
    return stamp / 1e9 if stamp > _NANOSECONDS else stamp, pose


def read_tum(file: Path, skips: Skips) -> Trajectory:
    """`stamp x y z qx qy qz qw` a line, the stamp in s, or in ns as ORB-SLAM3 writes it for EuRoC.

    Raises RecordingError.
    """
    out = Trajectory()
    for stamp, pose in kept(read_rows(file), stamped_pose, skips):
        out.add(stamp, pose)
    if not len(out):
        raise RecordingError(f"{file}: no poses; a line `stamp x y z qx qy qz qw` each is wanted")
    return out
