"""Signed by a valid key and hostile all the same: in open mode anybody may sign.

Each of these once raised, cost too much, or drove honest robots apart.
"""

from __future__ import annotations

import zlib

import msgspec
import numpy as np
import pytest

from chains import CONFIG, Author, bundle, identity
from dagmap import Agent, Cycle
from dagmap.config import IssuanceConfig, OverheadConfig
from dagmap.messages import Head, Heads, Transactions, Want, encode
from dagmap.messages import parse as parse_message
from dagmap.model import (
    FLEET_FRAME,
    Accepted,
    CycleError,
    Forked,
    FrameId,
    Reason,
    Rejected,
    quantise_pose,
)
from dagmap.payload import Anchor, Bundle, Link, Payload
from dagmap.transaction import Transaction, parse, seal

P = quantise_pose(np.eye(4))
EMPTY = np.zeros((0, 3))


def rx(agent: Agent, *txs: Transaction) -> list:
    data = tuple(tx.data for tx in txs)
    return agent.receive(encode(Transactions(data), CONFIG, b"somebody"), 0.0)


def test_a_session_per_feature_costs_no_map_per_feature():
    n, liar = 1000, Author("liar")
    agent = Agent(identity("me"), CONFIG)
    anchors = tuple(Anchor(c, c, 0, P) for c in range(n))
    plain = np.zeros((n, 3), np.int32), np.full((n, 2), -1, np.int64), np.zeros((n, 3), np.uint8)
    rest = np.arange(n + 1), np.arange(n), np.zeros(n, np.uint8)
    rx(agent, liar.make(payload=Payload(anchors=anchors, bundle=Bundle(0, *plain, *rest))))
    agent.tick(0.0)
    assert agent.consensus.nbytes < 20 * n * 200, agent.consensus.nbytes / 1e6
    tx = liar.make(payload=Payload(bundle=Bundle(n, *plain, *rest)))
    rx(agent, tx)
    agent.tick(0.0)
    assert agent.consensus.nbytes < 20 * n * 200, agent.consensus.nbytes / 1e6


def test_false_heads_cost_bounded_memory():
    agent = Agent(identity("me"), CONFIG)
    for k in range(10):
        heads = tuple(Head((3300 * k + i).to_bytes(8, "big"), 5, b"x" * 8) for i in range(3300))
        agent.receive(encode(Heads(1, (), heads), CONFIG, b"somebody"), float(k))
    held = len(agent.sync._asked) + sum(len(p.heads) for p in agent.sync.peers.values())
    assert held <= 2 * 4096, held


def test_a_message_of_many_nothings_costs_one_refusal():
    agent = Agent(identity("me"), CONFIG)
    head = encode(Transactions(()), CONFIG, b"somebody")[:28]
    data = head + b"\0" + b"\0" * 59_900
    events = agent.receive(data + zlib.crc32(data).to_bytes(4, "little"), 0.0)
    assert [type(event) for event in events] == [Rejected]


def test_what_follows_one_that_nobody_could_accept_is_left_unread():
    agent, honest, liar = Agent(identity("me"), CONFIG), Author("honest"), Author("liar")
    good, bad = honest.make(), Author("other").make()
    forged = bad.data[:-1] + bytes([bad.data[-1] ^ 1])
    items = (forged, good.data)
    events = agent.receive(encode(Transactions(items), CONFIG, b"somebody"), 0.0)
    assert [type(event) for event in events] == [Rejected] and good.id not in agent.ledger
    # What an honest robot may hold, that has not heard of a fork yet, keeps nobody from the rest.
    first = liar.make()
    twin = Author("liar").make(payload=Payload(name="twin"))
    rx(agent, first, twin)
    late = Author("liar")
    late.chain.append(first)
    rx(agent, late.make(), good)
    assert good.id in agent.ledger


