"""A checkpoint saves the time of a fold and changes nothing; one that does not fit is not used."""

from __future__ import annotations

import random
from dataclasses import replace

import msgspec
import pytest

import scene
from dagmap import Agent
from dagmap import checkpoint as checkpoints
from dagmap.messages import Transactions, encode
from dagmap.model import Accepted, Rejected, TransactionId

Stored = dict[TransactionId, bytes]


def fleet_transactions(robots: int = 3, seed: int = 0) -> Stored:
    """What three robots said, in an order in which one could have heard it."""
    agents = [scene.agent(f"robot {i}") for i in range(robots)]
    streams = [list(scene.cycles(seed + i)) for i in range(robots)]
    stored: Stored = {}
    for k in range(len(streams[0])):
        for agent, stream in zip(agents, streams, strict=True):
            for event in agent.observe(stream[k], now=float(k)):
                if isinstance(event, Accepted):
                    stored[event.id] = event.data
            sent = [out.data for out in agent.outbox()]
            for other in agents:
                if other is not agent:
                    for data in sent:
                        other.receive(data, now=float(k))
                    other.outbox()
    return stored


def listener(data: list[bytes], checkpoint: bytes | None = None) -> Agent:
    identity = scene.agent("listener").identity
    return Agent.restore(identity, scene.QUICK, data, checkpoint=checkpoint)


@pytest.fixture(scope="module")
def stored() -> Stored:
    return fleet_transactions()


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 1.0])
def test_a_restart_from_a_checkpoint_is_a_restart(stored: Stored, share: float) -> None:
    ids, data = list(stored), list(stored.values())
    held = round(share * len(ids))
    checkpoint = listener(data[:held]).checkpoint(ids[:held])
    plain, quick = listener(data), listener(data, checkpoint)
    assert quick.digest() == plain.digest()
    assert len(quick.map) == len(plain.map) > 0
    assert list(quick.ledger.chains) == list(plain.ledger.chains)


def test_what_comes_after_a_checkpoint_may_sort_before_it(stored: Stored) -> None:
    """The undo records are in it, and the ray evidence."""
    ids, data = list(stored), list(stored.values())
    early = [id_ for i, id_ in enumerate(ids) if i % 3]  # one robot was never heard
    agent = listener([stored[id_] for id_ in early])
    quick = listener([stored[id_] for id_ in early], agent.checkpoint(early))
    late = [message_of(item) for id_, item in stored.items() if id_ not in early]
    random.Random(4).shuffle(late)
    for message in late:
        assert not any(isinstance(e, Rejected) for e in agent.receive(message, now=1.0))
        quick.receive(message, now=1.0)
    assert late and agent.digest() == quick.digest() == listener(data).digest()


def message_of(data: bytes) -> bytes:
    return encode(Transactions((data,)), scene.QUICK, bytes(8))


def test_the_robot_goes_on_with_its_own_chain() -> None:
    cycles = list(scene.cycles(3, count=8))
    agent = scene.agent("robot")
    said: Stored = {}
    for cycle in cycles[:5]:
        events = agent.observe(cycle, now=cycle.stamp)
        said |= {event.id: event.data for event in events if isinstance(event, Accepted)}
    checkpoint = agent.checkpoint(list(said))
    again = Agent.restore(agent.identity, agent.config, said.values(), checkpoint=checkpoint)
    for cycle in cycles[5:]:
        anew = replace(cycle, session=1, moved=None, removed=None)
        again.observe(anew, now=cycle.stamp)
    chain = again.ledger.chain(agent.identity.author)
    assert chain.cut is None and len(chain.main) > len(said)
    assert [tx.sequence for tx in chain.main] == list(range(len(chain.main)))


@pytest.mark.parametrize("damage", ["byte", "short", "empty", "version", "config", "store", "key"])
def test_one_that_does_not_fit_is_not_used(
    stored: Stored, damage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ids, data = list(stored), list(stored.values())
    checkpoint = listener(data).checkpoint(ids)
    identity, config, found = scene.agent("listener").identity, scene.QUICK, dict(stored)
    assert checkpoints.load(checkpoint, identity, config, found) is not None
    if damage == "byte":
        checkpoint = checkpoint[:-9] + bytes([checkpoint[-9] ^ 1]) + checkpoint[-8:]
    elif damage == "short":
        checkpoint = checkpoint[: len(checkpoint) // 2]
    elif damage == "empty":
        checkpoint = b""
    elif damage == "version":
        monkeypatch.setattr(checkpoints, "VERSION", checkpoints.VERSION + 1)
    elif damage == "config":
        fold = msgspec.structs.replace(config.fold, delta=0.06)
        config = msgspec.structs.replace(config, fold=fold)
    elif damage == "store":
        del found[ids[-1]]
    else:
        identity = scene.agent("another").identity
    assert checkpoints.load(checkpoint, identity, config, found) is None
    assert Agent.restore(identity, config, found.values(), checkpoint=checkpoint).ledger


def test_what_another_release_wrote_is_not_used(
    stored: Stored, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its fold may be another: the robot would keep another map than all others, for ever."""
    ids, data = list(stored), list(stored.values())
    checkpoint = listener(data).checkpoint(ids)
    monkeypatch.setattr(checkpoints, "__version__", "0.0.9")
    identity = scene.agent("listener").identity
    assert checkpoints.load(checkpoint, identity, scene.QUICK, dict(stored)) is None


def test_classes_that_are_gone_are_no_reason_to_fail(
    stored: Stored, monkeypatch: pytest.MonkeyPatch
) -> None:
    ids, data = list(stored), list(stored.values())
    checkpoint = listener(data).checkpoint(ids)
    monkeypatch.delattr("dagmap.ledger.Chain")
    identity = scene.agent("listener").identity
    assert checkpoints.load(checkpoint, identity, scene.QUICK, dict(stored)) is None


def test_what_was_never_stored_does_not_come_back() -> None:
    """The disk refused a transaction, then took the checkpoint: nobody was told of the first."""
    agent = scene.agent("robot")
    said: Stored = {}
    for cycle in scene.cycles(3, count=8):
        events = agent.observe(cycle, now=cycle.stamp)
        said |= {event.id: event.data for event in events if isinstance(event, Accepted)}
    assert len(agent.ledger) == len(said) > 1
    said.popitem()
    checkpoint = agent.checkpoint(list(said))
    again = Agent.restore(agent.identity, agent.config, said.values(), checkpoint=checkpoint)
    assert [tx.id for tx in again.ledger] == list(said)
