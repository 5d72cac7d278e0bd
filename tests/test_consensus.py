"""Order, marks and undo: what a change costs, and that it is done once."""

from __future__ import annotations

import msgspec
import numpy as np

from chains import CONFIG, Author, anchor, bundle
from dagmap import MapChanged
from dagmap.config import LedgerConfig
from dagmap.consensus import Consensus
from dagmap.messages import Transactions, encode
from dagmap.payload import Payload
from scene import QUICK, agent, cycles


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