def test_a_question_that_asks_for_the_same_twice_is_refused():
    agent = Agent(identity("me"), CONFIG)
    me = agent.identity.author
    for want in (
        Want(((me, 0, 9), (me, 0, 9))),
        Want((), (bytes(32),) * 2),
        Want((), (), (me, me)),
    ):
        events = agent.receive(encode(want, CONFIG, b"somebody"), 0.0)
        assert [event.reason for event in events] == [Reason.MALFORMED]
        assert agent.outbox() == []


def test_questions_that_a_cap_holds_back_are_bounded():
    capped = msgspec.structs.replace(CONFIG, overhead=OverheadConfig(robot_bytes_per_second=5e4))
    agent = Agent(identity("me"), capped)
    agent.tick(0.0)
    for k in range(200):  # forks that nobody has heard of, all to be asked for
        forks = (Head((500 * k + i).to_bytes(8, "big"), 2, bytes(8), 0) for i in range(500))
        agent.receive(encode(Heads(k, (), tuple(forks)), capped, b"somebody"), 0.001 * k)
    assert sum(map(len, agent.steering.shaper._queues)) <= 64


def test_a_liar_does_not_move_two_honest_robots_apart():
    names = sorted((identity(f"n{i}").author, f"n{i}") for i in range(6))
    liar, one, two = (Author(name) for _, name in names[:3])
    agent = Agent(identity("me"), CONFIG)
    for honest in (one, two):
        frame = FrameId(honest.identity.author)
        rx(agent, honest.make(payload=Payload(links=(Link(frame, FLEET_FRAME, P, (1 << 31) - 1),))))
    agent.digest()
    before = {
        a.identity.author: agent.consensus.placement(a.identity.author, 0) for a in (one, two)
    }
    far = np.eye(4)
    far[0, 3] = 100.0
    mine = FrameId(liar.identity.author)
    rx(
        agent,
        liar.make(
            payload=Payload(
                links=tuple(
                    Link(mine, FrameId(a.identity.author), quantise_pose(p), (1 << 31) - 1)
                    for a, p in ((one, np.eye(4)), (two, far))
                )
            )
        ),
    )
    agent.digest()
    for a in (one, two):
        now = agent.consensus.placement(a.identity.author, 0)
        assert (
            now[0] == before[a.identity.author][0]
            and (now[1] == before[a.identity.author][1]).all()
        )


def test_repeating_a_retraction_undoes_nothing():
    liar, honest = Author("liar"), Author("honest")
    agent = Agent(identity("me"), CONFIG)
    rx(agent, liar.make())
    rx(agent, liar.make(payload=Payload(retracted=np.array([0])), features=0))
    for _ in range(20):
        rx(agent, honest.make())
    agent.consensus.advance()
    rx(agent, liar.make(honest.chain[-1], payload=Payload(retracted=np.array([0]))))
    undone, _ = agent.consensus.advance()
    assert undone == 0


def test_near_with_an_outlier_far_away():
    liar = Author("liar")
    agent = Agent(identity("me"), CONFIG)
    place = np.array([[0, 0, 0], [1 << 29, 1 << 29, 0], [-(1 << 29), -(1 << 29), 0]], np.int32)
    bundle = Bundle(
        0,
        place,
        np.full((3, 2), -1, np.int64),
        np.zeros((3, 3), np.uint8),
        np.array([0, 3]),
        np.array([0]),
        np.zeros(1, np.uint8),
    )
    link = Link(FrameId(liar.identity.author), FLEET_FRAME, P, 5)
    rx(
        agent,
        liar.make(payload=Payload(anchors=(Anchor(0, 0, 0, P),), bundle=bundle, links=(link,))),
    )
    assert agent.map.near([0, 0, 0], 1e5).tolist() == [0]  # MemoryError: 1.16 TiB


def test_previous_among_the_references_does_not_raise():
    liar = Author("liar")
    a = liar.make()
    b = parse(
        seal(liar.identity, CONFIG, 1, a.id, 2, (a.id,), Payload()), CONFIG
    )  # its own previous, twice
    agent = Agent(identity("me"), CONFIG)
    rx(agent, b)  # waits for a, twice
    rx(agent, a)  # a KeyError escaped Agent.receive
    assert a.id in agent.ledger and b.id not in agent.ledger


