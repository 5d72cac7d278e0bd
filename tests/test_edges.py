"""The edges of validity, as docs/protocol.md states them: the last that holds, the first that does
not. Robots that differ here would hold different maps, so no bound may move unseen."""

from __future__ import annotations

import hashlib
import struct
import zlib

import pytest

from chains import CONFIG, Author, identity
from dagmap import messages
from dagmap.identity import signature_holds
from dagmap.messages import Transactions
from dagmap.payload import Kind, Payload, decode_payload
from dagmap.transaction import parse, seal
from dagmap.wire import Reader, Refusal, number, signed

UNIT = struct.pack("<7i", 1 << 30, 0, 0, 0, 0, 0, 0)
FRAME = b"abcdefgh"


def pose(*quaternion: int, x: int = 0) -> bytes:
    return struct.pack("<7i", *quaternion, x, 0, 0)


def anchor(cycle: int = 0, session: int = 0, stamp: int = 0, where: bytes = UNIT) -> bytes:
    return number(cycle) + number(session) + signed(stamp) + where


def link(session: int = 0, inliers: int = 0) -> bytes:
    return FRAME + number(session) + FRAME + number(session) + UNIT + number(inliers)


def numbers(count: int, last: int) -> bytes:
    """A list that ends with `last`."""
    return number(count) + bytes(count - 1) + number(last - count + 1)


def described(count: int, x: int = 0, cycle: int = 0) -> bytes:
    return number(cycle) + struct.pack("<3i", x, 0, 0).ljust(44, b"\0") * count


CYCLE, SESSION, NUMBER, FAR = (1 << 31) - 1, (1 << 32) - 1, (1 << 40) - 1, 1 << 29
# The largest and smallest w, x of which the squares sum up to 2^60 +- 2^50.
LONG, SHORT = (1074265984, 11584), (1073217407, 44858)
EDGES = {
    "cycle": (Kind.ANCHORS, anchor(CYCLE), anchor(CYCLE + 1)),
    "session": (Kind.ANCHORS, anchor(0, SESSION), anchor(0, SESSION + 1)),
    "latest stamp": (Kind.ANCHORS, anchor(stamp=(1 << 62) - 1), anchor(stamp=1 << 62)),
    "earliest stamp": (Kind.ANCHORS, anchor(stamp=-(1 << 62)), anchor(stamp=-(1 << 62) - 1)),
    "far": (
        Kind.ANCHORS,
        anchor(where=pose(1 << 30, 0, 0, 0, x=-FAR)),
        anchor(where=pose(1 << 30, 0, 0, 0, x=-FAR - 1)),
    ),
    "retracted": (Kind.RETRACTION, numbers(1, NUMBER), numbers(1, NUMBER + 1)),
    "sum of steps": (Kind.RETRACTION, numbers(2, NUMBER), numbers(2, NUMBER + 1)),
    "long list": (Kind.RETRACTION, numbers(1 << 16, 1 << 16), numbers((1 << 16) + 1, 1 << 17)),
    "sighting": (Kind.SIGHTING, number(0) + numbers(1, 0), number(0) + number(0)),
    "sighting's cycle": (
        Kind.SIGHTING,
        number(CYCLE) + numbers(1, 0),
        number(CYCLE + 1) + numbers(1, 0),
    ),
    "link's session": (Kind.LINK, link(SESSION), link(SESSION + 1)),
    "inliers": (Kind.LINK, link(0, CYCLE), link(0, CYCLE + 1)),
    "revoked": (Kind.REVOCATION, FRAME + number(1 << 40), FRAME + number((1 << 40) + 1)),
    "described": (Kind.DESCRIPTORS, described(1024), described(1025)),
    "nothing described": (Kind.DESCRIPTORS, described(1), described(0)),
    "described's cycle": (Kind.DESCRIPTORS, described(1, 0, CYCLE), described(1, 0, CYCLE + 1)),
    "described far": (Kind.DESCRIPTORS, described(1, FAR), described(1, FAR + 1)),
    "name": (Kind.PROFILE, b"a" * 64, b"a" * 65),
    "certified name": (Kind.CERTIFICATE, b"a" * 128, b"a" * 129),
    "nameless certificate": (Kind.CERTIFICATE, b"a" * 65, b"a" * 64),
}


def decode(kind: Kind, body: bytes) -> Payload:
    return decode_payload(number(kind) + number(len(body)) + body, 2)


@pytest.mark.parametrize("edge", EDGES)
def test_records(edge: str) -> None:
    kind, last, beyond = EDGES[edge]
    decode(kind, last)
    with pytest.raises(Refusal):
        decode(kind, beyond)


def test_a_quaternion_is_of_unit_length_to_a_1024th_of_its_square() -> None:
    one, slack = 1 << 60, 1 << 50
    for (w, x), far in ((LONG, one + slack), (SHORT, one - slack)):
        outwards = 1 if far > one else -1
        inside, outside = w * w + x * x, w * w + (x + outwards) ** 2
        assert abs(inside - one) <= slack < abs(outside - one)
        decode(Kind.ANCHORS, anchor(where=pose(w, x, 0, 0)))
        with pytest.raises(Refusal, match="unit quaternion"):
            decode(Kind.ANCHORS, anchor(where=pose(w, 0, x + outwards, 0)))


