"""What a transaction says: typed records (kind, length, body), to bytes and back.

An unknown kind is kept in the transaction's bytes and relayed; it says nothing to this version.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from . import wire
from .kernels.codec import decode_features, encode_features
from .model import (
    DESCRIPTOR,
    LIMIT_MM,
    MAX_CYCLE,
    MAX_DESCRIBED,
    MAX_NAME,
    QUATERNION_ONE,
    AuthorId,
    FrameId,
    Int32s,
    Int64s,
    Reason,
    Uint8s,
)
from .text import printable
from .wire import Reader, Refusal

MAX_FEATURES = 4096  # of one bundle record; bounds the work that foreign bytes can ask for
MAX_NUMBER = (1 << 40) - 1  # of an author's features
MAX_SEQUENCE = (1 << 40) - 1  # of an author's transactions
CERTAIN = (1 << 31) - 1  # inliers of a link that was configured, not measured
_MAX_LIST = 1 << 16
_DESCRIBED = np.dtype([("position", "<i4", 3), ("descriptor", "u1", DESCRIPTOR)])
_NORM_SLACK = 1 << 50  # of a quaternion's squared norm 2^60: a 1024th


class Kind(IntEnum):
    """Record kinds of version 1. The numbers are the wire's."""

    PROFILE = 1
    ANCHORS = 2
    BUNDLE = 3
    RETRACTION = 4
    SIGHTING = 5
    LINK = 6
    CERTIFICATE = 7
    REVOCATION = 8
    DESCRIPTORS = 9


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """The pose of one cycle: sensor to the author's SLAM frame of that session."""

    cycle: int  # number of the cycle in its author's chain
    session: int
    stamp: int  # microseconds: the cycle's name
    pose: Int32s  # (7,)


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """Features of one transaction in issue order: feature i has the author's number base + i.

    Segments of features share an anchor. The cores of the bundles (section 4.2) are the features
    that no later one in the transaction refers to; each carries those of its ascendants here.
    """

    base: int
    position: Int32s  # (n, 3) mm in the frame of the anchor
    parents: Int64s  # (n, N_p) the author's feature numbers, -1 for none or a lattice node
    color: Uint8s  # (n, 3)
    starts: Int64s  # (s + 1,) first feature of each segment
    cycles: Int64s  # (s,) number of the anchor's cycle of each segment
    colored: Uint8s  # (s,) whether a segment carries colours

    def cores(self) -> Int64s:
        """Indices of the bundle cores, newest first."""
        referred = np.zeros(len(self.position), np.bool_)
        inside = self.parents[self.parents >= self.base] - self.base
        referred[inside] = True
        return np.flatnonzero(~referred)[::-1].astype(np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """Features of the author that one of its cycles saw again."""

    cycle: int
    numbers: Int64s  # ascending


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """A measured or configured pose of frame `source` in frame `target`.

    inliers: what speaks for it; of a configured one CERTAIN less its standard deviation in mm.
    """

    source: FrameId
    target: FrameId
    pose: Int32s  # (7,)
    inliers: int


@dataclass(frozen=True, slots=True, eq=False)
class Described:
    """Points of one cycle by which robots that share no frame find each other's."""

    cycle: int
    position: Int32s  # (n, 3) mm in the frame of the anchor
    descriptors: Uint8s  # (n, 32), compared by Hamming distance


@dataclass(frozen=True, slots=True)
class Revocation:
    """The fleet key's word on a robot: its first `count` transactions count, no others."""

    author: AuthorId
    count: int


@dataclass(frozen=True, slots=True, eq=False)
class Payload:
    """The records of one transaction, by kind."""

    name: str | None = None
    anchors: tuple[Anchor, ...] = ()
    bundle: Bundle | None = None
    retracted: Int64s = field(default_factory=lambda: np.zeros(0, np.int64))  # ascending numbers
    sightings: tuple[Sighting, ...] = ()
    links: tuple[Link, ...] = ()
    certificate: bytes | None = None  # name, then 64 bytes of signature: see identity.py
    revocations: tuple[Revocation, ...] = ()
    described: tuple[Described, ...] = ()

    @property
    def robot(self) -> str | None:
        """What the author is called: by its certificate, else by its own word."""
        return self.name if self.certificate is None else self.certificate[:-64].decode()

    @property
    def features(self) -> int:
        return 0 if self.bundle is None else len(self.bundle.position)


def encode_payload(payload: Payload) -> bytes:
    """The canonical bytes of a payload; `decode_payload` is the inverse."""
    records: list[tuple[Kind, bytes]] = []
    if payload.certificate is not None:  # first, so that it is found before the rest is read
        records.append((Kind.CERTIFICATE, payload.certificate))
    if payload.name is not None:
        records.append((Kind.PROFILE, payload.name.encode()))
    if payload.anchors:
        records.append((Kind.ANCHORS, b"".join(map(_encode_anchor, payload.anchors))))
    if payload.bundle is not None:
        records.append((Kind.BUNDLE, _encode_bundle(payload.bundle)))
    if len(payload.retracted):
        records.append((Kind.RETRACTION, _encode_ascending(payload.retracted)))
    for sighting in payload.sightings:
        body = wire.number(sighting.cycle) + _encode_ascending(sighting.numbers)
        records.append((Kind.SIGHTING, body))
    records.extend((Kind.LINK, _encode_link(link)) for link in payload.links)
    for gone in payload.revocations:
        records.append((Kind.REVOCATION, gone.author + wire.number(gone.count)))
    records.extend(
        (Kind.DESCRIPTORS, _encode_described(keyframe)) for keyframe in payload.described
    )
    return b"".join(wire.number(kind) + wire.number(len(body)) + body for kind, body in records)


def decode_payload(data: bytes, n_p: int) -> Payload:
    """Read the records. Raises Refusal for whatever is not exactly as `encode_payload` writes."""
    found: dict[Kind, list[Reader]] = {kind: [] for kind in Kind}
    reader = Reader(data)
    while reader.left:
        kind, size = reader.number(), reader.number(len(data))
        body = Reader(reader.take(size))
        if kind in found:
            found[Kind(kind)].append(body)
    for kind in (Kind.PROFILE, Kind.ANCHORS, Kind.BUNDLE, Kind.RETRACTION, Kind.CERTIFICATE):
        if len(found[kind]) > 1:
            raise Refusal(Reason.MALFORMED, f"two records of kind {kind.name}")
    names = [_decode_name(body) for body in found[Kind.PROFILE]]
    anchors = [anchor for body in found[Kind.ANCHORS] for anchor in _decode_anchors(body)]
    bundles = [_decode_bundle(body, n_p) for body in found[Kind.BUNDLE]]
    retracted = [_whole(body, _decode_ascending) for body in found[Kind.RETRACTION]]
    certificates = [_decode_certificate(body) for body in found[Kind.CERTIFICATE]]
    return Payload(
        names[0] if names else None,
        tuple(anchors),
        bundles[0] if bundles else None,
        retracted[0] if retracted else np.zeros(0, np.int64),
        tuple(_decode_sighting(body) for body in found[Kind.SIGHTING]),
        tuple(_decode_link(body) for body in found[Kind.LINK]),
        certificates[0] if certificates else None,
        tuple(_decode_revocation(body) for body in found[Kind.REVOCATION]),
        tuple(_decode_described(body) for body in found[Kind.DESCRIPTORS]),
    )


def first_certificate(data: bytes) -> bytes:
    """The certificate with which these records begin; nothing behind it is read.

    Raises Refusal where the first record is another, or none.
    """
    reader = Reader(data)
    if not reader.left or reader.number() != Kind.CERTIFICATE:
        raise Refusal(Reason.CERTIFICATE, "the first record is none")
    return reader.take(reader.number(MAX_NAME + 64))


def _decode_certificate(body: Reader) -> bytes:
    if body.left <= 64:
        raise Refusal(Reason.MALFORMED, "certificate without a name")
    _decode_name(Reader(body.data[:-64]))
    return body.data


def _decode_revocation(body: Reader) -> Revocation:
    revocation = Revocation(body.take(8), body.number(MAX_SEQUENCE + 1))
    body.end()
    return revocation


def _decode_name(body: Reader) -> str:
    if body.left > MAX_NAME:
        raise Refusal(Reason.MALFORMED, "name longer than 64 bytes")
    try:
        name = body.take(body.left).decode()
    except UnicodeDecodeError:
        raise Refusal(Reason.MALFORMED, "name is not UTF-8") from None
    if not printable(name):
        raise Refusal(Reason.MALFORMED, "name has characters that none may have")
    return name


def _encode_anchor(anchor: Anchor) -> bytes:
    head = wire.number(anchor.cycle) + wire.number(anchor.session) + wire.signed(anchor.stamp)
    return head + anchor.pose.astype("<i4").tobytes()


def _decode_anchors(body: Reader) -> list[Anchor]:
    anchors = []
    while body.left:
        cycle, session = body.number(MAX_CYCLE), body.number((1 << 32) - 1)
        anchors.append(Anchor(cycle, session, body.signed(), _decode_pose(body)))
    return anchors


def _decode_pose(body: Reader) -> Int32s:
    pose = np.frombuffer(body.take(28), "<i4").astype(np.int32)
    norm = sum(int(q) * int(q) for q in pose[:4])
    if abs(norm - QUATERNION_ONE * QUATERNION_ONE) > _NORM_SLACK:
        raise Refusal(Reason.MALFORMED, "pose without a unit quaternion")
    if max(abs(int(t)) for t in pose[4:]) > LIMIT_MM:
        raise Refusal(Reason.MALFORMED, "pose beyond 2^29 mm")
    return pose


def _encode_bundle(bundle: Bundle) -> bytes:
    head = bytearray(wire.number(bundle.base) + wire.number(len(bundle.position)))
    head += wire.number(len(bundle.cycles))
    cycle = 0
    counts = np.diff(bundle.starts).tolist()
    for number, count, colored in zip(bundle.cycles.tolist(), counts, bundle.colored, strict=True):
        head += wire.signed(number - cycle) + wire.number(2 * count + int(colored))
        cycle = number
    return (
        bytes(head)
        + encode_features(
            bundle.position,
            bundle.parents,
            bundle.base,
            bundle.starts,
            bundle.color,
            bundle.colored,
        ).tobytes()
    )


def _decode_bundle(body: Reader, n_p: int) -> Bundle:
    base, count = body.number(MAX_NUMBER), body.number(MAX_FEATURES)
    segments = body.number(count)
    if not segments:
        raise Refusal(Reason.MALFORMED, "bundle without features")
    cycles = np.zeros(segments, np.int64)
    starts = np.zeros(segments + 1, np.int64)
    colored = np.zeros(segments, np.uint8)
    cycle = 0
    for s in range(segments):
        cycle += body.signed()
        size = body.number(2 * MAX_FEATURES + 1)
        if not 0 <= cycle <= MAX_CYCLE or size < 2:
            raise Refusal(Reason.MALFORMED, "segment without a cycle or features")
        cycles[s], starts[s + 1], colored[s] = cycle, starts[s] + (size >> 1), size & 1
    if starts[-1] != count:
        raise Refusal(Reason.MALFORMED, "segments do not add up")
    data = np.frombuffer(body.take(body.left), np.uint8)
    position, parents, color, _, ok = decode_features(data, count, n_p, base, starts, colored)
    if not ok:
        raise Refusal(Reason.MALFORMED, "feature columns")
    return Bundle(base, position, parents, color, starts, cycles, colored)


def _encode_ascending(numbers: Int64s) -> bytes:
    steps = np.diff(numbers, prepend=np.int64(-1)) - 1
    return wire.number(len(numbers)) + wire.numbers(steps)


def _decode_ascending(body: Reader) -> Int64s:
    count = body.number(min(_MAX_LIST, body.left))
    steps = body.numbers(count, MAX_NUMBER)
    numbers = np.cumsum(steps + 1) - 1
    if count and int(numbers[-1]) > MAX_NUMBER:
        raise Refusal(Reason.MALFORMED, "feature number out of range")
    return numbers.astype(np.int64)


def _whole(body: Reader, read: Callable[[Reader], Int64s]) -> Int64s:
    value = read(body)
    body.end()
    return value


def _decode_sighting(body: Reader) -> Sighting:
    sighting = Sighting(body.number(MAX_CYCLE), _whole(body, _decode_ascending))
    if len(sighting.numbers) == 0:
        raise Refusal(Reason.MALFORMED, "sighting of nothing")
    return sighting


def _encode_link(link: Link) -> bytes:
    ends = b"".join(f.author + wire.number(f.session) for f in (link.source, link.target))
    return ends + link.pose.astype("<i4").tobytes() + wire.number(link.inliers)


def _decode_link(body: Reader) -> Link:
    source = FrameId(body.take(8), body.number((1 << 32) - 1))
    target = FrameId(body.take(8), body.number((1 << 32) - 1))
    link = Link(source, target, _decode_pose(body), body.number((1 << 31) - 1))
    body.end()
    return link


def _encode_described(keyframe: Described) -> bytes:
    rows = np.empty(len(keyframe.position), _DESCRIBED)
    rows["position"], rows["descriptor"] = keyframe.position, keyframe.descriptors
    return wire.number(keyframe.cycle) + rows.tobytes()


def _decode_described(body: Reader) -> Described:
    cycle = body.number(MAX_CYCLE)
    if body.left % _DESCRIBED.itemsize or not 0 < body.left // _DESCRIBED.itemsize <= MAX_DESCRIBED:
        raise Refusal(Reason.MALFORMED, f"described points of {body.left} bytes")
    rows = np.frombuffer(body.take(body.left), _DESCRIBED)
    position = rows["position"].astype(np.int32)
    if (np.abs(position.astype(np.int64)) > LIMIT_MM).any():
        raise Refusal(Reason.MALFORMED, "described point out of range")
    return Described(cycle, position, rows["descriptor"].copy())
