"""Closed fleets: certificates before anything else, and revocations that spread like transactions.

Strangers are refused on every path, at the cost of one look-up or one signature; what counts stays
a pure function of the set, whatever order it arrives in.
"""

from __future__ import annotations

import itertools
import random
from dataclasses import replace
from functools import lru_cache

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dagmap.transaction
from chains import CONFIG, FLEET_KEY, Author, anchor, closed, enrolled, identity
from dagmap import Agent, Config, ConfigError, Cycle
from dagmap.identity import certificate_holds
from dagmap.messages import Head, Heads, Transactions, Want, encode
from dagmap.messages import parse as parse_message
from dagmap.model import Accepted, Event, Forked, Reason, Rejected, Revoked, Waiting
from dagmap.payload import Payload, Revocation, encode_payload
from dagmap.transaction import Transaction, id_of, parse, seal
from dagmap.wire import Refusal
from scene import QUICK

CLOSED = closed()
MAPPING = closed(QUICK)
ROUNDS = itertools.count()
WALL = np.random.default_rng(0).uniform([2, -1, -1], [2, 1, 1], (60, 3))


def hear(agent: Agent, *txs: Transaction | bytes, now: float = 0.0) -> list[Event]:
    data = tuple(tx if isinstance(tx, bytes) else tx.data for tx in txs)
    return agent.receive(encode(Transactions(data), agent.config, b"somebody"), now)


def listener(config: Config = CLOSED) -> Agent:
    return Agent(enrolled("listener", config), config)


def reason(data: bytes, config: Config = CLOSED) -> Reason:
    with pytest.raises(Refusal) as caught:
        parse(data, config)
    return caught.value.reason


def first(name: str, payload: Payload, config: Config = CLOSED) -> bytes:
    return seal(identity(name), config, 0, None, 1, (), payload)


# Certificates


def test_a_closed_fleet_has_an_id_of_its_own() -> None:
    ids = {CONFIG.fleet_id, CLOSED.fleet_id, closed(key="another").fleet_id}
    ids.add(msgspec.structs.replace(CLOSED, fleet="other").fleet_id)
    assert len(ids) == 4 and not CONFIG.closed and CLOSED.closed


@pytest.mark.parametrize("key", ["ab", "g" * 64, "A" * 64, "a" * 64 + "\n", "a" * 66])
def test_a_fleet_key_is_64_digits(key: str) -> None:
    with pytest.raises(ConfigError, match="fleet_key = .* 64 lower case hexadecimal digits"):
        Config(fleet_key=key)


def test_a_robot_is_judged_by_its_first_transaction_and_named_by_it() -> None:
    agent, robot = listener(), Author("drone 7", CLOSED)
    events = hear(agent, robot.make(), robot.make())
    assert [type(event) for event in events] == [Accepted, Accepted]
    assert [author.name for author in agent.consensus.authors.values()] == ["drone 7"]
    assert robot.chain[0].payload.robot == "drone 7"


def test_a_certificate_binds_fleet_key_fleet_robot_and_name() -> None:
    robot, fleet = enrolled("a", CLOSED), identity(FLEET_KEY).public_key
    good = (robot.certificate, fleet, CLOSED.fleet_id, robot.public_key)
    assert certificate_holds(*good)
    other = identity("b").public_key
    for i, wrong in enumerate((b"b" + good[0][1:], other, CONFIG.fleet_id, other)):
        assert not certificate_holds(*good[:i], wrong, *good[i + 1 :])
    assert not certificate_holds(b"", *good[1:]) and not certificate_holds(good[0][1:], *good[1:])


@pytest.mark.parametrize("name", ["", "x" * 65, "ä" * 33, "a\nb"])
def test_names_that_no_certificate_can_hold(name: str) -> None:
    with pytest.raises(ValueError, match="1 to 64 bytes of printable"):
        identity(FLEET_KEY).certify(CLOSED.fleet_id, bytes(32), name)


def test_strangers_are_refused() -> None:
    stolen = enrolled("honest", CLOSED).certificate
    foreign = closed(key="another fleet")
    theirs = enrolled("stranger", foreign, "another fleet").certificate
    forged = enrolled("stranger", CLOSED, "stranger").certificate
    for certificate in (None, stolen, theirs, forged):
        payload = Payload(certificate=certificate, anchors=(anchor(0),))
        assert reason(first("stranger", payload)) is Reason.CERTIFICATE


