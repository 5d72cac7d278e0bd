"""The paper's open question of heterogeneous cameras: RGB-D, stereo, mono and LiDAR, and all mixed.

Three robots of one kind (four of the mixed) in two rooms; a tenth of the points is wrong. The
defaults, the same with the doubt that suits a dense sensor, what `dagmap tune` proposes, and a grid
of delta and doubt. `--out DIR`; a minute.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import common
from common import BLUE, GREEN, INK, ORANGE, RED, Row
from dagmap import Config, weighing
from dagmap.io.panels import open_figure, save
from dagmap.sim.sensor import SensorConfig
from studies import OUTLIERS, Fleetful, parameters, with_delta

NAME = "sensors"
PAPER = (
    "in a following study: various factors, such as heterogeneous cameras (RGB-D, stereo, and "
    "monocular), and parameter optimization methods (7); no numbers"
)
SENSORS = {
    "RGB-D": SensorConfig(points=150, noise=0.01, outliers=OUTLIERS),
    "stereo": SensorConfig(kind="stereo", points=150, pixel=0.25, outliers=OUTLIERS),
    "mono": SensorConfig(kind="mono", points=40, outliers=OUTLIERS),
    "LiDAR": SensorConfig(
        kind="lidar", points=300, noise=0.02, range=20.0, field=(75.0, 30.0), outliers=OUTLIERS
    ),
}
MIXED = "mixed"
DELTAS = (0.02, 0.03, 0.05, 0.1, 0.2)
DOUBTS = (None, 20, weighing.MOST_DOUBT)  # learned, what suits few points, and many
SHOWN = "f_10_cm"


def run(
    out: Path,
    seconds: float = 30.0,
    kinds: Sequence[str] = (*SENSORS, MIXED),
    deltas: Sequence[float] = DELTAS,
    doubts: Sequence[int | None] = DOUBTS,
) -> Row:
    cases = [case(kind, seconds, deltas, doubts) for kind in kinds]
    draw(out / f"{NAME}.png", cases)
    return common.written(out, NAME, PAPER, [sentence(row) for row in cases], cases=cases)


def case(kind: str, seconds: float, deltas: Sequence[float], doubts: Sequence[int | None]) -> Row:
    alike = {f"{kind} {i}": SENSORS[kind] for i in range(3)} if kind in SENSORS else {}
    carried = alike or dict(SENSORS)
    fleet = Fleetful(carried, seconds)
    tuned = fleet.tuned()
    grid = [
        parameters(config) | fleet.played(config)
        for doubt in doubts
        for config in (with_delta(tuned, delta, doubt) for delta in deltas)
    ]
    dense = with_delta(Config(), Config().fold.delta, weighing.MOST_DOUBT)
    return {
        "sensor": kind,
        "robots": len(carried),
        "defaults": parameters(Config()) | fleet.played(Config()),
        "dense": parameters(dense) | fleet.played(dense),
        "tuned": parameters(tuned) | fleet.played(tuned),
        "best_of_grid": max(grid, key=lambda row: row[SHOWN]),
        "grid": grid,
    }


def sentence(row: Row) -> str:
    usual, dense, tuned, best = (row[n] for n in ("defaults", "dense", "tuned", "best_of_grid"))
    return (
        f"{row['sensor']}: F-score at 10 cm {usual[SHOWN]:.3f} with the defaults (delta "
        f"{usual['delta']:g}, doubt learned), {dense[SHOWN]:.3f} with doubt {dense['doubt']}, "
        f"{tuned[SHOWN]:.3f} as tuned (delta {tuned['delta']:g}), {best[SHOWN]:.3f} at best "
        f"(delta {best['delta']:g}, doubt {best['doubt']})"
    )


def draw(path: Path, cases: list[Row]) -> None:
    with open_figure((2.9 * len(cases), 3.2), 1, len(cases)) as (figure, axes):
        for axis, row in zip(axes, cases, strict=True):
            doubts = dict.fromkeys(each["doubt"] for each in row["grid"])
            for doubt, color in zip(doubts, (RED, ORANGE, BLUE), strict=False):
                mine = [each for each in row["grid"] if each["doubt"] == doubt]
                x, y = [each["delta"] for each in mine], [each[SHOWN] for each in mine]
                axis.plot(x, y, "o-", markersize=3, color=color, label=f"doubt {doubt}")
            for name, marker, color in (("defaults", "X", INK), ("tuned", "*", GREEN)):
                point = row[name]
                axis.plot(
                    point["delta"], point[SHOWN], marker, color=color, markersize=9, label=name
                )
            axis.set_xscale("log")
            axis.set_xticks(DELTAS, [f"{100 * delta:g}" for delta in DELTAS])
            axis.minorticks_off()
            axis.set_ylim(0, 1.02)
            axis.set_title(row["sensor"], fontweight="bold")
            axis.set_xlabel("delta, cm")
        axes[0].set_ylabel("F-score at 10 cm")
        axes[0].legend()
        save(path, figure)


if __name__ == "__main__":
    common.main(run, ("seconds", float, 30.0, 5.0, 3600.0, "length of the missions"))
