"""`dagmap simulate`: a fleet in one process, with faults and liars, from a seed."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import msgspec
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from ..io.clouds import read_cloud
from ..io.export import atomic_write
from ..io.sources import open_source
from ..metrics import check_cloud
from ..model import Cycle, DagmapError, Floats, State
from ..sim.mission import Mission, Report
from ..sim.scenario import Scenario, load_scenario
from ..sim.sweep import Failure, minimised, sweep, timeline_of
from ..sim.timeline import Timeline
from ..sim.truth import Lies, Quality
from .kernels import warm_up

_COLUMNS = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())


@dataclass(slots=True)
class Simulate:
    """One run of the command. `run` returns its exit code."""

    scenarios: list[Path]
    seed: int
    seeds: int | None
    timeline: Path | None
    jobs: int
    json: bool
    console: Console = field(default_factory=lambda: Console(stderr=True))

    def run(self) -> int:
        """0: all agreed; 1: a promise was broken, or no agreement. Raises DagmapError."""
        if self.timeline is not None and self.seeds is not None:
            raise DagmapError("--timeline is of one run; leave out --seeds and name a --seed")
        if self.timeline == Path("-") and self.json:
            raise DagmapError("--timeline - and --json both want the terminal; name a file")
        if self.timeline is not None and not self.timeline.parent.is_dir():
            raise DagmapError(f"--timeline {self.timeline}: there is no such folder; make it first")
        scenarios = [load_scenario(path) for path in self.scenarios]
        warm_up(self.console)
        if self.seeds is not None:
            return self._sweep(scenarios, self.seeds)
        if len(scenarios) > 1:
            raise DagmapError("several scenarios are for --seeds; name one, or say how many seeds")
        return self._simulate(scenarios[0], self.scenarios[0])

    def _simulate(self, scenario: Scenario, path: Path) -> int:
        recordings = _recordings(scenario.drawn(self.seed), path.parent)
        timeline = Timeline(lambda: mission.fleet.now)
        wanted = self.timeline is not None
        mission = Mission(
            scenario,
            self.seed,
            recordings,
            timeline if wanted else None,
            reference=_reference(scenario, path.parent),
        )
        with Progress(*_COLUMNS, TimeElapsedColumn(), console=self.console) as progress:
            task = progress.add_task("simulating", total=round(scenario.seconds))
            report = mission.run(
                lambda now: progress.update(
                    task,
                    completed=min(round(now), round(scenario.seconds)),
                    description=mission.stage,
                )
            )
        if self.timeline is not None:
            self._write_timeline(self.timeline, timeline.lines)
        if self.json:
            sys.stdout.write(msgspec.json.encode(report).decode() + "\n")
        elif self.timeline != Path("-"):
            _show(report)
        return 0 if report.agreed else 1

    def _sweep(self, scenarios: list[Scenario], seeds: int) -> int:
        if any(scenario.recordings for scenario in scenarios):
            raise DagmapError("--seeds is for synthetic scenes; leave out scenarios of recordings")
        jobs = self.jobs or os.cpu_count() or 1
        with Progress(*_COLUMNS, TimeElapsedColumn(), console=self.console) as progress:
            task = progress.add_task("sweeping", total=seeds * len(scenarios))
            failure = sweep(
                scenarios,
                range(self.seed, self.seed + seeds),
                jobs,
                lambda done: progress.update(task, completed=done),
            )
        if failure is not None:
            with self.console.status(f"seed {failure.seed} breaks a promise; cutting it down"):
                failure = minimised(failure)
        result = {"runs": seeds * len(scenarios), "failure": msgspec.to_builtins(failure)}
        if self.json:
            sys.stdout.write(json.dumps(result) + "\n")
        elif failure is None:
            sys.stdout.write(f"{result['runs']:,} runs, no promise broken\n")
        else:
            sys.stdout.write(_told(failure))
        return 0 if failure is None else 1

    def _write_timeline(self, path: Path, lines: list[str]) -> None:
        text = "".join(f"{line}\n" for line in lines)
        if path == Path("-"):
            sys.stdout.write(text)
            return
        with atomic_write(path) as file:
            file.write(text.encode())


def _recordings(scenario: Scenario, folder: Path) -> dict[str, Iterable[Cycle]]:
    """The recordings that a scenario names, relative to its file, by robot."""
    sources = [open_source(folder / name, max_features=1000) for name in scenario.recordings]
    return dict(zip(scenario.names, sources, strict=False))


def _reference(scenario: Scenario, folder: Path) -> Floats | None:
    """The points of the file that the scenario names, relative to its own."""
    if scenario.reference is None:
        return None
    path = folder / scenario.reference
    return check_cloud(read_cloud(path).positions, str(path))


def _told(failure: Failure) -> str:
    """The first failure, and how to see it again."""
    lines = timeline_of(failure.scenario, failure.seed)
    return "\n".join(
        [
            f"BROKEN with seed {failure.seed}: {failure.detail}",
            f"the shortest timeline found has {failure.timeline} events, the last of them:",
            *(f"  {line}" for line in lines[-12:]),
            f"to see it all, run this scenario with --seed {failure.seed} --timeline -",
            f"to have it checked again, with --seed {failure.seed} --seeds 1",
            "",
            failure.scenario.toml().decode(),
        ]
    )


def _show(report: Report) -> None:
    console, table = Console(), Table(title=f"{report.name}, seed {report.seed}", show_header=False)
    for name, value in _rows(report):
        table.add_row(name, value)
    console.print(table)


def _rows(report: Report) -> list[tuple[str, str]]:
    agreed = "never" if report.agreement_s is None else f"{report.agreement_s:.2f} s"
    folded = "never" if report.map_agreement_s is None else f"{report.map_agreement_s:.2f} s"
    ideal = "" if report.ideal_s is None else f" (a flood without loss: {report.ideal_s:.2f} s)"
    over = report.bytes_carried / max(1, report.bytes_minimum)
    states = ", ".join(f"{report.map[s.name.lower()]:,} {s.name.lower()}" for s in State)
    rows = [
        ("robots", f"{report.robots}, {report.liars} of them liars"),
        ("agreement after the last news", agreed + ideal),
        ("maps alike after the last news", folded),
        ("digest", f"{report.digest[:16]}... on all" if report.agreed else "THE ROBOTS DISAGREE"),
        ("map", f"{report.map['nodes']:,} nodes: {states}"),
        ("transactions", f"{report.transactions:,}"),
        (
            "copies sent",
            f"{report.bytes_carried / 1000:,.0f} kB, {over:.2f} times the least needed",
        ),
        ("messages", f"{report.messages:,}, {report.messages_per_s:,.0f} a second of wall time"),
        ("time", f"{report.simulated_s:,.1f} s simulated in {report.wall_s:.1f} s"),
    ]
    if report.quality is not None:
        rows.append(("against the truth", _quality(report.quality)))
    elif find_spec("scipy") is None:
        remedy = "not compared: scipy is missing; pip install 'dagmap[evaluate]'"
        rows.append(("against the truth", escape(remedy)))
    if report.lies is not None:
        rows += _lies(report.lies)
    return rows + [("refused", f"{count:,} x {why}") for why, count in report.rejected.items()]


def _quality(quality: Quality) -> str:
    shares = f"precision {quality.precision:.3f}, recall {quality.recall:.3f}"
    near = f"accuracy {quality.accuracy * 100:.1f} cm"
    far = f"completeness {quality.completeness * 100:.1f} cm"
    return f"{near}, {far}; {shares}, F-score {quality.f_score:.3f}"


def _lies(lies: Lies) -> list[tuple[str, str]]:
    lost = f"{lies.honest_lost:,} of {lies.honest_points:,} features"
    proven = f"{lies.proven_lost:,} of {lies.proven_nodes:,} proven nodes"
    confirmed = f"{lies.liars_confirmed:,} of {lies.liars_only:,} nodes that only liars saw"
    return [("lost to lies", f"{lost}, {proven}"), ("lies confirmed", confirmed)]