def test_a_stolen_key_and_certificate_without_the_private_key_sign_nothing() -> None:
    honest = Author("honest", CLOSED).make()
    forged = bytearray(honest.data)
    forged[-1] ^= 1
    assert reason(bytes(forged)) is Reason.SIGNATURE


def test_where_certificates_and_names_may_stand() -> None:
    robot = enrolled("a", CLOSED)
    mine = Payload(certificate=robot.certificate)
    assert parse(first("a", mine), CLOSED).payload.robot == "a"
    later = seal(robot, CLOSED, 1, bytes(32), 2, (), mine)
    assert reason(later) is Reason.STRUCTURE
    assert reason(first("a", replace(mine, name="a"))) is Reason.STRUCTURE
    assert reason(seal(robot, CLOSED, 1, bytes(32), 2, (), Payload(name="b"))) is Reason.STRUCTURE
    assert reason(first("a", mine, CONFIG), CONFIG) is Reason.STRUCTURE  # an open fleet has none
    record = encode_payload(mine)
    twice = seal_records("a", record + record)
    assert reason(twice) is Reason.MALFORMED
    behind = seal_records("a", encode_payload(Payload(anchors=(anchor(0),))) + record)
    assert reason(behind) is Reason.CERTIFICATE


def seal_records(name: str, records: bytes) -> bytes:
    """A first transaction with exactly these bytes as payload."""
    import unittest.mock

    with unittest.mock.patch("dagmap.transaction.encode_payload", return_value=records):
        return first(name, Payload())


