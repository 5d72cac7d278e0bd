"""Figure 10: features, graphs, transactions and map of three robots in the office.

Panel (b) is a snapshot from the middle of the run, as the paper's is. Drawn as recorded, and with a
fifth of the points displaced along their rays and V_th = 3, where it can be counted what is dropped
before it is sent (validation) and what is voted out (confirmation). `--out DIR`; half a minute.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

import common
from common import Row
from dagmap import Config, Cycle, GraphConfig, State, WorldMap
from dagmap.cli.replay import graph_layer
from dagmap.io.figures import GraphLayer, MapsFigure, draw_maps
from dagmap.io.sources import open_source
from dagmap.sim.fleet import Fleet
from dagmap.sim.robot import Robot

NAME = "figure_10"
PAPER = (
    "most of the noisy features were dropped at the validation process; features with hit ratios "
    "greater than 0.5 in the observed colour, those with less in red"
)
FACTOR = (0.3, 1.6)  # along the ray, of a displaced point
CASES = ((1, 0.0), (1, 0.2), (3, 0.2))  # V_th, share of points that are displaced
Columns = npt.NDArray[Any]


class Recorded(NamedTuple):
    """What one robot's SLAM puts out. false: (N,) which points are displaced, in order of ids."""

    cycles: list[Cycle]
    false: Columns


class Played(NamedTuple):
    """A run. halfway: the robots' graphs in the middle of it; world: the map at the end."""

    robots: list[Robot]
    halfway: list[GraphLayer]
    world: WorldMap
    agree: bool


def recorded(path: Path, share: float, most: int | None) -> Recorded:
    """A recording with a share of its points displaced, each point with an id of its own."""
    rng, cycles, false = np.random.default_rng(0), [], [np.zeros(0, np.bool_)]
    start = 0
    for cycle in islice(open_source(path), most):
        points = np.asarray(cycle.points, np.float64)
        wrong = rng.random(len(points)) < share
        factor = np.where(wrong, rng.uniform(*FACTOR, len(points)), 1.0)
        ids = np.arange(start, start + len(points), dtype=np.uint64)
        cycles.append(replace(cycle, points=points * factor[:, None], ids=ids))
        start += len(points)
        false.append(wrong)
    return Recorded(cycles, np.concatenate(false))


def play(v_th: int, recordings: dict[str, Recorded]) -> Played:
    fleet = Fleet(msgspec.structs.replace(Config(), graph=GraphConfig(v_th=v_th)))
    half = sum(len(recording.cycles) for recording in recordings.values()) // 2
    halfway: list[GraphLayer] = []
    for step in fleet.run({name: recording.cycles for name, recording in recordings.items()}):
        half -= step.robot is not None
        if half == 0 and not halfway:
            halfway = [graph_layer(r, np.eye(4), r.agent.map) for r in fleet.robots.values()]
    robots = list(fleet.robots.values())
    agree = len({robot.agent.digest() for robot in robots}) == 1
    return Played(robots, halfway, robots[0].agent.map, agree)


def fate(played: Played, recordings: dict[str, Recorded], false: bool) -> Row:
    """What became of the points that are displaced, or of those that are not, as shares."""
    seen = sent = kept = 0
    for robot in played.robots:
        ids = np.flatnonzero(recordings[robot.name].false == false)
        observing, nodes = robot.agent.observing, played.world.nodes_of(robot.name)
        numbers = observing.issuance.number
        rows = np.array([observing.node_of(int(i)) for i in ids], np.int64)
        known = rows[rows >= 0]
        out = numbers[known][numbers[known] >= 0]
        states = played.world.states[nodes[out]]
        seen, sent = seen + len(known), sent + len(out)
        kept += int((states != State.REJECTED).sum())
    return {
        "in_the_graphs": seen,
        "not_sent": 1 - sent / max(seen, 1),
        "sent_then_rejected": (sent - kept) / max(seen, 1),
        "in_the_map": kept / max(seen, 1),
    }


def figure(played: Played, recordings: dict[str, Recorded]) -> MapsFigure:
    features = [np.concatenate(list(placed(r.cycles))) for r in recordings.values()]
    poses = [np.array([cycle.pose for cycle in r.cycles]) for r in recordings.values()]
    return MapsFigure(list(recordings), features, poses, played.halfway, played.world)


def placed(cycles: Sequence[Cycle]) -> Iterator[Columns]:
    """(N, 3) m of each cycle in the frame that the recordings share."""
    for cycle in cycles:
        pose = np.asarray(cycle.pose, np.float64)
        yield np.asarray(cycle.points) @ pose[:3, :3].T + pose[:3, 3]


def case(out: Path, v_th: int, share: float, most: int | None) -> Row:
    recordings = {path.name: recorded(path, share, most) for path in common.OFFICE}
    played = play(v_th, recordings)
    drawn = None
    if (v_th == 1 and not share) or v_th > 1:
        drawn = f"{NAME}.png" if not share else f"{NAME}_noisy.png"
        draw_maps(out / drawn, figure(played, recordings))
    layers = played.halfway
    row: Row = {"v_th": v_th, "displaced": share, "picture": drawn, "agree": played.agree}
    row["halfway"] = {
        "nodes": sum(len(layer.ids) for layer in layers),
        "broadcast": [int(layer.issued.sum()) for layer in layers],
        "merged": [int((layer.issued & layer.merged).sum()) for layer in layers],
        "not_broadcast": [int((~layer.issued).sum()) for layer in layers],
    }
    states = np.asarray(played.world.states)
    row["map"] = {state.name.lower(): int((states == state).sum()) for state in State}
    row["true_points"] = fate(played, recordings, False)
    if share:
        row["displaced_points"] = fate(played, recordings, True)
    return row


def run(out: Path, most: int | None = None) -> Row:
    """most: cycles of each recording; None: all."""
    cases = [case(out, v_th, share, most) for v_th, share in CASES]
    measured = [sentence(row) for row in cases]
    return common.written(out, NAME, PAPER, measured, cases=cases)


def sentence(row: Row) -> str:
    wrong, right = row.get("displaced_points"), row["true_points"]
    begin = f"V_th = {row['v_th']}, {row['displaced']:.0%} displaced: "
    if wrong is None:
        return f"{begin}{right['in_the_map']:.1%} of the points sent or kept back are in the map"
    return (
        f"{begin}of the displaced points validation keeps back {wrong['not_sent']:.1%}, consensus "
        f"rejects {wrong['sent_then_rejected']:.1%}; of the others {right['not_sent']:.1%} and "
        f"{right['sent_then_rejected']:.1%}"
    )


if __name__ == "__main__":
    common.main(run)
