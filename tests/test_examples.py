"""The examples do what they show."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


def test_kiss_icp_frame_by_frame() -> None:
    pytest.importorskip("kiss_icp")
    example = runpy.run_path(str(EXAMPLES / "kiss_icp" / "run.py"))
    robots, off = example["run"](frames=15)
    red, green = (robot.agent for robot in robots.values())
    assert max(off.values()) < 0.15  # m, after 2 m
    assert red.digest() == green.digest()
    map_ = red.map
    assert map_.count(example["State"].CONFIRMED) > 1000
    walls = np.minimum(np.abs(map_.positions), np.abs(map_.positions - example["HALL"])).min(axis=1)
    pillars = np.linalg.norm(map_.positions[:, None, :2] - example["PILLARS"], axis=2).min(axis=1)
    assert np.mean((walls < 0.15) | (np.abs(pillars - 0.4) < 0.15)) > 0.95
