"""The paper's Figure 11: features a second on the wire, with and without DAGmap.

The office with a SLAM that hands its points over every 4.8 s (eight cycles of the recording at
once), and a simulated mission of robots whose SLAM has a cycle of 5 s. Each with the usual
configuration but for two things: `cycle_period`, so that the first cycle is spread as well, and
`repeats = 0`, so that the features are the same with and without: usually DAGmap does not say again
what is known, which would flatter it. Writes out/traffic/NAME.png where matplotlib is installed.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dagmap import Config, Cycle, GraphConfig
from dagmap.cli.replay import traffic_figure
from dagmap.config import IssuanceConfig
from dagmap.io.figures import draw_traffic
from dagmap.io.sources import open_source
from dagmap.model import OutputError
from dagmap.sim.fleet import Fleet
from dagmap.sim.mission import Mission
from dagmap.sim.robot import Robot
from dagmap.sim.scenario import Scenario
from dagmap.sim.sensor import SensorConfig

Row = dict[str, Any]
BY_NAME_ONLY = True  # the simulated hour takes minutes
OFFICE = Path(__file__).parents[1] / "examples" / "office"
OUT = Path("out/traffic")
TOGETHER = 8


def joined(cycles: Iterable[Cycle]) -> Iterator[Cycle]:
    """Cycles of a SLAM that hands over what it has seen only now and then."""
    held: list[Cycle] = []
    for cycle in cycles:
        held.append(cycle)
        if len(held) == TOGETHER:
            yield _one(held)
            held = []
    if held:
        yield _one(held)


def _one(cycles: list[Cycle]) -> Cycle:
    last = cycles[-1]
    back = np.linalg.inv(np.asarray(last.pose, np.float64))
    points = []
    for cycle in cycles:
        pose = back @ np.asarray(cycle.pose, np.float64)
        points.append(np.asarray(cycle.points, np.float64) @ pose[:3, :3].T + pose[:3, 3])
    return Cycle(last.stamp, last.pose, np.concatenate(points))


def office(most: int | None = None) -> list[Robot]:
    """Three robots in the office. most: cycles of each recording; None: all."""
    issuance = IssuanceConfig(cycle_period=0.6 * TOGETHER, repeats=0)
    fleet = Fleet(msgspec.structs.replace(Config(), issuance=issuance))
    sources = {f"robot{i}": open_source(OFFICE / f"robot{i}") for i in (1, 2, 3)}
    recordings = {name: joined(islice(source, most)) for name, source in sources.items()}
    for _ in fleet.run(recordings):
        pass
    return list(fleet.robots.values())


def hour(seconds: float, points: int = 400) -> list[Robot]:
    """Three robots of so many points in a cycle of 5 s, none of them seen twice or taken back: else
    DAGmap would send fewer."""
    config = Config(
        graph=GraphConfig(reference_pitch=0.25, max_parent_distance=0.75),
        issuance=IssuanceConfig(cycle_period=5.0, repeats=0),
    )
    sensor = SensorConfig(points=points, period=5.0, outliers=0.0, tracked=0.0)
    scenario = Scenario(
        name="an hour", robots=3, seconds=seconds, tick=0.25, config=config, sensor=sensor
    )
    mission = Mission(scenario, 1)
    mission.play()
    return list(mission.fleet.robots.values())


def measure(name: str, robots: list[Robot]) -> list[Row]:
    """Peaks and means over seconds from the first cycle to the last."""
    draw_all(OUT / f"{name}.png", robots)
    return rows(name, robots)


def rows(name: str, robots: list[Robot]) -> list[Row]:
    """A row a robot, and one of all."""
    return [_row(name, [robot]) for robot in robots] + [_row(name, robots)]


def _row(name: str, robots: list[Robot]) -> Row:
    seen = [pair for robot in robots for pair in robot.observed_at]
    sent = [pair for robot in robots for pair in robot.issued_at]
    span = int(max(at for at, _ in [*seen, *sent])) + 1
    without, with_it = (_bins(pairs, span) for pairs in (seen, sent))
    ratios = without.max() / without.mean(), with_it.max() / with_it.mean()
    return {
        "name": name,
        "robots": ", ".join(robot.name for robot in robots),
        "features_without": int(without.sum()),
        "features_with": int(with_it.sum()),
        "peak_without": int(without.max()),
        "peak_with": int(with_it.max()),
        "peak_to_mean_without": float(ratios[0]),
        "peak_to_mean_with": float(ratios[1]),
        "part": float(ratios[1] / ratios[0]),
        "bytes": sum(robot.bytes_sent for robot in robots),
    }


def _bins(pairs: list[tuple[float, int]], span: int) -> np.ndarray:
    at = np.array([int(t) for t, _ in pairs])
    return np.bincount(at, [count for _, count in pairs], span)


def draw_all(path: Path, robots: list[Robot]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        draw_traffic(path, traffic_figure(robots))
    except OutputError:
        return


def run(seconds: float | None = None) -> list[Row]:
    """Rows. The mission lasts an hour, or DAGMAP_BENCH_SECONDS."""
    seconds = seconds or float(os.environ.get("DAGMAP_BENCH_SECONDS", "3600"))
    return measure("office", office()) + measure("hour", hour(seconds))
