"""The promises that a run is watched for can be seen broken: what is bent is named.

That witnesses are miscounted is planted in the tests of the sweep.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from dagmap import Agent, Config
from dagmap.config import GraphConfig, TransactionConfig
from dagmap.consensus import Consensus
from dagmap.graph import AdjacencyDag
from dagmap.messages import Head
from dagmap.sim.invariants import Invariants, Violation
from dagmap.sim.mission import Mission
from dagmap.sim.robot import Robot
from dagmap.sim.scenario import Scenario
from dagmap.sim.sensor import SensorConfig
from dagmap.sync import Peer

SMALL = Scenario(
    robots=3,
    seconds=3.0,
    sensor=SensorConfig(points=16, tracked=0.4),
    config=Config(
        same_origin=True,
        transaction=TransactionConfig(proof_of_work_bits=0),
        graph=GraphConfig(reference_pitch=0.25, max_parent_distance=0.75),
    ),
)
Bend = Callable[[Robot], None]
Lie = Callable[[AdjacencyDag], object]


@pytest.fixture
def watched() -> tuple[Mission, Invariants]:
    """A fleet that agrees, and who watched it all the while."""
    invariants = Invariants()
    mission = Mission(SMALL, 1, on_event=invariants.saw, check=invariants)
    invariants.fleet = mission.fleet
    assert mission.play() is not None
    invariants.at_the_end(mission.honest)
    return mission, invariants


def chain_of(robot: Robot) -> list:
    return robot.agent.ledger.chain(robot.author).main


def forget(robot: Robot) -> None:
    del chain_of(robot)[-1]


def leave_out_a_number(robot: Robot) -> None:
    last = chain_of(robot)[-1]
    chain_of(robot).append(replace(last, sequence=last.sequence + 2, previous=last.id))


def hang_on_another(robot: Robot) -> None:
    last = chain_of(robot)[-1]
    chain_of(robot).append(replace(last, sequence=last.sequence + 1, previous=bytes(32)))


def refer_to_nothing(robot: Robot) -> None:
    last = chain_of(robot)[-1]
    lost = replace(last, sequence=last.sequence + 1, previous=last.id, references=(bytes(32),))
    chain_of(robot).append(lost)


def date_early(robot: Robot) -> None:
    last = chain_of(robot)[-1]
    chain_of(robot).append(replace(last, sequence=last.sequence + 1, previous=last.id, lamport=1))


def sign_wrongly(robot: Robot) -> None:
    last = chain_of(robot)[-1]
    numbers = {"sequence": last.sequence + 1, "previous": last.id, "references": ()}
    data = last.data[:-64] + bytes(64)
    chain_of(robot).append(
        replace(last, **numbers, lamport=last.lamport + 1, id=bytes(32), data=data)
    )


def raise_n_c(robot: Robot) -> None:
    robot.agent.steering.controller.n_c = robot.agent.config.graph.n_c_max + 1


def wait_for_nothing(robot: Robot) -> None:
    robot.agent.ledger._waited_for[bytes(32)] = [bytes(32)]


def many_peers(robot: Robot) -> None:
    for number in range(257):
        robot.agent.sync.peers[number.to_bytes(8, "big")] = Peer()


def many_heads(robot: Robot) -> None:
    names = [number.to_bytes(8, "big") for number in range(1801)]
    robot.agent.sync.peers[b"somebody"] = Peer({name: Head(name, 1, bytes(8)) for name in names})


def many_tokens(robot: Robot) -> None:
    robot.agent.sync._sent_at.update(dict.fromkeys(range(-65, 0), 0.0))


def many_ids(robot: Robot) -> None:
    for number in range(1 << 17):
        robot.agent.sync._asked_ids[number.to_bytes(32, "big")] = 0.0


def many_questions(robot: Robot) -> None:
    for number in range(3601):
        robot.agent.sync._asked[number.to_bytes(8, "big")] = None  # type: ignore[assignment]


LEDGER: list[tuple[Bend, str]] = [
    (forget, "a transaction was forgotten"),
    (leave_out_a_number, "a chain is broken"),
    (hang_on_another, "a chain is broken"),
    (refer_to_nothing, "a reference is unknown"),
    (date_early, "a Lamport time is false"),
    (sign_wrongly, "a signature is false"),
    (raise_n_c, "N_c is too large"),
    (wait_for_nothing, "memory"),
    (many_peers, "memory"),
    (many_heads, "memory"),
    (many_tokens, "memory"),
    (many_ids, "memory"),
    (many_questions, "memory"),
]


@pytest.mark.parametrize(
    ("bend", "promise"), LEDGER, ids=lambda bend: getattr(bend, "__name__", "")
)
def test_what_is_bent_is_named(
    watched: tuple[Mission, Invariants], bend: Bend, promise: str
) -> None:
    mission, invariants = watched
    robot = mission.honest[1]
    invariants(robot)  # nothing is wrong yet
    bend(robot)
    with pytest.raises(Violation, match=f"^{promise}: r01 at ") as broken:
        invariants(robot)
    assert broken.value.name == promise


def second_child(graph: AdjacencyDag) -> np.ndarray:
    """All features but the first are children of the first."""
    parents = np.full((len(graph), 2), -1)
    parents[1:, 0] = 0
    return parents


GRAPH: list[tuple[dict[str, Lie], str]] = [
    ({"parents": lambda g: np.arange(len(g))[:, None].repeat(2, 1)}, "the graph has a cycle"),
    ({"children_count": lambda g: np.full(len(g), 9)}, "children are miscounted"),
    (
        {
            "parents": second_child,
            "children_count": lambda g: np.bincount([0], minlength=len(g)) * (len(g) - 1),
        },
        "too many children",
    ),
    ({"terminals": lambda g: np.arange(1)}, "E is wrong"),
    ({"validity": lambda g: np.arange(len(g)) + 7}, "validity"),
]


@pytest.mark.parametrize(("lies", "promise"), GRAPH, ids=[promise for _, promise in GRAPH])
def test_a_bent_graph_is_named(
    watched: tuple[Mission, Invariants],
    monkeypatch: pytest.MonkeyPatch,
    lies: dict[str, Lie],
    promise: str,
) -> None:
    mission, invariants = watched
    for name, lie in lies.items():
        monkeypatch.setattr(AdjacencyDag, name, lie)
    invariants._grown.add("r01")
    with pytest.raises(Violation, match=f"^{promise}: r01"):
        invariants(mission.honest[1])


def issue_more(robot: Robot) -> None:
    robot.own.add(bytes(32))


def cut_an_honest_one(robot: Robot) -> None:
    robot.agent.ledger.chain(robot.author).cut = 99


def fold_less(robot: Robot) -> None:
    robot.agent.consensus = Consensus(robot.agent.config)


def withdraw(robot: Robot) -> None:
    robot.withdrawn.add(0)


ENDS: list[tuple[int, Bend, str]] = [
    (0, issue_more, "a transaction was forgotten"),
    (0, cut_an_honest_one, "an honest robot was cut"),
    (0, fold_less, "the fold is not that of the set"),
    (1, fold_less, "the maps differ"),
    (1, withdraw, "a retraction was lost"),
]


@pytest.mark.parametrize(
    ("who", "bend", "promise"), ENDS, ids=[f"{e[1].__name__}{e[0]}" for e in ENDS]
)
def test_what_is_wrong_at_the_end_is_named(
    watched: tuple[Mission, Invariants], who: int, bend: Bend, promise: str
) -> None:
    mission, invariants = watched
    bend(mission.honest[who])
    with pytest.raises(Violation, match=f"^{promise}: "):
        invariants.at_the_end(mission.honest)


def test_what_others_hold_and_a_restart_has_lost_is_named(
    watched: tuple[Mission, Invariants],
) -> None:
    mission, invariants = watched
    robot = mission.honest[1]
    robot.disk._safe.remove(chain_of(robot)[-1].data)
    robot.restart(mission.fleet.now, mission.fleet._parsers)
    with pytest.raises(Violation, match="^a restart lost what others hold: r01"):
        invariants(robot)


def test_every_so_many_changes_of_a_map_it_is_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """With 1 every map that a robot ever holds."""
    looked: list[str] = []

    def look(self: Invariants, agent: Agent) -> None:
        looked.append(agent.config.name)

    monkeypatch.setattr(Invariants, "_witnesses", look)
    monkeypatch.setattr(Invariants, "_fold", lambda *_: None)  # it looks, too, now and then
    counts = []
    for changes in (1, 3):
        looked.clear()
        invariants = Invariants(changes)
        mission = Mission(SMALL, 1, on_event=invariants.saw, check=invariants)
        invariants.fleet = mission.fleet
        assert mission.play() is not None
        counts.append(Counter(looked))
    assert min(counts[0].values()) >= 3 and len(counts[0]) == 3
    assert counts[1] == {name: count // 3 for name, count in counts[0].items()}


def test_events_without_end_within_a_second_are_named(
    watched: tuple[Mission, Invariants],
) -> None:
    mission, invariants = watched

    def storm() -> None:
        for _ in range(4001):
            invariants(mission.honest[1])

    with pytest.raises(Violation, match="^a storm: r01"):
        storm()
