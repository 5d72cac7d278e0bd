"""`dagmap evaluate`: how good a map is, as a table, as JSON, and as a picture."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from ..io.clouds import Cloud, read_cloud
from ..io.error_picture import draw_error
from ..metrics import PITCH, Distances, Score, check_cloud, nearest, score, thin
from ..model import DagmapError, Floats, State


@dataclass(frozen=True, slots=True)
class Evaluate:
    """One run of the command. Raises DagmapError."""

    map_file: Path
    reference: Path
    recall_reference: Path | None
    states: str
    picture: Path | None
    json: bool

    def run(self) -> None:
        chosen = states_named(self.states)
        cloud = read_cloud(self.map_file)
        which = "" if cloud.states is None else f" ({self.states} nodes)"
        points = check_cloud(_chosen(cloud, chosen), f"{self.map_file}{which}")
        reference = _read(self.reference)
        recall = None if self.recall_reference is None else _read(self.recall_reference)
        found = score(points, reference, recall)
        if self.picture is not None:
            draw_error(self.picture, thin(points), nearest(thin(points), thin(reference)))
        if self.json:
            sys.stdout.write(json.dumps(_as_json(found), indent=2) + "\n")
        else:
            _show(found)


def _read(path: Path) -> Floats:
    return check_cloud(read_cloud(path).positions, str(path))


def states_named(names: str, option: str = "--states") -> list[State]:
    """What `--states a,b` means. Raises DagmapError."""
    known = {state.name.lower(): state for state in State}
    chosen = [name.strip() for name in names.split(",")]
    wrong = [name for name in chosen if name not in known]
    if wrong:
        raise DagmapError(f"{option}: there is no {wrong[0]!r}; there are {', '.join(known)}")
    return [known[name] for name in chosen]


def _chosen(cloud: Cloud, states: list[State]) -> Floats:
    if cloud.states is None:
        return cloud.positions
    return cloud.positions[np.isin(cloud.states, states)]


def _as_json(found: Score) -> dict[str, object]:
    return {"thinned_to": PITCH, **asdict(found)}


def _show(found: Score) -> None:
    console = Console()
    shares = Table(title=f"Within a distance; all clouds thinned to {100 * PITCH:g} cm")
    for heading in ("Distance", "Precision", "Recall", "F-score"):
        shares.add_column(heading, justify="right")
    for row in found.at:
        numbers = (f"{value:.4f}" for value in (row.precision, row.recall, row.f_score))
        shares.add_row(f"{100 * row.threshold:g} cm", *numbers)
    console.print(shares)
    table = Table(show_header=False)
    table.add_row("points, reference, recall reference", _counts(found))
    table.add_row("accuracy: map to reference", _distances(found.accuracy))
    table.add_row("completeness: recall reference to map", _distances(found.completeness))
    table.add_row("Chamfer L1: half the sum of the means", f"{1000 * found.chamfer_l1:.2f} mm")
    table.add_row("Chamfer L2: sum of the mean squares", f"{1e6 * found.chamfer_l2:.1f} mm²")
    table.add_row("mean map entropy, 30 cm (lower is crisper)", _maybe(found.mean_map_entropy))
    table.add_row("double walls, share of flat patches", _maybe(found.double_walls))
    console.print(table)


def _counts(found: Score) -> str:
    return f"{found.points:,}  {found.reference_points:,}  {found.recall_points:,}"


def _distances(found: Distances) -> str:
    values = (("mean", found.mean), ("RMSE", found.rmse), ("P95", found.p95))
    return "  ".join(f"{name} {1000 * value:.2f} mm" for name, value in values)


def _maybe(value: float | None) -> str:
    return "too sparse to say" if value is None else f"{value:.4f}"
