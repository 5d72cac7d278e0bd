"""`dagmap replay`: recordings through one agent each, over an in-process network, to files."""

from __future__ import annotations

import json
import platform
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from .. import __version__
from ..config import Config, load_config
from ..io.export import atomic_write, prepare_out, write_graph_npz, write_ply
from ..io.figures import (
    GraphLayer,
    MapsFigure,
    RobotTraffic,
    TrafficFigure,
    draw_maps,
    draw_traffic,
)
from ..io.report import write_report
from ..io.sources import Options, Source, open_source
from ..io.status import unplaced
from ..io.store import Store
from ..model import Accepted, Cycle, DagmapError, Floats, State
from ..sim.fleet import Fleet
from ..sim.network import Link, Network
from ..sim.robot import Happening, Robot
from ..worldmap import WorldMap
from .inspect import tell_notes, tell_skips
from .kernels import warm_up

_LIBRARIES = ("numpy", "numba", "msgspec", "cryptography", "opencv-python-headless", "matplotlib")


@dataclass(slots=True)
class _Track:
    """What a robot's SLAM put out, for the figures."""

    points: list[Floats] = field(default_factory=list)  # (N, 3) m in the SLAM frame
    poses: list[Floats] = field(default_factory=list)


@dataclass(slots=True)
class Replay:
    """One run of the command. `run` returns its exit code."""

    recordings: list[Path]
    out: Path
    config_file: Path | None
    loss: float
    late: list[str]
    seed: int
    options: Options
    unknown_frames: bool
    force: bool
    json: bool
    console: Console = field(default_factory=lambda: Console(stderr=True))
    _tracks: dict[str, _Track] = field(default_factory=dict)
    _stores: dict[str, Store] = field(default_factory=dict)

    def run(self) -> int:
        """0: the robots agree; 1: they do not; 130: interrupted. Raises DagmapError."""
        if not 0 <= self.loss < 1:
            raise DagmapError(f"--loss {self.loss}: a share from 0 up to, not including, 1")
        config = Config() if self.config_file is None else load_config(self.config_file)
        config = msgspec.structs.replace(config, fleet_key="")  # keys follow from the names here
        if self.unknown_frames:
            config = msgspec.structs.replace(config, start_pose=None)
        sources = self._open_sources()
        prepare_out(self.out, self.force)
        started = time.perf_counter()
        warm_up(self.console)
        fleet = Fleet(config, Network(Link(loss=self.loss), self.seed), self._store)
        try:
            self._play(fleet, sources)
            summary = self._write(fleet, config, started)
        except KeyboardInterrupt:
            self.console.print(
                f"interrupted; {self.out / 'ledgers'} holds every transaction until then"
            )
            return 130
        finally:
            for store in self._stores.values():
                store.close()
        self._show(summary)
        return 0 if summary["converged"] else 1

    def _open_sources(self) -> dict[str, Source]:
        sources: dict[str, Source] = {}
        for path in self.recordings:
            source = open_source(path, self.options)
            if source.name in sources:
                raise DagmapError(
                    f"{path}: another recording is called {source.name} too; rename one of them"
                )
            sources[source.name] = source
            tell_notes(source, self.console)
        return sources

    def _play(self, fleet: Fleet, sources: dict[str, Source]) -> None:
        """Everybody on time first, then those who come late."""
        on_time = {name: s for name, s in sources.items() if name not in self.late}
        total = sum(len(source) for source in sources.values())
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
        with Progress(*columns, TimeElapsedColumn(), console=self.console) as progress:
            task = progress.add_task("replaying", total=total)
            rounds: list[dict[str, Source]] = [on_time] if on_time or not self.late else []
            rounds += [{n: sources[n]} if n in sources else {} for n in self.late]
            for i, group in enumerate(rounds):
                if not group:
                    fleet.join(self.late[i - len(rounds) + len(self.late)])
                tapped = {name: self._tap(name, source) for name, source in group.items()}
                for step in fleet.run(tapped):
                    progress.update(task, advance=step.robot is not None)
                progress.update(task, description="agreeing")
        for source in sources.values():
            tell_skips(source, self.console)

    def _tap(self, name: str, source: Source) -> Iterator[Cycle]:
        track = self._tracks[name] = _Track()
        for cycle in source:
            pose = np.asarray(cycle.pose, np.float64)
            points = np.asarray(cycle.points, np.float64).reshape(-1, 3)
            track.poses.append(pose)
            track.points.append(points @ pose[:3, :3].T + pose[:3, 3])
            yield cycle

    def _store(self, robot: Robot, event: Happening) -> None:
        """A transaction is on disk before anyone is told of it."""
        if not isinstance(event, Accepted):
            return
        store = self._stores.get(robot.name)
        if store is None:
            path, agent = self.out / "ledgers" / f"{robot.name}.db", robot.agent
            store = Store.open(path, agent.config.fleet_id, agent.identity.author)
            self._stores[robot.name] = store
        store.append(event.id, event.data)

    def _write(self, fleet: Fleet, config: Config, started: float) -> dict[str, Any]:
        self.console.print(f"writing {self.out}")
        robots = list(fleet.robots.values())
        digests = [robot.agent.digest() for robot in robots]
        world = robots[0].agent.map
        write_ply(self.out / "map.ply", world)
        for robot in robots:
            _write_graph(self.out / "graph" / f"{robot.name}.npz", robot)
        draw_maps(self.out / "maps.png", self._maps_figure(robots, world))
        draw_traffic(self.out / "traffic.png", traffic_figure(robots))
        summary = {
            "converged": len(set(digests)) == 1,
            "digest": digests[0].hex(),
            "robots": [_row(robot, digest) for robot, digest in zip(robots, digests, strict=True)],
            "map": {"nodes": len(world), **{s.name.lower(): world.count(s) for s in State}},
            "bytes_per_feature": sum(r.bytes_sent for r in robots)
            / max(1, sum(r.issued for r in robots)),
            "wall_s": time.perf_counter() - started,
            "simulated_s": fleet.now,
            "loss": self.loss,
            "seed": self.seed,
            "late": self.late,
            "parameters": msgspec.to_builtins(config),
            "versions": _versions(),
        }
        with atomic_write(self.out / "summary.json") as file:
            file.write(json.dumps(summary, indent=2).encode() + b"\n")
        self._report(summary, config)
        return summary

    def _report(self, summary: dict[str, Any], config: Config) -> None:
        parameters = json.dumps(msgspec.to_builtins(config), indent=2)
        figures = [self.out / "maps.png", self.out / "traffic.png"]
        write_report(self.out / "report.html", summary, figures, parameters, summary["versions"])

    def _maps_figure(self, robots: list[Robot], world: WorldMap) -> MapsFigure:
        placed = [robot for robot in robots if robot.name in self._tracks]
        names, features, poses, layers = [], [], [], []
        for robot in placed:
            track, frame = self._tracks[robot.name], robot.agent.frame()
            drift = (
                robot.agent.observing.drift.now
            )  # in the newest pose only: the DAG has it already
            frame = np.eye(4) if frame is None else frame @ np.linalg.inv(drift)
            names.append(robot.name)
            points = np.concatenate([np.zeros((0, 3)), *track.points])
            features.append(points @ frame[:3, :3].T + frame[:3, 3])
            poses.append(np.array([frame @ pose for pose in track.poses]).reshape(-1, 4, 4))
            layers.append(graph_layer(robot, frame, world))
        return MapsFigure(names, features, poses, layers, world)

    def _show(self, summary: dict[str, Any]) -> None:
        if self.json:
            sys.stdout.write(json.dumps(summary) + "\n")
            return
        console = Console()
        table = Table(title="What every robot did")
        for heading in (
            "robot",
            "cycles",
            "features seen",
            "sent",
            "kB sent",
            "kB received",
            "map",
        ):
            table.add_column(heading, justify="left" if heading in ("robot", "map") else "right")
        for row in summary["robots"]:
            table.add_row(
                row["name"],
                f"{row['cycles']}",
                f"{row['features_observed']:,}",
                f"{row['features_issued']:,}",
                f"{row['bytes_sent'] / 1000:,.0f}",
                f"{row['bytes_received'] / 1000:,.0f}",
                row["digest"][:16],
            )
        console.print(table)
        for row in summary["robots"]:
            for other in row["unplaced"]:
                whose = f"{row['name']} does not know where {other['name']} is"
                console.print(f"{whose}: {other['why']}", soft_wrap=True)

        nodes = summary["map"]
        console.print(
            f"map: {nodes['nodes']:,} nodes, {nodes['confirmed']:,} confirmed by several robots, "
            f"{nodes['tentative']:,} tentative, {nodes['rejected']:,} rejected; "
            f"{summary['bytes_per_feature']:.2f} bytes on the network per feature"
        )
        agree = "all robots hold the same map" if summary["converged"] else "THE ROBOTS DISAGREE"
        console.print(f"{agree}: digest {summary['digest'][:16]}...; results in {self.out}")


