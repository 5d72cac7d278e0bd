"""Robots that share no frame find each other's from what they saw, or say that they do not."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from chains import Author as ChainAuthor
from chains import anchor
from dagmap import Agent, Config, Cycle
from dagmap.config import PlacingConfig, load_config
from dagmap.consensus import Consensus
from dagmap.frames import contradicted, place_frames
from dagmap.ledger import Ledger
from dagmap.messages import Transactions, encode
from dagmap.model import (
    FLEET_FRAME,
    MAX_KEYFRAMES,
    Accepted,
    FrameId,
    pose_matrix,
    quantise_pose,
)
from dagmap.payload import Described, Link, Payload
from dagmap.placing import Placing
from dagmap.sim.fleet import Fleet
from dagmap.sim.robot import Robot
from scene import QUICK, agent, pose

UNKNOWN = msgspec.structs.replace(
    QUICK, start_pose=None, placing=PlacingConfig(units_per_tick=200, keyframe_distance=0.2)
)
Points = np.ndarray
Corner = tuple[float, float, float]


def room(
    seed: int, low: tuple[float, ...] = (0, 0, 0), high: tuple[float, ...] = (6, 5, 3)
) -> Points:
    """(400, 3) places in a box, and nothing else about it."""
    return np.random.default_rng(seed).uniform(low, high, (400, 3))


def names(seed: int, count: int = 400) -> Points:
    """(N, 32) a descriptor of each place."""
    return np.random.default_rng(1000 + seed).integers(0, 256, (count, 32)).astype(np.uint8)


def walk(
    places: Points,
    descriptors: Points,
    start: Points | None = None,
    seed: int = 0,
    count: int = 6,
    mirror: bool = False,
    session: int = 0,
    begin: float = 0.0,
) -> list[Cycle]:
    """A robot goes along x through the places and sees 150 of them in each cycle, to 5 mm."""
    rng = np.random.default_rng(seed)
    out = []
    for i in range(count):
        sensor = pose(0.5 * i, 0.1 * i, 1.0, 0.1 * i)
        rows = rng.choice(len(places), min(150, len(places)), replace=False)
        world = places[rows] + rng.normal(0, 0.005, (len(rows), 3))
        local = (world - sensor[:3, 3]) @ sensor[:3, :3]
        if mirror:
            flip = np.diag([-1.0, 1.0, 1.0, 1.0])
            local, sensor = local @ flip[:3, :3], flip @ sensor @ flip
        noisy = descriptors[rows].copy()
        noisy[:, 0] ^= rng.integers(0, 256, len(rows)).astype(np.uint8)  # up to 8 of 256 bits
        at = sensor if start is None else start @ sensor
        stamp = begin + float(i)
        out.append(Cycle(stamp, at, local, session=session, descriptors=noisy))
    return out


STARTS = {"ann": np.eye(4), "bob": pose(3, -2, 1, 2.0), "cid": pose(-7, 4, 0.5, -1.0)}


def meet(config: Config = UNKNOWN, **cycles: list[Cycle]) -> dict[str, Agent]:
    fleet = Fleet(config)
    for _ in fleet.run(cycles):
        pass
    agents = {name: robot.agent for name, robot in fleet.robots.items()}
    assert len({agent.digest() for agent in agents.values()}) == 1
    return agents


def relative(agents: dict[str, Agent], one: str, other: str, session: int = 0) -> Points | None:
    """(4, 4) the first one's frame in the other's, as the first one has it."""
    frames = agents[one].consensus.frames
    a = frames.get(FrameId(agents[one].identity.author, session))
    b = frames.get(FrameId(agents[other].identity.author))
    if a is None or b is None or a[0] != b[0]:
        return None
    return np.linalg.inv(pose_matrix(b[1])) @ pose_matrix(a[1])


def off(found: Points | None, one: Points, other: Points) -> tuple[float, float]:
    """Metres and degrees between a placement and the truth."""
    assert found is not None
    error = np.linalg.inv(other @ np.linalg.inv(one)) @ found
    cosine = np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1)
    return float(np.linalg.norm(error[:3, 3])), float(np.degrees(np.arccos(cosine)))


@pytest.fixture(scope="module")
def three() -> dict[str, Agent]:
    places, described = room(1), names(1)
    return meet(
        **{
            name: walk(places, described, start, seed)
            for seed, (name, start) in enumerate(STARTS.items())
        }
    )


def test_robots_find_each_others_frames(three: dict[str, Agent]) -> None:
    for one, other in (("ann", "bob"), ("bob", "cid"), ("cid", "ann")):
        metres, degrees = off(relative(three, one, other), STARTS[one], STARTS[other])
        assert metres < 0.03 and degrees < 0.3
    assert all(robot.unplaced == {} and len(robot.robots) == 3 for robot in three.values())
    assert len({robot.map.origin for robot in three.values()}) == 1


def test_both_ends_have_said_so(three: dict[str, Agent]) -> None:
    authors = three["ann"].consensus.authors.values()
    links = [link for author in authors for link in author.links.values()]
    ends = {(link.source.author, link.target.author) for link in links if link.inliers}
    assert all((b, a) in ends for a, b in ends)
    assert contradicted(links, three["ann"].consensus.frames) == []


def test_frames_are_a_function_of_the_transactions(three: dict[str, Agent]) -> None:
    data = [tx.data for tx in three["ann"].ledger]
    for seed in range(3):
        order = data + data[::5]
        random.Random(seed).shuffle(order)
        listener = agent(f"listener{seed}", UNKNOWN)
        for at, item in enumerate(order):
            listener.receive(encode(Transactions((item,)), UNKNOWN, bytes(8)), float(at))
            if at % 4 == 0:
                listener.tick(float(at))
        assert listener.digest() == three["ann"].digest()


def test_a_file_can_say_that_the_start_is_unknown(tmp_path: Path) -> None:
    (tmp_path / "fleet.toml").write_text("start_pose = []\n")
    config = load_config(tmp_path / "fleet.toml")
    robot = agent("ann", config)
    robot.observe(walk(room(1), names(1))[0], 0.0)
    assert robot.frame() is None and robot.consensus.frames == {}


def test_who_shares_a_frame_pays_nothing() -> None:
    places, described = room(1), names(1)
    known = msgspec.structs.replace(UNKNOWN, start_pose=QUICK.start_pose)
    agents = meet(known, ann=walk(places, described), bob=walk(places, described, seed=1))
    payloads = [tx.payload for tx in agents["ann"].ledger]
    assert payloads and not any(payload.described for payload in payloads)
    assert len(agents["ann"].map) and agents["ann"].unplaced == {}


def test_rough_starts_are_merged_at_once_and_then_refined() -> None:
    places, described = room(1), names(1)
    starts = {"ann": pose(0.03, -0.02, 0.01), "bob": pose(-0.03, 0.03, 0.0, 0.01)}
    cycles = {
        name: walk(places, described, start, seed)
        for seed, (name, start) in enumerate(starts.items())
    }
    rough = msgspec.structs.replace(UNKNOWN, start_pose=QUICK.start_pose, start_sigma=0.05)
    first = agent("ann", rough)
    first.observe(cycles["ann"][0], 0.0)
    first.tick(0.0)
    assert first.map.origin == FLEET_FRAME
    agents = meet(rough, **cycles)
    metres, degrees = off(relative(agents, "ann", "bob"), starts["ann"], starts["bob"])
    assert metres < 0.02 and degrees < 0.3
    assert all(robot.map.origin == FLEET_FRAME for robot in agents.values())
    assert all(robot.unplaced == {} for robot in agents.values())


Scene = Callable[[], tuple[list[Cycle], list[Cycle]]]


def _elsewhere() -> tuple[list[Cycle], list[Cycle]]:
    return walk(room(1), names(1)), walk(room(2), names(2), STARTS["bob"])


def _noise() -> tuple[list[Cycle], list[Cycle]]:
    rng = np.random.default_rng(5)
    cycles = [
        replace(c, points=rng.uniform(-4, 4, np.shape(c.points)))
        for c in walk(room(1), names(1), STARTS["bob"], 1)
    ]
    return walk(room(1), names(1)), cycles


def _mirrored() -> tuple[list[Cycle], list[Cycle]]:
    return walk(room(1), names(1)), walk(room(1), names(1), STARTS["bob"], 1, mirror=True)


def _wall() -> tuple[list[Cycle], list[Cycle]]:
    wall = room(1, (0, 4, 0), (6, 4, 3))
    return walk(wall, names(1)), walk(wall, names(1), STARTS["bob"], 1)


def _mirrored_wall() -> tuple[list[Cycle], list[Cycle]]:
    wall = room(1, (0, 4, 0), (6, 4, 3))
    return walk(wall, names(1)), walk(wall, names(1), STARTS["bob"], 1, mirror=True)


def _corridor() -> tuple[list[Cycle], list[Cycle]]:
    """Ten bays, each like the other."""
    bay = np.random.default_rng(1).uniform([0, 0, 0], [2, 2, 2.5], (40, 3))
    places = np.concatenate([bay + np.array([2.0 * i, 0, 0]) for i in range(10)])
    described = np.concatenate([names(1, 40)] * 10)
    return walk(places, described), walk(places, described, STARTS["bob"], 1)


def _two_rooms() -> tuple[list[Cycle], list[Cycle]]:
    """The one has seen two rooms that are alike, the other one of them."""
    first = walk(room(1), names(1))
    second = walk(room(1), names(1), pose(20), 3, begin=10.0)
    return first + second, walk(room(1), names(1), STARTS["bob"], 1)


NOT_PLACED: dict[str, Scene] = {
    "no overlap": _elsewhere,
    "only noise": _noise,
    "mirrored": _mirrored,
    "a single wall": _wall,
    "a single wall, mirrored": _mirrored_wall,
    "a corridor of equal bays": _corridor,
    "two equal rooms": _two_rooms,
}


@pytest.mark.parametrize("name", NOT_PLACED)
def test_what_cannot_be_told_is_not_placed(name: str) -> None:
    ann, bob = NOT_PLACED[name]()
    agents = meet(ann=ann, bob=bob)
    assert relative(agents, "ann", "bob") is None
    for one, other in (("ann", "bob"), ("bob", "ann")):
        (reason,) = agents[one].unplaced.values()
        assert reason
        assert list(agents[one].unplaced) == [FrameId(agents[other].identity.author)]
        assert len(agents[one].robots) == 1  # nothing is merged


def test_it_is_told_why() -> None:
    told = {}
    for name in ("no overlap", "only noise", "a single wall", "two equal rooms"):
        ann, bob = NOT_PLACED[name]()
        told[name] = set(meet(ann=ann, bob=bob)["bob"].unplaced.values())
    assert told == {
        "no overlap": {"nothing in common was seen yet"},
        "only noise": {"nothing in common was seen yet"},
        "a single wall": {"the points that agree lie in one plane or line"},
        "two equal rooms": {"the maps fit in more than one way"},
    }


def test_a_new_session_is_placed_like_a_new_robot() -> None:
    places, described = room(1), names(1)
    again = walk(places, described, STARTS["cid"], 2, session=1, begin=10.0)
    agents = meet(
        ann=walk(places, described), bob=walk(places, described, STARTS["bob"], 1) + again
    )
    metres, degrees = off(relative(agents, "bob", "ann", 1), STARTS["cid"], np.eye(4))
    assert metres < 0.03 and degrees < 0.3


def test_groups_that_meet_become_one() -> None:
    """Two pairs in rooms of their own; then one of a pair goes over to the other's room."""
    here, there = (room(1), names(1)), (room(2), names(2))
    moved = [
        replace(c, pose=STARTS["bob"] @ pose(30, 0, 0, 0.5) @ np.asarray(c.pose))
        for c in walk(*there, seed=4, begin=20.0)
    ]
    apart = {
        "ann": walk(*here),
        "bob": walk(*here, STARTS["bob"], 1),
        "cid": walk(*there, STARTS["cid"], 2),
        "dan": walk(*there, None, 3),
    }
    before = meet(**apart)
    assert relative(before, "ann", "bob") is not None and relative(before, "cid", "dan") is not None
    assert relative(before, "ann", "cid") is None
    after = meet(**{**apart, "bob": apart["bob"] + moved})
    truth = STARTS["cid"] @ np.linalg.inv(pose(30, 0, 0, 0.5))
    metres, degrees = off(relative(after, "ann", "cid"), np.eye(4), truth)
    assert metres < 0.1 and degrees < 0.5


