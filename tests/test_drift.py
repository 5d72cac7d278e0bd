"""A robot whose SLAM drifts and closes no loop follows what others, placed already, have seen."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from dagmap import Agent, Cycle
from dagmap.bending import Look, Path, bent, borne_out, solved
from dagmap.bending import _tridiagonal as tridiagonal
from dagmap.config import PlacingConfig
from dagmap.drift import Bend, Drift
from dagmap.messages import Transactions, encode
from dagmap.model import ConfigError, CycleError, FrameId, pose_matrix, quantise_pose
from dagmap.payload import Anchor
from dagmap.registration import Views
from dagmap.sim.fleet import Fleet
from scene import QUICK, agent, pose

Points = np.ndarray
START = pose(3, -2, 1, 2.0)
FOLLOWING = PlacingConfig(units_per_tick=400, keyframe_distance=0.2, drift=0.03)
CONFIG = msgspec.structs.replace(QUICK, start_pose=None, placing=FOLLOWING)
CYCLES = 24
OFF = 0.015  # m to the side per cycle, of half a metre: 3 %


def walk(start: Points, drift: float, seed: int, count: int = CYCLES) -> list[Cycle]:
    """A robot goes along x through 1200 places and sees 120 of those near by in each cycle."""
    world = np.random.default_rng(1).uniform([-3, -3, 0], [15, 3, 3], (1200, 3))
    names = np.random.default_rng(2).integers(0, 256, (1200, 32)).astype(np.uint8)
    rng, out = np.random.default_rng(seed), []
    for i in range(count):
        true = pose(0.5 * i, 0.2 * np.sin(i), 1.0, 0.1 * np.sin(i))
        near = np.flatnonzero(np.abs(world[:, 0] - 0.5 * i) < 2.5)
        rows = rng.choice(near, 120, replace=False)
        local = (world[rows] + rng.normal(0, 0.005, (120, 3)) - true[:3, 3]) @ true[:3, :3]
        believed = pose(0, drift * max(0, i - 4), 0, 0) @ true
        out.append(Cycle(float(i), start @ believed, local, descriptors=names[rows]))
    return out


def met(drift: float, rate: float) -> dict[str, Agent]:
    """ann's poses are right, bob's drift; bob follows by `rate`, ann does not."""
    fleet = Fleet(CONFIG)
    robots = {name: fleet.join(name).agent for name in ("ann", "bob")}
    robots["ann"].observing.drift.rate = 0.0
    robots["bob"].observing.drift.rate = rate
    for _ in fleet.run({"ann": walk(np.eye(4), 0.0, 1), "bob": walk(START, drift, 2)}):
        pass
    assert robots["ann"].digest() == robots["bob"].digest()
    return robots


def errors(robots: dict[str, Agent]) -> Points:
    """(C,) m that each of bob's cycles is off in ann's frame, as ann has them."""
    ann, author = robots["ann"], robots["bob"].identity.author
    frames = ann.consensus.frames
    ends = [frames[FrameId(robots[name].identity.author)] for name in ("ann", "bob")]
    assert ends[0][0] == ends[1][0]
    into = np.linalg.inv(pose_matrix(ends[0][1])) @ pose_matrix(ends[1][1])
    anchors = ann.consensus.authors[author].anchors
    places = [(into @ pose_matrix(anchors[i].pose))[:3, 3] for i in range(CYCLES)]
    true = [np.asarray(cycle.pose)[:3, 3] for cycle in walk(np.eye(4), 0.0, 2)]
    return np.linalg.norm(np.array(places) - true, axis=1)


def corrections(robots: dict[str, Agent]) -> int:
    """Anchors that bob has published anew."""
    chain = robots["ann"].ledger.chain(robots["bob"].identity.author).main
    return sum(len(tx.payload.anchors) for tx in chain) - CYCLES


@pytest.fixture(scope="module")
def followed() -> dict[str, Agent]:
    return met(OFF, 0.03)


def test_a_path_that_drifts_is_bent_to_where_it_was(followed: dict[str, Agent]) -> None:
    as_it_was = met(OFF, 0.0)
    assert corrections(as_it_was) == 0, "nobody follows unless it is wanted"
    left, now = errors(as_it_was), errors(followed)
    assert corrections(followed) > 0
    assert np.median(now) < np.median(left) / 2 and np.median(now) < 0.01
    assert now.max() < 0.045


def test_the_frame_is_that_of_the_newest_cycle(followed: dict[str, Agent]) -> None:
    ann, bob = followed["ann"], followed["bob"]
    here = np.linalg.inv(ann.frame()) @ bob.frame() @ np.asarray(walk(START, OFF, 2)[-1].pose)
    true = np.asarray(walk(np.eye(4), 0.0, 2)[-1].pose)
    assert np.linalg.norm(here[:3, 3] - true[:3, 3]) < 0.06


def test_what_is_bent_is_a_function_of_the_transactions(followed: dict[str, Agent]) -> None:
    listener = agent("listener", CONFIG)
    for tx in list(followed["ann"].ledger)[::-1]:
        listener.receive(encode(Transactions((tx.data,)), CONFIG, bytes(8)), 0.0)
    for at in range(20):
        listener.tick(float(at))
    assert listener.digest() == followed["ann"].digest()


def test_a_path_that_is_right_stays() -> None:
    assert corrections(met(0.0, 0.03)) == 0


def test_nobody_follows_unless_it_is_wanted() -> None:
    assert PlacingConfig().drift == 0.0
    with pytest.raises(ConfigError, match="drift"):
        PlacingConfig(drift=0.5)


def anchor(cycle: int, x: float) -> Anchor:
    return Anchor(cycle, 0, cycle * 1_000_000, quantise_pose(pose(x)))


def shifted(millimetres: float) -> Points:
    out = np.eye(4)
    out[1, 3] = millimetres
    return out


def placed(anchors: list[Anchor]) -> dict[int, list[int]]:
    return {anchor.cycle: anchor.pose[4:].tolist() for anchor in anchors}


def test_what_lies_between_two_keyframes_is_carried_by_both() -> None:
    drift = Drift(FOLLOWING)
    for cycle in range(7):
        assert drift.enter(anchor(cycle, float(cycle))).pose[5] == 0
    drift.bend([Bend(1, shifted(0.0)), Bend(5, shifted(40.0))])
    assert placed(drift.take()) == {
        2: [2000, 10, 0], 3: [3000, 20, 0], 4: [4000, 30, 0], 5: [5000, 40, 0], 6: [6000, 40, 0],
    }  # fmt: skip
    assert drift.take() == [] and drift.enter(anchor(7, 7.0)).pose[5] == 40
    drift.bend([Bend(1, shifted(0.0)), Bend(5, shifted(41.0))])
    assert drift.take() == [], "a millimetre is no news"


def test_a_slam_that_corrects_itself_is_followed_and_what_was_found_is_void() -> None:
    drift = Drift(FOLLOWING)
    for cycle in range(3):
        drift.enter(anchor(cycle, float(cycle)))
    drift.bend([Bend(0, shifted(100.0))])
    drift.take()
    back = drift.follow([anchor(1, 1.5)])
    assert placed(back) == {0: [0, 0, 0], 1: [1500, 0, 0], 2: [2000, 0, 0]}
    assert drift.enter(anchor(3, 3.0)).pose[5] == 0 and np.array_equal(drift.now, np.eye(4))


def test_a_long_way_is_carried_a_little_in_every_tick() -> None:
    """An hour's cycles in one tick would take seconds."""
    drift = Drift(FOLLOWING)
    for cycle in range(1000):
        drift.enter(anchor(cycle, 0.01 * cycle))
    drift.bend([Bend(0, shifted(40.0))])
    taken = drift.take()
    assert 0 < len(taken) <= 100
    assert drift.enter(anchor(1000, 10.0)).pose[5] == 40, "what is new is right at once"
    while more := drift.take():
        assert len(more) <= 100
        taken += more
    assert [anchor.cycle for anchor in taken] == list(range(1000))
    assert {anchor.pose[5] for anchor in taken} == {40}


