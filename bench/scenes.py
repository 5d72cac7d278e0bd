"""Seeded points for the benchmarks. Whole millimetres, (N, 3) int32."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Points = npt.NDArray[np.int32]

FRAME = 250  # points that a SLAM adds in one cycle
DENSITY = 500  # points a square metre of wall


def surface(count: int, seed: int = 1, density: float = DENSITY, noise_mm: float = 10.0) -> Points:
    """Walls, floor and ceiling of a winding corridor, 4 m by 3 m, in the order of a scan.

    A robot walks along it; each cycle adds FRAME points of the surfaces a few metres ahead, in no
    order within the cycle. The corridor grows with `count`, the density stays.
    """
    rng = np.random.default_rng(seed)
    length = count / density / 14.0  # m; the section is 14 m around
    ahead = np.arange(count) // FRAME * (FRAME / density / 14.0)
    along = ahead + rng.uniform(0.0, min(3.0, max(length, 0.1)), count)
    around = rng.uniform(0.0, 14.0, count)
    y = np.select([around < 4, around < 7, around < 11], [around, 4.0, 11 - around], 0.0)
    z = np.select([around < 4, around < 7, around < 11], [0.0, around - 4, 3.0], 14 - around)
    points = np.stack([along, y + 2.0 * np.sin(along / 7.0), z], axis=1) * 1000.0
    points += rng.normal(0.0, noise_mm, points.shape)
    return np.floor(points + 0.5).astype(np.int32)
