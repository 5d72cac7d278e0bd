"""Cut `examples/office` from the whole office walk: `python examples/cut_office.py SRC DST`.

SRC is a TUM RGB-D folder with `associations.txt`, `groundtruth.txt`, `camera.json`, `rgb/`,
`depth/` and `LICENSE`. Three robots are cut from disjoint ranges of its frames, every third frame
of each, so that no two of them share a measurement. Pictures are copied bit for bit.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

RANGES = {"robot1": range(0, 125, 3), "robot2": range(125, 250, 3), "robot3": range(250, 373, 3)}


def cut(source: Path, target: Path) -> None:
    """Write `target/robot1` to `robot3` and the licence. Nothing that is there already is kept."""
    associations = (source / "associations.txt").read_text().splitlines()
    poses = {
        line.split()[0]: line
        for line in (source / "groundtruth.txt").read_text().splitlines()
        if line and not line.startswith("#")
    }
    target.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source / "LICENSE", target / "LICENSE")
    for name, indices in RANGES.items():
        folder = target / name
        shutil.rmtree(folder, ignore_errors=True)
        lines = [associations[index] for index in indices]
        for line in lines:
            for picture in line.split()[1::2]:
                (folder / picture).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source / picture, folder / picture)
        shutil.copyfile(source / "camera.json", folder / "camera.json")
        (folder / "associations.txt").write_text("\n".join(lines) + "\n")
        walked = [poses[line.split()[2]] for line in lines]
        header = "# timestamp tx ty tz qx qy qz qw   (camera to world)"
        (folder / "groundtruth.txt").write_text("\n".join([header, *walked]) + "\n")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    cut(Path(sys.argv[1]), Path(sys.argv[2]))