def test_a_correction_under_way_ends_where_the_slam_corrects_itself() -> None:
    drift = Drift(FOLLOWING)
    for cycle in range(300):
        drift.enter(anchor(cycle, 0.01 * cycle))
    drift.bend([Bend(0, shifted(40.0))])
    moved = {anchor.cycle for anchor in drift.take()}
    back = drift.follow([anchor(299, 5.0)])
    assert {anchor.cycle for anchor in back} == moved | {299}
    assert {anchor.pose[5] for anchor in back} == {0} and drift.take() == []


def done(work, *given):  # type: ignore[no-untyped-def]
    """What work in small pieces comes to."""
    return done_in(work, *given)[0]


def done_in(work, *given):  # type: ignore[no-untyped-def]
    """The same, and the units of each piece."""
    going, pieces = work(*given), []
    while True:
        try:
            pieces.append(next(going))
        except StopIteration as end:
            return end.value, pieces


def path(count: int = 8) -> Path:
    said = np.array([np.eye(4)] * count)
    said[:, 0, 3] = 500.0 * np.arange(count)
    nothing = np.zeros((0, 32), np.uint8)
    views = Views(said, [np.zeros((0, 3))] * count, [nothing] * count, 2000.0)
    return Path(list(range(count)), said, np.array([np.eye(4)] * count), views)


