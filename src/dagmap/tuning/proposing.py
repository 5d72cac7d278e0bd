"""From resolution and noise to parameters, each with its reason.

What agrees with the plane of its neighbours in other cycles is taken for real, what lies far off it
for wrong: so thresholds can be tried without truth, on the graph itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np

from ..config import Config, GraphConfig
from ..graph import AdjacencyDag
from ..kernels.codec import morton_order
from ..model import LIMIT_MM, Bools, Floats, Int32s, Int64s
from .measuring import Measured, Points, patches

_TWINS = 1.96 * math.sqrt(2)  # standard deviations within which 95 % of twins lie
_AGREES, _WRONG = 3.0, 6.0  # standard deviations off the plane: real up to, wrong from
_PITCHES = (0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.2, 0.3, 0.5, 0.8, 1.2)  # m
_REACH = 3  # pitches to a parent at most
_V_TH = (8, 4, 3, 2, 1)
_TRIED = 3  # V_th by which pitches are compared
_KEPT_BACK = 0.02  # of what is real, at most, by V_th
_RAY_CELLS = 100  # of a ray at most: its work grows with them
_FOLDED = 100_000  # points that a threshold is tried on


@dataclass(frozen=True, slots=True)
class Proposed:
    """A value for a field of `Config`, as "fold.delta", and why."""

    field: str
    value: Any
    why: str


@dataclass(frozen=True, slots=True)
class _Judged:
    """Rows of `Points` that other cycles confirm, and that they contradict."""

    real: Int64s
    wrong: Int64s


def propose(points: Points, measured: Measured) -> list[Proposed]:
    """Values for the fields of `Config` that follow from the sensor."""
    judged = _judge(points, measured)
    out = [_delta(measured), *_placing(measured)]
    out += _rays(measured, out[0].value)
    out += _graph(points, judged, measured)
    if measured.period >= Config().issuance.spread_from:
        value = round(measured.period, 2)
        why = "the time between two cycles, so that the first one goes out spread as well"
        out.append(Proposed("issuance.cycle_period", value, why))
    return out


def proposal(proposed: Iterable[Proposed]) -> Config:
    """The configuration with these values. Raises ConfigError where they contradict each other."""
    config = Config()
    for item in proposed:
        group, name = item.field.split(".")
        part = {**msgspec.structs.asdict(getattr(config, group)), name: item.value}
        config = msgspec.structs.replace(config, **{group: type(getattr(config, group))(**part)})
    return config


def _judge(points: Points, measured: Measured) -> _Judged:
    found = patches(points, points.cycle, measured.in_scan_90)
    if found is None:
        return _Judged(np.zeros(0, np.int64), np.zeros(0, np.int64))
    off = np.abs(found.off) / np.maximum(measured.noise.within(points.reach[found.rows]), 1e-6)
    real, wrong = found.rows[off <= _AGREES], found.rows[off >= _WRONG]
    return _Judged(real, wrong)


def _delta(measured: Measured) -> Proposed:
    """95 % of the twins in the nearer half of what is seen: farther ones would blur the map."""
    at = [sigma for reach, sigma in measured.noise.at if reach <= measured.ranges[0]]
    sigma = float(np.median(at)) if at else measured.noise.along
    value = _up(max(_TWINS * sigma, 0.02), 0.005)
    why = (
        f"95 % of the twins nearer than {measured.ranges[0]:.1f} m: their noise is "
        f"{1000 * sigma:.0f} mm an observation"
    )
    return Proposed("fold.delta", value, why)


def _placing(measured: Measured) -> list[Proposed]:
    """How far apart two robots see one point: their frames may not fit exactly."""
    sigma = max(measured.noise.along, measured.between_robots or 0.0)
    value = min(_up(max(4 * sigma, 0.02), 0.01), 10.0)
    return [Proposed("placing.tolerance", value, f"four times the noise, {1000 * sigma:.0f} mm")]


def _rays(measured: Measured, delta: float) -> list[Proposed]:
    """Cells that hold what a surface shows of itself, and rays as long as most."""
    cell = min(_up(max(10 / 3 * delta, 1.5 * measured.between), 0.01), 10.0)
    far = measured.ranges[1]
    ray = min(_up(far, 0.5), round(_RAY_CELLS * cell, 2), 100.0)
    least = (
        "ten thirds of delta" if cell <= 10 / 3 * delta + 0.01 else "as wide as points are apart"
    )
    return [
        Proposed("fold.cell", cell, least),
        Proposed("fold.max_ray", ray, f"90 % of the points are nearer than {far:.1f} m"),
    ]


def _shares(dropped: Bools, real: Bools, wrong: Bools) -> str:
    """How much of what is real, and of what is wrong, is dropped."""
    text = f"{dropped[real].mean():.1%} of what other cycles confirm"
    return f"{text}, {dropped[wrong].mean():.0%} of what they contradict" if wrong.any() else text


def _foldable(points: Points) -> Int64s:
    """Rows in the shared frame and in range, whole cycles, not too many."""
    fits = (points.frame == 0) & (np.abs(points.place) < LIMIT_MM / 1000).all(axis=1)
    rows: Int64s = np.flatnonzero(fits)
    every = max(1, -(-len(rows) // _FOLDED))
    return np.asarray(rows[points.cycle[rows] % every == 0])


def _cycles(points: Points, rows: Int64s) -> Iterator[tuple[int, int]]:
    """Where each cycle's rows begin and end."""
    edges = np.flatnonzero(np.diff(points.cycle[rows])) + 1
    return pairwise([0, *edges.tolist(), len(rows)])


