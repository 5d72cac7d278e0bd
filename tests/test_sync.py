"""Spreading, repair and the late joiner: robots that can reach each other end with one ledger."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from dagmap import Agent, Cycle
from dagmap.messages import Head, Heads, Transactions, Want, encode, parse
from scene import agent, cycles, pose

Carries = Callable[[str, str], bool]


class Radio:
    """Carries outboxes between named agents; `carries` says who hears whom now."""

    def __init__(self, *names: str) -> None:
        self.agents: dict[str, Agent] = {name: agent(name) for name in names}
        self.address = {a.identity.author: name for name, a in self.agents.items()}
        self.bytes = 0
        self.log: list[object] = []

    def exchange(self, now: float, carries: Carries = lambda a, b: True) -> None:
        """Everything in the outboxes arrives at once, and the answers, until all is quiet."""
        while any(posts := {name: a.outbox() for name, a in self.agents.items()}.values()):
            for sender, outgoing in zip(list(self.agents), posts, strict=True):
                for out in outgoing:
                    self.bytes += len(out.data)
                    self.log.append(parse(out.data, self.agents[sender].config)[1])
                    for name in self.agents:
                        wanted = out.to is None or self.address[out.to] == name
                        if wanted and name != sender and carries(sender, name):
                            self.agents[name].receive(out.data, now)

    def pass_time(self, start: float, seconds: float, carries: Carries = lambda a, b: True) -> None:
        for step in range(int(seconds / 0.5)):
            now = start + 0.5 * step
            for a in self.agents.values():
                a.tick(now)
            self.exchange(now, carries)

    def digests(self) -> set[bytes]:
        return {a.digest() for a in self.agents.values()}


def mapped(radio: Radio, carries: Carries = lambda a, b: True) -> Radio:
    for i, a in enumerate(radio.agents.values()):
        for cycle in cycles(i, count=4):
            a.observe(cycle, cycle.stamp)
            radio.exchange(cycle.stamp, carries)
    return radio


def test_robots_that_hear_each_other_agree_at_once() -> None:
    radio = mapped(Radio("a", "b", "c"))
    assert len(radio.digests()) == 1


def test_lost_messages_are_repaired() -> None:
    rng = random.Random(5)

    def lossy(a: str, b: str) -> bool:
        return rng.random() > 0.5

    radio = mapped(Radio("a", "b", "c"), lossy)
    assert len(radio.digests()) == 3
    radio.pass_time(10.0, 20.0, lossy)
    assert len(radio.digests()) == 1


def test_robots_that_never_meet_agree_through_the_one_between() -> None:
    def chain(a: str, b: str) -> bool:
        return abs(ord(a) - ord(b)) == 1

    radio = mapped(Radio("a", "b", "c", "d"), chain)
    radio.pass_time(10.0, 10.0, chain)
    assert len(radio.digests()) == 1
    assert len(radio.agents["d"].ledger) == len(radio.agents["a"].ledger) > 8


def test_two_groups_that_mapped_apart_become_one() -> None:
    def split(a: str, b: str) -> bool:
        return (a in "ab") == (b in "ab")

    radio = mapped(Radio("a", "b", "c", "d"), split)
    assert len(radio.digests()) == 2
    radio.pass_time(10.0, 5.0)
    assert len(radio.digests()) == 1


def test_a_newcomer_copies_the_map_from_one_neighbour() -> None:
    radio = mapped(Radio("a", "b"))
    size = sum(len(tx.data) for tx in radio.agents["a"].ledger)
    late = agent("late")
    radio.agents["late"] = late
    radio.address[late.identity.author] = "late"
    radio.bytes, radio.log = 0, []
    radio.pass_time(10.0, 4.0, lambda a, b: {a, b} == {"late", "a"})
    assert late.digest() == radio.agents["a"].digest()
    sent = [m for m in radio.log if isinstance(m, Transactions)]
    assert sum(len(data) for m in sent for data in m.data) == size  # nothing came twice


def test_answers_come_in_chunks_and_the_asker_asks_on() -> None:
    import msgspec

    from dagmap.config import SyncConfig
    from scene import QUICK

    small = msgspec.structs.replace(QUICK, sync=SyncConfig(chunk_bytes=1 << 16))
    giver, taker = agent("giver", small), agent("taker", small)
    for cycle in cycles(1, count=80, points=280, churn=False):
        giver.observe(cycle, cycle.stamp)
    giver.outbox()
    radio = Radio()
    radio.agents = {"giver": giver, "taker": taker}
    radio.address = {a.identity.author: name for name, a in radio.agents.items()}
    radio.pass_time(100.0, 1.0)
    assert taker.digest() == giver.digest()
    wants = [m for m in radio.log if isinstance(m, Want)]
    assert len(wants) >= 2 and any(m.more for m in radio.log if isinstance(m, Transactions))


def test_an_answer_that_is_coming_in_is_not_asked_for_again() -> None:
    giver, taker = agent("giver"), agent("taker")
    for cycle in cycles(1):
        giver.observe(cycle, cycle.stamp)
    giver.tick(9.0)
    chain = [tx.data for tx in giver.ledger]
    taker.tick(0.0)
    taker.receive(giver.outbox()[-1].data, 0.0)  # the announcement

    def asked(now: float, unread: bool = False) -> list[Want]:
        taker.tick(now, unread)
        said = (parse(out.data, taker.config)[1] for out in taker.outbox())
        return [message for message in said if isinstance(message, Want)]

    me, them = giver.identity.author, taker.config
    patience = them.sync.retry_period
    assert asked(0.1) == [Want(((me, 0, len(chain)),))]
    for i in range(3):  # slowly: each part takes nearly as long as an answer may
        now = 0.9 * patience * (i + 1)
        taker.receive(encode(Transactions((chain[i],)), them, me), now)
        assert asked(now + 0.05) == []
    now += patience + 0.05
    assert asked(now, unread=True) == []  # it may be what was not read yet
    rest = [Want(((me, 3, len(chain)),))]
    assert asked(now) == rest  # it was lost
    assert asked(now + 0.9 * patience) == []
    assert asked(now + 100 * patience, unread=True) == rest  # a flood does not stop repair


def test_repair_of_a_gap_asks_for_the_gap_only() -> None:
    giver, taker = agent("giver"), agent("taker")
    sent = []
    for cycle in cycles(1, count=9, churn=False):
        giver.observe(cycle, cycle.stamp)
        sent += giver.outbox()
    for out in sent[:3] + sent[5:]:
        taker.receive(out.data, 9.0)
    giver.tick(10.0)
    for out in giver.outbox():
        taker.receive(out.data, 10.0)
    want = [parse(o.data, taker.config)[1] for o in taker.outbox()][-1]
    assert want == Want(((giver.identity.author, 3, 5),))


def test_heads_of_strangers_cost_one_bounded_question() -> None:
    from dagmap.messages import Head, encode

    robot = agent("a")
    lie = Heads(1, (), (Head(b"nobody!!", 1 << 40, b"x" * 8),))
    for i in range(50):
        robot.receive(encode(lie, robot.config, b"liar1234"), 0.01 * i)
    assert len(robot.outbox()) == 1


@pytest.mark.parametrize(("names", "rate"), [(1, 400), (300, 300), (1000, 300)])
def test_false_promises_in_many_names_do_not_keep_a_newcomer_out(names: int, rate: int) -> None:
    """Announcements are not signed: anybody may promise what no one has, and first."""
    holder, newcomer = mapped(Radio("holder")).agents["holder"], agent("newcomer")
    me, config = holder.identity.author, holder.config
    while holder.holds_back:
        holder.tick(5.0)
    holder.outbox()
    liars = [random.Random(i).randbytes(8) for i in range(names)]
    false = (Head(me, 1 << 39, bytes(8)),)
    now, said = 10.0, 0
    while len(newcomer.ledger) < len(holder.ledger):
        now += 0.01
        while said < (now - 10.0) * rate:
            said += 1
            liar = liars[said % names]
            newcomer.receive(encode(Heads(said, (), false), config, liar), now)
        for giver, taker in ((holder, newcomer), (newcomer, holder)):
            giver.tick(now)
            for out in giver.outbox():
                if out.to in (None, taker.identity.author):
                    taker.receive(out.data, now)
        assert now < 40.0, (len(newcomer.ledger), len(holder.ledger))


def test_delay_is_measured_by_echoed_tokens() -> None:
    a, b = agent("a"), agent("b")
    now = 0.0
    for _ in range(6):
        for sender, receiver in ((a, b), (b, a)):
            sender.tick(now)
            posts = sender.outbox()
            now += 0.3  # on the way
            for out in posts:
                receiver.receive(out.data, now)
            now += 0.9  # held
    assert abs(a.sync.peers[b.identity.author].delay - 0.3) < 0.01


def test_a_fork_is_known_and_cut_everywhere() -> None:
    radio = mapped(Radio("a", "b", "c"), lambda a, b: {a, b} != {"a", "c"} or a == "c")
    twin = agent("a")  # the same key on a second robot: two branches from number 0 on
    for cycle in cycles(9, count=3):
        twin.observe(cycle, cycle.stamp)
    for out in twin.outbox():
        radio.agents["c"].receive(out.data, 20.0)
    radio.pass_time(21.0, 12.0)
    assert len(radio.digests()) == 1
    liar = twin.identity.author
    for a in radio.agents.values():
        assert a.ledger.chain(liar).cut == 0
    forked = radio.agents["a"]
    assert forked.identity.author == liar
    assert not forked.observe(Cycle(99.0, pose(), [[2.0, 0, 0]] * 20), 99.0)
    assert not forked.outbox()