@pytest.mark.parametrize(("field", "last"), [("sequence", NUMBER), ("lamport", (1 << 48) - 1)])
def test_envelope(field: str, last: int) -> None:
    def made(value: int) -> bytes:
        sequence, lamport = (value, 1) if field == "sequence" else (1, value)
        return seal(identity("a"), CONFIG, sequence, bytes(32), lamport, (), Payload())

    assert getattr(parse(made(last), CONFIG), field) == last
    with pytest.raises(Refusal, match="above"):
        parse(made(last + 1), CONFIG)


def test_numbers() -> None:
    assert Reader(number((1 << 63) - 1)).number() == (1 << 63) - 1
    for data in (number(1 << 63), b"\x80\x00", b"\xff" * 10):
        with pytest.raises(Refusal):
            Reader(data).number()


def message(kind: int, body: bytes) -> messages.Message:
    data = messages.encode(Transactions(()), CONFIG, b"senderid")
    return messages.parse(_summed(data[:3] + bytes([kind]) + data[4:28] + body), CONFIG)[1]


def _summed(data: bytes) -> bytes:
    return data + zlib.crc32(data).to_bytes(4, "little")


HEAD, LENGTH = number(0) + number(0) + FRAME, 1 << 40
MESSAGE_EDGES = {
    "more": (1, b"\x01", b"\x02"),
    "a transaction": (1, b"\0" + number(56_000) + bytes(56_000), b"\0" + number(56_001)),
    "a small transaction": (1, b"\0" + number(105) + bytes(105), b"\0" + number(104) + bytes(104)),
    "echoes": (2, number(0) + number(8) + (FRAME + b"\0\0") * 8, number(0) + number(9)),
    "length": (2, HEAD + number(2 * LENGTH) + FRAME, HEAD + number(2 * LENGTH + 1) + FRAME + b"\0"),
    "length with proof": (
        2,
        HEAD + number(2 * LENGTH - 1) + FRAME + number(LENGTH),
        HEAD + number(2 * LENGTH - 1) + FRAME + number(LENGTH + 1),
    ),
    "range": (
        3,
        number(1) + FRAME + number(LENGTH) * 2 + b"\0\0",
        number(1) + FRAME + number(LENGTH + 1) + b"\0\0\0",
    ),
    "range's length": (
        3,
        number(1) + FRAME + b"\0" + number(LENGTH) + b"\0\0",
        number(1) + FRAME + b"\0" + number(LENGTH + 1) + b"\0\0",
    ),
    "proofs": (3, b"\0\0\2" + FRAME + FRAME[::-1], b"\0\0\2" + FRAME * 2),
    "end": (3, b"\0\0\0", b"\0\0\0\0"),
    "kind": (3, b"\0\0\0", None),
}


@pytest.mark.parametrize("edge", MESSAGE_EDGES)
def test_messages(edge: str) -> None:
    kind, last, beyond = MESSAGE_EDGES[edge]
    message(kind, last)
    with pytest.raises(Refusal):
        message(4 if beyond is None else kind, last if beyond is None else beyond)


# Ed25519. Implementations differ in what they take of keys and signatures that no honest signer
# makes (RFC 8032 leaves some of it open): with another library robots could disagree.

ORDER = (1 << 252) + 27742317777372353535851937790883648493
PRIME = (1 << 255) - 19


def point(y: int, sign: int = 0) -> bytes:
    return (y | sign << 255).to_bytes(32, "little")


NEUTRAL, NOTHING = point(1), bytes(32)


def test_a_signature_has_one_form() -> None:
    """S + L is refused: else anybody could make a second transaction out of one, with another id,
    and so prove a fork of an honest author."""
    tx = Author("a").make()
    data = tx.data[:-32] + (int.from_bytes(tx.data[-32:], "little") + ORDER).to_bytes(32, "little")
    with pytest.raises(Refusal, match="signature"):
        parse(data, CONFIG)
    for scalar in (ORDER, 2 * ORDER, (1 << 256) - 1):
        assert not signature_holds(NEUTRAL, NEUTRAL + scalar.to_bytes(32, "little"), b"m")


def test_keys_of_small_order_are_keys_and_their_points_need_not_be_in_shortest_form() -> None:
    for key in (NEUTRAL, point(1 + PRIME), point(1, sign=1)):
        assert signature_holds(key, NEUTRAL + NOTHING, b"m")
    assert not signature_holds(point(2), NEUTRAL + NOTHING, b"m")  # no point of the curve


def test_the_point_of_a_signature_is_compared_by_its_bytes() -> None:
    for other in (point(1 + PRIME), point(1, sign=1)):
        assert not signature_holds(NEUTRAL, other + NOTHING, b"m")


def test_the_cofactor_is_not_multiplied_out() -> None:
    """Of a key of order 2 a signature S = 0, R = neutral holds where the hash is even; with the
    cofactor it would always."""
    key, found = point(PRIME - 1), set()
    for i in range(16):
        digest = hashlib.sha512(NEUTRAL + key + bytes([i])).digest()
        even = int.from_bytes(digest, "little") % ORDER % 2 == 0
        assert signature_holds(key, NEUTRAL + NOTHING, bytes([i])) == even
        found.add(even)
    assert found == {True, False}
