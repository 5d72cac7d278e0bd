"""The envelope: what is valid in itself, and that nothing else is."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chains import CONFIG, Author, anchor, bundle, identity
from dagmap import wire
from dagmap.config import Config, TransactionConfig
from dagmap.model import FLEET_FRAME, FrameId, Reason, quantise_pose
from dagmap.payload import Link, Payload, Sighting, decode_payload, encode_payload
from dagmap.transaction import MAX_SIZE, id_of, parse, seal
from dagmap.wire import Reader, Refusal


def full_payload() -> Payload:
    parents = np.array([[-1, -1], [7, 2], [8, 7], [-1, 9]], np.int64)
    return Payload(
        name="drone ä",
        anchors=(anchor(3, 1.5), anchor(4)),
        bundle=bundle(7, 4, 3, parents),
        retracted=np.array([0, 5, 6], np.int64),
        sightings=(Sighting(4, np.array([1, 9], np.int64)),),
        links=(Link(FrameId(b"abcdefgh", 2), FLEET_FRAME, quantise_pose(np.eye(4)), 12),),
    )


def refused(data: bytes, config: Config = CONFIG) -> Reason:
    with pytest.raises(Refusal) as caught:
        parse(data, config)
    return caught.value.reason


def test_payload_comes_back_as_it_was() -> None:
    sent = full_payload()
    back = decode_payload(encode_payload(sent), 2)
    assert back.name == sent.name
    assert [(a.cycle, a.session, a.stamp) for a in back.anchors] == [
        (3, 0, 3_000_000),
        (4, 0, 4_000_000),
    ]
    assert all(
        np.array_equal(a.pose, b.pose) for a, b in zip(back.anchors, sent.anchors, strict=False)
    )
    assert back.bundle is not None and sent.bundle is not None
    for column in ("base", "position", "parents", "starts", "cycles", "colored"):
        assert np.array_equal(getattr(back.bundle, column), getattr(sent.bundle, column)), column
    assert back.retracted.tolist() == [0, 5, 6]
    assert back.sightings[0].cycle == 4 and back.sightings[0].numbers.tolist() == [1, 9]
    assert (back.links[0].source, back.links[0].inliers) == (FrameId(b"abcdefgh", 2), 12)


def test_cores_are_the_features_that_none_in_the_bundle_refers_to() -> None:
    parents = np.array([[-1, -1], [0, -1], [0, 1], [-1, -1]], np.int64)
    assert bundle(0, 4, 0, parents).cores().tolist() == [3, 2]


def test_unknown_records_are_kept_and_relayed() -> None:
    strange = wire.number(77) + wire.number(3) + b"xyz"
    assert decode_payload(strange + encode_payload(full_payload()), 2).name == "drone ä"


def test_id_is_the_hash_of_the_exact_bytes() -> None:
    tx = Author("a").make()
    assert tx.id == id_of(tx.data)
    again = parse(tx.data, CONFIG)
    assert (again.id, again.author, again.key) == (tx.id, identity("a").author, tx.key)


def test_decoding_again_gives_the_same_columns() -> None:
    tx = Author("a").make(payload=Payload(anchors=(anchor(0),), bundle=bundle(0, 5)))
    first = tx.payload.bundle
    tx.drop_columns()
    again = tx.decode_again(CONFIG).bundle
    assert tx.payload.bundle is None and tx.features == 5
    assert np.array_equal(first.position, again.position)


def test_every_truncation_is_refused() -> None:
    data = Author("a").make(payload=full_payload_at_zero()).data
    cut = {refused(data[:size]) for size in range(len(data))}
    assert cut == {Reason.TRUNCATED}
    assert refused(data + b"\0") is Reason.MALFORMED


@pytest.mark.parametrize("flip", [0x01, 0x80, 0xFF])
def test_every_changed_byte_is_refused(flip: int) -> None:
    data = Author("a").make(payload=full_payload_at_zero()).data
    reasons = set()
    for i in range(len(data)):
        changed = bytearray(data)
        changed[i] ^= flip
        reasons.add(refused(bytes(changed)))
    assert reasons == {Reason.VERSION, Reason.MALFORMED, Reason.SIGNATURE}


def full_payload_at_zero() -> Payload:
    parents = np.array([[-1, -1], [0, -1], [1, 0]], np.int64)
    return Payload("r", (anchor(0),), bundle(0, 3, 0, parents))


def test_work_is_demanded_and_done() -> None:
    worked = Config(transaction=TransactionConfig(proof_of_work_bits=8))
    data = seal(identity("a"), worked, 0, None, 1, (), full_payload_at_zero())
    assert parse(data, worked).lamport == 1
    lazy = [seal(identity("a"), CONFIG, 0, None, n, (), full_payload_at_zero()) for n in range(9)]
    reasons = {refused(item, worked) for item in lazy}
    assert Reason.PROOF_OF_WORK in reasons


def test_another_fleets_signature_does_not_hold() -> None:
    data = seal(identity("a"), CONFIG, 0, None, 1, (), full_payload_at_zero())
    assert refused(data, msgspec.structs.replace(CONFIG, fleet="other")) is Reason.SIGNATURE


def test_references_are_ascending_and_bounded() -> None:
    a, b, c = (Author(name).make() for name in "abc")
    with pytest.raises(Refusal) as caught:
        Author("d").make(a, b, c)
    assert caught.value.reason is Reason.MALFORMED


@pytest.mark.parametrize(
    "parents",
    [
        [[-1, -1], [0, 0]],
        [[-1, -1], *[[0, -1]] * 9],
    ],
)
def test_structure_is_judged(parents: list[list[int]]) -> None:
    rows = np.array(parents, np.int64)
    payload = Payload(anchors=(anchor(0),), bundle=bundle(0, len(rows), 0, rows))
    data = seal(identity("a"), CONFIG, 0, None, 1, (), payload)
    assert refused(data) is Reason.STRUCTURE


def test_too_large_is_refused_before_anything_is_read() -> None:
    assert refused(bytes([1]) * (MAX_SIZE + 1)) is Reason.MALFORMED


@given(st.binary(max_size=200))
@settings(max_examples=300, deadline=None)
def test_noise_is_refused(data: bytes) -> None:
    unread = {Reason.TRUNCATED, Reason.MALFORMED}
    assert refused(data) in unread | {Reason.VERSION} and refused(b"\x01" + data) in unread


@given(st.integers(0, (1 << 63) - 1))
def test_numbers_come_back(value: int) -> None:
    reader = Reader(wire.number(value))
    assert reader.number() == value
    reader.end()


@given(st.integers(-(1 << 61), 1 << 61))
def test_signed_numbers_come_back(value: int) -> None:
    assert Reader(wire.signed(value)).signed() == value


@pytest.mark.parametrize("data", [b"\x80\x00", b"\xff" * 10, b"\x80"])
def test_numbers_have_one_form(data: bytes) -> None:
    with pytest.raises(Refusal):
        Reader(data).number()


@given(
    values=st.lists(st.integers(0, 127) | st.integers(0, (1 << 40) - 1), max_size=30),
    harm=st.lists(st.tuples(st.integers(0, 200), st.integers(0, 255)), max_size=3),
)
def test_many_numbers_are_read_and_written_as_one_after_the_other(
    values: list[int], harm: list[tuple[int, int]]
) -> None:
    data = wire.numbers(np.array(values, np.int64))
    assert data == b"".join(map(wire.number, values))
    harmed = bytearray(data + b"\x05")
    for at, byte in harm:
        harmed[at % len(harmed)] = byte

    def read(many: bool) -> tuple[list[int], int] | Reason:
        reader = wire.Reader(bytes(harmed))
        try:
            if many:
                return reader.numbers(len(values), 1 << 40).tolist(), reader.left
            return [reader.number(1 << 40) for _ in values], reader.left
        except wire.Refusal as refusal:
            return refusal.reason

    assert read(many=True) == read(many=False)