@pytest.fixture
def checks(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """How often the costly functions are called."""
    calls = {"_work_holds": 0, "signature_holds": 0, "decode_payload": 0}
    for module, name in [
        (dagmap.transaction, "_work_holds"),
        (dagmap.transaction, "signature_holds"),
        (dagmap.identity, "signature_holds"),
        (dagmap.transaction, "decode_payload"),
    ]:
        real = getattr(module, name)

        def counted(*args: object, _real: object = real, _name: str = name) -> object:
            calls[_name] = calls.get(_name, 0) + 1
            return _real(*args)  # type: ignore[operator]

        monkeypatch.setattr(module, name, counted)
    certificate_holds.cache_clear()
    return calls


def test_a_strangers_flood_costs_a_hash_or_one_signature(checks: dict[str, int]) -> None:
    agent, liar = listener(), identity("liar")
    ids = [bytes([n]) * 32 for n in range(1, 21)]
    flood = [seal(liar, CLOSED, n, id_, n + 1, (), Payload()) for n, id_ in enumerate(ids, 1)]
    checks.update(dict.fromkeys(checks, 0))
    for n, data in enumerate(flood, 1):
        (event,) = hear(agent, data)
        assert isinstance(event, Waiting) and event.missing == (bytes([n]) * 32,)
    assert checks.pop("_work_holds") == 20 and not any(checks.values())
    assert not agent.ledger.missing()  # nothing kept, nothing asked
    stolen = enrolled("honest", CLOSED).certificate
    for n in range(20):
        data = first("liar", Payload(certificate=stolen, anchors=(anchor(n),)))
        (event,) = hear(agent, data)
        assert isinstance(event, Rejected) and event.reason is Reason.CERTIFICATE
        assert event.fault == liar.author
    assert checks["signature_holds"] <= 20 and checks["decode_payload"] == 0
    hear(agent, first("liar", Payload(anchors=(anchor(0),))))
    assert checks["signature_holds"] <= 20, "no certificate at all: not even a signature"
    honest = Author("honest", CLOSED).make()
    checks.update(dict.fromkeys(checks, 0))
    for n in range(20):  # the true certificate, shown again and again by somebody else
        (event,) = hear(agent, honest.data[:-2] + bytes([n, 255]))
        assert isinstance(event, Rejected) and event.reason is Reason.SIGNATURE
    assert checks["signature_holds"] <= 21 and checks["decode_payload"] == 0


def test_what_a_certified_robot_refers_to_is_looked_at() -> None:
    """Else a transaction could wait for ever for one whose author's first nobody announces."""
    agent, gone, friend = listener(), Author("gone", CLOSED), Author("friend", CLOSED)
    early, late = gone.make(), gone.make()
    answer = friend.make(late)
    hear(agent, Author(FLEET_KEY, CLOSED).revoke(0, gone))
    assert isinstance(hear(agent, late)[0], Waiting) and not agent.ledger.holds(late.id)
    hear(agent, answer)
    assert agent.ledger.missing() == (late.id,)
    hear(agent, late)
    assert agent.ledger.missing() == (early.id,)
    hear(agent, early)
    assert answer.id in agent.ledger and agent.ledger.chain(gone.identity.author).end == 0


# Agents


def test_an_agent_needs_a_certificate_of_its_fleet() -> None:
    with pytest.raises(ConfigError, match=r"has no certificate; enroll the robot \(dagmap keys"):
        Agent(identity("a"), CLOSED)
    foreign = closed(key="another fleet")
    with pytest.raises(ConfigError, match="is not one of the fleet 'dagmap' with fleet_key"):
        Agent(enrolled("a", foreign, "another fleet"), CLOSED)
    stolen = Author("a", CLOSED).identity.certificate
    with pytest.raises(ConfigError, match="is not one of the fleet"):
        Agent(type(identity("b")).from_seed(b"b".ljust(32, b"."), stolen), CLOSED)
    with pytest.raises(ConfigError, match="name = 'b', but the certificate names the robot 'a'"):
        Agent(enrolled("a", CLOSED), msgspec.structs.replace(CLOSED, name="b"))


def test_agents_of_a_closed_fleet_map_together_and_restart() -> None:
    a, b = (Agent(enrolled(name, MAPPING), MAPPING) for name in "ab")
    log = []
    for robot in (a, b):
        for stamp in (0.0, 1.0):
            log += robot.observe(Cycle(stamp, np.eye(4), WALL + stamp), stamp)
    for giver, taker in ((a, b), (b, a)):
        for out in giver.outbox():
            log += taker.receive(out.data, 1.0)
    assert a.digest() == b.digest() and len(a.map) and a.robots.keys() == {"a", "b"}
    assert not [event for event in log if isinstance(event, Rejected)]
    again = Agent.restore(a.identity, MAPPING, [tx.data for tx in a.ledger])
    assert again.digest() == a.digest() and not again.outbox()
    again.observe(Cycle(5.0, np.eye(4), WALL, session=1), 5.0)
    own = again.ledger.chain(a.identity.author).main
    assert len(own) == 3 and own[2].payload.certificate is None
    for out in again.outbox():
        b.receive(out.data, 5.0)
    assert again.digest() == b.digest()


def exchange(
    agents: list[Agent], rng: random.Random, loss: float, steps: int, start: int = 0
) -> None:
    """Ticks and messages, each lost with a chance, the others in any order."""
    posts: list[tuple[Agent, bytes]] = []
    for step in range(start, start + steps):
        for agent in agents:
            agent.tick(0.5 * step)
            for out in agent.outbox():
                others = [o for o in agents if o is not agent]
                takers = [o for o in others if out.to in (None, o.identity.author)]
                posts += [(taker, out.data) for taker in takers if rng.random() >= loss]
        rng.shuffle(posts)
        late = len(posts) // 3
        for taker, data in posts[late:]:
            taker.receive(data, 0.5 * step)
        posts = posts[:late]


def until_they_agree(agents: list[Agent], rng: random.Random, loss: float) -> None:
    """With lost questions and answers it can take a while."""
    for start in range(0, 400, 40):
        exchange(agents, rng, loss, 40, start)
        if counted(agents[0]) == counted(agents[1]) == counted(agents[2]):
            break


@pytest.mark.parametrize("seed", range(4))
def test_loss_and_reordering_are_repaired(seed: int) -> None:
    rng = random.Random(seed)
    agents = [Agent(enrolled(name, MAPPING), MAPPING) for name in "abc"]
    for stamp in range(4):
        for i, agent in enumerate(agents):
            agent.observe(Cycle(float(stamp), np.eye(4), WALL + 3 * i + stamp), float(stamp))
    posts = [(o, out.data) for a in agents for out in a.outbox() for o in agents if o is not a]
    rng.shuffle(posts)
    for taker, data in posts:
        if rng.random() < 0.5:
            taker.receive(data, 4.0)
    lengths = [len(agent.ledger.chain(agent.identity.author).main) for agent in agents]
    assert min(lengths) > 2
    fleet, lengths[2] = Author(FLEET_KEY, MAPPING), 2
    revocation = fleet.revoke(2, Author("c", MAPPING))
    assert any(isinstance(event, Revoked) for event in agents[1].take(revocation.data))
    until_they_agree(agents, rng, 0.4)
    assert len({agent.digest() for agent in agents}) == 1
    for robot, length in zip(agents, lengths, strict=True):
        assert {agent.ledger.chain(robot.identity.author).end for agent in agents} == {length}


# Revocations


def test_only_the_fleet_key_revokes_and_it_does_nothing_else() -> None:
    robot, fleet = Author("a", CLOSED), Author(FLEET_KEY, CLOSED)
    own = Payload(certificate=robot.identity.certificate)
    word = (Revocation(b"whoever!", 3),)
    assert reason(first("a", replace(own, revocations=word))) is Reason.STRUCTURE
    assert reason(first("a", Payload(revocations=word), CONFIG), CONFIG) is Reason.STRUCTURE
    me = Revocation(fleet.identity.author, 0)
    for payload in (
        Payload(),
        Payload(anchors=(anchor(0),)),
        Payload(anchors=(anchor(0),), revocations=word),
        Payload(certificate=own.certificate, revocations=word),
        Payload(revocations=(me,)),
    ):
        assert reason(first(FLEET_KEY, payload)) is Reason.STRUCTURE
    assert parse(fleet.revoke(3, robot).data, CLOSED).payload.revocations[0].count == 3


def test_a_revoked_robot_counts_up_to_its_number_and_is_refused_beyond() -> None:
    agent, robot, fleet = listener(), Author("gone", CLOSED), Author(FLEET_KEY, CLOSED)
    chain = [robot.make() for _ in range(4)]
    hear(agent, *chain)
    before = agent.digest()
    events = hear(agent, fleet.revoke(2, robot))
    assert Revoked(robot.identity.author, 2) in events
    assert agent.ledger.chain(robot.identity.author).end == 2 and agent.digest() != before
    only = listener()
    hear(only, *chain[:2])
    assert agent.digest() == only.digest()
    (event,) = hear(agent, robot.make())
    assert isinstance(event, Rejected) and event.reason is Reason.REVOKED
    assert event.fault == robot.identity.author
    assert Revoked(robot.identity.author, 1) in hear(agent, fleet.revoke(1, robot))
    assert not [e for e in hear(agent, fleet.revoke(3, robot)) if isinstance(e, Revoked)]
    assert agent.ledger.chain(robot.identity.author).end == 1


def test_a_robot_that_learns_of_its_revocation_stops() -> None:
    agent, fleet = Agent(enrolled("gone", CLOSED), CLOSED), Author(FLEET_KEY, CLOSED)
    agent.observe(Cycle(0.0, np.eye(4), WALL), 0.0)
    assert agent.outbox()
    tx = fleet.revoke(9, Author("gone", CLOSED))
    assert agent.take(tx.data)[0] == Revoked(agent.identity.author, 9)
    assert not agent.observe(Cycle(1.0, np.eye(4), WALL + 1), 1.0)
    assert not [e for e in agent.tick(9.0) if isinstance(e, Accepted)]
    again = Agent.restore(agent.identity, CLOSED, [tx.data for tx in agent.ledger])
    assert not again.observe(Cycle(1.0, np.eye(4), WALL, session=1), 1.0)


def test_a_fork_of_the_fleet_key_takes_its_revocations_back_on_every_robot() -> None:
    """Its chain is cut like any other: else the two halves of a fleet would differ for ever."""
    robot, fleet = Author("a", CLOSED), Author(FLEET_KEY, CLOSED)
    chain = [robot.make() for _ in range(3)]
    one = fleet.revoke(2, robot)
    left, right = fleet.revoke(1, robot, keep=False), fleet.revoke(0, robot, keep=False)
    for order in (
        [*chain, one, left, right],
        [one, right, left, *chain],
        [right, *chain, one, left],
    ):
        agent = listener()
        events = [event for tx in order for event in hear(agent, tx)]
        assert any(isinstance(e, Forked) and e.author == fleet.identity.author for e in events)
        hear(agent, *chain)
        assert agent.ledger.chain(robot.identity.author).end == 2
        only = listener()
        hear(only, *chain[:2])
        assert agent.digest() == only.digest()
    lifted = listener()
    other = fleet.revoke(1, robot, after=[])
    events = hear(lifted, *chain, one, other, *chain)
    assert Revoked(robot.identity.author, None) in events
    only = listener()
    hear(only, *chain)
    assert lifted.digest() == only.digest()


@lru_cache(maxsize=16)
def world(seed: int) -> tuple[list[Transaction], Agent, list[bytes]]:
    """Transactions, and a robot that was repaired until it held them all with what it stored.

    Robots that refer to each other; one forks; some are revoked, one of them twice."""
    rng = random.Random(seed)
    robots = [Author(name, CLOSED) for name in "abcd"]
    fleet, out = Author(FLEET_KEY, CLOSED), []
    for _ in range(16):
        robot = rng.choice(robots)
        others = [r.chain[-1] for r in robots if r is not robot and r.chain]
        out.append(robot.make(*others[: rng.randint(0, 2)]))
    forker = max(robots, key=lambda r: len(r.chain))
    at = rng.randrange(len(forker.chain))
    branch = forker.chain[:at]
    for _ in range(2):
        branch.append(forker.make(features=2, after=branch))
    witness = Author("witness", CLOSED).make(branch[-1])
    out += [*branch[at:], witness]
    for robot in rng.sample(robots, 2):
        out.append(fleet.revoke(rng.randint(0, 4), robot))
    out.append(fleet.revoke(rng.randint(0, 4), forker))
    if seed % 3 == 0:  # the fleet key itself forks
        out.append(fleet.revoke(0, robots[0], after=fleet.chain[: rng.randint(1, 2)]))
    return out, *repaired(out, rng)


def repaired(order: list[Transaction], rng: random.Random) -> tuple[Agent, list[bytes]]:
    """What was not kept, and what is missing, comes again in any order until nothing changes.

    Returns the robot and what a store would hold of it.
    """
    agent, log = listener(), []
    for _ in range(60):
        before = (len(agent.ledger), agent.ledger.missing(), ends(agent))
        for tx in order:
            log += [event.data for event in hear(agent, tx) if isinstance(event, Accepted)]
            if rng.random() < 0.2:
                agent.consensus.advance(rng.choice([None, 1, 5]))
        if before == (len(agent.ledger), agent.ledger.missing(), ends(agent)):
            return agent, log
        order = list(order)
        rng.shuffle(order)
    raise AssertionError("no end of repair")


def ends(agent: Agent) -> dict[bytes, tuple[int, int | None, int | None]]:
    chains = agent.ledger.chains.items()
    return {a: (c.end, c.cut, c.revoked) for a, c in chains if c.main or c.cut is not None}


def counted(agent: Agent) -> set[bytes]:
    return {tx.id for tx in agent.ledger if agent.ledger.counts(tx)}


@given(rng=st.randoms(use_true_random=False), seed=st.integers(0, 11))
@settings(max_examples=40, deadline=None)
def test_any_order_of_revocations_and_forks_ends_with_one_digest(
    rng: random.Random, seed: int
) -> None:
    transactions, truth, _ = world(seed)
    order = [*transactions, *rng.choices(transactions, k=4)]
    rng.shuffle(order)
    agent, log = repaired(order, rng)
    assert counted(agent) == counted(truth)
    assert agent.digest() == truth.digest()
    again = Agent.restore(agent.identity, CLOSED, log)
    assert counted(again) == counted(truth) and again.digest() == truth.digest()
    witness = next(tx for tx in transactions if tx.author == identity("witness").author)
    assert witness.id in agent.ledger, "an honest robot's own transaction is never lost"


@pytest.mark.parametrize("seed", range(12))
def test_robots_that_hold_different_parts_of_it_agree_by_asking(seed: int) -> None:
    transactions, rng = world(seed)[0], random.Random(seed)
    agents = [Agent(enrolled(name, CLOSED), CLOSED) for name in "xyz"]
    posts = [(agent, tx) for tx in transactions for agent in rng.sample(agents, rng.randint(1, 3))]
    rng.shuffle(posts)
    for agent, tx in posts:
        hear(agent, tx)
    until_they_agree(agents, rng, 0.3)
    assert counted(agents[0])
    assert counted(agents[0]) == counted(agents[1]) == counted(agents[2])
    assert len({agent.digest() for agent in agents}) == 1


def questions(agent: Agent, *heads: Head) -> list[Want]:
    """What a robot asks a neighbour that announces these heads, and in the ten seconds after."""
    agent.outbox()
    start = 100.0 * next(ROUNDS)  # later than every question before
    agent.receive(encode(Heads(1, (), heads), agent.config, b"neighbor"), start)
    for step in range(20):
        agent.tick(start + 0.5 * step)
    messages = [parse_message(out.data, agent.config)[1] for out in agent.outbox()]
    return [message for message in messages if isinstance(message, Want)]


def test_a_fork_beyond_a_revocation_is_not_asked_about() -> None:
    agent, robot, fleet = listener(), Author("a", CLOSED), Author(FLEET_KEY, CLOSED)
    chain = [robot.make() for _ in range(2)]
    left, right = list(chain), list(chain)
    for branch, size in ((left, 1), (right, 2)):
        for _ in range(3):
            branch.append(robot.make(features=size, after=branch))
    hear(agent, *left, right[4])
    assert agent.ledger.chain(robot.identity.author).cut == 4
    assert questions(agent) == [Want((), (right[3].id,))] * 10
    hear(agent, fleet.revoke(2, robot))
    assert not questions(agent)


def test_what_a_revoked_robot_went_on_to_say_is_not_asked_for() -> None:
    robot, fleet = Author("a", CLOSED), Author(FLEET_KEY, CLOSED)
    chain, me = [robot.make() for _ in range(4)], robot.identity.author
    agent = listener()
    hear(agent, *chain[:2])
    assert questions(agent, Head(me, 9, b"whatever"))[0] == Want(((me, 2, 9),))
    hear(agent, fleet.revoke(3, robot))
    assert questions(agent, Head(me, 9, b"whatever"))[0] == Want(((me, 2, 3),))
    hear(agent, chain[2])
    assert not questions(agent, Head(me, 9, b"whatever"))
    late = listener()
    hear(late, *chain)
    assert questions(late, Head(me, 4, b"whatever"))[0] == Want(((me, 3, 4),))
    hear(late, fleet.chain[0])
    assert not questions(late, Head(me, 4, b"whatever"))


def test_proofs_are_asked_for_where_they_can_be_judged() -> None:
    agent, robot = listener(), Author("a", CLOSED)
    me = robot.identity.author
    assert not questions(agent, Head(me, 0, bytes(8), 5))
    assert questions(agent, Head(me, 0, bytes(8), 0))[0] == Want((), (), (me,))
    hear(agent, robot.make())
    assert questions(agent, Head(me, 1, robot.chain[0].id[:8], 5))[0] == Want((), (), (me,))


def test_a_stored_proof_is_known_again_after_a_restart() -> None:
    """It was stored while the author's first transaction still waited for another."""
    agent, robot, friend = listener(), Author("a", CLOSED), Author("friend", CLOSED)
    first_one = robot.make(friend.make())
    left, right = robot.make(keep=False), robot.make(features=1, keep=False)
    events = hear(agent, first_one, left, right)
    assert Forked(robot.identity.author, 1) in events
    log = [event.data for event in events if isinstance(event, Accepted)]
    assert log == [left.data, right.data]
    again = Agent.restore(agent.identity, CLOSED, log)
    assert again.ledger.chain(robot.identity.author).cut == 1


def test_what_a_fork_of_the_fleet_key_frees_is_folded_once() -> None:
    robot, fleet = Author("a", CLOSED), Author(FLEET_KEY, CLOSED)
    chain = [robot.make() for _ in range(2)]
    one = fleet.revoke(1, robot, keep=False)
    other = fleet.revoke(0, Author("b", CLOSED), keep=False)
    chain.append(robot.make(other))
    agent, only = listener(), listener()
    hear(agent, *chain, one)  # the last of the chain waits for the other branch
    events = hear(agent, other)
    assert Revoked(robot.identity.author, None) in events
    hear(only, other, *chain)
    assert chain[2].id in agent.ledger and chain[2].id in only.ledger
    assert len(list(agent.consensus.contributions())) == 3
    assert agent.digest() == only.digest()


def test_the_door_shows_the_id_of_what_is_not_kept() -> None:
    tx = Author("a", CLOSED)
    tx.make()
    second = tx.make()
    assert hear(listener(), second) == [Waiting(id_of(second.data), (tx.chain[0].id,))]
