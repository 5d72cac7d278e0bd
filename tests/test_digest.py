"""The map and its digest once more, after docs/protocol.md: from the transactions alone, in plain
Python, with the slow twins of `naive`, nothing of frames, consensus, contribution and folded."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Iterable
from itertools import pairwise
from math import isqrt

import msgspec
import numpy as np
import pytest

from dagmap import Agent, Config, GraphConfig, State
from dagmap.blocks import Block
from dagmap.config import FoldConfig
from dagmap.messages import Transactions, encode
from dagmap.model import FLEET_FRAME, FrameId
from dagmap.payload import Payload
from dagmap.transaction import Transaction
from naive import NaiveRays, Point, naive_default, naive_verdict
from scene import QUICK, agent, cycles

LIMIT, ONE = 1 << 29, 1 << 30
Pose = tuple[int, ...]  # w x y z, translation
HERE: Pose = (ONE, 0, 0, 0, 0, 0, 0)
TURNED = ((0.6, -0.8, 0.0, 1.5), (0.8, 0.6, 0.0, -0.5), (0.0, 0.0, 1.0, 0.25), (0.0, 0.0, 0.0, 1.0))
Seen = tuple[Transaction, Payload]


def cut(value: int) -> int:
    return max(-LIMIT, min(LIMIT, value))


def carried(pose: Pose, place: Iterable[int]) -> Point:
    w, x, y, z, *offset = pose
    rows = (
        ((1 << 60) - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), (1 << 60) - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), (1 << 60) - 2 * (x * x + y * y)),
    )
    turn = [[(e + (1 << 29)) // ONE for e in row] for row in rows]
    moved = [sum(a * b for a, b in zip(row, place, strict=True)) for row in turn]
    u, v, w = (t + (m + (1 << 29)) // ONE for t, m in zip(offset, moved, strict=True))
    return u, v, w


def after(a: Pose, b: Pose) -> Pose:
    w = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3]
    x = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2]
    y = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1]
    z = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0]
    n = isqrt(w * w + x * x + y * y + z * z)
    turn = tuple(((1 << 31) * c + n) // (2 * n) for c in (w, x, y, z))
    return turn + tuple(map(cut, carried(a, b[4:])))


def inverse(pose: Pose) -> Pose:
    w, x, y, z, *offset = pose
    back = (w, -x, -y, -z)
    return back + tuple(map(cut, carried((*back, 0, 0, 0), [-t for t in offset])))


def started(seen: list[Seen]) -> dict[FrameId, tuple[FrameId, Pose]]:
    """Frames of the robots whose start is known; there are no other links here."""
    found = {}
    for _, payload in seen:
        for link in payload.links:
            assert link.target == FLEET_FRAME
            found[FLEET_FRAME] = (FLEET_FRAME, HERE)
            pose = after(HERE, inverse(inverse(tuple(link.pose.tolist()))))
            found[link.source] = (FLEET_FRAME, pose)
    return found


class Placing:
    """What the transactions add, to which component, as blocks of it."""

    def __init__(self, seen: list[Seen]) -> None:
        self.frames = started(seen)
        self.anchors: dict[tuple[bytes, int], tuple[FrameId, Pose]] = {}
        self.retracted: set[tuple[bytes, int]] = set()
        for tx, payload in sorted(seen, key=lambda one: one[0].sequence):
            for anchor in payload.anchors:
                frame = FrameId(tx.author, anchor.session)
                self.anchors[tx.author, anchor.cycle] = (frame, tuple(anchor.pose.tolist()))
            self.retracted |= {(tx.author, number) for number in payload.retracted.tolist()}
        authors = sorted({tx.author for tx, _ in seen})
        self.index = {author: number for number, author in enumerate(authors)}
        self.blocks: dict[FrameId, list[Block]] = defaultdict(list)
        for tx, payload in sorted(seen, key=lambda one: one[0].key):
            self._add(tx.author, payload)

    def _home(self, author: bytes, cycle: int) -> tuple[FrameId, Pose, Pose] | None:
        if (author, cycle) not in self.anchors:
            return None
        frame, pose = self.anchors[author, cycle]
        origin, way = self.frames.get(frame, (frame, HERE))
        return origin, pose, way

    def _add(self, author: bytes, payload: Payload) -> None:
        bundle = payload.bundle
        cycles = [] if bundle is None else bundle.cycles.tolist()
        starts = [0] if bundle is None else bundle.starts.tolist()
        homes = [self._home(author, cycle) for cycle in cycles]
        again = [(s, self._home(author, s.cycle)) for s in payload.sightings]
        known = [home for home in [*homes, *(home for _, home in again)] if home]
        if not known:
            return
        component, xyz, alive, stands = known[0][0], [], [], []
        for home, (low, high) in zip(homes, pairwise(starts), strict=True):
            there = home if home and home[0] == component else None
            stands.append(carried(there[2], carried(there[1], (0, 0, 0))) if there else (0, 0, 0))
            for i in range(low, high):
                assert bundle is not None
                gone = there is None or (author, bundle.base + i) in self.retracted
                place = (0, 0, 0)
                if there is not None:
                    place = carried(there[2], carried(there[1], bundle.position[i].tolist()))
                xyz.append(place)
                alive.append(not gone and max(map(abs, place)) <= LIMIT)
        here = [s for s, home in again if home and home[0] == component]
        self.blocks[component].append(
            Block(
                author=self.index[author],
                base=0 if bundle is None else bundle.base,
                xyz=np.array(xyz, np.int32).reshape(-1, 3),
                alive=np.array(alive, np.bool_),
                starts=np.array(starts),
                cycle=np.array(cycles, np.int32),
                color=np.zeros((0, 3), np.uint8) if bundle is None else bundle.color,
                colored=np.zeros(0, np.bool_) if bundle is None else bundle.colored.astype(bool),
                parents=None,
                cores=np.zeros(0, np.int64),
                sightings=np.array([n for s in here for n in s.numbers.tolist()], np.int64),
                sighting_cycle=np.array([s.cycle for s in here for _ in s.numbers], np.int32),
                origin=np.array(stands, np.int32).reshape(-1, 3),
            )
        )


def named(frame: FrameId) -> bytes:
    return frame.author + frame.session.to_bytes(4, "little")


def independent(config: Config, seen: list[Seen]) -> tuple[bytes, list[State]]:
    """The digest, and the states of all nodes."""
    placed, states = Placing(seen), list[State]()
    out = hashlib.blake2b(digest_size=32, person=b"dagmap map 1")
    for component, blocks in sorted(placed.blocks.items()):
        nodes, verdicts = folded(config.fold, blocks)
        if not nodes:
            continue
        out.update(named(component))
        columns = [*zip(*nodes, strict=True), *zip(*verdicts, strict=True)]
        kinds = ("<i4", "<i8", "<i4", "<i8", "<i4", "<i4", "<i4", "<i4", "|u1")
        for kind, column in zip(kinds, columns, strict=True):
            values = np.array(column, kind)
            out.update(f"{kind} {values.size};".encode() + values.tobytes())
        states += [verdict[3] for verdict in verdicts]
    for frame, (origin, pose) in sorted(placed.frames.items()):
        out.update(named(frame) + named(origin) + np.array(pose, "<i4").tobytes())
    return out.digest(), states


def folded(config: FoldConfig, blocks: list[Block]) -> tuple[list, list]:  # type: ignore[type-arg]
    """Columns and verdicts of the nodes of a component."""
    fold, rays = naive_default(config, blocks), NaiveRays(config.cell_mm, config.max_ray_mm)
    for block in blocks:
        places = [tuple(place) for place in block.xyz.tolist()]
        stands = [tuple(place) for place in block.origin.tolist()]
        rays.walk(block.author, stands, block.starts.tolist(), places, block.alive.tolist(), 1)
    verdicts = naive_verdict(config, fold, rays) if fold.nodes else []
    return [node.columns() for node in fold.nodes], verdicts


@pytest.mark.parametrize("doubt", [None, 1000])  # learned; whatever somebody denies
def test_the_digest_follows_from_the_transactions_as_the_protocol_says(doubt: int | None) -> None:
    """Robots that repeat, withdraw and move what they saw; one starts turned, one somewhere."""
    fold, graph = FoldConfig(doubt=doubt, delta=0.06), GraphConfig(reference_pitch=0.25)
    config = msgspec.structs.replace(QUICK, fold=fold, graph=graph)
    starts = {"ann": config, "bob": config}
    starts["turned"] = msgspec.structs.replace(config, start_pose=TURNED)
    starts["lost"] = msgspec.structs.replace(config, start_pose=None)
    robots: list[Agent] = [agent(name, own) for name, own in starts.items()]
    reader = agent("reader", config)
    for seed, robot in enumerate(robots):
        for cycle in cycles(seed, count=6, points=24):
            robot.observe(cycle, cycle.stamp)
        for tx in robot.ledger:
            reader.receive(encode(Transactions((tx.data,)), config, b"somebody"), 0.0)
    seen = [(tx, tx.decode_again(config)) for tx in reader.ledger]
    assert any(len(payload.retracted) for _, payload in seen)
    assert any(payload.sightings for _, payload in seen)
    digest, states = independent(config, seen)
    assert digest == reader.digest()
    assert set(states) == set(State) and len(Placing(seen).blocks) == 2
