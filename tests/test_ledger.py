"""The verified set: what it accepts depends on the set, never on the order of arrival."""

from __future__ import annotations

import random
from collections import Counter

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chains import CONFIG, Author, anchor, bundle
from dagmap.config import LedgerConfig
from dagmap.kernels.ascendants import count_children
from dagmap.ledger import Ledger
from dagmap.model import Reason
from dagmap.payload import Payload, Sighting
from dagmap.transaction import Transaction


def deliver(transactions: list[Transaction]) -> Ledger:
    ledger = Ledger(CONFIG)
    for tx in transactions:
        ledger.add(tx)
    return ledger


def counted(ledger: Ledger) -> dict[bytes, list[bytes]]:
    return {
        author: [tx.id for tx in chain.main[: chain.end]]
        for author, chain in ledger.chains.items()
        if chain.end or chain.cut is not None
    }


def conversation(steps: int = 12, seed: int = 3) -> list[Transaction]:
    """Three honest robots that refer to each other's newest transactions."""
    rng = random.Random(seed)
    robots = [Author(name) for name in "abc"]
    out: list[Transaction] = []
    for _ in range(steps):
        robot = rng.choice(robots)
        others = [r.chain[-1] for r in robots if r is not robot and r.chain]
        out.append(robot.make(*others[: rng.randint(0, 2)]))
    return out


@given(st.randoms(use_true_random=False))
@settings(max_examples=60, deadline=None)
def test_any_order_and_repetition_gives_the_same_set(rng: random.Random) -> None:
    transactions = conversation()
    shuffled = transactions + rng.choices(transactions, k=5)
    rng.shuffle(shuffled)
    ledger = deliver(shuffled)
    assert counted(ledger) == counted(deliver(transactions))
    assert len(ledger) == len(transactions) and not ledger.missing()


def test_a_transaction_waits_for_what_it_refers_to() -> None:
    a, b = Author("a"), Author("b")
    first, second = a.make(), a.make()
    answer = b.make(second)
    ledger = Ledger(CONFIG)
    third = a.make()
    assert ledger.waiting_from() == {}
    assert ledger.add(answer).missing == (second.id,)
    assert ledger.add(third).missing == (second.id,)
    assert ledger.waiting_from() == {answer.author: 0, first.author: 2}
    assert ledger.add(second).missing == (first.id,)
    assert ledger.missing() == (first.id,)
    assert ledger.waiting_from() == {answer.author: 0, first.author: 1}
    accepted = [tx.id for tx in ledger.add(first).accepted]
    assert accepted[:2] == [first.id, second.id] and set(accepted[2:]) == {answer.id, third.id}
    assert ledger.waiting_from() == {}


def test_waiting_room_is_bounded_and_what_left_can_come_again() -> None:
    config = msgspec.structs.replace(CONFIG, ledger=LedgerConfig(waiting_transactions=3))
    author = Author("a")
    chain = [author.make() for _ in range(10)]
    ledger = Ledger(config)
    for tx in chain[1:]:
        ledger.add(tx)
    assert len([tx for tx in chain if ledger.holds(tx.id)]) == 3
    for tx in chain:
        ledger.add(tx)
    assert len(ledger) == 10


def refusal(tx: Transaction, *before: Transaction) -> Reason:
    outcome = deliver(list(before)).add(tx)
    assert not outcome.accepted
    return outcome.refused[0].reason


def test_lamport_time_must_follow_from_the_references() -> None:
    a, b = Author("a"), Author("b")
    far = [a.make() for _ in range(4)]
    early = b.make(far[-1], lamport=2)
    late = Author("c").make(lamport=9)
    assert refusal(early, *far) is Reason.LAMPORT
    assert refusal(late) is Reason.LAMPORT


def test_chains_cannot_be_joined_or_skipped() -> None:
    a, b = Author("a"), Author("b")
    theirs = a.make()
    stolen = b.make(after=[theirs])
    assert refusal(stolen, theirs) is Reason.CHAIN
    mine = b.make()
    twice = Author("b").make(mine, after=[mine])
    assert refusal(twice, mine) is Reason.CHAIN


@pytest.mark.parametrize(
    "payload",
    [
        Payload(anchors=(anchor(1),), bundle=bundle(7, 2, 1)),
        Payload(retracted=np.array([3], np.int64)),
        Payload(sightings=(Sighting(0, np.array([3], np.int64)),)),
    ],
    ids=["numbers skipped", "retracts the unknown", "sees the unknown"],
)
def test_feature_numbers_follow_the_chain(payload: Payload) -> None:
    author = Author("a")
    first = author.make(features=3)
    assert refusal(author.make(payload=payload), first) is Reason.CHAIN


