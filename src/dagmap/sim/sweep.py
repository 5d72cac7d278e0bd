"""Many seeds, one question: does anything break? What does is cut down to the shortest timeline."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import TypeVar

import msgspec

from ..model import Cycle
from .invariants import Invariants, Violation
from .mission import Mission
from .network import Link
from .robot import Happening, Robot
from .scenario import Clocks, Liars, Scenario
from .timeline import Timeline

T = TypeVar("T")

_ATTEMPTS = 300  # runs that cutting a failure down may take
_CHUNK = 8  # seeds that a process takes at a time


class Failure(msgspec.Struct, frozen=True, kw_only=True):
    """A run that broke a promise. The scenario has its faults listed."""

    scenario: Scenario
    seed: int
    name: str  # of the promise
    detail: str
    at: float  # s of simulated time
    timeline: int  # events until then


def attempt(
    scenario: Scenario, seed: int, recordings: dict[str, Iterable[Cycle]] | None = None
) -> Failure | None:
    """Run a scenario with every invariant checked after every event."""
    return _watched(scenario, seed, recordings)[0]


def timeline_of(scenario: Scenario, seed: int) -> list[str]:
    """The events of a run, until it ends or breaks."""
    return _watched(scenario, seed)[1].lines


def sweep(
    scenarios: list[Scenario],
    seeds: range,
    jobs: int = 1,
    told: Callable[[int], None] | None = None,
) -> Failure | None:
    """Run every scenario with every seed; the first failure, in order, or None.

    told: hears how many runs are done.
    """
    work = [(scenario, seed) for seed in seeds for scenario in scenarios]
    for done, failure in enumerate(_attempts(work, jobs), 1):
        if told is not None:
            told(done)
        if failure is not None:
            return failure
    return None


def minimised(failure: Failure) -> Failure:
    """The same failure with as few faults, liars, robots and seconds as it takes."""
    best, left = failure, _ATTEMPTS
    improved = True
    while improved and left > 0:
        improved = False
        for candidate in _simpler(best):
            left -= 1
            found = attempt(candidate, best.seed)
            if found is not None and found.name == best.name:
                best, improved = found, True
                break
            if left == 0:
                break
    return best


def _watched(
    scenario: Scenario, seed: int, recordings: dict[str, Iterable[Cycle]] | None = None
) -> tuple[Failure | None, Timeline]:
    invariants = Invariants()
    timeline = Timeline(lambda: mission.fleet.now)

    def on_event(robot: Robot, happening: Happening) -> None:
        invariants.saw(robot, happening)
        timeline(robot, happening)

    mission = Mission(scenario, seed, recordings, on_event, invariants)
    invariants.fleet = mission.fleet
    try:
        if mission.play() is None:
            raise Violation("no agreement", "the fleet", mission.fleet.now, "out of patience")
        invariants.at_the_end(mission.honest)
    except Violation as violation:
        name, detail = violation.name, str(violation)
    except Exception as error:  # noqa: BLE001  # whatever escapes from an agent breaks promise 5
        name, detail = f"{type(error).__name__} escaped", repr(error)
    else:
        return None, timeline
    failure = Failure(
        scenario=mission.scenario,
        seed=seed,
        name=name,
        detail=detail,
        at=mission.fleet.now,
        timeline=len(timeline.lines),
    )
    return failure, timeline


def _attempts(work: list[tuple[Scenario, int]], jobs: int) -> Iterator[Failure | None]:
    if jobs <= 1:
        yield from (attempt(*item) for item in work)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        try:
            yield from pool.map(_attempt, work, chunksize=_CHUNK)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _attempt(item: tuple[Scenario, int]) -> Failure | None:
    return attempt(*item)


def _simpler(failure: Failure) -> Iterator[Scenario]:
    """Scenarios with a little less in them, the largest cuts first."""
    full = failure.scenario
    for seconds in (round(failure.at + 0.001, 3), round(full.seconds * 0.6, 3)):
        if 0 < seconds < full.seconds:
            yield _shorter(full, seconds)
    for name in ("partitions", "crashes"):
        yield from (
            msgspec.structs.replace(full, **{name: rest})
            for rest in _without_one(getattr(full, name))
        )
    yield from _smaller_fleets(full)
    for name, usual in (("link", Link()), ("clocks", Clocks())):
        if getattr(full, name) != usual:
            yield msgspec.structs.replace(full, **{name: usual})
    for field in ("loss", "tail", "duplicate", "reach", "bandwidth"):
        if getattr(full.link, field) != getattr(Link(), field):
            link = msgspec.structs.replace(full.link, **{field: getattr(Link(), field)})
            yield msgspec.structs.replace(full, link=link)
    if full.sensor.points > 4:
        sensor = msgspec.structs.replace(full.sensor, points=full.sensor.points // 2)
        yield msgspec.structs.replace(full, sensor=sensor)
    if full.motion.loop_closures:
        motion = msgspec.structs.replace(full.motion, loop_closures=False)
        yield msgspec.structs.replace(full, motion=motion)


def _shorter(full: Scenario, seconds: float) -> Scenario:
    late = tuple(min(at, seconds) for at in full.late)
    return msgspec.structs.replace(full, seconds=seconds, late=late)


def _without_one(items: tuple[T, ...]) -> Iterator[tuple[T, ...]]:
    return (items[:i] + items[i + 1 :] for i in range(len(items)))


def _smaller_fleets(full: Scenario) -> Iterator[Scenario]:
    """One robot less: one of the liars, or the last honest one."""
    for i, group in enumerate(full.liars):
        fewer = (msgspec.structs.replace(group, count=group.count - 1),) if group.count > 1 else ()
        liars = full.liars[:i] + fewer + full.liars[i + 1 :]
        yield from _resized(full, liars=liars)
    if full.robots - full.lying > 1:
        yield from _resized(full, liars=full.liars)


def _resized(full: Scenario, liars: tuple[Liars, ...]) -> Iterator[Scenario]:
    """With one robot less and these liars; what names the robot that is gone leaves too."""
    if full.recordings or len(full.late) >= full.robots - 1 - sum(g.count for g in liars):
        return
    fields = {"robots": full.robots - 1, "liars": liars}
    bare = msgspec.structs.replace(full, partitions=(), crashes=(), **fields)
    left = set(bare.names)
    partitions = tuple(
        msgspec.structs.replace(p, robots=tuple(n for n in p.robots if n in left))
        for p in full.partitions
    )
    crashes = tuple(crash for crash in full.crashes if crash.robot in left)
    yield msgspec.structs.replace(bare, partitions=partitions, crashes=crashes)
