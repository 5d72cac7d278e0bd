"""Map completion time: cycles until 95 % of the final map, against N_c and V_th.

A robot that looks at a wall over and over, and three robots that walk through a room. The paper has
it that a larger N_c "greatly increases the validation overhead and map completion time".
`--out DIR`; half a minute.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

import common
import overhead
from common import BLUE, GREEN, ORANGE, RED, Row
from dagmap import Config, GraphConfig
from dagmap.config import IssuanceConfig, TransactionConfig
from dagmap.io.panels import open_figure, save
from dagmap.sim.mission import Mission
from dagmap.sim.scenario import Scenario
from dagmap.sim.scene import SceneConfig
from dagmap.sim.sensor import SensorConfig

NAME = "completion"
PAPER = (
    "a higher N_c greatly increases the validation overhead and map completion time due to the "
    "large width of the graph (5.1); no numbers"
)
DEGREES = (2, 3, 4, 6, 8)  # N_c
FEW = (2, 4, 8)  # of them, in the room
THRESHOLDS = (1, 3, 8, 64)  # V_th
GREATLY = 1.5  # times as many cycles, or as little of the map in as many
CELL = 0.2  # m, of the room that is covered


def room(n_c: int, v_th: int, cycles: int) -> Row:
    """Cycles until the map of three robots in a room covers 95 % of what it covers in the end."""
    scenario = Scenario(
        name="room",
        seconds=float(cycles),
        patience=0.1,
        scene=SceneConfig(rooms=(1, 1), room=6.0),
        sensor=SensorConfig(points=100, tracked=0.0, outliers=0.0),
        config=Config(
            graph=GraphConfig(n_c=n_c, v_th=v_th, reference_pitch=0.25, max_parent_distance=0.75),
            issuance=IssuanceConfig(repeats=0),
            transaction=TransactionConfig(proof_of_work_bits=0),
        ),
    )
    mission, covered = Mission(scenario, 1), []

    def look(_: float) -> None:
        mission.honest[0].agent.settle()
        folded = mission.honest[0].agent.consensus.folded.components.values()
        seeds = [np.zeros((0, 3)), *(component.fold.columns().seed for component in folded)]
        cells = np.floor(np.concatenate(seeds) / (1000 * CELL))
        covered.append(len(np.unique(cells, axis=0)))  # nodes alone: judging them takes longer

    mission.play(look)
    reached = [i + 1 for i, cells in enumerate(covered) if cells >= 0.95 * covered[-1]]
    return {"n_c": n_c, "v_th": v_th, "cycles_to_95": reached[0], "cells": covered[-1]}


def run(
    out: Path,
    cycles: int = 40,
    thresholds: Sequence[int] = THRESHOLDS,
    degrees: Sequence[int] = DEGREES,
    few: Sequence[int] = FEW,
) -> Row:
    """cycles: that a robot looks at the wall; in the room it is half as many again."""

    def sweep(degrees: Sequence[int], measure: Callable[[int, int], Row]) -> list[Row]:
        return [measure(n_c, v_th) for v_th in thresholds for n_c in degrees]

    walls = sweep(degrees, lambda n_c, v_th: overhead.completion(n_c, v_th, cycles))
    rooms = sweep(few, lambda n_c, v_th: room(n_c, v_th, cycles * 3 // 2))
    most = max(row["cells"] for row in rooms)
    for row in rooms:
        row["covered_at_end"] = row["cells"] / most  # of the best
    scenes = {"wall": walls, "room": rooms}
    judged = {name: judgement(rows) for name, rows in scenes.items()}
    draw(out / f"{NAME}.png", scenes)
    measured = [sentence(name, row) for name, rows in judged.items() for row in rows]
    return common.written(out, NAME, PAPER, measured, greatly=GREATLY, judged=judged, **scenes)


def judgement(rows: list[Row]) -> list[Row]:
    """For each V_th: from the least N_c to the largest, and whether the claim holds.

    A map of which much is missing when the others are complete is not complete early, though 95 %
    of what there will be of it may be there: so the claim holds for either.
    """
    found = []
    for v_th in dict.fromkeys(row["v_th"] for row in rows):
        mine = [row for row in rows if row["v_th"] == v_th]
        first, last = mine[0], mine[-1]
        later = last["cycles_to_95"] / first["cycles_to_95"]
        less = first["covered_at_end"] / max(last["covered_at_end"], 1e-9)
        found.append(
            {
                "v_th": v_th,
                "n_c": [first["n_c"], last["n_c"]],
                "cycles": [first["cycles_to_95"], last["cycles_to_95"]],
                "covered": [first["covered_at_end"], last["covered_at_end"]],
                "times_the_cycles": later,
                "times_less_covered": less,
                "claim_holds": max(later, less) >= GREATLY,
            }
        )
    return found


def sentence(name: str, row: Row) -> str:
    low, high = row["covered"]
    return (
        f"{name}, V_th = {row['v_th']}: {row['cycles'][0]} cycles with N_c = {row['n_c'][0]}, "
        f"{row['cycles'][1]} with {row['n_c'][1]}, covering {low:.0%} and {high:.0%}: the claim "
        f"{'holds' if row['claim_holds'] else 'does not hold'}"
    )


def draw(path: Path, scenes: dict[str, list[Row]]) -> None:
    with open_figure((8.0, 6.0), 2, 2) as (figure, axes):
        titles = {"wall": "one robot before a wall", "room": "three robots in a room"}
        for column, (name, rows) in enumerate(scenes.items()):
            thresholds = dict.fromkeys(row["v_th"] for row in rows)
            for v_th, color in zip(thresholds, (BLUE, GREEN, ORANGE, RED), strict=False):
                mine = [row for row in rows if row["v_th"] == v_th]
                x = [row["n_c"] for row in mine]
                took = [row["cycles_to_95"] for row in mine]
                share = [100 * row["covered_at_end"] for row in mine]
                axes[column].plot(x, took, "o-", color=color, label=f"V_th = {v_th}")
                axes[2 + column].plot(x, share, "o-", color=color)
            axes[column].set_title(titles[name], fontweight="bold")
            axes[column].set_ylim(bottom=0)
            axes[2 + column].set_ylim(0, 105)
            axes[2 + column].set_xlabel("N_c")
        axes[0].set_ylabel("cycles until 95 % of the final map")
        axes[2].set_ylabel("of wall, or of the best map of the room, %")
        axes[0].legend()
        save(path, figure)


if __name__ == "__main__":
    common.main(run, ("cycles", int, 40, 10, 10_000, "cycles before the wall"))
