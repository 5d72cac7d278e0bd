"""The figures of docs/reliability.md: `make reliability` (hours), or for a look at them
`python bench/reliability.py --seeds 60 --runs 2 --seconds 30 --out out/figures` (minutes).

All figures go to reliability.json beside the page, with how each part of them was made; the page is
written from that alone. `python bench/reliability.py hundred busy` measures these parts anew and
takes the others from there, `... text` only writes the page again. What is interrupted goes on
where it was, as long as the code is the same.

Not part of `dagmap bench`: it measures the promises, not the machine.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
from rich.console import Console
from rich.progress import Progress

from dagmap.config import Config, FoldConfig, GraphConfig, SyncConfig, TransactionConfig
from dagmap.model import Cycle
from dagmap.sim.fleet import Crash
from dagmap.sim.mission import Mission, Report
from dagmap.sim.network import Link, Partition
from dagmap.sim.scenario import Liars, Scenario, load_scenario
from dagmap.sim.scene import Scene, SceneConfig
from dagmap.sim.sensor import SensorConfig
from dagmap.sim.sweep import sweep
from dagmap.sim.truth import Lies, judge_lies
from dagmap.sim.walk import MotionConfig
from keeping import kept
from reliability_text import PAGE, write

ROOT = Path(__file__).parents[1]
LONG = ("hundred", "hour")  # scenarios that are runs of their own, not part of the sweep
LOSSES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
KINDS = ("forger", "eraser", "splitter", "wrong-frame", "outsider", "early-outsider")
SLICE = 125  # seeds of each scenario between two times that a sweep is kept
FLEET = 8  # robots in the runs with loss and in those with liars
A, B = TypeVar("A"), TypeVar("B")
Tell = Callable[[str, float], None]  # (what is measured, share done)
PARTS = {  # and which options each depends on
    "busy": (),
    "hundred": ("seconds",),
    "hour": ("seconds",),
    "divergence": (),
    "loss": ("runs",),
    "liars": ("runs",),
    "sweep": ("seeds",),
}

SMALL = Scenario(
    robots=FLEET,
    seconds=5.05,
    patience=600.0,
    sensor=SensorConfig(points=16, tracked=0.4),
    config=Config(
        same_origin=True,
        transaction=TransactionConfig(proof_of_work_bits=2),
        graph=GraphConfig(reference_pitch=0.25, max_parent_distance=0.75),
        fold=FoldConfig(delta=0.1),
    ),
)


def changed(scenario: Scenario, **fields: object) -> Scenario:
    return msgspec.structs.replace(scenario, **fields)


# Every robot hears every other; or each stands in its room of a row and hears the next ones only.
TOPOLOGIES = {
    "all hear all": SMALL,
    "a chain": changed(
        SMALL,
        scene=SceneConfig(rooms=(FLEET, 1)),
        motion=MotionConfig(kind="rotate"),
        link=Link(reach=9.0),
    ),
}
# Partitions and crashes of which the plot shows what they do.
TROUBLED = changed(
    SMALL,
    name="trouble",
    seconds=120.0,
    link=Link(loss=0.2),
    partitions=(
        Partition(start=15.0, end=40.0, robots=("r00", "r01", "r02", "r03")),
        Partition(start=60.0, end=75.0, robots=("r05",), direction="in"),
    ),
    crashes=(
        Crash(robot="r02", at=25.0, down=5.0),
        Crash(robot="r06", at=85.0, down=10.0, moment="unsynced"),
        Crash(robot="r07", at=100.0, down=5.0, moment="unsent"),
    ),
)
# One room, seen from all sides, so that points find witnesses.
CROWDED = changed(
    SMALL,
    scene=SceneConfig(rooms=(1, 1)),
    motion=MotionConfig(drift=0.0, drift_yaw=0.0),
    sensor=SensorConfig(points=100, tracked=0.2),
    seconds=20.05,
)
# Transactions of a few points from everybody to everybody.
BUSY = changed(
    SMALL,
    name="many messages",
    robots=40,
    seconds=20.0,
    tick=0.5,
    sensor=SensorConfig(points=8, tracked=0.0),
    config=msgspec.structs.replace(SMALL.config, sync=SyncConfig(announce_period=5.0)),
)


def timed(
    scenario: Scenario, tell: Callable[[float], None], *recordings: dict[str, list[Cycle]]
) -> dict[str, Any]:
    """One run, alone in this process."""
    mission, began = Mission(scenario, 1, *recordings), time.process_time()
    report = mission.run(lambda now: tell(min(1.0, now / scenario.seconds)))
    took = {"mission_s": scenario.seconds, "processor_s": time.process_time() - began}
    return took | msgspec.to_builtins(report)


def busy(tell: Callable[[float], None]) -> dict[str, Any]:
    """Agents and network alone: what the robots see is made beforehand."""
    b = BUSY
    scene = Scene(b.scene, b.sensor, b.motion, b.robots, 1)
    cycles = {name: list(scene.robot(i).cycles(b.seconds)) for i, name in enumerate(b.names)}
    return without_divergence(timed(b, tell, cycles))


def without_divergence(run: dict[str, Any]) -> dict[str, Any]:
    """Only the largest share that one robot ever lacked."""
    shares = [share for _, share in run.pop("divergence")]
    return run | {"apart_most": max(shares, default=0.0)}


def fly(item: tuple[Scenario, int]) -> Report:
    """One run."""
    return Mission(*item).run()


def lie(item: tuple[Scenario, int]) -> Lies:
    """What liars did to one run; without liars, the same comparison."""
    scenario, seed = item
    mission = Mission(scenario, seed)
    if mission.play() is None:
        raise RuntimeError(f"no agreement with {scenario.liars} and seed {seed}")
    s, honest = mission.scenario, mission.honest
    scene = Scene(s.scene, s.sensor, s.motion, s.robots, seed)
    return judge_lies(honest[0], honest, s.lying, scene)


def spread(
    work: Callable[[A], B], items: list[A], jobs: int, told: Callable[[float], None]
) -> list[B]:
    """The results in the order of the items, from several processes."""
    results: list[B] = []
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for result in pool.map(work, items):
            results.append(result)
            told(len(results) / len(items))
    return results


def swept(options: argparse.Namespace, tell: Callable[[float], None]) -> dict[str, Any]:
    """Every scenario but the long ones, with about as many seeds in all as asked for.

    It takes longest, so every slice of it is kept: an interrupted one goes on from there.
    """
    paths = [path for path in sorted((ROOT / "scenarios").glob("*.toml")) if path.stem not in LONG]
    scenarios = [load_scenario(path) for path in paths]
    each, failure = -(-options.seeds // len(paths)), None

    spent = [0.0, 0.0]

    def of(seeds: range) -> str | None:
        before, total = seeds.start * len(paths), each * len(paths)
        found = sweep(scenarios, seeds, options.jobs, lambda done: tell((before + done) / total))
        return (
            None if found is None else f"{found.scenario.name}, seed {found.seed}: {found.detail}"
        )

    for first in range(0, each, SLICE):
        seeds = range(first, min(first + SLICE, each))
        path, asked = options.kept / f"sweep_{first}.json", {"seeds": options.seeds}
        part = kept(path, asked, partial(of, seeds))
        spent = [a + b for a, b in zip(spent, part["made"]["spent"], strict=True)]
        tell(seeds.stop / each)
        failure = part["figures"]
        if failure is not None:
            break
    return {
        "spent": spent,
        "scenarios": [path.stem for path in paths],
        "seeds_each": each,
        "runs": seeds.stop * len(paths),
        "failure": failure,
    }


def long_run(name: str, seconds: float | None, tell: Callable[[float], None]) -> dict[str, Any]:
    """A scenario that is a run of its own, shortened for a quick look."""
    scenario = load_scenario(ROOT / "scenarios" / f"{name}.toml")
    if seconds is not None:
        parts = tuple(msgspec.structs.replace(p, end=seconds) for p in scenario.partitions)
        scenario = changed(scenario, seconds=seconds, partitions=parts)
    return without_divergence(timed(scenario, tell))


def lossy(
    losses: Iterable[float], runs: int, jobs: int, tell: Callable[[float], None]
) -> list[dict[str, Any]]:
    """Time to agreement and bytes, a row for each topology and loss."""
    cells = [(topology, loss) for topology in TOPOLOGIES for loss in losses]
    items = []
    for topology, loss in cells:
        scenario = TOPOLOGIES[topology]
        link = msgspec.structs.replace(scenario.link, loss=loss)
        items += [(changed(scenario, link=link), seed) for seed in range(runs)]
    reports = spread(fly, items, jobs, tell)
    return [
        _lossy_row(topology, loss, reports[i * runs : (i + 1) * runs])
        for i, (topology, loss) in enumerate(cells)
    ]


def _lossy_row(topology: str, loss: float, reports: list[Report]) -> dict[str, Any]:
    """Runs in which some robot was out of everybody's reach are left out, and counted."""
    joined = [r for r in reports if r.ideal_s is not None]
    took = [r.agreement_periods for r in joined if r.agreement_periods is not None]
    over = [r.bytes_carried / r.bytes_minimum for r in joined]
    period = SMALL.config.sync.announce_period
    p50, p99 = np.percentile(took, [50, 99]).tolist() if took else (None, None)
    return {
        "topology": topology,
        "loss": loss,
        "runs": len(joined),
        "apart": len(reports) - len(joined),
        "never": len(joined) - len(took),
        "p50": p50,
        "p99": p99,
        "ideal": float(np.median([r.ideal_s for r in joined])) / period if joined else None,
        "bytes_over_minimum": float(np.median(over)) if over else None,
    }


