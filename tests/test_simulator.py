"""The simulator itself: one seed is one timeline, and every fault does what its name says."""

from __future__ import annotations

import io
import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from statistics import mean

import msgspec
import numpy as np
import pytest

from dagmap import Config, Cycle
from dagmap.config import GraphConfig, IssuanceConfig, TransactionConfig
from dagmap.io.sources import open_source, save_cycles
from dagmap.model import Accepted, ConfigError, Issued
from dagmap.payload import Anchor
from dagmap.sim.building import SceneConfig
from dagmap.sim.fleet import Crash, Fleet
from dagmap.sim.invariants import Invariants
from dagmap.sim.liars import LIARS
from dagmap.sim.mission import Mission
from dagmap.sim.network import Link, Network, Partition, Position
from dagmap.sim.robot import Clock, Costs, Crashed, Disk, Happening, Recording, Restarted, Robot
from dagmap.sim.scenario import Chaos, Clocks, Liars, Scenario, load_scenario
from dagmap.sim.sensor import SensorConfig
from dagmap.sim.timeline import Timeline
from dagmap.sim.walk import MotionConfig
from scene import QUICK, cycles

SCENARIOS = sorted((Path(__file__).parents[1] / "scenarios").glob("*.toml"))
SMALL = Scenario(
    robots=3,
    seconds=6.0,
    sensor=SensorConfig(points=16, tracked=0.4),
    link=Link(loss=0.2, tail=0.05, duplicate=0.1),
    clocks=Clocks(offset=5.0, drift=0.01),
    chaos=Chaos(crashes=2, down=(0.2, 1.0), partitions=1, apart=(1.0, 2.0)),
    config=Config(
        same_origin=True,
        transaction=TransactionConfig(proof_of_work_bits=0),
        graph=GraphConfig(reference_pitch=0.25, max_parent_distance=0.75),
        issuance=IssuanceConfig(features_per_transaction=8),
    ),
)
CALM = msgspec.structs.replace(SMALL, link=Link(), clocks=Clocks(), chaos=Chaos())


def changed(scenario: Scenario, **fields: object) -> Scenario:
    return msgspec.structs.replace(scenario, **fields)


def timeline(scenario: Scenario, seed: int, watched: bool = False) -> str:
    invariants = Invariants()
    lines = Timeline(lambda: mission.fleet.now)

    def on_event(robot: Robot, happening: Happening) -> None:
        invariants.saw(robot, happening)
        lines(robot, happening)

    mission = Mission(scenario, seed, None, on_event, invariants if watched else None)
    invariants.fleet = mission.fleet
    assert mission.play() is not None
    return "\n".join(lines.lines)


# One seed, one timeline


def test_the_same_seed_gives_the_same_timeline_to_the_byte() -> None:
    first = timeline(SMALL, 7)
    assert first == timeline(SMALL, 7) != timeline(SMALL, 8)
    assert " crashes " in first and " restarts " in first and " issues " in first