def test_described_points_spread_like_all_else_and_stay_bounded() -> None:
    config = msgspec.structs.replace(UNKNOWN, placing=PlacingConfig(points=50, keyframes=3))
    places, described = room(1), names(1)
    agents = meet(config, ann=walk(places, described), bob=walk(room(2), names(2), seed=1))
    for robot in agents.values():
        shown = [d for tx in robot.ledger for d in tx.payload.described]
        assert len(shown) == 6 and {len(d.position) for d in shown} == {50}


def test_an_agent_that_starts_again_goes_on(three: dict[str, Agent]) -> None:
    ann = three["ann"]
    again = Agent.restore(ann.identity, ann.config, [tx.data for tx in ann.ledger])
    for at in range(5):
        assert not [e for e in again.tick(float(at)) if type(e).__name__ == "Issued"]
    assert again.digest() == ann.digest() and again.unplaced == {}


def test_a_link_follows_a_loop_closure() -> None:
    """Nothing new is seen; all that bob has seen moves."""
    places, described = room(1), names(1)
    seen, shift = walk(places, described, STARTS["bob"], 1), pose(5.0, 3.0, 0.0, 1.0)
    poses = np.stack([shift @ np.asarray(cycle.pose) for cycle in seen])
    stamps = [cycle.stamp for cycle in seen]
    closure = Cycle(20.0, poses[-1], np.zeros((0, 3)), moved=(stamps, poses))
    agents = meet(ann=walk(places, described), bob=[*seen, closure])
    metres, degrees = off(relative(agents, "ann", "bob"), STARTS["ann"], shift @ STARTS["bob"])
    assert metres < 0.03 and degrees < 0.3


