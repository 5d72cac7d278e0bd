"""Agreement over time: how far apart the robots' ledgers are, while the network misbehaves.

The paper shows one map and says that every agent comes to have it; here the largest share of all
transactions that one robot lacks, each second, and whether the maps are equal at the end.
`--out DIR`; a quarter of a minute.
"""

from __future__ import annotations

from pathlib import Path

import msgspec

import common
from common import BLUE, GREEN, ORANGE, RED, Row
from dagmap import Config, GraphConfig
from dagmap.config import FoldConfig, TransactionConfig
from dagmap.io.panels import open_figure, save
from dagmap.sim.fleet import Crash
from dagmap.sim.mission import Mission, Report
from dagmap.sim.network import Link, Partition
from dagmap.sim.scenario import Scenario
from dagmap.sim.sensor import SensorConfig

NAME = "agreement"
PAPER = (
    "every agent comes to have the same shape of the global map with the same properties of each "
    "feature (4.3); how soon is not said"
)
SECONDS = 60.0


def scenario(name: str, seconds: float) -> Scenario:
    """Six robots, the last of which joins late, under one of the networks."""
    base = Scenario(
        name=name,
        robots=6,
        seconds=seconds,
        late=(round(2 / 3 * seconds, 3),),
        sensor=SensorConfig(points=60),
        config=Config(
            same_origin=True,
            transaction=TransactionConfig(proof_of_work_bits=0),
            graph=GraphConfig(reference_pitch=0.25, max_parent_distance=0.75),
            fold=FoldConfig(delta=0.1),
        ),
    )
    trouble = {
        "no loss": {},
        "20 % loss": {"link": Link(loss=0.2)},
        "50 % loss": {"link": Link(loss=0.5)},
        "20 % loss, halves apart for a while, a crash": {
            "link": Link(loss=0.2),
            "partitions": (
                Partition(start=seconds / 6, end=seconds / 2, robots=("r00", "r01", "r02")),
            ),
            "crashes": (Crash(robot="r04", at=0.75 * seconds, down=seconds / 12),),
        },
    }
    return msgspec.structs.replace(base, **trouble[name])


NETWORKS = {
    "no loss": BLUE,
    "20 % loss": GREEN,
    "50 % loss": ORANGE,
    "20 % loss, halves apart for a while, a crash": RED,
}


def run(out: Path, seconds: float = SECONDS) -> Row:
    reports = {name: Mission(scenario(name, seconds), 1).run() for name in NETWORKS}
    draw(out / f"{NAME}.png", reports)
    cases = [row(name, report) for name, report in reports.items()]
    return common.written(out, NAME, PAPER, [sentence(r) for r in cases], cases=cases)


def row(name: str, report: Report) -> Row:
    return {
        "network": name,
        "agreed": report.agreed,
        "digest": report.digest,
        "agreement_s": report.agreement_s,
        "transactions": report.transactions,
        "lacking": report.divergence,
        "bytes_carried_over_minimum": report.bytes_carried / report.bytes_minimum,
    }


def sentence(row: Row) -> str:
    if not row["agreed"]:
        return f"{row['network']}: THE ROBOTS DISAGREE"
    return (
        f"{row['network']}: all maps equal {row['agreement_s']:.2f} s after the last news; "
        f"{row['bytes_carried_over_minimum']:.2f} times the least bytes"
    )


def draw(path: Path, reports: dict[str, Report]) -> None:
    with open_figure((7.2, 1.0 + 1.2 * len(reports)), len(reports), 1) as (figure, axes):
        for axis, (name, report) in zip(axes, reports.items(), strict=True):
            times = [at for at, _ in report.divergence]
            lacking = [100 * share for _, share in report.divergence]
            axis.step(times, lacking, where="post", color=NETWORKS[name], linewidth=1.2)
            axis.set_title(name, loc="left", fontsize=8.5, fontweight="bold")
            axis.set_ylabel("%")
            axis.set_ylim(0, None if max(lacking) > 10 else 10)
            axis.spines[["top", "right"]].set_visible(False)
        axes[-1].set_xlabel("time, s; the largest share of all transactions that one robot lacks")
        save(path, figure)


if __name__ == "__main__":
    common.main(run, ("seconds", float, SECONDS, 6.0, 3600.0, "length of each mission"))
