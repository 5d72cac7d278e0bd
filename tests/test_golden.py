"""The bytes of every record kind, of the envelope and of every message, byte by byte.

These bytes are protocol version 1 (docs/protocol.md). Robots in the field hold them in their
ledgers and check signatures over them, so until release 1.0 a change here is a change that the
CHANGELOG names, and from 1.0 on the bytes are frozen. Where the format has to change then:

1. raise VERSION in transaction.py (records, envelope) or in messages.py (messages);
2. keep reading the old version: `parse` dispatches on the first byte, and an accepted transaction
   of the old version stays what it is, since its id is the hash of its exact bytes;
3. leave the tests below as they are, for the old version, and add the new bytes beside them;
4. say so in docs/protocol.md and in CHANGELOG.md.

A new record kind needs no new version: unknown kinds are kept and relayed. Give it the next number,
and its bytes here.
"""

from __future__ import annotations

import zlib

import numpy as np
import pytest

from chains import CONFIG, FLEET_KEY, closed, enrolled, identity
from dagmap import messages
from dagmap.config import Config
from dagmap.identity import author_of
from dagmap.messages import Head, Heads, Message, Transactions, Want
from dagmap.model import FLEET_FRAME, FrameId, quantise_pose
from dagmap.payload import (
    Anchor,
    Bundle,
    Described,
    Kind,
    Link,
    Payload,
    Revocation,
    Sighting,
    decode_payload,
    encode_payload,
)
from dagmap.text import printable
from dagmap.transaction import id_of, parse, seal
from dagmap.wire import Refusal

WORKED = Config()  # with the default proof of work
CLOSED = closed()


def pose() -> np.ndarray:
    """A quarter turn about z, 1, -2 and 3 m away."""
    matrix = np.array([[0, -1, 0, 1], [1, 0, 0, -2], [0, 0, 1, 3], [0, 0, 0, 1]], float)
    return quantise_pose(matrix)


def bundle() -> Bundle:
    """Three features after seven earlier ones, of two cycles, the first two with colours."""
    return Bundle(
        base=7,
        position=np.array([[0, 0, 0], [40, -40, 80], [1000, 2000, -3000]], np.int32),
        parents=np.array([[-1, -1], [7, -1], [8, 2]], np.int64),
        color=np.array([[1, 2, 3], [255, 128, 0], [0, 0, 0]], np.uint8),
        starts=np.array([0, 2, 3], np.int64),
        cycles=np.array([3, 4], np.int64),
        colored=np.array([1, 0], np.uint8),
    )


def described() -> Described:
    """Two points of cycle 300 with a descriptor each."""
    position = np.array([[1000, -2000, 3000], [0, 0, 40]], np.int32)
    return Described(300, position, np.arange(64, dtype=np.uint8).reshape(2, 32))


PAYLOADS = {
    Kind.PROFILE: Payload(name="drone ä"),
    Kind.ANCHORS: Payload(anchors=(Anchor(300, 1, -1_500_000, pose()),)),
    Kind.BUNDLE: Payload(bundle=bundle()),
    Kind.RETRACTION: Payload(retracted=np.array([0, 5, 6, 500], np.int64)),
    Kind.SIGHTING: Payload(sightings=(Sighting(4, np.array([1, 9], np.int64)),)),
    Kind.LINK: Payload(links=(Link(FrameId(b"abcdefgh", 2), FLEET_FRAME, pose(), 200),)),
    Kind.CERTIFICATE: Payload(certificate=enrolled("r", CLOSED).certificate),
    Kind.REVOCATION: Payload(revocations=(Revocation(b"abcdefgh", 300),)),
    Kind.DESCRIPTORS: Payload(described=(described(),)),
}
RECORDS: dict[Kind, str] = {
    Kind.PROFILE: "010864726f6e6520c3a4",
    Kind.ANCHORS: "0223ac0201bf8db701cd3c412d0000000000000000cd3c412de803000030f8ffffb80b0000",
    Kind.BUNDLE: "0321070302060502020000411d763a5f9cdf88ab24b70cabd58082f6c66fcadcb00000",
    Kind.RETRACTION: "040604000400ed03",
    Kind.SIGHTING: "050404020107",
    Kind.LINK: (
        "0630616263646566676802000000000000000000cd3c412d0000000000000000cd3c412de8030000"
        "30f8ffffb80b0000c801"
    ),
    Kind.CERTIFICATE: (
        "0741728957a601e9b70301d16d780e44dbd9805b5713d0b6abb54346d097e1b8b84dd7ecd55fd070"
        "41d77d3bab7b1660ce9b27767ad4987d74771652b15c3ba749b508"
    ),
    Kind.REVOCATION: "080a6162636465666768ac02",
    Kind.DESCRIPTORS: (
        "095aac02e803000030f8ffffb80b0000000102030405060708090a0b0c0d0e0f1011121314151617"
        "18191a1b1c1d1e1f000000000000000028000000202122232425262728292a2b2c2d2e2f30313233"
        "3435363738393a3b3c3d3e3f"
    ),
}