def _row(robot: Robot, digest: bytes) -> dict[str, Any]:
    return {
        "name": robot.name,
        "digest": digest.hex(),
        "cycles": robot.cycles,
        "features_observed": robot.observed,
        "features_issued": robot.issued,
        "transactions": robot.transactions,
        "bytes_sent": robot.bytes_sent,
        "bytes_received": robot.bytes_received,
        "placed": robot.agent.frame() is not None,
        "unplaced": unplaced(robot.agent),
    }


def _write_graph(path: Path, robot: Robot) -> None:
    graph = robot.agent.observing.graph
    ids = np.flatnonzero(graph.alive())
    write_graph_npz(
        path,
        ids,
        graph.positions(ids) / 1000.0,
        graph.parents(ids),
        graph.validity(ids),
        graph.issued(ids),
    )


def graph_layer(robot: Robot, frame: Floats, world: WorldMap) -> GraphLayer:
    """The robot's DAG in the fleet frame; merged are features that another robot saw too."""
    graph = robot.agent.observing.graph
    ids = np.flatnonzero(graph.alive())
    positions = graph.positions(ids) / 1000.0 @ frame[:3, :3].T + frame[:3, 3]
    numbers = robot.agent.observing.issuance.number[ids]
    nodes = world.nodes_of(robot.name)
    inside = (numbers >= 0) & (numbers < len(nodes))
    merged = np.zeros(len(ids), np.bool_)
    mine = nodes[numbers[inside]]
    merged[inside] = (mine >= 0) & (world.witnesses[mine] > 1)
    return GraphLayer(ids, positions, graph.parents(ids), graph.issued(ids), merged)


def traffic_figure(robots: list[Robot]) -> TrafficFigure:
    """What robots saw and sent, for `draw_traffic`."""

    def columns(pairs: list[tuple[float, int]]) -> tuple[Any, Any]:
        return (
            np.array([at for at, _ in pairs], np.float64),
            np.array([count for _, count in pairs], np.int64),
        )

    return TrafficFigure(
        [
            RobotTraffic(robot.name, *columns(robot.issued_at), *columns(robot.observed_at))
            for robot in robots
        ]
    )


def _versions() -> dict[str, str]:
    found = {"dagmap": __version__, "python": platform.python_version()}
    for library in _LIBRARIES:
        try:
            found[library] = version(library)
        except PackageNotFoundError:
            continue
    return found
