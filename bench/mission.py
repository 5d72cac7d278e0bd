"""One long mission: three robots, each a process, walk the office over and over.

`python bench/mission.py [--minutes 60] [--speed 1] [--out DIR]` writes mission.json and
mission.png: memory, ledger, traffic, processor time and the time of a cycle against the time of the
mission. Every round sees the same places with other noise, as a SLAM that never stops would.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dagmap import Cycle
from dagmap.cli.agent import AgentCommand
from dagmap.io.settings import Settings
from dagmap.io.sources import Source, open_source
from fleet_robots import Robot, running, until

OFFICE = Path(__file__).parents[1] / "examples" / "office"
ROBOTS = 3
RATE = 10  # cycles a second
POINTS = 1000  # in a cycle
NOISE = 0.005  # m, of every point anew
PROGRAM = "import sys; sys.path.insert(0, {here!r}); import mission; mission.walk({rest})"
Samples = dict[str, list[list[float]]]  # what, then robot, then minute


class Rounds:
    """A robot's round through its part of the office, there and back so that nothing jumps."""

    def __init__(self, number: int, count: int) -> None:
        self.name = f"robot{number}"
        self._seen = list(open_source(OFFICE / self.name))
        self._seed, self._count = number, count

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[Cycle]:
        rng = np.random.default_rng(self._seed)
        for number in range(self._count):
            lap = number % (2 * len(self._seen))
            base = self._seen[min(lap, 2 * len(self._seen) - 1 - lap)]
            points = np.asarray(base.points, np.float64)
            points = points[rng.integers(0, len(points), POINTS)]
            points = points + rng.normal(0.0, NOISE, points.shape)
            yield Cycle(stamp=1.0 + number / RATE, pose=base.pose, points=points)


def walk(number: int, count: int, speed: float) -> None:
    """`dagmap agent FILE --speed N` of one robot, with a walk that no recording could hold."""

    class Walker(AgentCommand):
        def _open_source(self, settings: Settings) -> Source:
            return Rounds(number, count)

    Walker(Path(sys.argv[2]), speed, ROBOTS - 1, None, False, "debug", False).run()


def fly(minutes: int, speed: float, folder: Path) -> dict[str, Any]:
    """Let the robots work; what was measured, a value a minute of the mission."""
    count = minutes * 60 * RATE
    robots: list[Robot] = []
    for i in range(ROBOTS):
        rest = f"{i + 1}, {count}, {speed}"
        program = PROGRAM.format(here=str(Path(__file__).parent), rest=rest)
        others = tuple(robot.port for robot in robots)
        robots.append(Robot(folder, f"robot{i + 1}", others, program=program))
    began = time.monotonic()
    with running(*robots):
        for robot in robots:
            robot.start()
        for robot in robots:
            robot.wait_for("observed")
        sampled = sample(robots, minutes, 60.0 / speed)
        until(lambda: all(r.status().get("cycles") == count for r in robots), "all cycles", 1.0)
        until(lambda: len({r.status().get("digest") for r in robots}) == 1, "one map", 1.0)
        answers = [robot.status() for robot in robots]
        peak = max(robot.peak() for robot in robots)
        for robot in robots:
            robot.stop()
        sampled["cycle_ms"] = [cycle_ms(robot) for robot in robots]
        ledger = max(robot.ledger.stat().st_size for robot in robots)
    times = np.array(sampled["cycle_ms"])
    return {
        "minutes": minutes,
        "speed": speed,
        "wall_s": time.monotonic() - began,
        "digests": sorted({answer["digest"] for answer in answers}),
        "transactions": answers[0]["transactions"],
        "nodes": answers[0]["map"]["nodes"],
        "peak_mb": peak / 1e6,
        "ledger_mb": ledger / 1e6,
        "last_to_fifth": [float(row[-1] / row[min(4, minutes - 1)]) for row in times],
        "robots": sampled,
    }


def sample(robots: list[Robot], minutes: int, period: float) -> Samples:
    """What each robot costs, at the end of every minute of the mission."""
    values: dict[str, Callable[[Robot], float]] = {
        "memory_mb": lambda robot: robot.memory() / 1e6,
        "ledger_mb": lambda robot: robot.ledger.stat().st_size / 1e6,
        "sent_kb": sent_kb,
        "processor_s": lambda robot: robot.cpu(),
    }
    found: Samples = {what: [[] for _ in robots] for what in values}
    began = time.monotonic()
    for minute in range(1, minutes + 1):
        time.sleep(max(0.0, began + minute * period - time.monotonic()))
        for what, of in values.items():
            for i, robot in enumerate(robots):
                found[what][i].append(of(robot))
        told = ", ".join(f"{what} {rows[0][-1]:,.1f}" for what, rows in found.items())
        sys.stderr.write(f"minute {minute}: {told}\n")
    for what in ("sent_kb", "processor_s"):  # what counts is that of the minute
        found[what] = [list(np.diff(row, prepend=0.0)) for row in found[what]]
    return found


def sent_kb(robot: Robot) -> float:
    """Transactions, announcements and questions so far, kB."""
    table = until(robot.status, "status")["traffic"]["sent"]
    return float(sum(row["bytes"] for row in table.values())) / 1e3


def cycle_ms(robot: Robot) -> list[float]:
    """What 95 % of the calls of `observe` in each minute of the mission took at most, ms."""
    each = [float(line["ms"]) for line in robot.lines("observed")]
    length = 60 * RATE
    starts = range(0, len(each) - length + 1, length)
    return [float(np.percentile(each[i : i + length], 95)) for i in starts]


def draw(result: dict[str, Any], path: Path) -> None:
    figure = Figure(figsize=(9, 6), layout="constrained")
    panels = (
        ("memory_mb", "memory of a robot, MB"),
        ("ledger_mb", "ledger of a robot on disk, MB"),
        ("sent_kb", "sent by a robot, kB a minute"),
        ("cycle_ms", "observe, 95 % within, ms"),
    )
    for axis, (what, title) in zip(figure.subplots(2, 2).flat, panels, strict=True):
        for i, row in enumerate(result["robots"][what]):
            axis.plot(np.arange(1, len(row) + 1), row, label=f"robot {i + 1}")
        axis.set_title(title)
        axis.set_xlabel("minute of the mission")
        axis.set_ylim(bottom=0)
    figure.axes[0].legend()
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--minutes", type=int, default=60)
    parser.add_argument("--speed", type=float, default=1.0, help="times the pace of the robots")
    parser.add_argument("--out", type=Path, default=Path("out/mission"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        result = fly(options.minutes, options.speed, Path(folder))
    (options.out / "mission.json").write_text(json.dumps(result, indent=1) + "\n")
    draw(result, options.out / "mission.png")
    sys.stdout.write(json.dumps({k: v for k, v in result.items() if k != "robots"}) + "\n")


if __name__ == "__main__":
    main()