@given(st.lists(st.lists(st.tuples(st.integers(-1, 5), st.integers(-1, 5)), max_size=6)))
def test_children_are_counted_whole_or_not_at_all(story: list[list[tuple[int, int]]]) -> None:
    children, counted = np.zeros(6, np.uint8), Counter[int]()
    for rows in story:
        after = counted + Counter(parent for row in rows for parent in row if parent >= 0)
        fits = max(after.values(), default=0) <= 4
        assert count_children(children, np.array(rows, np.int64).reshape(-1, 2), 4) == fits
        counted = after if fits else counted
        assert children.tolist() == [counted[k] for k in range(6)]


def test_children_of_issued_features_are_counted_over_transactions() -> None:
    author, most = Author("a"), CONFIG.graph.n_c_max
    first = author.make(features=1)

    def children(count: int, base: int) -> Payload:
        parents = np.array([[0, -1]] * count, np.int64)
        return Payload(anchors=(anchor(1),), bundle=bundle(base, count, 1, parents))

    second = author.make(payload=children(most - 1, 1))
    good = author.make(payload=children(1, most), keep=False)
    bad = author.make(payload=children(2, most), keep=False)
    ledger = deliver([first, second, bad])
    assert bad.id in ledger and not ledger.counts(bad)  # kept, never folded
    ledger = deliver([first, second, good])
    assert good.id in ledger and ledger.counts(good)


def test_tips_are_what_nobody_refers_to() -> None:
    a, b, c = Author("a"), Author("b"), Author("c")
    one, two = a.make(), b.make()
    ledger = deliver([one, two])
    me = c.identity.author
    assert ledger.tips(me, 2) == tuple(sorted([one.id, two.id]))
    three = c.make(one)
    ledger.add(three)
    assert ledger.tips(a.identity.author, 2) == tuple(sorted([two.id, three.id]))
    assert ledger.tips(me, 2) == (two.id,)
    assert ledger.tips(me, 0) == ()


def forked() -> tuple[list[Transaction], bytes, int]:
    """An author that signs two branches from number 2 on; an honest robot saw one of them."""
    liar, honest = Author("liar"), Author("honest")
    common = [liar.make(), liar.make()]
    left = [liar.make(), liar.make()]
    branch = list(common)
    for _ in range(3):
        branch.append(liar.make(features=2, after=branch))
    witness = honest.make(branch[3])
    return [*common, *left, *branch[2:], witness], liar.identity.author, 2


def repaired(ledger: Ledger, transactions: list[Transaction]) -> Ledger:
    """What a robot lacks it asks for by id, as sync does, until nothing is missing."""
    while lacking := set(ledger.missing()):
        for tx in transactions:
            if tx.id in lacking:
                ledger.add(tx)
    return ledger


@given(st.randoms(use_true_random=False))
@settings(max_examples=80, deadline=None)
def test_a_fork_is_cut_at_its_lowest_number_in_any_order(rng: random.Random) -> None:
    transactions, liar, cut = forked()
    order = list(transactions)
    rng.shuffle(order)
    ledger = repaired(deliver(order), transactions)
    chain = ledger.chain(liar)
    assert chain.cut == cut and chain.end == cut
    assert counted(ledger) == counted(repaired(deliver(transactions), transactions))
    assert transactions[-1].id in ledger  # the honest robot's own transaction is never lost


def test_a_fork_proof_needs_no_known_predecessor() -> None:
    liar = Author("liar")
    common = [liar.make() for _ in range(3)]
    other = liar.make(features=1, after=common[:2])
    ledger = deliver([common[2]])
    assert ledger.add(other).forked == [(liar.identity.author, 2)]
    for tx in common:
        ledger.add(tx)
    assert ledger.chain(liar.identity.author).end == 2


def test_beyond_a_fork_nothing_is_taken() -> None:
    transactions, liar, _ = forked()
    ledger = deliver(transactions[:4] + transactions[4:5])
    more = Author("liar")
    more.chain = transactions[:4]
    outcome = ledger.add(more.make())
    assert outcome.refused[0].reason is Reason.FORK
    assert outcome.refused[0].fault == liar
