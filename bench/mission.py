"""One long mission: three robots walk the office over and over, faster than real time.

`python bench/mission.py [--minutes 60] [--out DIR]` writes mission.json and mission.png: memory,
ledger, traffic and the time of a cycle against the time of the mission. Every round sees the same
places with other noise, as a SLAM that never stops would.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from dagmap import Agent, Config, Cycle, Identity
from dagmap.io.sources import open_source

OFFICE = Path(__file__).parents[1] / "examples" / "office"
RATE = 10  # cycles a second
POINTS = 1000  # in a cycle
NOISE = 0.005  # m, of every point anew


@dataclass
class Track:
    """One robot and what it costs, a value a minute."""

    agent: Agent
    seen: list[Cycle]
    sent: int = 0
    cycle_ms: list[float] = field(default_factory=list)  # p95 of the cycles of the minute
    worst_ms: list[float] = field(default_factory=list)
    traffic: list[int] = field(default_factory=list)  # bytes sent
    ledger: list[int] = field(default_factory=list)  # bytes
    held: list[int] = field(default_factory=list)  # bytes that fold, evidence and DAG hold
    spent: list[float] = field(default_factory=list)

    def cycle(self, number: int, rng: np.random.Generator) -> Cycle:
        """The next cycle of its endless round, there and back so that nothing jumps."""
        lap = number % (2 * len(self.seen))
        base = self.seen[min(lap, 2 * len(self.seen) - 1 - lap)]
        points = np.asarray(base.points, np.float64)
        points = points[rng.integers(0, len(points), POINTS)]
        points = points + rng.normal(0.0, NOISE, points.shape)
        return Cycle(stamp=1.0 + number / RATE, pose=base.pose, points=points)


def fly(minutes: int, tracks: list[Track]) -> Iterator[int]:
    """Let the robots work; a number a minute of the mission."""
    rng = np.random.default_rng(1)
    for number in range(minutes * 60 * RATE):
        now = number / RATE
        for track in tracks:
            cycle = track.cycle(number, rng)
            started = time.thread_time()  # what else the machine does is no matter
            track.agent.observe(cycle, now)
            track.agent.tick(now)
            track.spent.append((time.thread_time() - started) * 1e3)
            for out in track.agent.outbox():
                track.sent += len(out.data)
                for other in tracks:
                    if other is not track:
                        other.agent.receive(out.data, now)
        if (number + 1) % (60 * RATE) == 0:
            for track in tracks:
                sample(track)
            yield (number + 1) // (60 * RATE)


def sample(track: Track) -> None:
    agent = track.agent
    track.cycle_ms.append(float(np.percentile(track.spent, 95)))
    track.worst_ms.append(max(track.spent))
    track.traffic.append(track.sent)
    track.ledger.append(sum(len(tx.data) for tx in agent.ledger))
    track.held.append(agent.consensus.nbytes + agent.observing.graph.nbytes)
    track.sent = 0
    track.spent.clear()


def draw(tracks: list[Track], rss: list[float], path: Path) -> None:
    figure = Figure(figsize=(9, 6), layout="constrained")
    axes = figure.subplots(2, 2)
    minutes = np.arange(1, len(rss) + 1)
    for (row, column), name, values in (
        ((0, 1), "ledger of a robot, MB", [np.array(t.ledger) / 1e6 for t in tracks]),
        ((1, 0), "sent by a robot, kB a minute", [np.array(t.traffic) / 1e3 for t in tracks]),
        (
            (1, 1),
            "p95 of a cycle, ms of processor",
            [np.array(t.cycle_ms) for t in tracks],
        ),
    ):
        for i, line in enumerate(values):
            axes[row, column].plot(minutes, line, label=f"robot {i + 1}")
        axes[row, column].set_title(name)
    axes[0, 0].plot(minutes, np.array(rss) / 3)
    axes[0, 0].set_title("memory of the process, MB a robot")
    axes[1, 1].legend()
    for axis in axes.flat:
        axis.set_xlabel("minute of the mission")
        axis.set_ylim(bottom=0)
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--minutes", type=int, default=60)
    parser.add_argument("--out", type=Path, default=Path("out/mission"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    config = Config()
    tracks = [
        Track(
            Agent(Identity.from_seed(bytes([1 + i]) * 32), config),
            list(open_source(OFFICE / f"robot{1 + i}")),
        )
        for i in range(3)
    ]
    rss, started = [], time.perf_counter()
    for minute in fly(options.minutes, tracks):
        rss.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3)
        first = tracks[0]
        sys.stderr.write(
            f"minute {minute}: {rss[-1]:,.0f} MB, ledger {first.ledger[-1] / 1e6:.1f} MB, "
            f"{first.traffic[-1] / 1e3:,.0f} kB sent, cycle {first.cycle_ms[-1]:.1f} ms\n"
        )
    digests = {track.agent.digest().hex() for track in tracks}
    result = {
        "minutes": options.minutes,
        "wall_s": time.perf_counter() - started,
        "digests": sorted(digests),
        "peak_mb_a_robot": rss[-1] / 3,
        "ledger_mb": tracks[0].ledger[-1] / 1e6,
        "robots": [
            {
                name: getattr(track, name)
                for name in ("cycle_ms", "worst_ms", "traffic", "ledger", "held")
            }
            for track in tracks
        ],
    }
    (options.out / "mission.json").write_text(json.dumps(result, indent=1) + "\n")
    draw(tracks, rss, options.out / "mission.png")
    sys.stdout.write(json.dumps({k: v for k, v in result.items() if k != "robots"}) + "\n")


if __name__ == "__main__":
    main()
