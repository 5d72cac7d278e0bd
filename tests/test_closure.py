"""What changes the past: loop closures, withdrawal, late transactions. The map before is served
meanwhile, each call does a bounded part, and the end is the fold from scratch."""

from __future__ import annotations

import random
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chains import CONFIG, Author, anchor
from dagmap import Agent, Config, Cycle, Identity, MapChanged
from dagmap.config import IssuanceConfig, LedgerConfig
from dagmap.consensus import Consensus
from dagmap.folded import TRANSACTION, Folded
from dagmap.messages import Transactions, encode
from dagmap.metrics import nearest, thin
from dagmap.model import FrameId
from dagmap.observing import _MOST_RETRACTED, _REARRANGED
from dagmap.payload import Payload
from dagmap.sim.scene import Scene, SceneConfig
from dagmap.sim.sensor import SensorConfig
from dagmap.sim.walk import MotionConfig
from dagmap.worldmap import WorldMap
from scene import QUICK, agent, cycles, pose, secret
from test_promise import from_scratch

NOTHING = np.zeros((0, 3))


def bounded(units: int, config: Config = QUICK) -> Config:
    return msgspec.structs.replace(config, ledger=LedgerConfig(fold_per_tick=units))


def walked(config: Config, name: str = "a", count: int = 12) -> Agent:
    """A robot that has walked past the wall, and folded what it saw."""
    robot = agent(name, config)
    for cycle in cycles(3, count, churn=False):
        robot.observe(cycle, cycle.stamp)
    robot.settle()
    robot.outbox()
    return robot


def closing(count: int, shift: float = 0.5) -> Cycle:
    """A loop closure that moves all of the walk."""
    poses = np.stack([pose(shift + 0.1 * i, 0.2 * i - 0.5) for i in range(count)])
    return Cycle(1000.0, np.eye(4), NOTHING, moved=(np.arange(count, dtype=float), poses))


def same(one: WorldMap, other: WorldMap) -> bool:
    return one.states.tolist() == other.states.tolist() and np.array_equal(
        one.positions, other.positions
    )


def afresh(robot: Agent) -> Agent:
    """What another robot makes of the same transactions."""
    identity = Identity.from_seed(secret("afresh"))
    return Agent.restore(identity, robot.config, [tx.data for tx in robot.ledger])


class TestTheMapBefore:
    def test_is_served_until_the_revision_is_over(self) -> None:
        robot = walked(bounded(300))
        before = robot.map
        robot.observe(closing(12), 1000.0)
        reads = 0
        while not robot.settled:
            events = robot.tick(1001.0)
            changed = any(isinstance(event, MapChanged) for event in events)
            assert changed == robot.settled
            reads += not robot.settled
            assert (robot.map is before) == (not robot.settled)
        assert reads > 5
        assert robot.map.diff(before).added.size and robot.digest() == afresh(robot).digest()

    @pytest.mark.parametrize("ticks", [1, 2, 8])
    def test_is_kept_even_where_nobody_had_read_it(self, ticks: int) -> None:
        robot, other = walked(bounded(300)), walked(bounded(300))
        before = other.map
        robot.observe(closing(12), 1000.0)
        for _ in range(ticks):
            robot.tick(1001.0)
        assert not robot.settled
        assert same(robot.map, before) and robot.map is robot.map
        seen = [robot.map.provenance(i) for i in range(len(before))]
        assert [len(s) for s in seen] == [len(before.provenance(i)) for i in range(len(before))]

    def test_costs_no_copy_where_it_was_read_or_the_revision_is_short(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("dagmap.consensus.Copying", None)  # a copy would raise
        robot = walked(bounded(300))
        assert len(robot.map)
        robot.observe(closing(12), 1000.0)
        robot.tick(1001.0)
        assert not robot.settled
        short = walked(bounded(100_000), "b")
        short.observe(closing(12), 1000.0)
        short.tick(1001.0)
        assert short.settled

    def test_a_read_settles_what_is_short_and_does_nothing_in_a_long_revision(self) -> None:
        robot = walked(bounded(100_000))
        before = robot.map
        robot.observe(closing(12), 1000.0)
        assert robot.map is not before and robot.settled
        slow = walked(bounded(300))
        slow.observe(closing(12), 1000.0)
        assert len(slow.map) and not slow.settled
        left = len(slow.consensus.folded.applied)
        assert slow.map is slow.map and len(slow.consensus.folded.applied) == left

    def test_of_a_robot_that_had_none_is_empty(self) -> None:
        config = msgspec.structs.replace(bounded(60), start_pose=None)
        robot = walked(bounded(60))
        stranger = agent("stranger", config)
        for tx in robot.ledger:
            stranger.receive(encode(Transactions((tx.data,)), config, b"somebody"), 0.0)
        stranger.settle()
        robot.observe(closing(12), 1000.0)
        for out in robot.outbox():
            stranger.receive(out.data, 1.0)
        stranger.tick(2.0)
        assert not stranger.settled and len(stranger.map) == 0


class TestWork:
    @given(st.integers(1, 600), st.integers(0, 29))
    @settings(max_examples=30, deadline=None)
    def test_of_a_call_is_bounded_in_counted_units(self, budget: int, at: int) -> None:
        author, other, consensus = Author("a"), Author("b"), Consensus(CONFIG)
        for _ in range(30):
            consensus.add(author.make())
        consensus.advance()
        consensus.add(other.make(lamport=1))
        consensus.add(author.make(payload=Payload(anchors=(anchor(at, 0.5),))))
        keep = FrameId(author.identity.author, 0)
        calls = 0
        while consensus.pending:
            undone, applied = consensus.advance(budget, keep)
            last = 2 * TRANSACTION  # a transaction that was begun is ended
            assert undone * TRANSACTION // 2 + applied * TRANSACTION <= budget + last
            calls += 1
        assert calls <= 2 + 30 * 200 // budget
        scratch = Consensus(CONFIG)
        for tx in [*other.chain, *author.chain]:
            tx.payload = tx.decode_again(CONFIG)
            scratch.add(tx)
        assert consensus.digest() == scratch.digest()

    def test_late_ones_one_by_one_do_not_keep_a_revision_from_its_end(self) -> None:
        author, late, consensus = Author("a"), Author("b"), Consensus(CONFIG)
        for _ in range(30):
            consensus.add(author.make())
        consensus.advance()
        ended = 0
        for i in range(200):  # each sorts before all that the others have said
            consensus.add(late.make(lamport=1 + i // 1000, after=late.chain, keep=True))
            late.chain.append(max(consensus._contributions.values(), key=_number).transaction)
            before = consensus.version
            consensus.advance(300)
            ended += consensus.version != before
        assert ended >= 10

    def test_a_thousand_late_ones_are_folded_a_few_times_not_a_thousand(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        applied = 0
        plain = Folded.apply

        def counting(self: Folded, contribution: object) -> None:
            nonlocal applied
            applied += 1
            plain(self, contribution)  # type: ignore[arg-type]

        monkeypatch.setattr(Folded, "apply", counting)
        author, late, consensus = Author("a"), Author("b"), Consensus(CONFIG)
        for _ in range(500):
            consensus.add(author.make(features=1))
        consensus.advance()
        for _ in range(1000):
            consensus.add(late.make(features=1))
            consensus.advance(2000)
        consensus.advance()
        assert applied < 60 * 1500


def _number(contribution: object) -> int:
    return contribution.transaction.sequence  # type: ignore[attr-defined]