def silent(start: Points = STARTS["bob"]) -> dict[str, Agent]:
    """Ann and bob have shown each other their described points, and published no link."""
    never = msgspec.structs.replace(UNKNOWN.placing, inliers=1 << 20)
    mute = msgspec.structs.replace(UNKNOWN, placing=never)
    places, described = room(1), names(1)
    return meet(mute, ann=walk(places, described), bob=walk(places, described, start, 1))


def issues(robot: Agent, calls: int) -> bool:
    return any(type(e).__name__ == "Issued" for at in range(calls) for e in robot.tick(float(at)))


def test_a_robot_that_listens_for_its_own_chain_signs_no_link() -> None:
    """It may have been told already, with a number that the copy of the ledger does not know."""
    ann = silent()["ann"]
    again = Agent.restore(ann.identity, UNKNOWN, [tx.data for tx in ann.ledger])
    again.listening = True
    assert not issues(again, 20)
    again.listening = False
    again.resume()
    assert issues(again, 20)


def test_described_points_beyond_all_reach_are_no_reason_to_stop() -> None:
    """Who repeats a robot's described points a thousand kilometres away offers it a frame that no
    pose can tell of."""
    ann, bob = agent("ann", UNKNOWN), agent("bob", UNKNOWN)
    far, further = np.eye(4), np.array([3e8, 3e8, 4e8])
    far[:3, 3] = 500_000.0
    for cycle in walk(room(1), names(1)):
        ann.observe(cycle, cycle.stamp)
        bob.observe(replace(cycle, pose=far @ np.asarray(cycle.pose)), cycle.stamp)
    held = bob.observing._keyframes._held
    for at, (keyframe, cycle) in enumerate(zip(held, walk(room(1), names(1)), strict=True)):
        offset = (further @ np.asarray(cycle.pose)[:3, :3]).astype(np.int32)
        held[at] = replace(keyframe, position=keyframe.position + offset)
    bob.observing.relate([], True)
    bob.tick(10.0)
    for out in bob.outbox():
        ann.receive(out.data, 10.0)
    for at in range(20):
        ann.tick(11.0 + at)
    assert ann.unplaced[FrameId(bob.identity.author)] == "it lies beyond 2^29 mm"


