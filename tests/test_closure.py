"""What changes the past: loop closures, withdrawal, late transactions. The map before is served
meanwhile, each call does a bounded part, and the end is the fold from scratch."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Literal

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chains import CONFIG, Author, anchor
from dagmap import Agent, Config, Cycle, Identity, MapChanged
from dagmap.config import IssuanceConfig, LedgerConfig
from dagmap.consensus import Consensus
from dagmap.contribution import Contribution
from dagmap.folded import TRANSACTION, Folded
from dagmap.messages import Transactions, encode
from dagmap.metrics import nearest, thin
from dagmap.model import FrameId
from dagmap.observing import _MOST_RETRACTED, REARRANGED
from dagmap.payload import Payload
from dagmap.sim.scene import Scene, SceneConfig
from dagmap.sim.sensor import SensorConfig
from dagmap.sim.walk import MotionConfig
from dagmap.worldmap import WorldMap
from scene import QUICK, agent, cycles, pose, secret
from test_promise import from_scratch

NOTHING = np.zeros((0, 3))


def bounded(units: int, config: Config = QUICK, undo_kept: int = 1_000_000) -> Config:
    ledger = LedgerConfig(fold_per_tick=units, undo_kept=undo_kept)
    return msgspec.structs.replace(config, ledger=ledger)


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
        robot, other = walked(bounded(150)), walked(bounded(150))
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


class TestLateOnes:
    def test_one_that_is_cut_and_counts_again_within_a_revision_is_folded_once(self) -> None:
        """A revocation that the fork of the fleet key takes back, while a revision goes on."""
        author, other, late, consensus = Author("a"), Author("b"), Author("c"), Consensus(CONFIG)
        for i in range(30):
            consensus.add(author.make(lamport=100 + i))
        consensus.advance()
        consensus.add(late.make(lamport=1))
        consensus.advance(600)
        assert consensus.revising and consensus._upwards
        for i in range(4):
            consensus.add(other.make(lamport=50 + i))
        consensus.cut(other.identity.author, 1)
        for tx in other.chain[1:]:
            assert tx not in consensus
            tx.payload = tx.decode_again(CONFIG)
            consensus.add(tx)
        scratch, digest = Consensus(CONFIG), consensus.digest()
        for tx in [*author.chain, *other.chain, *late.chain]:
            tx.payload = tx.decode_again(CONFIG)
            scratch.add(tx)
        assert digest == scratch.digest()

    def test_one_with_every_call_does_not_keep_a_revision_from_its_end(self) -> None:
        author, late, consensus = Author("a"), Author("b"), Consensus(CONFIG)
        for i in range(30):
            consensus.add(author.make(lamport=1000 + i))
        consensus.advance()
        ended = 0
        for _ in range(100):  # each sorts before all that the other has said
            consensus.add(late.make())
            before = consensus.version
            consensus.advance(300)
            ended += consensus.version != before
        assert ended >= 5

    def test_a_thousand_are_folded_a_few_times_not_a_thousand(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        applied = 0
        plain = Folded.apply

        def counting(self: Folded, contribution: Contribution) -> None:
            nonlocal applied
            applied += 1
            plain(self, contribution)

        author, late, consensus = Author("a"), Author("b"), Consensus(CONFIG)
        for i in range(300):
            consensus.add(author.make(features=1, lamport=2000 + i))
        consensus.advance()
        monkeypatch.setattr(Folded, "apply", counting)
        most = 0
        for _ in range(1000):
            consensus.add(late.make(features=1))
            before = applied
            consensus.advance(2000)
            most = max(most, applied - before)
        consensus.advance()
        assert most <= 2000 // TRANSACTION + 1
        assert applied < 100 * 1300  # had each been folded on its own: 300 x 1000

    def test_what_was_cut_while_a_revision_goes_up_is_gone_at_the_end(self) -> None:
        author, late, consensus = Author("a"), Author("b"), Consensus(CONFIG)
        for i in range(30):
            consensus.add(author.make(lamport=1000 + i))
        consensus.advance()
        first = late.make()
        consensus.add(first)
        while not consensus._upwards:
            consensus.advance(40)
        second = late.make()
        consensus.add(second)
        consensus.cut(late.identity.author, 1)
        assert first in consensus and second not in consensus
        consensus.add(second)
        assert second in consensus and consensus.revising
        consensus.cut(late.identity.author, 0)
        assert first not in consensus
        scratch = Consensus(CONFIG)
        for tx in author.chain:
            tx.payload = tx.decode_again(CONFIG)
            scratch.add(tx)
        assert consensus.digest() == scratch.digest()
        bricks = [
            sum(len(c.rays) for c in each.folded.components.values())
            for each in (consensus, scratch)
        ]
        assert bricks[0] == bricks[1] > 0


class TestDroppedRecords:
    """Undo records behind a checkpoint."""

    @pytest.mark.parametrize("preset", ["default", "paper"])
    def test_free_memory_and_what_comes_from_before_them_is_folded_from_the_first_on(
        self, preset: Literal["default", "paper"]
    ) -> None:
        fold = msgspec.structs.replace(QUICK.fold, preset=preset)
        config = msgspec.structs.replace(bounded(300, undo_kept=100), fold=fold)
        robot = walked(config)
        held, before = robot.consensus.nbytes, robot.map
        observations = sum(c.size for c in robot.consensus.contributions())
        robot.checkpoint([tx.id for tx in robot.ledger])
        freed = held - robot.consensus.nbytes
        assert freed >= 4 * (observations - 200) > 0  # the transaction that reaches 100 is whole
        robot.observe(closing(12), 1000.0)
        while not robot.settled:
            robot.tick(1001.0)
            assert robot.settled or robot.map is before
        assert robot.map is not before and robot.digest() == afresh(robot).digest()

    def test_leave_enough_for_what_comes_a_little_late(self) -> None:
        author, late, consensus = Author("a"), Author("b"), Consensus(bounded(300, CONFIG, 40))
        for i in range(30):
            consensus.add(author.make(lamport=1000 + i))
        consensus.advance()
        consensus.drop_records()
        firm = consensus.folded.firm
        assert 0 < firm < 30
        consensus.add(late.make(lamport=1028))
        assert consensus.advance() == (2, 3)
        consensus.add(late.make(lamport=1029))
        consensus.drop_records()
        consensus.add(late.make(lamport=1031))
        assert consensus.advance() == (1, 3)
        consensus.add(Author("c").make(lamport=1))
        assert consensus.advance() == (33, 34)  # which is all of them


@given(
    rng=st.randoms(use_true_random=False),
    units=st.sampled_from([40, 150, 700]),
    undo_kept=st.sampled_from([0, 50, 1_000_000]),
)
@settings(max_examples=25, deadline=None)
def test_moved_removed_and_late_in_any_mixture_end_as_the_fold_from_scratch(
    rng: random.Random, units: int, undo_kept: int
) -> None:
    """Two robots walk, remove and close loops; a listener gets it in any order and small steps,
    is read now and then, drops undo records, and in a revision serves the map of before."""
    config, said = bounded(units, undo_kept=undo_kept), []
    for seed in (1, 2):
        robot = agent(f"r{seed}", config)
        for cycle in cycles(seed, rng.randint(3, 8)):
            robot.observe(cycle, cycle.stamp)
        robot.observe(closing(robot.observing.cycles, rng.uniform(-0.2, 0.2)), 1000.0)
        robot.tick(1001.0)
        said += [tx.data for tx in robot.ledger]
    rng.shuffle(said)
    listener, before, version = agent("listener", config), None, -1
    while said or not listener.settled:
        if listener.settled:
            before, version = afresh(listener).map, listener.consensus.version
            if rng.random() < 0.5:
                assert same(listener.map, before)
            if rng.random() < 0.3:
                listener.consensus.drop_records()
        handful, said = said[:6], said[6:]
        listener.receive(encode(Transactions(tuple(handful)), config, b"somebody"), 0.0)
        listener.tick(1.0)
        if listener.consensus.revising and listener.consensus.version == version:
            assert before is not None and same(listener.map, before)
    data = tuple(tx.data for tx in listener.ledger)
    assert listener.digest() == from_scratch(data, config)


class TestWithdrawal:
    COUNT = 20_000

    def robot(self, config: Config) -> tuple[Agent, Cycle]:
        """A robot that has seen so many points, and the cycle that removes them all."""
        robot, rng = agent("a", config), np.random.default_rng(1)
        ids = np.arange(self.COUNT, dtype=np.uint64)
        points = rng.uniform([2, -8, -2], [3, 8, 2], (self.COUNT, 3))
        robot.observe(Cycle(0.0, np.eye(4), points, ids=ids), 0.0)
        robot.outbox()
        return robot, Cycle(1.0, np.eye(4), NOTHING, removed=ids)

    def test_of_many_issued_points_is_paced_and_nothing_is_lost(self) -> None:
        config = msgspec.structs.replace(
            QUICK,
            graph=msgspec.structs.replace(QUICK.graph, v_th=0),
            issuance=IssuanceConfig(repeats=0),
        )
        robot, gone = self.robot(config)
        assert robot.ledger.features(robot.identity.author) == self.COUNT
        calls, retracted = 0, 0
        robot.observe(gone, 1.0)
        while True:
            calls += 1
            sent = [tx for tx in robot.ledger if len(tx.payload.retracted)]
            now = sum(len(tx.payload.retracted) for tx in sent)
            assert now - retracted <= _MOST_RETRACTED
            retracted = now
            if not robot.holds_back:
                break
            robot.tick(1.0 + calls)
        assert calls == -(-self.COUNT // REARRANGED) and retracted == self.COUNT
        assert len(robot.map) == 0 and len(afresh(robot).map) == 0

    def test_of_many_points_not_issued_is_paced_in_the_graph(self) -> None:
        silent = msgspec.structs.replace(QUICK, issuance=IssuanceConfig(features_per_second=0.1))
        robot, gone = self.robot(silent)
        left, calls = self.COUNT, 0
        robot.observe(gone, 1.0)
        while True:
            calls += 1
            now = int(robot.observing.graph.alive().sum())
            assert left - now <= REARRANGED // 2
            left = now
            if not robot.observing.rearranging:
                break
            robot.tick(1.0)
        assert left == 0 and calls == -(-self.COUNT // (REARRANGED // 2))

    def test_of_a_move_takes_the_ids_along(self) -> None:
        silent = msgspec.structs.replace(QUICK, issuance=IssuanceConfig(features_per_second=0.1))
        robot, gone = self.robot(silent)
        moved = ([0.0], pose(1.0)[None])
        robot.observe(Cycle(0.5, np.eye(4), NOTHING, moved=moved), 0.5)
        graph, ticks = robot.observing.graph, 0
        while robot.observing.rearranging:
            before, ticks = len(graph), ticks + 1
            robot.tick(0.5)
            assert len(graph) - before <= REARRANGED // 3 + 1  # one cycle's, in pieces
        assert ticks > self.COUNT // REARRANGED
        node = robot.observing.node_of(7)
        assert graph.positions([node])[0][0] - graph.positions([node - self.COUNT])[0][0] == 1000
        robot.observe(gone, 1.0)
        while robot.observing.rearranging:
            robot.tick(1.0)
        assert not graph.alive().any()


def test_a_closure_of_a_hundred_cycles_is_a_message_of_four_kilobytes() -> None:
    robot, rng = agent("a"), np.random.default_rng(1)
    for i in range(100):
        points = rng.uniform([2, -1, -1], [3, 1, 1], (10, 3))
        robot.observe(Cycle(float(i), pose(0.1 * i, yaw=0.02 * i), points), float(i))
    robot.tick(200.0)
    robot.outbox()
    robot.observe(closing(100), 1000.0)
    sent = [out.data for out in robot.outbox()]
    assert len(sent) == 1 and len(sent[0]) < 4096
    assert len(next(iter(reversed(list(robot.ledger)))).payload.anchors) == 101


def test_after_its_closure_a_robot_that_drifted_has_the_map_of_one_that_did_not() -> None:
    sensor = SensorConfig(points=400, tracked=0.0, outliers=0.1)
    scene = Scene(SceneConfig(rooms=(1, 1), people=0), sensor, MotionConfig(drift=0.0), 1, 3)
    walker = scene.robot(0)
    steady, drifting = agent("steady", Config()), agent("drifting", bounded(2000, Config()))
    seen = list(walker.cycles(60.0))
    reference = thin(walker.seen().reference)

    def f_score(world: WorldMap) -> float:
        cloud = thin(world.positions[world.kept])
        precision = float((scene.distance(cloud) <= 0.05).mean())
        recall = float((nearest(reference, cloud) <= 0.05).mean())
        return 2 * precision * recall / (precision + recall)

    for i, cycle in enumerate(seen):
        steady.observe(cycle, cycle.stamp)
        off = pose(0.004 * i, -0.003 * i, 0.001 * i, 0.0008 * i)
        drifting.observe(replace(cycle, pose=off @ cycle.pose), cycle.stamp)
    drifting.settle()
    before = f_score(drifting.map)
    poses = np.stack([cycle.pose for cycle in seen])
    stamps = [cycle.stamp for cycle in seen]
    drifting.observe(Cycle(100.0, poses[-1], NOTHING, moved=(stamps, poses)), 100.0)
    drifting.tick(100.0)
    assert not drifting.settled and f_score(drifting.map) == before
    while not drifting.settled:
        drifting.tick(100.0)
    wanted = f_score(steady.map)
    assert abs(f_score(drifting.map) - wanted) <= 0.01 < wanted - before - 0.05