def test_too_many_children_on_a_branch_is_judged_alike():
    fork, accomplice = Author("forker"), Author("accomplice")

    def kids(base, n):
        parents = np.full((n, 2), -1, np.int64)
        parents[:, 0] = 0
        return Payload(bundle=bundle(base, n, 0, parents))

    g = fork.make(features=1)
    a1 = fork.make(features=1, keep=False)
    b1 = fork.make(payload=kids(1, 8), keep=False)
    b2 = fork.make(after=[g, b1], payload=kids(9, 1), keep=False)  # the ninth child of feature 0
    h = accomplice.make(b2)
    held = []
    for order in ([g, a1, h, b2, b1], [g, b1, h, b2, a1]):
        agent = Agent(identity("me"), CONFIG)
        for _ in range(3):
            for tx in order:
                rx(agent, tx)
        held.append(agent)
    assert (h.id in held[0].ledger) == (h.id in held[1].ledger)
    assert held[0].digest() == held[1].digest()


def test_junk_in_the_waiting_room_does_not_keep_from_asking():
    agent = Agent(identity("me"), CONFIG)
    for i in range(256):
        tx = parse(seal(identity(f"l{i}"), CONFIG, 1, bytes([i]) * 32, 3, (), Payload()), CONFIG)
        rx(agent, tx)
    fork, friend = Author("forker"), Author("friend")
    g, a1, b1 = fork.make(), fork.make(keep=False), fork.make(features=2, keep=False)
    rx(agent, g, a1, friend.make(b1))
    agent.receive(encode(Heads(1, (), ()), CONFIG, b"neighbor"), 0.0)
    asked = set()
    for step in range(100):
        agent.tick(step * 0.1)
        for out in agent.outbox():
            message = parse_message(out.data, CONFIG)[1]
            if isinstance(message, Want):
                asked |= set(message.ids)
    assert b1.id in asked


def test_a_known_fork_is_not_proven_again_and_again():
    liar = identity("liar")
    x, y = (parse(seal(liar, CONFIG, 5, b"?" * 32, 9, (), Payload(name=n)), CONFIG) for n in "xy")
    one, two = Agent(identity("p"), CONFIG), Agent(identity("q"), CONFIG)
    for agent in (one, two):
        rx(agent, x, y)
    answers = 0
    for step in range(100):
        for agent, other in ((one, two), (two, one)):
            agent.tick(step * 0.1)
            for out in agent.outbox():
                other.receive(out.data, step * 0.1)
                answers += isinstance(parse_message(out.data, CONFIG)[1], Transactions)
    assert answers == 0  # 20 in 10 s, up to 112 KB each, per pair of robots, for ever


def moved(*stamps, x=0.1):
    pose = np.eye(4)
    pose[0, 3] = x
    return list(stamps), [pose] * len(stamps)


def test_one_cycle_moved_twice_keeps_the_ids():
    agent = Agent(identity("me"), CONFIG)
    agent.observe(Cycle(0.0, np.eye(4), [[5, 0, 0], [9, 0, 0]], ids=[1, 2]), 0.0)
    with pytest.raises(CycleError, match="twice"):
        agent.observe(Cycle(1.0, np.eye(4), EMPTY, moved=moved(0.0, 0.0)), 1.0)
    agent.observe(Cycle(2.0, np.eye(4), EMPTY, removed=[1]), 2.0)  # raises with the id half gone