def test_a_link_that_is_a_thousandth_off_a_rotation_is_an_answer_like_others() -> None:
    """The quaternion of a foreign pose may be off by so much (docs/protocol.md)."""
    half = pose(3, -2, 1, np.pi)
    pair = silent(half)
    low, high = sorted(pair.values(), key=lambda robot: robot.identity.author)
    slow = msgspec.structs.replace(UNKNOWN.placing, units_per_tick=1)
    config = msgspec.structs.replace(UNKNOWN, placing=slow)
    again = Agent.restore(high.identity, config, [tx.data for tx in high.ledger])
    again.tick(0.0)
    truth = half if low.config.name == "ann" else np.linalg.inv(half)
    ends = FrameId(low.identity.author), FrameId(high.identity.author)
    short = quantise_pose(truth)
    short[:4] = (short[:4] * 0.99952).astype(np.int32)
    low.observing.relate([Link(*ends, short, 500)], True)
    low.tick(100.0)
    for out in low.outbox():
        again.receive(out.data, 100.0)
    assert issues(again, 3000) and again.unplaced == {}


def test_keyframes_of_anchors_that_never_come_keep_nobody_elses_out() -> None:
    mallory, bob = ChainAuthor("mallory", UNKNOWN), silent()["bob"]
    ledger = Ledger(UNKNOWN)
    junk = tuple(
        Described(cycle, np.zeros((1, 3), np.int32), np.zeros((1, 32), np.uint8))
        for cycle in range(MAX_KEYFRAMES)
    )
    for tx in [mallory.make(payload=Payload(described=junk)), *bob.ledger]:
        ledger.add(tx)
    for order in (sorted, lambda chains: sorted(chains, reverse=True)):
        ledger.chains = {author: ledger.chains[author] for author in order(ledger.chains)}
        placing = Placing(UNKNOWN, bob.identity.author)
        placing._take_in(ledger, Consensus(UNKNOWN))  # as in a revision: no anchor is known yet
        placing._take_in(ledger, bob.consensus)
        assert sum(map(len, placing._keyframes.values())) == 12