def look(own: int, off: float, other: int | None = None) -> Look:
    """Twenty points around a keyframe, seen `off` mm further to the side."""
    source = np.random.default_rng(own).uniform(-2000, 2000, (20, 3)) + np.array(
        [500.0 * own, 0, 0]
    )
    target = source + np.array([0.0, off, 0.0])
    return Look(own, own if other is None else other, source, target, shifted(off))


def test_drift_is_found_and_carried_on() -> None:
    looks = [look(k, 20.0 * k) for k in range(6)]
    motions = done(bent, path(), looks, FOLLOWING)
    assert motions is not None
    said = path().said
    moved = (motions @ said - said)[:, 1, 3]
    assert abs(moved[0]) < 15 and 50 < moved[5] < 80  # seven tenths of it
    assert moved[7] > moved[5] - 10


def test_more_than_drift_is_not_followed() -> None:
    assert done(bent, path(), [look(k, 400.0) for k in range(6)], FOLLOWING) is not None
    assert done(bent, path(), [look(k, 900.0) for k in range(6)], FOLLOWING) is None


def test_a_few_looks_are_not_enough() -> None:
    assert done(bent, path(), [look(k, 60.0) for k in range(3)], FOLLOWING) is None
    assert done(bent, path(), [look(0, 60.0 + k) for k in range(9)], FOLLOWING) is None


def test_a_look_counts_where_another_bears_it_out() -> None:
    one, other, alone = look(1, 50.0), look(2, 60.0), look(3, -200.0)
    assert done(borne_out, [one, other, alone], 80.0) == [one, other]
    same = look(2, 60.0, other=1)  # the same keyframe of the others
    assert done(borne_out, [one, same], 80.0) == []
    assert done(borne_out, [one, look(7, 60.0)], 80.0) == [], "too far along the path"


def test_a_look_that_contradicts_the_others_is_left_out() -> None:
    looks = [look(k, 60.0) for k in range(6)]
    with_one_off = done(bent, path(), [*looks, look(3, -300.0)], FOLLOWING)
    without = done(bent, path(), looks, FOLLOWING)
    assert with_one_off is not None and without is not None
    assert np.abs(with_one_off - without).max() < 1.0


