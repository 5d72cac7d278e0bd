"""How good the map is, beside simple filters: `python bench/quality.py --data DIR`.

DIR is a walk of one RGB-D camera (a TUM folder). It is cut in three robots (disjoint ranges, every
third frame, ORB points with depth); then something goes wrong with what they see. Precision is
measured against the cloud of all depth pictures, recall against the union of all points before
anything went wrong, all thinned to 2.5 cm. The median of several seeds.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree

import merging
import office
from dagmap import Config
from dagmap.metrics import thin
from filters import METHODS, listener
from office import Points, Walk

WITHIN = 0.05  # m
ROTATING = "20 %, one robot only rotates"
CLEAR = 0.10  # m from everything static: what of a person can be told from it
Change = Callable[[Walk, np.random.Generator], Walk]


def _off(share: float, shift: float = 0.0) -> Change:
    def change(walk: Walk, rng: np.random.Generator) -> Walk:
        walk = office.displaced(walk, share, rng) if share else walk
        return office.shifted(walk, shift, rng) if shift else walk

    return change


def _rotating(walk: Walk, rng: np.random.Generator) -> Walk:
    return office.displaced(office.rotating(walk, rng), 0.2, rng)


CONDITIONS: dict[str, Change] = {
    **{f"{share} %": _off(share / 100) for share in (0, 10, 20, 40)},
    **{
        f"{share} %, {shift} cm off": _off(share / 100, shift / 100)
        for shift in (3, 5)
        for share in (0, 10, 20, 40)
    },
    "people": office.peopled,
    ROTATING: _rotating,
}
OTHER_VIEWS = ("people", ROTATING)  # what was seen is not what the recording saw
QUICK = ("0 %", "10 %", "20 %", "40 %")


@dataclass(frozen=True, slots=True)
class Truth:
    """What maps are measured against."""

    dense: cKDTree
    union: Points  # thinned

    @staticmethod
    def of(walk: Walk) -> Truth:
        return Truth(cKDTree(thin(walk.dense)), thin(walk.placed()))

    def measure(self, found: Points, union: Points) -> tuple[float, float, float]:
        """Precision, recall, F-score at 5 cm (`metrics.score` without what is not shown here)."""
        if len(found) == 0:
            return 0.0, 0.0, 0.0
        found = thin(found)
        precision = _near(self.dense, found).mean()
        recall = _near(cKDTree(found), union).mean()
        return precision, recall, 2 * precision * recall / max(precision + recall, 1e-9)


def _near(tree: cKDTree, points: Points) -> npt.NDArray[np.bool_]:
    return np.isfinite(tree.query(points, distance_upper_bound=np.nextafter(WITHIN, 1.0))[0])


def measure(walk: Walk, name: str, seeds: int, methods: list[str]) -> list[dict[str, Any]]:
    """One row a method. Of candidates the one with the best median F-score counts."""
    truth, found = Truth.of(walk), {method: {} for method in methods}
    for seed in range(seeds):
        changed = CONDITIONS[name](walk, np.random.default_rng(seed))
        union = thin(_static(changed)) if name in OTHER_VIEWS else truth.union
        for method in methods:
            started = time.process_time()
            for parameters, points in METHODS[method](changed):
                scored = truth.measure(points, union)
                people = _people_left(changed, points, truth) if name == "people" else np.nan
                spent = time.process_time() - started
                found[method].setdefault(parameters, []).append((*scored, people, spent))
    return [_row(name, method, rows) for method, rows in found.items()]


def _row(name: str, method: str, candidates: dict[str, list[tuple[float, ...]]]) -> dict[str, Any]:
    medians = {key: np.median(rows, axis=0) for key, rows in candidates.items()}
    best = max(medians, key=lambda key: medians[key][2])
    precision, recall, f_score, people, seconds = (round(float(x), 4) for x in medians[best])
    row = {
        "condition": name,
        "method": method,
        "parameters": best,
        "precision": precision,
        "recall": recall,
        "f_score": f_score,
        "seconds": seconds,
    }
    return row if np.isnan(people) else {**row, "people_left": people}


def _static(walk: Walk) -> Points:
    frames = [frame for robot in walk.robots for frame in robot]
    return np.concatenate([frame.placed[~frame.false] for frame in frames])


def _people_left(walk: Walk, found: Points, truth: Truth) -> float:
    """Share of the points of people, clear of everything static, that are still in the map."""
    frames = [frame for robot in walk.robots for frame in robot]
    people = np.concatenate([frame.placed[frame.false] for frame in frames])
    people = people[truth.dense.query(people)[0] > CLEAR]
    return float(_near(cKDTree(found), people).mean()) if len(found) else 0.0


def _show(rows: list[dict[str, Any]]) -> None:
    conditions = list(dict.fromkeys(row["condition"] for row in rows))
    table = Table(title="F-score at 5 cm", show_lines=False)
    table.add_column("")
    for condition in conditions:
        table.add_column(condition, justify="right")
    for method in dict.fromkeys(row["method"] for row in rows):
        cells = {row["condition"]: _cell(row) for row in rows if row["method"] == method}
        table.add_row(method, *(cells.get(condition, "") for condition in conditions))
    Console(width=60 + 14 * len(conditions)).print(table)


def _cell(row: dict[str, Any]) -> str:
    cell = f"{row['f_score']:.3f}"
    if "people_left" in row:
        cell += f", {row['people_left']:.1%} of people, {1 - row['recall']:.1%} of static lost"
    return cell


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="the walk: a TUM RGB-D folder")
    parser.add_argument("--cache", type=Path, default=Path("out/quality"), help="for ORB points")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--conditions", nargs="+", choices=CONDITIONS, default=list(CONDITIONS))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--quick", action="store_true", help="one seed of DAGmap without offsets")
    parser.add_argument("--json", action="store_true", help="one JSON object a row and condition")
    parser.add_argument(
        "--merging", action="store_true", help="merged positions against single observations"
    )
    chosen = parser.parse_args()
    if chosen.quick:
        chosen.seeds, chosen.conditions, chosen.methods = 1, list(QUICK), ["DAGmap default"]
    walk = office.load(chosen.data, chosen.cache)
    if chosen.merging:
        found = merging.measure(walk, lambda changed: listener(changed, Config()), chosen.seeds)
        print(json.dumps(found, indent=2))
        return
    rows = []
    for name in chosen.conditions:
        rows += measure(walk, name, chosen.seeds, chosen.methods)
        print(f"done: {name}", file=sys.stderr)
    if chosen.json:
        print(json.dumps(rows, indent=2))
    else:
        _show(rows)


if __name__ == "__main__":
    main()
