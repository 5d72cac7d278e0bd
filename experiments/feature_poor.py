"""The paper's open question of a featureless environment: ever fewer points a cycle.

Three robots with RGB-D cameras in two rooms that give 300 points a cycle or as few as 5; a tenth is
wrong. The defaults, the defaults with V_th = 3, and what `dagmap tune` proposes. `--out DIR`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import common
from common import BLUE, GREEN, RED, Row
from dagmap import Config
from dagmap.io.panels import open_figure, save
from dagmap.model import DagmapError
from dagmap.sim.sensor import SensorConfig
from studies import OUTLIERS, Fleetful, parameters, with_v_th

NAME = "feature_poor"
PAPER = "in a following study: various factors, such as a featureless environment (7); no numbers"
POINTS = (300, 100, 40, 15, 5)
COLORS = {"defaults": RED, "V_th = 3": BLUE, "tuned": GREEN}
SHOWN = {
    "f_10_cm": "F-score at 10 cm",
    "true_rejected": "true nodes rejected",
    "issued": "features sent, of those seen",
    "bytes_per_feature": "bytes a feature sent",
}


def run(out: Path, seconds: float = 30.0, counts: Sequence[int] = POINTS) -> Row:
    cases = [case(count, seconds) for count in counts]
    draw(out / f"{NAME}.png", cases)
    return common.written(out, NAME, PAPER, [sentence(row) for row in cases], cases=cases)


def case(count: int, seconds: float) -> Row:
    sensor = SensorConfig(points=count, noise=0.01, outliers=OUTLIERS)
    fleet = Fleetful({f"r{i}": sensor for i in range(3)}, seconds)
    row: Row = {"points_a_cycle": count, "refused": None}
    configs = {"defaults": Config(), "V_th = 3": with_v_th(Config(), 3)}
    try:
        configs["tuned"] = fleet.tuned()
    except DagmapError as error:
        row["refused"] = str(error)  # too little to tell noise from
    return row | {name: parameters(c) | fleet.played(c) for name, c in configs.items()}


def sentence(row: Row) -> str:
    parts = [
        f"{name} F-score at 10 cm {row[name]['f_10_cm']:.3f} ({row[name]['issued']:.0%} sent)"
        for name in COLORS
        if name in row
    ]
    refused = [f"tune refuses: {row['refused']}"] if row["refused"] else []
    return f"{row['points_a_cycle']} points a cycle: {', '.join(parts + refused)}"


def draw(path: Path, cases: list[Row]) -> None:
    with open_figure((8.0, 5.4), 2, 2) as (figure, axes):
        for axis, (column, title) in zip(axes, SHOWN.items(), strict=True):
            for name, color in COLORS.items():
                mine = [row for row in cases if name in row and row[name][column] is not None]
                x = [row["points_a_cycle"] for row in mine]
                axis.plot(x, [row[name][column] for row in mine], "o-", color=color, label=name)
            axis.set_xscale("log")
            axis.set_ylim(bottom=0)
            axis.set_title(title, fontweight="bold")
            axis.set_xlabel("points a cycle")
        axes[0].legend()
        save(path, figure)


if __name__ == "__main__":
    common.main(run, ("seconds", float, 30.0, 5.0, 3600.0, "length of the missions"))
