"""Order, marks and undo: what a change costs, and that it is done once."""

from __future__ import annotations

import random
from dataclasses import replace

import msgspec
import numpy as np

from chains import CONFIG, Author, anchor, bundle
from dagmap import MapChanged
from dagmap.config import LedgerConfig
from dagmap.consensus import MAX_LINKS, Consensus
from dagmap.messages import Transactions, encode
from dagmap.model import FrameId, quantise_pose
from dagmap.payload import Link, Payload
from dagmap.transaction import Transaction
from scene import QUICK, agent, cycles, pose


def filled(count: int = 6) -> tuple[Consensus, Author]:
    author, consensus = Author("a"), Consensus(CONFIG)
    for _ in range(count):
        consensus.add(author.make())
    consensus.advance()
    return consensus, author


def test_in_order_nothing_is_undone() -> None:
    consensus, author = filled()
    consensus.add(author.make())
    assert consensus.advance() == (0, 1) and not consensus.pending
    assert consensus.advance() == (0, 0)


def test_a_retraction_goes_back_to_the_feature_and_no_further() -> None:
    consensus, author = filled(6)
    consensus.add(author.make(payload=Payload(retracted=np.array([9], np.int64))))
    undone, applied = consensus.advance()
    assert (undone, applied) == (3, 4)  # feature 9 stands in the transaction with number 3


def test_a_moved_anchor_goes_back_to_its_first_use() -> None:
    consensus, author = filled(6)
    before = consensus.digest()
    consensus.add(author.make(payload=Payload(anchors=(anchor(4, 0.5),))))
    assert consensus.advance() == (2, 3)
    assert consensus.digest() != before
    consensus.add(author.make(payload=Payload(anchors=(anchor(4, 0.5),))))
    assert consensus.advance() == (0, 1)  # the same pose again moves nothing


def test_what_is_retracted_leaves_no_ray_either() -> None:
    consensus, author = filled(1)
    fresh = Consensus(CONFIG)
    other = Author("a")
    numbers = np.arange(3)
    consensus.add(author.make(payload=Payload(retracted=numbers)))
    fresh.add(other.make(payload=Payload(anchors=(anchor(0),), bundle=bundle(0, 3, 0))))
    fresh.add(other.make(payload=Payload(retracted=numbers)))
    assert consensus.digest() == fresh.digest()
    component = next(iter(consensus.folded.components.values()))
    passes, ends = component.rays.evidence(np.array([[0, 40, 80]], np.int32))
    assert passes.sum() == 0 and ends.sum() == 0


def test_a_tick_folds_a_bounded_share_and_a_read_the_rest() -> None:
    slow = msgspec.structs.replace(QUICK, ledger=LedgerConfig(fold_per_tick=50))
    giver, taker = agent("giver"), agent("taker", slow)
    for cycle in cycles(1, count=10, churn=False):
        giver.observe(cycle, cycle.stamp)
    for tx in giver.ledger:
        taker.receive(encode(Transactions((tx.data,)), slow, b"somebody"), 0.0)
    ticks = [e for n in range(3) for e in taker.tick(float(n)) if isinstance(e, MapChanged)]
    assert len(ticks) == 3 and all(0 < e.applied <= 3 for e in ticks)
    assert taker.consensus.pending and taker.digest() == giver.digest()


def test_a_robot_that_folds_seldom_does_what_came_at_once() -> None:
    seldom = msgspec.structs.replace(QUICK, ledger=LedgerConfig(fold_period=10.0))
    giver, taker = agent("giver"), agent("taker", seldom)
    for cycle in cycles(1, count=10, churn=False):
        giver.observe(cycle, cycle.stamp)
    first, *rest = giver.ledger
    folded = []
    for now, found in ((0.0, [first]), (4.0, rest[::2]), (8.0, rest[1::2]), (10.0, [])):
        for tx in found:
            taker.receive(encode(Transactions((tx.data,)), seldom, b"somebody"), now)
        changes = [e for e in taker.tick(now) if isinstance(e, MapChanged)]
        folded.append([(e.undone, e.applied) for e in changes])
        assert taker.settled is (now in (0.0, 10.0))
    assert folded == [[(0, 1)], [], [], [(0, len(rest))]]
    assert taker.digest() == giver.digest()


def shown(author: Author, sessions: int) -> None:
    """Something was seen in so many SLAM frames of an author."""
    for session in range(sessions):
        seen = replace(anchor(session), session=session)
        author.make(payload=Payload(anchors=(seen,), bundle=bundle(author.features, 1, session)))
        author.features += 1


def link(source: Author, target: Author, session: int, x: float) -> Link:
    here, there = FrameId(source.identity.author), FrameId(target.identity.author, session)
    return Link(here, there, quantise_pose(pose(x)), 50)


def in_any_order(chains: list[list[Transaction]], rng: random.Random) -> Consensus:
    """What comes of the chains, each in its order, as the network happens to mix them."""
    consensus, left = Consensus(CONFIG), [list(chain) for chain in chains]
    for tx in (tx for chain in left for tx in chain):
        tx.payload = tx.decode_again(CONFIG)
    while any(left):
        chain = rng.choice([chain for chain in left if chain])
        consensus.add(chain.pop(0))
        if rng.random() < 0.1:
            consensus.advance()
    consensus.advance()
    return consensus


def test_ever_new_frames_of_a_liar_use_up_no_room_for_those_of_others() -> None:
    """A liar shows copied keyframes in one session after the other, and is linked to in each."""
    ann, bob, liar = Author("ann"), Author("bob"), Author("liar")
    shown(ann, 1)
    shown(bob, 1)
    shown(liar, 256)
    links = tuple(link(ann, liar, session, 5.0) for session in range(256))
    for part in range(0, 256, 64):
        ann.make(payload=Payload(links=links[part : part + 64]))
    ann.make(payload=Payload(links=(link(ann, bob, 0, 3.0),)))
    bob.make(payload=Payload(links=(link(bob, ann, 0, -3.0),)))
    liar.make(payload=Payload(links=(link(liar, ann, 0, -5.0),)))
    frames = FrameId(ann.identity.author), FrameId(bob.identity.author)
    digests = set()
    for seed in range(4):
        consensus = in_any_order([ann.chain, bob.chain, liar.chain], random.Random(seed))
        origins = {consensus.frames[frame][0] for frame in frames}
        x = [int(consensus.frames[frame][1][4]) for frame in frames]
        assert len(origins) == 1 and abs(x[0] - x[1]) == 3000
        digests.add(consensus.digest())
        assert sum(frame.author == liar.identity.author for frame in consensus.frames) <= MAX_LINKS
    assert len(digests) == 1


def test_a_link_to_a_frame_in_which_nothing_was_seen_does_not_count_yet() -> None:
    ann, bob = Author("ann"), Author("bob")
    shown(ann, 1)
    ann.make(payload=Payload(links=(link(ann, bob, 0, 3.0), link(ann, bob, 7, 3.0))))
    early = in_any_order([ann.chain], random.Random(0))
    assert early.frames == {}
    shown(bob, 1)
    for tx in bob.chain:
        tx.payload = tx.decode_again(CONFIG)
        early.add(tx)
    early.advance()
    assert set(early.frames) == {FrameId(a.identity.author) for a in (ann, bob)}
    late = in_any_order([bob.chain, ann.chain], random.Random(1))
    assert early.digest() == late.digest()