def test_blocks_are_solved_as_the_whole() -> None:
    rng, count = np.random.default_rng(0), 5
    whole = np.zeros((6 * count, 6 * count))
    diagonal, beside = np.zeros((count, 6, 6)), rng.normal(size=(count - 1, 6, 6))
    for k in range(count):
        root = rng.normal(size=(6, 6))
        diagonal[k] = root @ root.T + 20 * np.eye(6)
        whole[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = diagonal[k]
    for k, block in enumerate(beside):
        whole[6 * k + 6 : 6 * k + 12, 6 * k : 6 * k + 6] = block
        whole[6 * k : 6 * k + 6, 6 * k + 6 : 6 * k + 12] = block.T
    right = rng.normal(size=(count, 6))
    found = tridiagonal(diagonal, beside, right)
    assert np.allclose(whole @ found.ravel(), right.ravel())


def test_a_step_fits_what_is_seen_where_nothing_holds_it() -> None:
    change = done(solved, path(), [look(k, 10.0) for k in range(8)], FOLLOWING)
    assert np.allclose(change[:, 4], 10.0, atol=0.01) and np.abs(change[:, :3]).max() < 1e-5


def turned_look(own: int, angle: float) -> Look:
    source = np.random.default_rng(own).uniform(-2000, 2000, (20, 3))
    turn = pose(yaw=angle)
    return Look(own, own, source, source @ turn[:3, :3].T, turn)


def test_a_robot_that_stands_still_is_not_turned() -> None:
    """Where nothing is driven nothing drifts: others cannot turn what it sees by 20 cm."""
    still = path()
    said = np.array([np.eye(4)] * 8)
    views = Views(said, still.views.points, still.views.descriptors, 2000.0)
    still = Path(still.cycles, said, still.motions, views)
    assert done(bent, still, [turned_look(k, 0.1) for k in range(8)], FOLLOWING) is None
    assert done(bent, still, [turned_look(k, 0.04) for k in range(8)], FOLLOWING) is not None


def test_many_looks_that_contradict_each_other_are_judged_bit_by_bit() -> None:
    looks = [look(k // 4, 500.0 * k, other=k) for k in range(40)]
    kept, pieces = done_in(borne_out, looks, 80.0)
    assert kept == [] and max(pieces) == 1 and len(pieces) >= 40 * 39 / 2 / 16
    _, pieces = done_in(bent, path(100), [look(k // 4, 60.0) for k in range(400)], FOLLOWING)
    assert max(pieces) == 1 and len(pieces) >= 50 and min(pieces) > 0


def test_a_new_session_leaves_no_correction_half_done() -> None:
    """All of the old one lies where it was found to be, though only a part fits into a tick."""
    bob = agent("bob", CONFIG)
    for at in range(250):
        bob.observe(Cycle(float(at), pose(0.1 * at), np.ones((1, 3))), float(at))
    bob.observing.drift.bend([Bend(0, shifted(40.0))])
    bob.tick(250.0)
    bob.observe(Cycle(300.0, np.eye(4), np.ones((1, 3)), session=1), 300.0)
    for at in range(300, 330):
        bob.tick(float(at))
    anchors = [anchor for tx in bob.ledger for anchor in tx.payload.anchors]
    newest = placed(anchors)  # the last one of a cycle counts
    assert newest == {cycle: [100 * cycle, 40, 0] for cycle in range(250)} | {250: [0, 0, 0]}


def test_a_restored_robot_begins_a_new_session() -> None:
    """How far its SLAM had drifted is not in the ledger: cycles would jump back."""
    bob = agent("bob", CONFIG)
    for at, cycle in enumerate(walk(START, 0.0, 1, 3)):
        bob.observe(cycle, float(at))
    bob.tick(60.0)
    data = [tx.data for tx in bob.ledger]
    back = type(bob).restore(bob.identity, bob.config, data)
    with pytest.raises(
        CycleError, match="session 0 was begun before a restart.*start a new session"
    ):
        back.observe(Cycle(70.0, np.eye(4), np.ones((1, 3))), 70.0)
    back.observe(Cycle(70.0, np.eye(4), np.ones((1, 3)), session=1), 70.0)
    back.observe(Cycle(71.0, np.eye(4), np.ones((1, 3)), session=1), 71.0)
    with pytest.raises(CycleError, match="start a new session"):
        back.observe(Cycle(72.0, np.eye(4), np.ones((1, 3))), 72.0)
    plain = type(bob).restore(bob.identity, QUICK, [])
    plain.observe(Cycle(70.0, np.eye(4), np.ones((1, 3))), 70.0)