@pytest.mark.parametrize("kind", Kind, ids=lambda kind: kind.name)
def test_records(kind: Kind) -> None:
    data = bytes.fromhex(RECORDS[kind])
    assert encode_payload(PAYLOADS[kind]).hex() == data.hex()
    assert data[0] == kind and encode_payload(decode_payload(data, 2)) == data


# First and last code point of what no name may hold; every plane ends with two more.
NOT_IN_NAMES = (
    "0000-001f 007f-009f 061c-061c 200e-200f 2028-2029 202a-202e 2066-2069 d800-dfff fdd0-fdef "
    "feff-feff"
)


def test_names_hold_what_the_protocol_says_whatever_the_python() -> None:
    refused = [number for number in range(0x110000) if not printable(f"a{chr(number)}b")]
    ranges = [[int(end, 16) for end in pair.split("-")] for pair in NOT_IN_NAMES.split()]
    ranges += [[plane + 0xFFFE, plane + 0xFFFF] for plane in range(0, 0x110000, 0x10000)]
    assert refused == sorted(n for first, last in ranges for n in range(first, last + 1))


@pytest.mark.parametrize("edge", NOT_IN_NAMES.replace("d800-dfff ", "").split())
def test_names_at_the_edges(edge: str) -> None:
    """Also of robots: characters that Unicode has had since Python 3.10, and those of nobody."""
    first, last = (int(end, 16) for end in edge.split("-"))
    for letter in (chr(first), chr(last)):
        for payload in (Payload(name=letter), Payload(certificate=letter.encode() + bytes(64))):
            with pytest.raises(Refusal, match="characters that none may have"):
                decode_payload(encode_payload(payload), 2)
    for letter in (chr(max(first, 1) - 1), chr(last + 1), "\U0001fae8", "\u0378", "\ue000", "\xa0"):
        if printable(letter):
            assert decode_payload(encode_payload(Payload(name=letter)), 2).name == letter


def test_names_are_well_formed() -> None:
    for data in (b"\xed\xa0\x80", b"\xc0\xaf", b"\xf4\x90\x80\x80", b"\xff", b"a" * 65):
        with pytest.raises(Refusal):
            decode_payload(bytes([Kind.PROFILE, len(data)]) + data, 2)
    assert decode_payload(bytes([Kind.PROFILE, 0]), 2).name == ""


def test_ids() -> None:
    assert author_of(identity("a").public_key).hex() == "ab6439ce4e4986d4"
    assert CONFIG.fleet_id.hex() == "dd7a25f72ba2868b"
    assert CLOSED.fleet_key == "776683aa82b09bc6403b618f6f97ce9a504495e9afc91965ebd90d2bffa54913"
    assert CLOSED.fleet_id.hex() == "12883a212b73c9e3"