def test_ids_that_a_move_threw_out_can_be_removed():
    agent = Agent(identity("me"), CONFIG)
    agent.observe(Cycle(0.0, np.eye(4), [[300000.0, 0, 0], [9, 0, 0]], ids=[1, 2]), 0.0)
    agent.observe(Cycle(1.0, np.eye(4), EMPTY, moved=moved(0.0, x=400000.0)), 1.0)
    agent.observe(Cycle(2.0, np.eye(4), EMPTY, removed=[1]), 2.0)
    with pytest.raises(CycleError, match="removed before"):
        agent.observe(Cycle(3.0, np.eye(4), EMPTY, removed=[1]), 3.0)


def test_a_restored_robot_can_move_its_earlier_cycles():
    agent, log, rng = Agent(identity("me"), CONFIG), [], np.random.default_rng(1)
    for c in range(6):
        events = agent.observe(Cycle(float(c), np.eye(4), rng.normal(0, 0.05, (50, 3))), float(c))
        log += [e.data for e in events if isinstance(e, Accepted)]
    back = Agent.restore(identity("me"), CONFIG, log)
    pose = moved(2.0)
    assert any(a.stamp == 2_000_000 for t in back.ledger for a in t.payload.anchors)
    back.observe(Cycle(30.0, np.eye(4), EMPTY, moved=pose), 30.0)


def test_what_was_held_back_survives_a_new_session():
    config = msgspec.structs.replace(CONFIG, issuance=IssuanceConfig(features_per_second=100.0))
    agent = Agent(identity("me"), config)
    agent.observe(Cycle(0.0, np.eye(4), np.random.default_rng(1).normal(0, 0.05, (500, 3))), 0.0)
    assert agent.observing.issuance.waiting
    agent.observe(Cycle(1.0, np.eye(4), EMPTY, session=1), 1.0)
    for k in range(100):
        agent.tick(1.0 + k)
    assert agent.ledger.features(identity("me").author) > 0


@pytest.mark.parametrize(
    "wrong",
    [
        {"session": "a"},
        {"session": 1.5},
        {"session": None},
        {"session": float("nan")},
        {"moved": (["x"], [1])},
        {"moved": 5},
        {"moved": ([0.0],)},
        {"removed": [[1], [2, 3]]},
        {"ids": [[1], [2, 3]]},
        {"colors": [[1], [2, 3]]},
    ],
)
def test_wrong_cycles_are_cycle_errors(wrong):
    with pytest.raises(CycleError):
        Agent(identity("me"), CONFIG).observe(
            Cycle(**{"stamp": 0.0, "pose": np.eye(4), "points": [[0, 0, 0]], **wrong}), 0.0
        )


def test_a_restart_does_not_shorten_the_own_chain():
    liar, friend = Author("liar"), Author("friend")
    a0 = liar.make()
    a1, b1 = liar.make(keep=False), liar.make(features=2, keep=False)
    h = friend.make(b1)
    me, log = Agent(identity("me"), CONFIG), []

    def take(events):
        log.extend(e.data for e in events if isinstance(e, Accepted))
        return events

    # the fork is proven first, then an honest robot's transaction needs the other branch
    for tx in (a0, a1, b1, h, b1):
        take(me.receive(encode(Transactions((tx.data,)), CONFIG, b"somebody"), 0.0))
    assert h.id in me.ledger
    rng = np.random.default_rng(0)
    take(me.observe(Cycle(0.0, np.eye(4), rng.normal(0, 0.05, (50, 3))), 0.0))
    back = Agent.restore(identity("me"), CONFIG, log)

    def mine(agent: Agent) -> list:
        return [tx.id for tx in agent.ledger.chain(identity("me").author).main]

    assert h.id in back.ledger, "accepted transaction lost by the restart"
    assert mine(back) == mine(me), "the own chain is shorter: the next cycle forks it"
    take(back.observe(Cycle(1.0, np.eye(4), rng.normal(0, 0.05, (50, 3))), 1.0))
    peer = Agent(identity("peer"), CONFIG)
    for d in (*log, b1.data, *log):
        ev = peer.receive(encode(Transactions((d,)), CONFIG, b"somebody"), 0.0)
        assert not any(isinstance(e, Forked) and e.author == identity("me").author for e in ev)
