"""Grammars of what travels, and the robots that sign in the fuzzing's fleet.

A new record kind: give it a grammar in RECORDS and a sample in `payloads`. Until then its body is
changed as mere bytes.
"""

from __future__ import annotations

import zlib
from random import Random

import msgspec
import numpy as np

from dagmap import identity, messages, payload, transaction
from dagmap.config import Config, GraphConfig, TransactionConfig
from dagmap.identity import Identity
from dagmap.model import FLEET_FRAME, LIMIT_MM, FrameId, quantise_pose
from dagmap.payload import Anchor, Bundle, Described, Kind, Link, Payload, Revocation, Sighting
from dagmap.transaction import id_of
from dagmap.wire import Reader, Refusal
from grammar import (
    Branch,
    Flip,
    Grammar,
    Leaf,
    Node,
    by_kind,
    counted,
    labelled,
    many,
    mutate,
    number,
    raw,
    record,
    rest,
    signed,
    sized,
    tree,
    when,
)


class FuzzConfig(Config, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """With one id of the parameters for good: else the corpus would be refused, message by
    message and unnoticed, whenever a default changes or a parameter comes.
    """

    @property
    def parameters_id(self) -> bytes:
        return bytes.fromhex("02f561876e12c44b")


CONFIG = FuzzConfig(  # whatever judges a transaction is fixed too
    fleet="dagmap",
    graph=GraphConfig(n_p=2, n_c=2, n_c_max=8),
    transaction=TransactionConfig(proof_of_work_bits=1, max_references=2),
)
AUTHORITY = Identity.from_seed(bytes([9]) * 32)  # the key of the closed fleet
CLOSED = msgspec.structs.replace(CONFIG, fleet_key=AUTHORITY.public_key.hex())
_OPEN = [Identity.from_seed(bytes([i]) * 32) for i in range(3)]
ROBOTS = [
    Identity.from_seed(
        bytes([i]) * 32, AUTHORITY.certify(CLOSED.fleet_id, robot.public_key, f"robot{i}")
    )
    for i, robot in enumerate(_OPEN)
]
_BY_KEY = {robot.public_key: robot for robot in (*ROBOTS, AUTHORITY)}
_POSE = quantise_pose(np.eye(4))

_FRAME = record(raw(8), number)


def _certificate(reader: Reader, _: list[Node]) -> Node:
    data = reader.take(reader.left)
    return Branch("list", [Leaf("raw", data[:-64]), Leaf("raw", data[-64:])], "certificate")


RECORDS: dict[int, Grammar] = {
    Kind.PROFILE: rest,
    Kind.ANCHORS: many(record(number, number, signed, raw(28))),
    Kind.BUNDLE: record(number, number, counted(record(signed, number)), rest, label="bundle"),
    Kind.RETRACTION: counted(number),
    Kind.SIGHTING: record(number, counted(number)),
    Kind.LINK: record(_FRAME, _FRAME, raw(28), number),
    Kind.CERTIFICATE: _certificate,
    Kind.REVOCATION: record(raw(8), number),
    Kind.DESCRIPTORS: record(number, many(raw(44))),
}
_SIZED = {int(kind): sized(grammar) for kind, grammar in RECORDS.items()}
PAYLOAD = many(record(number, by_kind(_SIZED, sized(rest))))
TRANSACTION = record(
    raw(1),  # version
    raw(32),  # public key
    number,  # sequence
    when(lambda before: before[2] != Leaf("number", 0), raw(32)),  # previous
    number,  # Lamport time
    counted(raw(32)),  # references
    sized(PAYLOAD),
    raw(4),  # nonce
    raw(64),  # signature
    label="transaction",
)


def _cut_follows(before: list[Node]) -> bool:
    return (
        isinstance(before[1], Leaf)
        and isinstance(before[1].value, int)
        and bool(before[1].value & 1)
    )


def message(content: Grammar) -> Grammar:
    """A whole message; `content` is the grammar of a transaction in it."""
    heads = record(
        number,
        counted(record(raw(8), number, number)),
        many(record(raw(8), number, raw(8), when(_cut_follows, number))),
    )
    want = record(counted(record(raw(8), number, number)), counted(raw(32)), counted(raw(8)))
    bodies = {
        messages.Kind.TRANSACTIONS: record(number, many(sized(content))),
        messages.Kind.HEADS: heads,
        messages.Kind.WANT: want,
    }
    kinds = {int(kind): grammar for kind, grammar in bodies.items()}
    head = record(raw(2), raw(1), raw(1), raw(8), raw(8), raw(8), by_kind(kinds, at=2))

    def read(reader: Reader, _: list[Node]) -> Node:
        data = reader.take(reader.left)
        return Branch("list", [*tree(data[:-4], head).items, Leaf("raw", data[-4:])], "message")

    return read


def payloads() -> list[Payload]:
    """A sample of every kind of record, the smallest and one with more in it."""
    none, color = np.full((1, 2), -1, np.int64), np.zeros((1, 3), np.uint8)
    one = Bundle(
        0,
        np.zeros((1, 3), np.int32),
        none,
        color,
        np.array([0, 1]),
        np.array([0]),
        np.zeros(1, np.uint8),
    )
    anchors = (Anchor(0, 0, 0, _POSE), Anchor(3, 1, -1_000_000, _POSE))
    frame = FrameId(ROBOTS[0].author, 1)
    links = (Link(frame, FLEET_FRAME, _POSE, 7), Link(FrameId(ROBOTS[1].author), frame, _POSE, 0))
    numbers = np.array([0, 1, 5, 300], np.int64)
    seen = (Sighting(1, numbers[:1]), Sighting(2, numbers))
    return [
        Payload(),
        Payload(name="robot"),
        Payload(name="", anchors=anchors),
        Payload(bundle=one),
        Payload(bundle=bundle(Random(1), 12, 2), anchors=anchors[:1]),
        Payload(bundle=bundle(Random(2), 24, 3)),
        Payload(retracted=numbers),
        Payload(sightings=seen),
        Payload(links=links),
        Payload("all", anchors, bundle(Random(3), 5, 1), numbers[:1], seen[:1], links[:1]),
        Payload(certificate=ROBOTS[0].certificate, anchors=anchors[:1], links=links),
        Payload(revocations=(Revocation(ROBOTS[1].author, 1), Revocation(ROBOTS[2].author, 0))),
        Payload(anchors=anchors, described=(_described(1), _described(5))),
    ]


def _described(count: int) -> Described:
    rng = np.random.default_rng(count)
    position = rng.integers(-3000, 3000, (count, 3)).astype(np.int32)
    return Described(3, position, rng.integers(0, 256, (count, 32)).astype(np.uint8))


def bundle(rng: Random, count: int, segments: int, base: int = 40, n_p: int = 2) -> Bundle:
    """Features near each other, with parents of every kind, in segments with and without colour."""
    position = np.array([[rng.randrange(2000) for _ in range(3)] for _ in range(count)], np.int32)
    position[-1, 0] = rng.choice((LIMIT_MM, -LIMIT_MM, 5))
    parents = np.full((count, n_p), -1, np.int64)
    for i in range(1, count):
        kinds = (rng.randrange(base + i), base + rng.randrange(i), *parents[i - 1].tolist())
        chosen = rng.sample(sorted({k for k in kinds if k >= 0}), 1) + [-1] * n_p
        if rng.random() < 0.7:
            chosen[1] = int(rng.choice(parents[max(0, chosen[0] - base)].tolist()))
        parents[i] = chosen[:n_p]
    color = np.array([[rng.randrange(256) for _ in range(3)] for _ in range(count)], np.uint8)
    starts = np.array([count * s // segments for s in range(segments + 1)], np.int64)
    colored = np.array([s % 2 for s in range(segments)], np.uint8)
    color[: starts[1]] = 0
    return Bundle(base, position, parents, color, starts, np.arange(segments) * 3, colored)


def change_bundle(body: bytes, rng: Random) -> bytes:
    """A bundle record with other columns, encoded anew: any change of the code itself fails."""
    try:
        old = payload._decode_bundle(Reader(body), CONFIG.graph.n_p)
    except Refusal:
        return body
    position, parents, color = old.position.copy(), old.parents.copy(), old.color.copy()
    base, starts, colored = old.base, old.starts.copy(), old.colored.copy()
    i = rng.randrange(len(position))
    way = rng.randrange(6)
    if way == 0:
        position[i, rng.randrange(3)] = rng.choice((LIMIT_MM, -LIMIT_MM, 0, rng.randrange(1 << 20)))
    elif way == 1:
        parents[i, rng.randrange(parents.shape[1])] = rng.randrange(-1, max(base + i, 1))
    elif way == 2:
        color[i] = rng.randbytes(1)[0]
        colored[rng.randrange(len(colored))] ^= 1
    elif way == 3:
        base = rng.choice((0, 1, base + 1, payload.MAX_NUMBER))
    elif way == 4 and len(position) < 64:
        times = rng.choice((2, 2, 3, 70))
        position, color = np.tile(position, (times, 1)), np.tile(color, (times, 1))
        parents = np.tile(parents, (times, 1))
        starts = np.array([*starts[:-1], len(position)])
    else:
        parents[:, rng.randrange(parents.shape[1])] = base  # many children
        parents[0] = -1
    try:
        return payload._encode_bundle(
            Bundle(base, position, parents, color, starts, old.cycles, colored)
        )
    except ValueError:
        return body


def change(
    data: bytes, grammar: Grammar, rng: Random, flip: Flip, config: Config = CONFIG
) -> bytes:
    """Change the tree, then (mostly) make ids, certificates, work, signatures and checksums right
    again, as the fleet of this configuration wants them.
    """
    root = tree(data, grammar)
    before = {id(node): id_of(node.dump()) for node in labelled(root, "transaction")}
    mutate(root, rng, flip, {"bundle": change_bundle})
    renamed: dict[bytes, bytes] = {}
    for node in labelled(root, "transaction"):
        if rng.random() < 0.95:
            _seal(node, renamed, rng, config)
        renamed[before.get(id(node), b"")] = id_of(node.dump())
    for node in labelled(root, "message"):
        if rng.random() < 0.95 and node.items:
            _checksum(node)
    return root.dump()


def _seal(node: Branch, renamed: dict[bytes, bytes], rng: Random, config: Config) -> None:
    """Point to the transactions before by their new ids; certify, work and sign."""
    if len(node.items) != 9:
        return
    previous, references, key = node.items[3], node.items[5], node.items[1]
    if isinstance(previous, Leaf) and isinstance(previous.value, bytes):
        previous.value = renamed.get(previous.value, previous.value)
    if isinstance(references, Branch):
        ids = [leaf.dump() for leaf in references.items]
        ids = [renamed.get(id_, id_) for id_ in ids]
        ids = sorted(set(ids)) if rng.random() < 0.9 else ids
        references.items = [Leaf("raw", id_) for id_ in ids]
    if config.closed and rng.random() < 0.9:
        _certify(node, key.dump(), config)
    unworked = Branch("list", node.items[:7]).dump()
    unsigned = unworked + transaction._work(config, unworked)
    robot = _BY_KEY.get(key.dump(), ROBOTS[0])
    signature = robot.sign(transaction._SIGNED + config.fleet_id + unsigned)
    node.items[7:] = [Leaf("raw", unsigned[-4:]), Leaf("raw", signature)]


def _certify(node: Branch, key: bytes, config: Config) -> None:
    """Let the fleet key vouch for whatever name stands with whatever key."""
    for certificate in labelled(node, "certificate"):
        name = certificate.dump()[:-64]
        signature = AUTHORITY.sign(identity._CERTIFIED + config.fleet_id + key + name)
        certificate.items = [Leaf("raw", name), Leaf("raw", signature)]


def _checksum(node: Branch) -> None:
    data = Branch("list", node.items[:-1]).dump()
    node.items[-1] = Leaf("raw", zlib.crc32(data).to_bytes(4, "little"))
