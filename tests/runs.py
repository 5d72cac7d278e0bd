"""A replay's output folder for tests."""

from __future__ import annotations

from pathlib import Path

from dagmap.cli.replay import Replay
from dagmap.io.sources import Options
from robots import record

NAMES = ("red", "blue")


def replay_of(folder: Path) -> Path:
    """Two robots at one wall: the folder that `dagmap replay` writes."""
    recordings = [record(folder / f"{name}.npz", i, 8, 150) for i, name in enumerate(NAMES)]
    out = folder / "out"
    code = Replay(
        recordings=recordings, out=out, config_file=None, loss=0.0, late=[], seed=0,
        options=Options(), unknown_frames=False, force=False, json=False,
    ).run()  # fmt: skip
    assert code == 0
    return out
