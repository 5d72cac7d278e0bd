"""Robots that lie: the honest ones agree, and what they lose and believe stays within the bound."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from dagmap import Agent, Config, Cycle, GraphConfig, messages, transaction
from dagmap.config import FoldConfig, TransactionConfig
from dagmap.identity import Identity
from dagmap.messages import Transactions
from dagmap.model import Accepted, ConfigError
from dagmap.sim.building import SceneConfig
from dagmap.sim.liars import LIARS, make_liar
from dagmap.sim.mission import Mission, Report
from dagmap.sim.network import Link
from dagmap.sim.robot import Happening, Robot
from dagmap.sim.scenario import Liars, Scenario
from dagmap.sim.sensor import SensorConfig
from dagmap.sim.sweep import attempt
from dagmap.sim.truth import judge_lies
from dagmap.sim.walk import MotionConfig
from dagmap.sync import Peer

ROOM = Scenario(  # everybody looks at the walls of one small room
    name="a room",
    seconds=15.0,
    config=Config(
        same_origin=True,
        transaction=TransactionConfig(proof_of_work_bits=0),
        graph=GraphConfig(reference_pitch=0.25, max_parent_distance=0.75),
        fold=FoldConfig(delta=0.1, max_ray=8.0),
    ),
    scene=SceneConfig(rooms=(1, 1), room=3.5, objects=1),
    motion=MotionConfig(drift=0.0, drift_yaw=0.0, loop_closures=False),
    sensor=SensorConfig(points=60, outliers=0.0),
)
# who lie about what is there
SAYING = ["forger", "eraser", "splitter", "wrong-frame", "outsider", "early-outsider"]


def room(kind: str, liars: int, honest: int = 3, witnesses: int = 2, **changes: object) -> Scenario:
    fold = msgspec.structs.replace(ROOM.config.fold, witnesses=witnesses)
    config = msgspec.structs.replace(ROOM.config, fold=fold)
    lying = (Liars(kind=kind, count=liars),) if liars else ()
    return msgspec.structs.replace(
        ROOM, robots=honest + liars, liars=lying, config=config, **changes
    )


def played(scenario: Scenario, seed: int = 1) -> tuple[Mission, Report]:
    mission = Mission(scenario, seed)
    report = mission.run()
    assert report.agreed
    return mission, report


@pytest.mark.parametrize("kind", sorted(LIARS))
def test_the_honest_agree_whatever_one_does(kind: str) -> None:
    few = msgspec.structs.replace(ROOM.sensor, points=20)
    scenario = room(kind, 1, seconds=8.0, sensor=few, link=Link(loss=0.1))
    assert attempt(scenario, 3) is None, "every invariant holds, and all agree"


@pytest.mark.parametrize("kind", sorted(set(LIARS) - set(SAYING)))
def test_many_of_a_kind_do_not_feed_each_other(kind: str) -> None:
    """Three of six: no storm of messages, and agreement, in bounded time."""
    few = msgspec.structs.replace(ROOM.sensor, points=10)
    scenario = room(kind, 3, seconds=3.0, sensor=few)
    assert attempt(scenario, 1) is None


@pytest.mark.parametrize("kind", SAYING)
@pytest.mark.parametrize("witnesses", [2, 3])
def test_what_only_liars_say_is_confirmed_from_witnesses_liars_on(
    kind: str, witnesses: int
) -> None:
    lies = played(room(kind, witnesses - 1, witnesses=witnesses))[1].lies
    assert lies is not None and lies.liars_only > 30 and lies.liars_confirmed == 0
    if kind in ("forger", "splitter", "wrong-frame"):
        beyond = played(room(kind, witnesses, witnesses=witnesses))[1].lies
        assert beyond is not None and beyond.liars_confirmed > 0, "one liar more and the bound ends"


def doubting(scenario: Scenario, doubt: int | None) -> Scenario:
    """With another weight of what lies around a place; 1000: nothing but votes counts."""
    fold = msgspec.structs.replace(scenario.config.fold, doubt=doubt)
    config = msgspec.structs.replace(scenario.config, fold=fold)
    return msgspec.structs.replace(scenario, config=config)


@pytest.mark.parametrize("kind", SAYING)
@pytest.mark.parametrize("liars", [1, 2])
@pytest.mark.parametrize("doubt", [None, 36, 1000])
def test_what_outweighs_the_liars_is_never_lost(kind: str, liars: int, doubt: int | None) -> None:
    """Places that honest robots saw first, with and without what lies around them."""
    lies = played(doubting(room(kind, liars, honest=4), doubt))[1].lies
    assert lies is not None and lies.proven_nodes > 30 and lies.proven_lost == 0
    assert doubt == 1000 or lies.usurped_lost == 0


@pytest.mark.parametrize("kind", ["outsider", "early-outsider"])
def test_who_sees_a_place_first_chooses_from_where_it_is_judged(kind: str) -> None:
    """Beyond the bound: one liar's false pose can reject what many honest robots saw."""
    lies = played(doubting(room(kind, 1, honest=4), 1000))[1].lies
    assert lies is not None and lies.usurped_lost > 0 == lies.proven_lost


