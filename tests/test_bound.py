"""The bound of docs/reliability.md at its edge: enrolled keys, and one liar more."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from chains import closed, enrolled, identity
from dagmap import Agent, Config, Cycle, GraphConfig, State
from dagmap.config import FoldConfig, TransactionConfig
from dagmap.messages import Transactions, encode
from dagmap.model import Event, Reason, Rejected
from dagmap.transaction import seal

OPEN = Config(
    same_origin=True,
    transaction=TransactionConfig(proof_of_work_bits=0),
    graph=GraphConfig(reference_pitch=0.25, max_parent_distance=0.75),
    fold=FoldConfig(delta=0.1, doubt=1000),  # nothing but votes counts
)
CLOSED = closed(OPEN)
WALL = np.array([[2.0, y, z] for y in np.arange(-1, 1, 0.4) for z in np.arange(-0.4, 0.5, 0.4)])
BEHIND = 1.5 * WALL  # whoever sees this looks through the wall
ELSEWHERE = WALL + np.array([0.0, 4.0, 0.0])  # where nothing is, and nobody else looks


def told(config: Config, **sayings: np.ndarray) -> tuple[Agent, list[Event]]:
    """One who has heard what each of these says it sees from where all of them stand."""
    listener, events = Agent(enrolled("listener", config), config), []
    for name, points in sayings.items():
        robot = Agent(enrolled(name, config), config)
        robot.observe(Cycle(0.0, np.eye(4), points), 0.0)
        for out in robot.outbox():
            events += listener.receive(out.data, 0.0)
    return listener, events


def crowd(kind: str, count: int, points: np.ndarray) -> dict[str, np.ndarray]:
    return {f"{kind}{i}": points for i in range(count)}


def states(robot: Agent, points: np.ndarray) -> set[State]:
    """Of the nodes at these points; each has one."""
    world = robot.map
    apart = np.linalg.norm(world.positions[None] - points[:, None], axis=2)
    assert (apart.min(axis=1) < 0.005).all()
    return {State(world.states[i]) for i in apart.argmin(axis=1)}


def witnessed_by(witnesses: int, config: Config = CLOSED) -> Config:
    fold = msgspec.structs.replace(config.fold, witnesses=witnesses)
    return msgspec.structs.replace(config, fold=fold)


@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_what_m_and_one_honest_robots_saw_survives_m_liars_and_not_one_more(m: int) -> None:
    honest = crowd("honest", m + 1, WALL)
    robot, events = told(CLOSED, **honest, **crowd("liar", m, BEHIND))
    assert not any(isinstance(event, Rejected) for event in events)
    assert states(robot, WALL) == {State.CONFIRMED}
    robot, _ = told(CLOSED, **honest, **crowd("liar", m + 1, BEHIND))
    assert states(robot, WALL) == {State.REJECTED}


@pytest.mark.parametrize("first", ["honest", "liars"])
def test_it_does_not_matter_who_speaks_first(first: str) -> None:
    honest, liars = crowd("honest", 3, WALL), crowd("liar", 2, BEHIND)
    robot, _ = told(CLOSED, **(honest | liars if first == "honest" else liars | honest))
    assert states(robot, WALL) == {State.CONFIRMED}


def test_honest_robots_that_see_through_a_place_count_against_it_too() -> None:
    """h > a + m: three saw it, one no longer does, and one liar is not enough, but two are."""
    honest = crowd("honest", 3, WALL) | crowd("later", 1, BEHIND)
    assert states(told(CLOSED, **honest, **crowd("liar", 1, BEHIND))[0], WALL) == {State.CONFIRMED}
    assert states(told(CLOSED, **honest, **crowd("liar", 2, BEHIND))[0], WALL) == {State.REJECTED}


@pytest.mark.parametrize("witnesses", [2, 3, 4])
def test_what_only_liars_say_is_confirmed_by_as_many_as_witnesses_and_not_by_fewer(
    witnesses: int,
) -> None:
    config = witnessed_by(witnesses)
    robot, _ = told(config, **crowd("liar", witnesses - 1, ELSEWHERE))
    assert states(robot, ELSEWHERE) == {State.TENTATIVE}
    robot, _ = told(config, **crowd("liar", witnesses, ELSEWHERE))
    assert states(robot, ELSEWHERE) == {State.CONFIRMED}


def another_key_of(liar: str, name: str) -> bytes:
    """What a liar said, said again by a key with a certificate that it made itself."""
    robot = Agent(enrolled(liar, CLOSED), CLOSED)
    robot.observe(Cycle(0.0, np.eye(4), ELSEWHERE), 0.0)
    [tx] = robot.ledger
    payload = replace(tx.payload, certificate=enrolled(name, CLOSED, name).certificate)
    data = seal(identity(name), CLOSED, 0, None, 1, (), payload)
    return encode(Transactions((data,)), CLOSED, b"somebody")


def test_keys_that_nobody_enrolled_do_not_count_and_in_an_open_fleet_all_do() -> None:
    """Why the bound is one of enrolled keys: one liar with another key would be two."""
    robot, _ = told(CLOSED, liar=ELSEWHERE)
    [refused] = robot.receive(another_key_of("liar", "nobody"), 0.0)
    assert isinstance(refused, Rejected) and refused.reason is Reason.CERTIFICATE
    assert states(robot, ELSEWHERE) == {State.TENTATIVE}
    robot, _ = told(OPEN, liar=ELSEWHERE, the_liar_again=ELSEWHERE)
    assert states(robot, ELSEWHERE) == {State.CONFIRMED}