def test_a_robot_that_started_often_is_still_placed() -> None:
    """Each session shows keyframes; the oldest ones make room for those of the newest."""
    robot, chain, ledger = ChainAuthor("often", UNKNOWN), [], Ledger(UNKNOWN)
    one = (np.zeros((1, 3), np.int32), np.zeros((1, 32), np.uint8))
    for session in range(5):
        cycles = range(100 * session, 100 * session + 100)
        anchors = tuple(replace(anchor(cycle), session=session) for cycle in cycles)
        shown = tuple(Described(cycle, *one) for cycle in cycles)
        chain.append(robot.make(payload=Payload(anchors=anchors, described=shown)))
    consensus, placing = Consensus(UNKNOWN), Placing(UNKNOWN, robot.identity.author)
    for tx in chain:
        ledger.add(tx)
        consensus.add(tx)
    placing._take_in(ledger, consensus)
    held = {frame.session: len(keyframes) for frame, keyframes in placing._keyframes.items()}
    assert held[4] == 100 and sum(held.values()) <= MAX_KEYFRAMES
    assert {frame.session for ends in placing._relations for frame in ends} == set(held)


def test_a_link_that_was_withdrawn_can_be_published_anew() -> None:
    """Also while its own withdrawal is not in the ledger yet."""
    ann = silent()["ann"]
    again = Agent.restore(ann.identity, UNKNOWN, [tx.data for tx in ann.ledger])
    assert issues(again, 20)
    (relation,) = again.placing._relations.values()
    before = relation.published
    assert before is not None and relation._withdraw() is not None
    again.placing._hear(relation, again.consensus)
    anew = relation._conclude()
    assert anew is not None and anew.inliers > 0


A, B, C, LIAR = (FrameId(bytes([n]) * 8) for n in (1, 2, 3, 9))


def link(source: FrameId, target: FrameId, inliers: int, x: float = 0.0) -> Link:
    return Link(source, target, quantise_pose(pose(x)), inliers)


def test_a_liar_places_nobody_but_itself() -> None:
    lies = [link(LIAR, A, 1 << 30, 7.0), link(LIAR, B, 1 << 30, 1.0), link(LIAR, C, 1 << 30)]
    placed = place_frames(lies)
    assert [frame for frame in (A, B, C) if frame in placed and placed[frame][0] != LIAR] == [
        frame for frame in (A, B, C) if frame in placed
    ]
    assert len(placed) == 2  # itself, and whom it claims to stand beside
    honest = [link(A, B, 40, 3.0), link(B, A, 50, -3.0)]
    with_lies = place_frames([*honest, *lies])
    assert with_lies[B][1].tolist() == place_frames(honest)[B][1].tolist()
    assert C not in with_lies or A not in with_lies or with_lies[C][0] != with_lies[A][0]


