"""What the parameter studies share: robots in a simulated building, and how good their map is."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

import common
from common import Row
from dagmap import Config, Cycle, GraphConfig, State
from dagmap.config import FoldConfig, TransactionConfig
from dagmap.metrics import nearest, thin
from dagmap.sim.fleet import Fleet
from dagmap.sim.scene import MotionConfig, Scene, SceneConfig
from dagmap.sim.sensor import SensorConfig
from dagmap.tuning import gather, measure, proposal, propose

WITHIN = (0.05, 0.1, 0.2)  # m
FALSE = 0.3  # m from every surface: a node there is wrong
STILL = MotionConfig(drift=0.0, drift_yaw=0.0, loop_closures=False)  # poses are another question
ROOMS = SceneConfig(rooms=(1, 2))
OUTLIERS = 0.1  # of the points
Recordings = dict[str, list[Cycle]]


class Fleetful:
    """Robots with these sensors, one each, in one building; what they see and what is there."""

    def __init__(self, sensors: dict[str, SensorConfig], seconds: float, seed: int = 1) -> None:
        scenes = [Scene(ROOMS, sensor, STILL, len(sensors), seed) for sensor in sensors.values()]
        self.scene = scenes[0]  # the building follows from the seed alone
        walkers = [scene.robot(i) for i, scene in enumerate(scenes)]
        self.recordings: Recordings = {
            name: list(walker.cycles(seconds))
            for name, walker in zip(sensors, walkers, strict=True)
        }
        self.places = thin(np.concatenate([walker.seen().reference for walker in walkers]))

    def tuned(self) -> Config:
        """What `dagmap tune` proposes for it, without the truth."""
        points, period = gather(self.recordings)
        return proposal(propose(points, measure(points, period)))

    def played(self, config: Config) -> Row:
        """How good the fleet's map is, and what it took."""
        transaction = TransactionConfig(proof_of_work_bits=0)
        fleet = Fleet(msgspec.structs.replace(config, transaction=transaction))
        for _ in fleet.run(self.recordings):
            pass
        robots = list(fleet.robots.values())
        world = robots[0].agent.map
        kept, false = world.kept, self.scene.distance(world.positions) > FALSE
        row: Row = {
            "nodes": len(world),
            **{state.name.lower(): world.count(state) for state in State},
            "true_rejected": float((~kept)[~false].mean()) if (~false).any() else None,
            "false_rejected": float((~kept)[false].mean()) if false.any() else None,
            "issued": sum(r.issued for r in robots) / max(1, sum(r.observed for r in robots)),
            "bytes_per_feature": sum(r.bytes_sent for r in robots)
            / max(1, sum(r.issued for r in robots)),
            "agree": len({robot.agent.digest() for robot in robots}) == 1,
        }
        return row | self.scores(world.positions[kept])

    def scores(self, nodes: Any) -> Row:
        """F-scores at `WITHIN`; 0 for an empty map."""
        if not len(nodes):
            return {f"f_{100 * limit:.0f}_cm": 0.0 for limit in WITHIN}
        cloud = thin(nodes)
        there, back = self.scene.distance(cloud), nearest(self.places, cloud)
        out = {}
        for limit in WITHIN:
            precision, recall = float((there <= limit).mean()), float((back <= limit).mean())
            both = max(precision + recall, 1e-9)
            out[f"f_{100 * limit:.0f}_cm"] = 2 * precision * recall / both
        return out


def parameters(config: Config) -> Row:
    """What matters here."""
    fold, graph = config.fold, config.graph
    return {
        "delta": fold.delta,
        "cell": fold.cell,
        "max_ray": fold.max_ray,
        "doubt": "learned" if fold.doubt is None else fold.doubt,
        "reference_pitch": graph.reference_pitch,
        "v_th": graph.v_th,
    }


def with_delta(config: Config, delta: float, doubt: int | None = None) -> Config:
    """With another delta, cells that go with it, and a doubt that is fixed."""
    cell = max(round(10 / 3 * delta, 2), 0.05)
    fold = FoldConfig(delta=delta, cell=cell, max_ray=config.fold.max_ray, doubt=doubt)
    return msgspec.structs.replace(config, fold=fold)


def with_v_th(config: Config, v_th: int) -> Config:
    held = config.graph
    graph = GraphConfig(
        v_th=v_th,
        reference_pitch=held.reference_pitch,
        max_parent_distance=held.max_parent_distance,
    )
    return msgspec.structs.replace(config, graph=graph)


__all__ = ["OUTLIERS", "Fleetful", "common", "parameters", "with_delta", "with_v_th"]