@pytest.mark.parametrize("seed", [2, 3])
def test_splitting_what_others_saw_gains_next_to_nothing(seed: int) -> None:
    """Seeds planted beside a place can share its hits out among nodes that are outvoted apart."""
    lies = played(room("splitter", 1), seed)[1].lies
    assert lies is not None and lies.proven_lost <= lies.proven_nodes // 100


def test_one_witness_less_and_it_is_lost() -> None:
    """Where nothing but votes counts, erasers outvote places that as many honest ones vouch for.

    By default what lies around a place speaks for it too, and keeps most of these.
    """
    mission, _ = played(doubting(room("eraser", 3), 1000))
    honest = mission.honest
    assert judge_lies(honest[0], honest, liars=3).proven_lost == 0
    assert judge_lies(honest[0], honest, liars=2).proven_lost > 0


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("wrong-prover", "signature does not match"),
        ("false-dater", "Lamport time does not follow from its references"),
        ("babbler", "checksum does not match"),
    ],
)
def test_a_refusal_says_why(kind: str, reason: str) -> None:
    few = msgspec.structs.replace(ROOM.sensor, points=20)
    report = played(room(kind, 1, seconds=8.0, sensor=few))[1]
    assert report.rejected.get(reason, 0) > 0, report.rejected


def test_spoilt_work_is_refused_before_the_signature_is_looked_at() -> None:
    few = msgspec.structs.replace(ROOM.sensor, points=20)
    scenario = room("wrong-prover", 1, seconds=5.0, sensor=few)
    worked = msgspec.structs.replace(
        scenario.config, transaction=TransactionConfig(proof_of_work_bits=2)
    )
    report = played(msgspec.structs.replace(scenario, config=worked))[1]
    assert report.rejected.get("proof of work missing", 0) > 3, report.rejected
    assert report.rejected.get("signature does not match", 0) > 3


def test_a_replayer_sends_what_others_said() -> None:
    replayer, agent = make_liar("replayer", 0), Agent(Identity.from_seed(bytes(32)), ROOM.config)
    replayer.hear(b"of another")
    agent.tick(0.0)
    sent = {out.data for out in replayer.send(agent, agent.outbox(), 0.0)}
    assert b"of another" in sent and len(sent) == 2
    agent.tick(5.0)
    again = replayer.send(agent, agent.outbox(), 5.0)
    assert len(again) > 10 and sent & {out.data for out in again}


def test_a_fork_is_cut_on_every_robot() -> None:
    few = msgspec.structs.replace(ROOM.sensor, points=20)
    mission, _ = played(room("forker", 1, seconds=8.0, sensor=few))
    liar = mission.fleet.robots["forker00"].author
    cuts = {robot.agent.ledger.chain(liar).cut for robot in mission.honest}
    assert len(cuts) == 1 and cuts != {None}


def test_a_forker_shows_no_robot_both_halves() -> None:
    """Only the others can tell a robot of the half that it was not sent."""
    forker, whom = make_liar("forker", 0), [bytes([i]) * 8 for i in (1, 2, 3)]
    agent = Agent(Identity.from_seed(bytes(32)), ROOM.config)
    for name in whom:
        agent.sync.peers[name] = Peer()
    agent.observe(Cycle(stamp=0.0, pose=np.eye(4), points=np.ones((5, 3))), 0.0)
    agent.tick(5.0)
    sent = [
        (out.to, transaction.parse(data, agent.config))
        for out in forker.send(agent, agent.outbox(), 5.0)
        for parsed in [messages.parse(out.data, agent.config)[1]]
        if isinstance(parsed, Transactions)
        for data in parsed.data
    ]
    assert sorted(to or b"" for to, _ in sent) == whom
    assert len({tx.id for _, tx in sent}) == 2 and len({tx.sequence for _, tx in sent}) == 1


def test_a_back_dater_comes_before_what_others_hold() -> None:
    few = msgspec.structs.replace(ROOM.sensor, points=20)
    early = []

    def on_event(robot: Robot, happening: Happening) -> None:
        tx = robot.agent.ledger.find(happening.id) if isinstance(happening, Accepted) else None
        liar = mission.fleet.robots["back-dater00"]
        if tx is not None and robot.honest and tx.author == liar.author:
            early.append(max(other.lamport for other in robot.agent.ledger) - tx.lamport)

    mission = Mission(room("back-dater", 1, seconds=8.0, sensor=few), 1, on_event=on_event)
    assert mission.run().agreed
    assert len(early) >= 12 and min(early) >= 2


def test_a_flood_stays_within_the_waiting_room() -> None:
    few = msgspec.structs.replace(ROOM.sensor, points=10)
    ledger = msgspec.structs.replace(ROOM.config.ledger, waiting_transactions=50)
    config = msgspec.structs.replace(ROOM.config, ledger=ledger)
    scenario = msgspec.structs.replace(
        room("flooder", 1, seconds=6.0, sensor=few, link=Link(loss=0.3)), config=config
    )
    assert attempt(scenario, 5) is None


def test_an_unknown_liar_is_refused() -> None:
    with pytest.raises(ConfigError, match="'thief' is unknown; one of .*forger"):
        make_liar("thief", 0)