def test_a_link_that_its_other_end_does_not_bear_out_is_but_a_claim() -> None:
    joined = [link(B, A, 60, 1.0), link(A, B, 60, -1.0)]
    one_sided = [*joined, link(C, FrameId(C.author, 1), 5), link(B, C, 900, 2.0)]
    placed = place_frames(one_sided)
    assert placed[C][0] == C and placed[B][0] == A  # b stands with a: it cannot draw c in
    disputed = [*joined, link(B, C, 900, 2.0), link(C, B, 900, 2.0)]
    disputed_placed = place_frames(disputed)
    assert disputed_placed[B][0] == A and disputed_placed[C][1][4] == 3000  # c's own word on c
    agreed = [*joined, link(B, C, 900, 2.0), link(C, B, 900, -2.0)]
    assert place_frames(agreed)[C][0] == A


def test_who_places_itself_beside_others_is_not_their_origin() -> None:
    """Else a stranger with a low id would turn everybody's map, and anew with each link."""
    low = FrameId(bytes(7) + b"\x01")
    honest = [link(A, B, 40, 3.0), link(B, A, 50, -3.0)]
    before, after = place_frames(honest), place_frames([*honest, link(low, B, 1 << 30, 7.0)])
    assert after[low][0] == A
    assert [(after[f][0], after[f][1].tolist()) for f in (A, B)] == [
        (before[f][0], before[f][1].tolist()) for f in (A, B)
    ]
    alone = place_frames([link(low, B, 1 << 30, 7.0)])
    assert alone[B][0] == alone[low][0] == B


def test_a_claim_binds_its_target_to_nothing() -> None:
    """B still places itself beside a robot that is gone, whoever claims to stand beside B."""
    claim = link(B, A, 60, 1.0)
    alone, with_lie = place_frames([claim]), place_frames([claim, link(LIAR, B, 1 << 30, 7.0)])
    assert with_lie[B][0] == alone[B][0] == A
    assert with_lie[B][1].tolist() == alone[B][1].tolist() and with_lie[LIAR][0] == A


def test_a_withdrawn_link_counts_no_more() -> None:
    assert place_frames([link(B, A, 0, 1.0)]) == {}


def test_a_contradiction_round_a_cycle_is_told() -> None:
    def both(a: FrameId, b: FrameId, inliers: int, x: float) -> list[Link]:
        return [link(a, b, inliers, x), link(b, a, inliers, -x)]

    right = [*both(A, B, 90, 1.0), *both(B, C, 80, 1.0), *both(A, C, 70, 2.0)]
    assert contradicted(right, place_frames(right)) == []
    wrong = [*both(A, B, 90, 1.0), *both(B, C, 80, 1.0), *both(A, C, 70, 9.0)]
    placed = place_frames(wrong)
    assert [(lie.source, lie.target) for lie in contradicted(wrong, placed)] == [(A, C)]
    assert placed[C][1][4] == -2000  # the better links decide


def test_a_robot_says_nothing_about_frames_of_others() -> None:
    """What a stranger signs about two others is left out."""
    mallory, ann, bob = agent("mallory", UNKNOWN), agent("ann", UNKNOWN), agent("bob", UNKNOWN)
    ends = [FrameId(robot.identity.author) for robot in (ann, bob)]
    mallory.observing.relate([link(*ends, 1 << 30, 5.0)], False)
    mallory.tick(0.0)
    for out in mallory.outbox():
        ann.receive(out.data, 0.0)
    ann.digest()
    assert ann.consensus.frames == {}