def test_another_process_with_another_hash_seed_gives_the_same_timeline(tmp_path: Path) -> None:
    scenario = changed(SMALL, liars=(Liars(kind="any"),), robots=4)
    file = tmp_path / "scenario.toml"
    file.write_bytes(scenario.toml())
    code = "from dagmap.cli import main; main()"
    arguments = ["simulate", str(file), "--seed", "7", "--timeline", "-"]
    other = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env={**os.environ, "PYTHONHASHSEED": "12345"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert other.stdout == timeline(scenario, 7) + "\n"


@pytest.mark.parametrize("seed", range(3))
def test_who_watches_changes_nothing(seed: int) -> None:
    """Invariants read maps and digests in between: no event may follow from that."""
    assert timeline(SMALL, seed) == timeline(SMALL, seed, watched=True)


# The network


def arrivals(network: Network, count: int = 4000, gap: float = 0.0) -> list[list[float]]:
    """When the copies of messages from a to b arrive, sent one `gap` seconds after the other."""
    sent = (network.send("a", ["b"], 100, i * gap) for i in range(count))
    return [[at for at, _ in copies] for copies in sent]


def test_loss_is_that_share_of_messages() -> None:
    lost = [not copies for copies in arrivals(Network(Link(loss=0.3), 1))]
    assert mean(lost) == pytest.approx(0.3, abs=0.03)
    assert all(arrivals(Network(Link(), 1)))


def test_delays_are_between_their_bounds_and_overtake_each_other() -> None:
    times = [at for [at] in arrivals(Network(Link(delay=(0.1, 0.3)), 1), gap=0.001)]
    delays = [at - i * 0.001 for i, at in enumerate(times)]
    assert 0.1 <= min(delays) < 0.11 and 0.29 < max(delays) <= 0.3
    assert times != sorted(times)


def test_a_tail_adds_its_mean_and_some_messages_come_very_late() -> None:
    link = Link(delay=(0.1, 0.1), tail=0.2)
    delays = [at for [at] in arrivals(Network(link, 1))]
    assert min(delays) >= 0.1 and mean(delays) == pytest.approx(0.3, abs=0.02)
    assert max(delays) > 1.0


def test_duplicates_arrive_each_at_its_own_time() -> None:
    copies = arrivals(Network(Link(duplicate=0.25), 1))
    assert mean(len(times) == 2 for times in copies) == pytest.approx(0.25, abs=0.03)
    assert {len(times) for times in copies} == {1, 2}
    assert all(len(set(times)) == len(times) for times in copies)


def test_bandwidth_makes_messages_wait_and_a_full_queue_drops_them() -> None:
    link = Link(delay=(0.0, 0.0), bandwidth=1000.0, queue=300)
    network = Network(link, 1)
    times = arrivals(network, 5)  # 100 bytes take 0.1 s
    assert [at for [at] in times[:3]] == pytest.approx([0.1, 0.2, 0.3]) and times[3:] == [[], []]
    assert network.dropped == 2
    assert network.send("c", ["b"], 100, 0.0) == [(0.1, "b")]  # everybody has a radio
    [(at, _)] = network.send("a", ["b"], 100, 0.2)  # the queue has emptied a little
    assert at == pytest.approx(0.4)
    [(at, _)] = network.send("d", ["b"], 10**6, 0.0)  # into an empty radio fits any message
    assert at == pytest.approx(1000.0)
    assert network.send("d", ["b"], 1, 0.0) == []  # and then none
    assert network.send("a", ["b", "c"], 100, 9.0) == [(9.1, "b"), (9.1, "c")]  # one broadcast


def test_who_hears_a_message_follows_from_when_it_leaves() -> None:
    def where(name: str, now: float) -> Position:
        return (0.0, 0.0, 0.0) if name == "a" else (now, 0.0, 0.0)

    slow = Link(delay=(0.0, 0.0), bandwidth=100.0)
    cut = Partition(start=1.5, end=3.5, robots=("b",))
    network = Network(slow, 1, [cut])
    sent = [network.send("a", ["b"], 100, 0.0) for _ in range(5)]
    assert sent == [[(1.0, "b")], [], [], [(4.0, "b")], [(5.0, "b")]]
    assert network.send("c", ["b"], 300, 2.0) == [(5.0, "b")]  # queued within, leaves after it
    near = Network(msgspec.structs.replace(slow, reach=2.5), 1, where=where)
    assert [len(near.send("a", ["b"], 100, 0.0)) for _ in range(4)] == [1, 1, 0, 0]


def test_reach_follows_the_robots() -> None:
    def where(name: str, now: float) -> Position:
        return (0.0, 0.0, 0.0) if name == "a" else (now, 0.0, 0.0)

    network = Network(Link(reach=5.0), 1, where=where)
    assert [network.connects("a", "b", now) for now in (0.0, 5.0, 5.1)] == [True, True, False]
    assert network.send("a", ["b"], 10, 4.0) and not network.send("a", ["b"], 10, 6.0)
    with pytest.raises(ConfigError, match="where the robots are"):
        Network(Link(reach=5.0), 1)


@pytest.mark.parametrize(
    ("direction", "heard"),
    [("both", []), ("in", [("a", "b")]), ("out", [("b", "a")])],
)
def test_partitions_in_one_direction_or_both(direction: str, heard: list[tuple[str, str]]) -> None:
    cut = msgspec.convert(
        {"start": 1.0, "end": 2.0, "robots": ["a"], "direction": direction}, Partition
    )
    network = Network(Link(), 1, [cut])
    pairs = [("a", "b"), ("b", "a")]
    assert [pair for pair in pairs if network.send(pair[0], [pair[1]], 10, 1.5)] == heard
    assert all(network.send(a, [b], 10, now) for a, b in pairs for now in (0.9, 2.0))
    assert network.send("b", ["c"], 10, 1.5)  # those on one side hear each other


def test_the_topology_changes_while_robots_walk() -> None:
    """Robots of a mission come into reach and leave it, and agree all the same."""
    scenario = load_scenario(next(path for path in SCENARIOS if path.stem == "reach"))
    mission = Mission(scenario, 3)
    names = scenario.names
    seen = {
        frozenset(
            (a, b)
            for a in names
            for b in names
            if a < b and mission._network.connects(a, b, float(now))
        )
        for now in range(0, 16, 3)
    }
    assert len(seen) > 2
    assert mission.play() is not None


# Crashes


def crashed(moment: str, at: float, source: list[Cycle]) -> tuple[Fleet, list[Happening]]:
    """Two robots; the first dies and is back half a second later; then they agree."""
    told: list[Happening] = []
    invariants = Invariants()

    def on_event(robot: Robot, happening: Happening) -> None:
        if robot.name == "a":
            told.append(happening)

    fleet = Fleet(QUICK, Network(Link(), 1), on_event, invariants)
    invariants.fleet = fleet
    for name in ("a", "b"):
        fleet.join(name)
    fleet.crash(msgspec.convert({"robot": "a", "at": at, "down": 0.5, "moment": moment}, Crash))
    for _ in fleet.run({"a": iter(source)}):
        pass
    assert fleet.agrees() and fleet.robots["a"].agent.digest() == fleet.robots["b"].agent.digest()
    return fleet, told


def steps(count: int) -> list[Cycle]:
    return [replace(cycle, colors=None) for cycle in cycles(3, count, churn=False)]


def test_a_crash_between_steps_loses_nothing() -> None:
    fleet, told = crashed("between", 2.5, steps(6))
    before = told[: told.index(Crashed("between"))]
    accepted = {event.id for event in before if isinstance(event, Accepted)}
    assert len(accepted) >= 3
    assert Restarted(len(accepted)) in told
    assert accepted <= {tx.id for tx in fleet.robots["b"].agent.ledger}


@pytest.mark.parametrize("moment", ["unsynced", "unsent"])
def test_what_was_synced_survives_and_what_was_not_is_gone(moment: str) -> None:
    """The third cycle is sealed at 2.0 s, the step in which the robot dies."""
    fleet, told = crashed(moment, 1.95, [replace(c, stamp=c.stamp * 0.98) for c in steps(6)])
    death = told.index(Crashed(moment))  # type: ignore[arg-type]
    sealed = [event for event in told[:death] if isinstance(event, Issued)]
    last = sealed[-1].id
    everybody = {tx.id for robot in fleet.robots.values() for tx in robot.agent.ledger}
    assert {event.id for event in sealed[:-1]} <= everybody
    assert (last in everybody) is (moment == "unsent")  # synced, and repaired after the restart
    assert Restarted(len(sealed) - (moment == "unsynced")) in told
    after = [event for event in told[death:] if isinstance(event, Issued)]
    a = fleet.robots["a"]
    chain = fleet.robots["b"].agent.ledger.chain(a.author)
    assert after and chain.cut is None and chain.proof is None
    count = len(sealed) + len(after) - (moment == "unsynced")
    assert [tx.sequence for tx in chain.main] == list(range(count))
    assert a.own == {tx.id for tx in chain.main}


def test_a_crash_before_the_sync_loses_something(monkeypatch: pytest.MonkeyPatch) -> None:
    """It waits for a step in which there is something to lose."""
    lost, plain = [], Disk.crash

    def crash(self: Disk) -> list[bytes]:
        gone = plain(self)
        lost.append(len(gone))
        return gone

    monkeypatch.setattr(Disk, "crash", crash)
    faults = [(1.05, "r00"), (2.31, "r01"), (3.77, "r02")]
    crashes = tuple(Crash(robot=n, at=at, moment="unsynced") for at, n in faults)
    for seed in range(4):
        assert Mission(changed(CALM, crashes=crashes), seed).play() is not None
    assert len(lost) >= 9 and min(lost) > 0


def test_a_robot_that_is_down_hears_and_says_nothing() -> None:
    mission = Mission(changed(CALM, crashes=(Crash(robot="r01", at=2.05, down=2.0),)), 1)
    robot = mission.fleet.robots["r01"]
    mission.fleet.advance(2.1)
    assert not robot.up
    received, sent = robot.messages, robot.bytes_sent
    mission.fleet.advance(4.0)
    assert (robot.messages, robot.bytes_sent, robot.up) == (received, sent, False)
    mission.fleet.advance(4.1)
    assert robot.up and robot.session == 1
    assert mission.play() is not None and robot.messages > received


def test_a_late_robot_can_crash_too() -> None:
    scenario = changed(CALM, late=(2.0,), crashes=(Crash(robot="r02", at=3.0),))
    assert " r02 crashes between" in timeline(scenario, 1)


def test_the_disk_forgets_what_was_not_synced() -> None:
    disk = Disk()
    disk.append(b"a")
    disk.sync()
    disk.append(b"b")
    assert disk.crash() == [b"b"] and disk.read() == [b"a"]


# Clocks, late joiners, recordings


def test_clocks_are_wrong_by_their_offset_and_their_drift() -> None:
    assert Clock(offset=-3.0, drift=0.5).at(10.0) == 12.0
    scenario = changed(CALM, clocks=Clocks(offset=100.0, drift=0.2))
    drawn = [scenario.clock(i, 1) for i in range(3)]
    assert len({clock.offset for clock in drawn}) == len({clock.drift for clock in drawn}) == 3
    assert all(abs(clock.offset) <= 100 and abs(clock.drift) <= 0.2 for clock in drawn)
    mission = Mission(scenario, 1)
    assert mission.play() is not None
    world = mission.honest[0].agent.robots
    for clock, robot in zip(drawn, mission.honest, strict=True):
        assert world[robot.name][1] == pytest.approx(clock.at(5.0), abs=1e-5)  # the last cycle


def test_late_joiners_come_when_they_are_said_to_and_copy_everything() -> None:
    mission = Mission(changed(CALM, late=(3.0, 4.5)), 1)
    mission.fleet.advance(2.9)
    assert list(mission.fleet.robots) == ["r00"]
    took = mission.play()
    assert took is not None and list(mission.fleet.robots) == ["r00", "r01", "r02"]
    late = mission.fleet.robots["r02"]
    assert late.observed_at[0][0] == pytest.approx(4.5, abs=0.01)
    assert {tx.author for tx in late.agent.ledger} == {r.author for r in mission.honest}
    assert min(tx.lamport for tx in late.agent.ledger) == 1


def test_divergence_rises_in_a_partition_and_ends_at_zero() -> None:
    cut = Partition(start=1.0, end=5.0, robots=("r00",))
    report = Mission(changed(CALM, partitions=(cut,)), 1).run()
    apart = dict(report.divergence)
    assert apart[1.0] < apart[3.0] < apart[5.0] > 0.5 and report.divergence[-1][1] < apart[5.0]
    assert report.agreed


def test_robots_agree_when_they_have_folded_what_they_know() -> None:
    """So small a step that maps lag behind the ledgers: agreement in knowledge comes first."""
    ledger = msgspec.structs.replace(CALM.config.ledger, fold_per_tick=3)
    config = msgspec.structs.replace(CALM.config, ledger=ledger)
    slow = changed(CALM, config=config, seconds=5.05)
    mission = Mission(slow, 1)
    stages: list[str] = []
    report = mission.run(lambda now: stages.append(mission.stage))
    assert all(robot.agent.settled for robot in mission.honest)
    assert report.agreed and report.agreement_s is not None and report.agreement_s < 0.1
    assert report.map_agreement_s is not None and report.map_agreement_s > 1.0
    assert list(dict.fromkeys(stages)) == ["simulating", "agreeing", "comparing maps"]
    mission = Mission(changed(slow, patience=0.5), 1)
    assert mission.play() is None, "knowing the same is not enough"
    quick = Mission(changed(CALM, seconds=5.05), 1).run()
    assert quick.agreement_s == report.agreement_s
    assert quick.map_agreement_s is not None and quick.map_agreement_s < 0.3


def test_agreement_counts_from_when_nothing_stood_in_its_way() -> None:
    quick = Mission(changed(CALM, seconds=5.05), 1).run()
    assert quick.agreement_s is not None and 0.002 <= quick.agreement_s <= 0.02 + 1e-9
    assert quick.agreement_periods == quick.agreement_s
    assert quick.ideal_s == pytest.approx(0.011)
    cut = Partition(start=0.0, end=20.0, robots=("r00",))
    healed = Mission(changed(CALM, seconds=5.05, partitions=(cut,)), 1).run()
    assert healed.simulated_s > 20.0
    assert healed.agreement_s is not None and 0.002 < healed.agreement_s < 3.0
    never = changed(CALM, patience=3.0, partitions=(msgspec.structs.replace(cut, end=1e9),))
    report = Mission(never, 1).run()
    assert not report.agreed and report.agreement_s is None and report.ideal_s is None


def test_bytes_are_counted_against_one_copy_for_everybody() -> None:
    mission = Mission(CALM, 1)
    report = mission.run()
    size = sum(len(tx.data) for tx in mission.honest[0].agent.ledger)
    assert report.bytes_minimum == 2 * size
    assert report.bytes_minimum < report.bytes_received < 3 * report.bytes_minimum
    assert report.bytes_received <= report.bytes_carried < 1.05 * report.bytes_received
    lossy = Mission(changed(CALM, link=Link(loss=0.5)), 1).run()
    assert lossy.bytes_carried > 1.5 * lossy.bytes_received, "what is lost was sent all the same"
    assert report.bytes_received == sum(robot.bytes_received for robot in mission.honest)


@pytest.fixture
def recordings(tmp_path: Path) -> list[str]:
    names = ["red.npz", "blue.npz"]
    for i, name in enumerate(names):
        save_cycles(tmp_path / name, list(plain(i)))
    return names


def plain(seed: int) -> Iterator[Cycle]:
    return (replace(cycle, colors=None) for cycle in cycles(seed, count=8))


def test_recordings_are_what_robots_see_and_crashes_hit_those_too(
    tmp_path: Path, recordings: list[str]
) -> None:
    scenario = changed(
        CALM,
        robots=2,
        seconds=8.0,
        recordings=tuple(recordings),
        crashes=(Crash(robot="r00", at=2.5, down=2.0),),
    )

    def mission(scenario: Scenario) -> Mission:
        sources = [open_source(tmp_path / name) for name in recordings]
        return Mission(scenario, 1, dict(zip(scenario.names, sources, strict=True)))

    whole = mission(changed(scenario, crashes=()))
    assert whole.play() is not None
    assert [robot.cycles for robot in whole.honest] == [8, 8]
    report = mission(scenario).run()
    assert report.agreed and report.quality is None and report.map["nodes"] > 10
    broken = mission(scenario)
    assert broken.play() is not None
    # the cycles of 3 s and 4 s passed while it was down
    assert [round(at) for at, _ in broken.honest[0].observed_at] == [0, 1, 2, 5, 6, 7]
    short = mission(changed(scenario, crashes=(Crash(robot="r00", at=2.5, down=0.2),)))
    assert short.play() is not None and short.honest[0].cycles == 8
    assert broken.honest[0].agent.observing.session == 1


def test_a_recording_with_sessions_of_its_own_goes_on_after_a_crash() -> None:
    """The SLAM started anew at 3.0 s and 6.0 s; the process died at 4.4 s: four sessions in all."""
    source = [replace(cycle, session=int(cycle.stamp) // 3) for cycle in steps(9)]
    fleet, _ = crashed("between", 4.4, source)
    sessions = [anchor.session for anchor in anchors(fleet, "a")]
    assert sessions == [0, 0, 0, 1, 1, 2, 3, 3, 3]


def anchors(fleet: Fleet, name: str) -> list[Anchor]:
    """What a robot published, as the other one knows it."""
    author = fleet.robots["b"].agent.consensus.authors[fleet.robots[name].author]
    return [author.anchors[cycle] for cycle in sorted(author.anchors)]


def test_a_recording_starts_when_its_robot_does() -> None:
    source = Recording(replace(cycle, stamp=cycle.stamp + 1000.0) for cycle in steps(3))
    assert [at for at, _ in source.cycles(5.0, 0)] == [5.0, 6.0, 7.0]


# Scenarios

BAD = {
    "robots = 0": "robots",
    "seconds = 0.0": "seconds",
    "seconds = inf": "seconds",
    "seconds = nan": "seconds",
    "patience = -1.0": "patience",
    "tick = 0.0": "tick",
    "late = [99.0]": "late",
    "late = [-1.0]": "late",
    "late = [1.0, 1.0, 1.0]": "late",
    "recordings = ['a.npz']": "recordings",
    "recordings = ['a.npz', 'b.npz', 'c.npz']\n[link]\nreach = 5.0": "recordings",
    "reference = 'truth.ply'": "reference.*recordings",
    "unknown = 1": "unknown",
    "[link]\nloss = 1.0": "Link: loss",
    "[link]\nloss = 'much'": "link.loss",
    "[link]\ndelay = [0.2, 0.1]": "delay",
    "[link]\ndelay = [0.0, inf]": "delay",
    "[link]\ntail = -0.1": "tail",
    "[link]\nduplicate = 1.1": "duplicate",
    "[link]\nreach = 0.0": "reach",
    "[link]\nbandwidth = 0.0": "bandwidth",
    "[link]\nqueue = -1": "queue",
    "[clocks]\noffset = -1.0": "offset",
    "[clocks]\noffset = inf": "offset",
    "[clocks]\ndrift = 0.5": "drift",
    "[costs]\nsent = -1.0": "Costs: sent",
    "[chaos]\ncrashes = -1": "crashes",
    "[chaos]\npartitions = -1": "partitions",
    "[chaos]\ndown = [2.0, 1.0]": "down",
    "[chaos]\napart = [2.0, 1.0]": "apart",
    "[[liars]]\nkind = 'cheat'": "kind.*forger",
    "[[liars]]\nkind = 'forger'\ncount = -1": "count",
    "[[liars]]\nkind = 'forger'\ncount = 3": "liars",
    "[[crashes]]\nrobot = 'r09'\nat = 1.0": "crashes.*r02",
    "[[crashes]]\nrobot = 'r00'": "`at`",
    "[[crashes]]\nrobot = 'r00'\nat = nan": "at",
    "[[crashes]]\nrobot = 'r00'\nat = 1.0\nmoment = 'now'": "moment",
    "[[partitions]]\nstart = 2.0\nend = 1.0\nrobots = ['r00']": "start.*end",
    "[[partitions]]\nstart = 1.0\nend = 2.0\nrobots = ['r09']": "partitions.*r02",
    "[[partitions]]\nstart = 1.0\nend = 2.0\nrobots = ['r00']\ndirection = 'up'": "direction",
    "[scene]\nrooms = [0, 1]": "rooms",
    "[sensor]\npoints = 0": "points",
    "[motion]\nspeed = 0.0": "speed",
    "[config.graph]\nn_c = 1": "n_c",
    "not = [toml": "TOML",
    "seconds = 1" + "0" * 5000: "too long",
}  # fmt: skip


@pytest.mark.parametrize("text", BAD)
def test_a_bad_value_names_the_file_the_key_and_what_is_wanted(tmp_path: Path, text: str) -> None:
    file = tmp_path / "bad.toml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=f"(?s)bad.toml: .*{BAD[text]}") as error:
        load_scenario(file)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda path: path.stem)
@pytest.mark.parametrize("seed", [0, 5])
def test_a_scenario_with_its_faults_drawn_is_a_file_again(
    tmp_path: Path, path: Path, seed: int
) -> None:
    drawn = load_scenario(path).drawn(seed)
    again = tmp_path / "again.toml"
    again.write_bytes(drawn.toml())
    assert load_scenario(again) == drawn == drawn.drawn(seed)
    listed = load_scenario(path)
    assert len(drawn.crashes) == listed.chaos.crashes + len(listed.crashes)
    assert len(drawn.partitions) == listed.chaos.partitions + len(listed.partitions)


def test_the_drawn_scenario_is_the_same_run() -> None:
    scenario = changed(SMALL, robots=4, liars=(Liars(kind="any"),))
    assert timeline(scenario, 3) == timeline(scenario.drawn(3), 3)


def test_liars_of_one_kind_in_two_groups_have_names_of_their_own() -> None:
    groups = (Liars(kind="forger", count=2), Liars(kind="eraser"), Liars(kind="forger"))
    names = Scenario(robots=5, liars=groups).names
    assert names == ["r00", "forger00", "forger01", "eraser00", "forger02"]
    crowd = Scenario(robots=9, liars=(Liars(kind="any", count=4), Liars(kind="any", count=4)))
    for seed in range(20):
        drawn = crowd.drawn(seed)
        assert len(set(drawn.names)) == 9 and drawn.lying == 8


def test_an_endless_wait_is_not_a_partition() -> None:
    assert Partition(start=0.0, end=math.inf, robots=("a",)).cuts("a", "b", 1e9)
    assert np.isfinite(Scenario().patience)


# The document

DOCUMENT = (Path(__file__).parents[1] / "docs" / "simulator.md").read_text()
TABLES = {
    "`[scene]`": SceneConfig,
    "`[sensor]`": SensorConfig,
    "`[motion]`": MotionConfig,
    "`[link]`": Link,
    "`[clocks]`": Clocks,
    "`[costs]`": Costs,
    "`[chaos]`": Chaos,
    "`[[partitions]]`": Partition,
    "`[[crashes]]`": Crash,
    "`[[liars]]`": Liars,
}


def rows(heading: str) -> dict[str, str]:
    """Key and second column of the first table of a section."""
    section = DOCUMENT.split(f"### {heading}")[1].split("\n#")[0]
    table = section[section.index("|---") :].split("\n\n")[0]
    cells = [line.split(" | ") for line in table.splitlines()[1:]]
    return {key.strip("| `"): second.strip(" |") for key, second, *_ in cells}


def default(field: msgspec.structs.FieldInfo) -> str:
    """As the document says it."""
    if field.default is msgspec.NODEFAULT:
        return "required"
    return "none" if field.default is None else json.dumps(field.default)


@pytest.mark.parametrize("heading", TABLES)
def test_the_document_names_every_key_with_its_default(heading: str) -> None:
    fields = msgspec.structs.fields(TABLES[heading])
    assert rows(heading) == {field.name: default(field) for field in fields}


def test_the_document_names_every_key_of_a_mission() -> None:
    lists = dict.fromkeys(("liars", "partitions", "crashes"), "list of tables")
    wanted = {
        field.name: "table" if isinstance(field.default, msgspec.Struct) else default(field)
        for field in msgspec.structs.fields(Scenario)
    }
    told = rows("The mission").items()
    assert {k: second for keys, second in told for k in keys.split("`, `")} == wanted | lists


def test_the_document_names_every_liar() -> None:
    section = DOCUMENT.split("| kind | what it does |")[1].split("\n\n")[0]
    assert re.findall(r"^\| `(.+?)`", section, re.MULTILINE) == list(LIARS)


def test_what_the_document_shows_works(tmp_path: Path) -> None:
    file = tmp_path / "example.toml"
    file.write_text(DOCUMENT.split("```toml\n")[1].split("```")[0])
    assert load_scenario(file).lying == 1
    code = DOCUMENT.split("```python\n")[1].split("```")[0]
    with redirect_stdout(io.StringIO()) as out:
        exec(code, {})
    first, *robots = out.getvalue().splitlines()
    assert first.startswith("True ") and len(robots) == 3
    assert len({line.split()[-1] for line in robots}) == 1