def lying(runs: int, jobs: int, tell: Callable[[float], None]) -> list[dict[str, Any]]:
    """What liars did, a row for each `witnesses`, kind and number of liars."""
    cells, items = [], []
    for witnesses in (2, 3):
        fold = msgspec.structs.replace(CROWDED.config.fold, witnesses=witnesses)
        config = msgspec.structs.replace(CROWDED.config, fold=fold)
        for kind in KINDS:
            for count in range(5):
                group = (Liars(kind=kind, count=count),) if count else ()
                cells.append({"witnesses": witnesses, "kind": kind, "liars": count})
                scenario = changed(CROWDED, config=config, liars=group)
                items += [(scenario, seed) for seed in range(runs)]
    judged = spread(lie, items, jobs, tell)
    return [
        cell | _summed(judged[i * runs : (i + 1) * runs]) | {"runs": runs}
        for i, cell in enumerate(cells)
    ]


def _summed(judged: list[Lies]) -> dict[str, int]:
    names = [name for name in Lies.__struct_fields__ if name != "liars"]
    return {name: sum(getattr(one, name) for one in judged) for name in names}


def troubled(tell: Callable[[float], None]) -> dict[str, Any]:
    """How far apart the robots are while things go wrong."""
    faults = {"partitions": TROUBLED.partitions, "crashes": TROUBLED.crashes}
    return timed(TROUBLED, tell) | msgspec.to_builtins(faults)


