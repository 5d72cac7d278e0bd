"""Odometry of clouds that have no poses, by KISS-ICP."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from ...model import Floats, RecordingError
from ._source import Options

_LEAST = 100  # points


class KissIcp:
    """Registers cloud after cloud. On one machine the same clouds give the same poses."""

    def __init__(self, options: Options) -> None:
        config = import_module("kiss_icp.config").KISSConfig()
        config.data.max_range = options.max_depth or 100.0
        config.data.deskew = False  # clouds bring no stamp for each point
        config.registration.max_num_threads = 1  # so that sums have one order
        config.mapping.voxel_size = config.data.max_range / 100.0
        self._odometry: Any = import_module("kiss_icp.kiss_icp").KissICP(config)

    @staticmethod
    def require(path: Path) -> None:
        """Raises RecordingError where KISS-ICP is not installed."""
        try:
            import_module("kiss_icp.kiss_icp")
        except ImportError:
            raise RecordingError(
                f"{path}: clouds without poses; add poses, or pip install 'dagmap[lidar]' for "
                "odometry by KISS-ICP"
            ) from None

    def register(self, points: Floats, cloud: Path) -> Floats:
        """(4, 4) pose of a cloud (N, 3) m in the frame of the first one.

        cloud: its file, for errors. Raises RecordingError.
        """
        good = points[np.isfinite(points).all(axis=1)]
        if len(good) < _LEAST:
            raise RecordingError(
                f"{cloud}: a cloud of {len(good)} points is too sparse for odometry; give poses"
            )
        self._odometry.register_frame(good, np.zeros(len(good)))
        return np.array(self._odometry.last_pose, np.float64)