FIRST = (
    "01415dc00345fe13cc8bd93730963b8a6f2a4701e6ec7e8bb578b88fb7f7c22cff0001000a010864"
    "726f6e6520c3a432000000dab70b0324315af6bef18259568c4cb398490cea9e05df6de7dff3cc7d"
    "cb985c3cb00669d60a5bf6169b7fa0885e00c1a1952a32c05e69985b4a2bf57a36430b"
)
SECOND = (
    "01415dc00345fe13cc8bd93730963b8a6f2a4701e6ec7e8bb578b88fb7f7c22cff01c88b08816602"
    "79e1875202248cac232ea99c56695a813f5a50554edef2dd55b8ac0202000102030405060708090a"
    "0b0c0d0e0f101112131415161718191a1b1c1d1e1f202122232425262728292a2b2c2d2e2f303132"
    "333435363738393a3b3c3d3e3f00410000008c6b5feb6fe249a4dd83fb12fc331f4dd9b117907fe5"
    "ce3fd0e85fbd19cd640048e8570039a670a247d4fd091946cf73df471a81ee697adf5e275438c02c"
    "0805"
)
CERTIFIED = (
    "01cec24b17cc55f44be2ca60bdb9d47b1acd6df4e6d1cfb1f77f8bfd81774a3faf00010043074172"
    "8957a601e9b70301d16d780e44dbd9805b5713d0b6abb54346d097e1b8b84dd7ecd55fd07041d77d"
    "3bab7b1660ce9b27767ad4987d74771652b15c3ba749b50800000000c0f1e7901ce6f1819407f889"
    "23d03b43a5c68c619a44d96f5108214e1aa018b39532e500f75013a5d38e4d97977210f2fb416a85"
    "30a6168345218be9b7a29b04"
)
REVOKING = (
    "01776683aa82b09bc6403b618f6f97ce9a504495e9afc91965ebd90d2bffa549130001000c080a61"
    "62636465666768ac0200000000551952e8240d4e4f187666aa3728befc8020b06104925996855333"
    "200eab991bc7221279b1da59101bf92e131283aff665ad06c22dfc163b283b42b56cbdef06"
)


def test_envelopes() -> None:
    first = seal(identity("a"), WORKED, 0, None, 1, (), PAYLOADS[Kind.PROFILE])
    references = (bytes(range(32)), bytes(range(32, 64)))
    second = seal(identity("a"), WORKED, 1, id_of(first), 300, references, Payload())
    certified = seal(enrolled("r", CLOSED), CLOSED, 0, None, 1, (), PAYLOADS[Kind.CERTIFICATE])
    revoking = seal(identity(FLEET_KEY), CLOSED, 0, None, 1, (), PAYLOADS[Kind.REVOCATION])
    sealed = (first, WORKED, FIRST), (second, WORKED, SECOND), (certified, CLOSED, CERTIFIED)
    for data, config, golden in (*sealed, (revoking, CLOSED, REVOKING)):
        assert data.hex() == golden
        assert parse(data, config).data == data
    assert id_of(first).hex() == "c88b0881660279e1875202248cac232ea99c56695a813f5a50554edef2dd55b8"


MESSAGES: dict[str, tuple[Message, str]] = {
    "transactions": (
        Transactions((b"1" * 105, b"2" * 130), True),
        "444d0101dd7a25f72ba2868b73656e6465726964" + "0169" + "31" * 105 + "8201" + "32" * 130,
    ),
    "heads": (
        Heads(
            7,
            ((b"abcdefgh", 300, 12_345),),
            (Head(b"abcdefgh", 300, b"01234567"), Head(b"ijklmnop", 2, b"89abcdef", 2)),
        ),
        (
            "444d0102dd7a25f72ba2868b73656e646572696407016162636465666768ac02b960616263646566"
            "6768d8043031323334353637696a6b6c6d6e6f7005383961626364656602"
        ),
    ),
    "want": (
        Want(((b"abcdefgh", 3, 300),), (bytes(range(32)),), (b"ijklmnop",)),
        (
            "444d0103dd7a25f72ba2868b73656e646572696401616263646566676803a9020100010203040506"
            "0708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f01696a6b6c6d6e6f70"
        ),
    ),
}


@pytest.mark.parametrize("name", MESSAGES)
def test_messages(name: str) -> None:
    message, golden = MESSAGES[name]
    data = messages.encode(message, WORKED, b"senderid")
    assert data[12:20] == WORKED.parameters_id  # changes with every fleet-wide parameter
    assert (data[:12] + data[20:-4]).hex() == golden
    assert data[-4:] == zlib.crc32(data[:-4]).to_bytes(4, "little")
    assert messages.parse(data, WORKED) == (b"senderid", message)
