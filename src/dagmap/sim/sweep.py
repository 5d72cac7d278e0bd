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
_SHARES = (0.5, 0.75, 0.9, 0.97)  # of the seconds: each success begins anew, as in a bisection
_BRIEF = 0.1  # s: shorter faults are not cut
NO_AGREEMENT = "no agreement"
_CHUNK = 8  # seeds that a process takes at a time


class _TooLong(Exception):
    """The timeline has more events than were asked for."""


class Failure(msgspec.Struct, frozen=True, kw_only=True):
    """A run that broke a promise. The scenario has its faults listed."""

    scenario: Scenario
    seed: int
    name: str  # of the promise
    detail: str
    at: float  # s of simulated time
    timeline: int  # events until then


def attempt(
    scenario: Scenario,
    seed: int,
    recordings: dict[str, Iterable[Cycle]] | None = None,
    invariants: Invariants | None = None,
) -> Failure | None:
    """Run a scenario with every invariant checked after every event."""
    return _watched(scenario, seed, recordings, invariants=invariants)[0]


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
    """The same failure with as few faults, liars, robots, seconds and events as it takes.

    A cut is kept where the timeline does not become longer by it.
    """
    best, left = failure, _ATTEMPTS
    improved = True
    while improved and left > 0:
        improved = False
        for candidate in _simpler(best):
            left -= 1
            found = _watched(candidate, best.seed, most=best.timeline)[0]
            if found is not None and found.name == best.name:
                best, improved = found, True
                break
            if left == 0:
                break
    return best


def _watched(
    scenario: Scenario,
    seed: int,
    recordings: dict[str, Iterable[Cycle]] | None = None,
    most: int | None = None,
    invariants: Invariants | None = None,
) -> tuple[Failure | None, Timeline]:
    """most: events of a timeline beyond which nobody wants to know of a failure."""
    invariants = Invariants() if invariants is None else invariants
    timeline = Timeline(lambda: mission.fleet.now)

    def on_event(robot: Robot, happening: Happening) -> None:
        invariants.saw(robot, happening)
        timeline(robot, happening)
        if most is not None and len(timeline.lines) > most:
            raise _TooLong

    mission = Mission(scenario, seed, recordings, on_event, invariants)
    invariants.fleet = mission.fleet
    try:
        if mission.play() is None:
            raise Violation(NO_AGREEMENT, "the fleet", mission.fleet.now, "out of patience")
        invariants.at_the_end(mission.honest)
    except _TooLong:
        return None, timeline
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
            pool.shutdown(cancel_futures=True)


def _attempt(item: tuple[Scenario, int]) -> Failure | None:
    return attempt(*item)


def _simpler(failure: Failure) -> Iterator[Scenario]:
    """Scenarios with a little less in them, the largest cuts first."""
    full = failure.scenario
    for seconds in (failure.at + 0.001, *(full.seconds * share for share in _SHARES)):
        if 0 < round(seconds, 3) < full.seconds:
            yield _shorter(full, round(seconds, 3))
    yield from _fewer_faults(full)
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
    yield from _briefer_faults(full)
    needed = round(max(failure.at - full.seconds, 0.0) + 0.001, 3)
    if failure.name != NO_AGREEMENT and needed < full.patience:  # that fails with less, bug or not
        yield msgspec.structs.replace(full, patience=needed)


def _shorter(full: Scenario, seconds: float) -> Scenario:
    late = tuple(min(at, seconds) for at in full.late)
    return msgspec.structs.replace(full, seconds=seconds, late=late)


def _fewer_faults(full: Scenario) -> Iterator[Scenario]:
    """Without one partition, crash or late start."""
    for name in ("partitions", "crashes", "late"):
        for rest in _without_one(getattr(full, name)):
            yield msgspec.structs.replace(full, **{name: rest})


def _briefer_faults(full: Scenario) -> Iterator[Scenario]:
    """With half of one partition, one robot down for half as long, or less late."""
    for i, cut in enumerate(full.partitions):
        middle = round((cut.start + cut.end) / 2, 3)
        for ends in ({"end": middle}, {"start": middle}):
            if cut.end - cut.start > _BRIEF:
                yield _with_one(full, "partitions", i, msgspec.structs.replace(cut, **ends))
    for i, crash in enumerate(full.crashes):
        if crash.down > _BRIEF:
            less = msgspec.structs.replace(crash, down=round(crash.down / 2, 3))
            yield _with_one(full, "crashes", i, less)
    for i, at in enumerate(full.late):
        if at > _BRIEF:
            yield _with_one(full, "late", i, round(at / 2, 3))


def _with_one(full: Scenario, name: str, i: int, item: object) -> Scenario:
    """With another i-th fault of a kind."""
    items = getattr(full, name)
    return msgspec.structs.replace(full, **{name: (*items[:i], item, *items[i + 1 :])})


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