@pytest.mark.parametrize("reach", [-1, 0, 900])
def test_the_nearest_descriptors_are_the_nearest(reach: int) -> None:
    from dagmap.kernels.hamming import NONE, nearest

    rng = np.random.default_rng(reach + 1)
    one, other = (rng.integers(0, 4, (n, 32)).astype(np.uint8) * 85 for n in (30, 40))
    here, there = (rng.integers(0, 1000, (n, 3)).astype(np.int32) for n in (30, 40))
    best, first, second = np.empty(30, np.int64), np.empty(30, np.int64), np.empty(30, np.int64)
    back = np.empty(40, np.int64)
    words = (d.view(np.int64).reshape(-1, 4) for d in (one, other))
    nearest(*words, here, there, reach, best, first, second, back)
    apart = np.unpackbits(one[:, None] ^ other[None], axis=2).sum(axis=2, dtype=np.int64)
    if reach >= 0:
        squared = ((here[:, None].astype(np.int64) - there[None]) ** 2).sum(axis=2)
        apart[squared > reach * reach] = NONE
    some, found = apart.min(axis=1) < NONE, apart.min(axis=0) < NONE
    assert best.tolist() == np.where(some, apart.argmin(axis=1), -1).tolist()
    assert back.tolist() == np.where(found, apart.argmin(axis=0), -1).tolist()
    assert first.tolist() == np.sort(apart, axis=1)[:, 0].tolist()
    assert second.tolist() == np.sort(apart, axis=1)[:, 1].tolist()


def test_described_points_must_be_points() -> None:
    from dagmap.payload import decode_payload, encode_payload
    from dagmap.wire import Refusal

    shown = Described(3, np.array([[1, 2, 3]], np.int32), np.zeros((1, 32), np.uint8))
    data = encode_payload(Payload(described=(shown,)))
    assert encode_payload(decode_payload(data, 2)) == data
    for bad in (data[:1] + b"\x01\x03", data[:1] + bytes([data[1] - 1]) + data[2:-1]):
        with pytest.raises(Refusal):
            decode_payload(bad, 2)


def test_descriptors_are_checked() -> None:
    from dagmap import DagmapError

    cycle = Cycle(0.0, np.eye(4), np.ones((3, 3)), descriptors=np.zeros((2, 32), np.uint8))
    with pytest.raises(DagmapError, match=r"descriptors are uint8 \(2, 32\); \(3, 32\)"):
        agent("ann").observe(cycle, 0.0)


def test_fleets_of_robots_know_that_they_search() -> None:
    fleet = Fleet(msgspec.structs.replace(UNKNOWN, placing=PlacingConfig(units_per_tick=1)))
    cycles = {"ann": walk(room(1), names(1)), "bob": walk(room(1), names(1), STARTS["bob"], 1)}
    busy: list[Robot] = []
    for _ in fleet.run(cycles):
        busy += [robot for robot in fleet.robots.values() if robot.agent.searching]
    assert busy and not any(robot.agent.searching for robot in fleet.robots.values())
    assert all(robot.agent.unplaced == {} for robot in fleet.robots.values())


def _paced(budget: int) -> tuple[list[int], Agent]:
    """Bob's units of each tick while ann's part is known and nothing new comes; and bob."""
    config = msgspec.structs.replace(
        UNKNOWN, placing=PlacingConfig(units_per_tick=budget, keyframe_distance=0.2)
    )
    ann, bob = agent("ann", config), agent("bob", config)
    for robot, other, start in ((ann, bob, None), (bob, ann, STARTS["bob"])):
        robot.observing.relate([], True)
        for cycle in walk(room(1), names(1), start, seed=1 if robot is bob else 0):
            for event in robot.observe(cycle, cycle.stamp):
                if isinstance(event, Accepted):
                    other.take(event.data)
    bob.settle()
    spent: list[int] = []
    links: list[Link] = []
    while not spent or bob.placing.busy:
        found, _ = bob.placing.step(bob.ledger, bob.consensus)
        spent.append(bob.placing.spent)
        links += found
    bob.observing.relate(links, True)
    bob.tick(100.0)
    return spent, bob


def test_a_tick_does_its_share_of_the_work_and_no_more() -> None:
    ample, all_at_once = _paced(10_000)
    spent, in_pieces = _paced(5)
    assert len(ample) < 4 and sum(spent) == sum(ample) > 100
    piece = 30  # the most that is done in one go, whatever is left of the budget
    assert max(spent) <= 5 + piece and sorted(spent)[len(spent) // 2] <= 8
    links = [
        [*robot.consensus.author(robot.identity.author).links.values()]
        for robot in (all_at_once, in_pieces)
    ]
    assert len(links[0]) == 1 and links[0][0].inliers > 30
    assert links[0][0].pose.tolist() == links[1][0].pose.tolist()