def fuzzed() -> int | None:
    """Executions in all, as docs/fuzzing.md says."""
    path = ROOT / "docs" / "fuzzing.md"
    text = path.read_text() if path.exists() else ""
    found = re.search(r"^In all ([\d,]+) coverage-guided", text, re.MULTILINE)
    return int(found[1].replace(",", "")) if found else None


def measure(options: argparse.Namespace, tell: Tell, before: dict[str, Any]) -> dict[str, Any]:
    """All parts. What is timed runs alone; the rest side by side.

    before: the parts that the page was written from last.
    """

    def about(what: str) -> Callable[[float], None]:
        return lambda share: tell(what, share)

    jobs, runs = options.jobs, options.runs
    work: dict[str, Callable[[], Any]] = {
        "busy": lambda: busy(about("messages a second")),
        "hundred": lambda: long_run("hundred", options.seconds, about("a hundred robots")),
        "hour": lambda: long_run("hour", options.seconds, about("an hour apart")),
        "divergence": lambda: troubled(about("divergence")),
        "loss": lambda: lossy(LOSSES, runs, jobs, about("loss")),
        "liars": lambda: lying(max(1, runs // 10), jobs, about("liars")),
        "sweep": lambda: swept(options, about("sweep")),
    }
    return {
        name: kept(options.kept / f"{name}.json", _asked(options, name), part)
        if name in options.part
        else before[name]
        for name, part in work.items()
    }


def _asked(options: argparse.Namespace, name: str) -> dict[str, Any]:
    return {option: getattr(options, option) for option in PARTS[name]}


def asked_for() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Write docs/reliability.md and its plots.")
    names = f"what to measure: {', '.join(PARTS)}; or text, to write the page only (default: all)"
    parser.add_argument("part", nargs="*", help=names)
    parser.add_argument("--seeds", type=int, default=10_000, help="runs of the sweep, in all")
    parser.add_argument("--runs", type=int, default=50, help="seeds for each loss; a tenth: liars")
    parser.add_argument("--seconds", type=float, help="shorten the long missions, for a look")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--out", type=Path, default=ROOT / "docs", help="folder of the page")
    kept_in = ROOT / "out" / "reliability"
    parser.add_argument("--kept", type=Path, default=kept_in, help="what is done; goes on from it")
    options = parser.parse_args()
    unknown = set(options.part) - {*PARTS, "text"}
    if unknown:
        parser.error(f"{', '.join(sorted(unknown))}: unknown; {names}")
    options.part = options.part or list(PARTS)
    return options


def parts_before(options: argparse.Namespace) -> dict[str, Any]:
    """What the page in that folder was written from. Exits where a part is neither there nor
    asked for."""
    path = options.out / PAGE.with_suffix(".json")
    before = json.loads(path.read_text())["parts"] if path.exists() else {}
    missing = [name for name in PARTS if name not in before and name not in options.part]
    if missing:
        sys.exit(f"{path}: without {', '.join(missing)}; name these parts, too")
    return before


def main() -> None:
    options = asked_for()
    before = parts_before(options)
    with Progress(console=Console(stderr=True)) as progress:
        tasks: dict[str, Any] = {}

        def tell(what: str, share: float) -> None:
            if what not in tasks:
                tasks[what] = progress.add_task(what, total=1.0)
            progress.update(tasks[what], completed=share)

        parts = measure(options, tell, before)
    hundred = load_scenario(ROOT / "scenarios" / "hundred.toml")
    settings = {
        "fleet": FLEET,
        "mission": SMALL.seconds,
        "points": SMALL.sensor.points,
        "period": SMALL.config.sync.announce_period,
        "trouble_loss": TROUBLED.link.loss,
        "fold_period": hundred.config.ledger.fold_period,
    }
    write({"parts": parts, "settings": settings, "fuzz_executions": fuzzed()}, options.out)
    failure = parts["sweep"]["figures"]["failure"]
    if failure is not None:
        sys.exit(f"a promise was broken: {failure}")


if __name__ == "__main__":
    main()
