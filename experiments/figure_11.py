"""Figure 11: features a second on the wire, with and without DAGmap, log scale.

The office with a SLAM that hands over what it saw every 4.8 s, and a simulated hour of three robots
in four rooms with a SLAM of T = 5 s and 400 points a cycle, which is all that fits into two minutes
of computing. Fewer points (`--points 200`) are not shaped as well: parts under 64 features are not
worth an envelope. `--seconds` for less than an hour.
"""

from __future__ import annotations

from pathlib import Path

import common
import traffic
from common import Row
from dagmap.cli.replay import traffic_figure
from dagmap.io.figures import draw_traffic
from dagmap.sim.robot import Robot

NAME = "figure_11"
PAPER = (
    "the transactions of features are continuously shared through the DAGmap network, whereas the "
    "comparison case collectively broadcasts the 3D features after the map update; the total "
    "amount of the traffic might be similar"
)
WANTED = 1 / 3  # of the peak-to-mean ratio without DAGmap, at most


def run(out: Path, seconds: float = 3600.0, points: int = 400, cycles: int | None = None) -> Row:
    """cycles: of each recording of the office; None: all."""
    cases = [case(out, "office", traffic.office(cycles), 4.8)]
    cases.append(case(out, "hour", traffic.hour(seconds, points), 5.0))
    cases[1] |= {"seconds": seconds, "points_a_cycle": points}
    measured = [sentence(row) for row in cases]
    return common.written(out, NAME, PAPER, measured, wanted_part=WANTED, cases=cases)


def case(out: Path, name: str, robots: list[Robot], period: float) -> Row:
    picture = f"{NAME}_{name}.png"
    draw_traffic(out / picture, traffic_figure(robots))
    *each, total = traffic.rows(name, robots)
    return {"case": name, "T": period, "picture": picture, "all": total, "robots": each}


def sentence(row: Row) -> str:
    total = row["all"]
    verdict = "reached" if total["part"] <= WANTED else "NOT REACHED"
    return (
        f"{row['case']}, T = {row['T']} s: peak to mean {total['peak_to_mean_with']:.2f} "
        f"with DAGmap, {total['peak_to_mean_without']:.2f} without, {total['part']:.2f} of it "
        f"(a third is wanted: {verdict}); {total['features_with']:,} of "
        f"{total['features_without']:,} features in {total['bytes'] / 1000:,.0f} kB"
    )


if __name__ == "__main__":
    common.main(
        run,
        ("seconds", float, 3600.0, 20.0, 86_400.0, "length of the simulated mission"),
        ("points", int, 400, 1, 100_000, "points of a cycle"),
    )
