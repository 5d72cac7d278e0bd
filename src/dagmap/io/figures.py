"""The paper's Figures 10 and 11 drawn from what a replay has measured, as PNG files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..model import Bools, Floats, Int64s, State
from .export import MapLike
from .panels import (
    FAINT,
    draw_lines,
    draw_points,
    frame,
    joined,
    limits_of,
    open_figure,
    page_size,
    plain,
    put_legend,
    put_title,
    rgb,
    robot_colors,
    save,
    scale_bar,
    visible,
)
from .projection import View, choose_view

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MERGED, _UNSENT, _REJECTED = "#8a2fb8", "#b4b4b4", "#e0261b"
_SHOWN = 8  # robots that have a panel of their own in the traffic figure
_BLUE = "#2166d1"  # traffic with DAGmap
_COUNTED, _DRAWN = 1_000_000, 1200  # bins of the traffic figure, and steps to draw them in


@dataclass(frozen=True, slots=True, eq=False)
class GraphLayer:
    """The adjacency DAG of one robot, its positions in the fleet frame.

    ids: (N,) rising; positions: (N, 3) metres; parents: (N, n_p) ids, -1 for lattice or none;
    issued: (N,) True where the feature was broadcast; merged: (N,) True where its node of the
    map was seen by another robot too.
    """

    ids: Int64s
    positions: Floats
    parents: Int64s
    issued: Bools
    merged: Bools


@dataclass(frozen=True, slots=True, eq=False)
class MapsFigure:
    """What `draw_maps` shows. One entry a robot, in one order; everything in the fleet frame.

    features: (N, 3) metres, all that the robot's SLAM put out; poses: (C, 4, 4) of its sensor.
    world: every node of the map that the robots agree on, rejected ones too.
    """

    names: Sequence[str]
    features: Sequence[Floats]
    poses: Sequence[Floats]
    graphs: Sequence[GraphLayer]
    world: MapLike


@dataclass(frozen=True, slots=True, eq=False)
class RobotTraffic:
    """How many features one robot put on the network, and when.

    sent_at, sent: (K,) seconds and features of its transactions.
    observed_at, observed: (C,) seconds and features of its SLAM cycles: what a robot without DAGmap
        would broadcast.
    """

    name: str
    sent_at: Floats
    sent: Int64s
    observed_at: Floats
    observed: Int64s


@dataclass(frozen=True, slots=True, eq=False)
class TrafficFigure:
    """What `draw_traffic` shows. All times are on one clock."""

    robots: Sequence[RobotTraffic]


def draw_maps(path: Path, data: MapsFigure) -> None:
    """Draw Figure 10: features, graph, transactions and map in one view. Raises OutputError."""
    features = joined(data.features)
    everything = np.concatenate([features, np.asarray(data.world.positions, np.float64)])
    poses = np.concatenate([np.zeros((0, 4, 4)), *data.poses])
    view = choose_view(features if len(features) else everything, poses)
    limits = limits_of(view.project(everything), view.project(poses[:, :3, 3]))
    with open_figure(page_size(limits, 2, 2), 2, 2) as (figure, axes):
        _draw_features(axes[0], data, view)
        _draw_graphs(axes[1], data, view)
        _draw_transactions(axes[2], data, view)
        _draw_map(axes[3], data, view)
        for axis in axes:
            frame(axis, limits)
        scale_bar(axes[0], limits)
        save(path, figure)


def draw_traffic(path: Path, data: TrafficFigure) -> None:
    """Draw Figure 11: features a second with and without DAGmap, log scale. Raises OutputError."""
    shown = list(data.robots[:_SHOWN])  # more would not be legible; the total has them all
    bins = _Bins.over([t for r in data.robots for t in (r.sent_at, r.observed_at)])
    rows = [(robot.name, [robot]) for robot in shown]
    rows.append((f"all {len(data.robots)} robots", list(data.robots)))
    with open_figure((7.2, 1.0 + 1.35 * len(rows)), len(rows), 1) as (figure, axes):
        for axis, (name, robots) in zip(axes, rows, strict=True):
            without = sum((bins.count(r.observed_at, r.observed) for r in robots), bins.zeros)
            with_it = sum((bins.count(r.sent_at, r.sent) for r in robots), bins.zeros)
            _draw_rates(axis, name, bins, without, with_it)
        _finish_rates(axes, bins)
        save(path, figure)


def _draw_features(axis: Axes, data: MapsFigure, view: View) -> None:
    points = joined(data.features)
    owner = np.repeat(np.arange(len(data.features)), [len(p) for p in data.features])
    draw_points(axis, view, points, rgb(robot_colors(len(data.names)))[owner])
    for poses, color in zip(data.poses, robot_colors(len(data.names)), strict=True):
        track = view.project(poses[:, :3, 3])
        axis.plot(*track.T, color="white", linewidth=2.0, solid_capstyle="round")
        axis.plot(*track.T, color=color, linewidth=1.0, solid_capstyle="round")
    detail = f"{len(points):,} features; lines: paths of the sensors"
    put_title(axis, "a", "What the SLAMs put out", detail)
    put_legend(axis, list(zip(data.names, robot_colors(len(data.names)), strict=True)))


def _draw_graphs(axis: Axes, data: MapsFigure, view: View) -> None:
    edges, kinds, positions = _edges(data.graphs)
    palette = [*robot_colors(len(data.names)), _MERGED, _UNSENT]
    rank = np.where(kinds == len(palette) - 1, 0, np.where(kinds == len(palette) - 2, 2, 1))
    order = np.argsort(rank[edges[:, 0]], kind="stable")  # unsent below, merged on top
    draw_lines(axis, view.project(positions)[edges[order]], rgb(palette)[kinds[edges[order, 0]]])
    for level in range(3):
        at = rank == level
        draw_points(axis, view, positions[at], rgb(palette)[kinds[at]], scale=0.8)
    issued = sum(int(graph.issued.sum()) for graph in data.graphs)
    put_title(axis, "b", "Adjacency graphs", f"{issued:,} of {len(positions):,} features broadcast")
    named = [(f"{name} broadcast", c) for name, c in zip(data.names, palette, strict=False)]
    put_legend(axis, [*named, ("merged", _MERGED), ("not broadcast", _UNSENT)])


def _draw_transactions(axis: Axes, data: MapsFigure, view: View) -> None:
    positions = np.asarray(data.world.positions, np.float64)
    draw_points(axis, view, positions, visible(data.world.colors))
    detail = f"{len(positions):,} nodes, whatever their votes"
    put_title(axis, "c", "All transactions merged", detail)


def _draw_map(axis: Axes, data: MapsFigure, view: View) -> None:
    positions, states = np.asarray(data.world.positions, np.float64), np.asarray(data.world.states)
    rejected = states == State.REJECTED
    red = np.broadcast_to(rgb([_REJECTED]), (int(rejected.sum()), 3))
    draw_points(axis, view, positions[rejected], red, scale=0.8)
    draw_points(axis, view, positions[~rejected], visible(data.world.colors)[~rejected])
    confirmed = int((states == State.CONFIRMED).sum())
    kept = int((~rejected).sum())
    put_title(axis, "d", "The map", f"{kept:,} nodes kept ({confirmed:,} confirmed)")
    put_legend(axis, [("kept, in the colour seen", "#4d4d4d"), ("rejected", _REJECTED)])


def _edges(graphs: Sequence[GraphLayer]) -> tuple[Int64s, Int64s, Floats]:
    """Edges (E, 2) child and parent row; what each row is: robot, merged or unsent; positions."""
    edges: list[Int64s] = [np.zeros((0, 2), np.int64)]
    kinds: list[Int64s] = [np.zeros(0, np.int64)]
    base = 0
    for robot, graph in enumerate(graphs):
        if len(graph.ids):
            at = np.minimum(np.searchsorted(graph.ids, graph.parents), len(graph.ids) - 1)
            child, slot = np.nonzero((graph.parents >= 0) & (graph.ids[at] == graph.parents))
            edges.append(base + np.stack([child, at[child, slot]], axis=1))
        kind = np.where(graph.issued, robot, len(graphs) + 1)
        kinds.append(np.where(graph.issued & graph.merged, len(graphs), kind))
        base += len(graph.ids)
    positions = joined([graph.positions for graph in graphs])
    return np.concatenate(edges), np.concatenate(kinds), positions


@dataclass(frozen=True, slots=True)
class _Bins:
    """Seconds to count features in; where they are too many to show, the largest of several."""

    start: float
    width: float  # s, of a bin: 1, or more in what lasts for weeks
    number: int
    step: int  # bins that are drawn as one

    @classmethod
    def over(cls, times: Sequence[Floats]) -> _Bins:
        at = np.concatenate([np.zeros(0), *times])
        start, end = (at.min(), at.max()) if len(at) else (0.0, 0.0)
        width = max(1.0, float(np.ceil((end - start) / _COUNTED)))
        number = int((end - start) // width) + 1
        return cls(float(start), width, number, -(-number // _DRAWN))

    @property
    def zeros(self) -> Floats:
        return np.zeros(self.number)

    @property
    def edges(self) -> Floats:
        steps = np.append(np.arange(0, self.number, self.step), self.number)
        return np.asarray(steps * self.width, np.float64)

    def largest(self, counts: Floats) -> Floats:
        """Features a second in the largest bin of each step, so that no burst is averaged away."""
        steps = np.arange(0, self.number, self.step)
        return np.asarray(np.maximum.reduceat(counts, steps) / self.width, np.float64)

    def count(self, at: Floats, counts: Int64s) -> Floats:
        """Features in each bin."""
        place = np.floor((np.asarray(at, np.float64) - self.start) / self.width).astype(np.int64)
        weights = np.asarray(counts, np.float64)
        return np.asarray(np.bincount(place, weights, self.number), np.float64)


def _draw_rates(axis: Axes, name: str, bins: _Bins, without: Floats, with_it: Floats) -> None:
    grey, blue = bins.largest(without), bins.largest(with_it)
    axis.stairs(grey, bins.edges, baseline=1e-3, fill=True, color="#d6d6d6", zorder=1)
    axis.stairs(blue, bins.edges, baseline=1e-3, fill=True, color=_BLUE, alpha=0.22, zorder=2)
    axis.stairs(blue, bins.edges, baseline=None, color=_BLUE, linewidth=1.0, zorder=3)
    axis.set_yscale("log")
    axis.set_title(plain(name), loc="left", fontsize=8.5, fontweight="bold", pad=4)
    detail = (
        f"without: {without.sum():,.0f} features, peak {grey.max():,.0f}/s      "
        f"with DAGmap: {with_it.sum():,.0f}, peak {blue.max():,.0f}/s"
    )
    axis.set_title(detail, loc="right", fontsize=7.5, color=FAINT, pad=4)
    positive = np.concatenate([grey[grey > 0], blue[blue > 0], [1.0]])
    axis.set_ylim(max(0.5 * min(positive[:-1], default=1.0), 0.01), 1.6 * positive.max())


def _finish_rates(axes: Sequence[Axes], bins: _Bins) -> None:
    low = min(axis.get_ylim()[0] for axis in axes)
    high = max(axis.get_ylim()[1] for axis in axes)
    for axis in axes:
        axis.set_xlim(0, bins.edges[-1])
        axis.set_ylim(low, high)
        axis.grid(axis="y", color="#e6e6e6", linewidth=0.6)
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(labelbottom=axis is axes[-1], which="both", width=0.5)
        axis.set_ylabel("features / s")
    spans = "" if bins.step == 1 else f"; of every {bins.step * bins.width:.0f} s the fullest one"
    axes[-1].set_xlabel(f"time, s{spans}")
    entries = [("without DAGmap: every feature, when the SLAM puts it out", "#bdbdbd")]
    put_legend(axes[-1], [*entries, ("with DAGmap: features in transactions", _BLUE)], below=-0.42)