def _mm(metres: Floats) -> Int32s:
    return np.floor(1000 * metres + 0.5).astype(np.int32)


def _graph(points: Points, judged: _Judged, measured: Measured) -> list[Proposed]:
    """The pitch at which V_th tells real from wrong best, and the V_th that holds little back."""
    rows = _foldable(points)
    real, wrong = np.isin(rows, judged.real), np.isin(rows, judged.wrong)
    if not real.any():
        return []
    usual = GraphConfig().reference_pitch
    pitches = [p for p in _PITCHES if measured.between / 2 <= p <= 3 * measured.in_scan_90]
    validity = {pitch: _validity(points, rows, pitch) for pitch in pitches or [usual]}

    def tells(pitch: float) -> float:
        held = validity[pitch] <= _TRIED
        return float((held[wrong].mean() if wrong.any() else 0.0) - held[real].mean())

    pitch = max(validity, key=tells)
    held = validity[pitch]
    v_th = next((v for v in _V_TH if (held[real] <= v).mean() <= _KEPT_BACK), 1)
    best = f"with it V_th = {_TRIED} would keep back {_shares(held <= _TRIED, real, wrong)}"
    least = f"the largest that keeps back little: {_shares(held <= v_th, real, wrong)}"
    return [
        Proposed("graph.reference_pitch", pitch, f"of {len(validity)} pitches the best: {best}"),
        Proposed("graph.max_parent_distance", round(_REACH * pitch, 3), "three pitches"),
        Proposed("graph.v_th", v_th, least),
    ]


def _validity(points: Points, rows: Int64s, pitch: float) -> Int64s:
    """(M,) v of each row in the graph of its robot."""
    out = np.zeros(len(rows), np.int64)
    config = GraphConfig(reference_pitch=pitch, max_parent_distance=_REACH * pitch)
    for robot in np.unique(points.robot[rows]).tolist():
        dag, mine = AdjacencyDag(config), np.flatnonzero(points.robot[rows] == robot)
        order = []
        for start, end in _cycles(points, rows[mine]):
            part = mine[start:end]
            order.append(part[morton_order(_mm(points.place[rows[part]]))])
        inserted = np.concatenate(order)
        dag.insert(_mm(points.place[rows[inserted]]))
        out[inserted] = dag.validity()
    return out


def _up(value: float, step: float) -> float:
    """Rounded up to a multiple of `step`."""
    return round(step * math.ceil(round(value / step, 6)), 4)
