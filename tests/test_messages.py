"""What robots say: nothing malformed gets in, and nothing that is refused changes anything."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chains import CONFIG, Author
from dagmap import Rejected, messages
from dagmap.config import FoldConfig
from dagmap.messages import MAX_MESSAGE, Head, Heads, Message, Transactions, Want
from dagmap.model import Reason
from dagmap.wire import Refusal
from scene import QUICK, agent, cycles

ME = b"12345678"
SAMPLES: list[Message] = [
    Transactions((b"a" * 105, b"x" * 300), more=True),
    Transactions(()),
    Heads(
        7,
        ((b"peer-one", 3, 250_000),),
        (Head(b"author-1", 5, b"tiptiptp"), Head(ME, 0, bytes(8), True)),
    ),
    Want(((b"author-1", 3, 9),), (b"i" * 32,), (b"author-2", ME)),
    Want(),
]


@pytest.mark.parametrize("message", SAMPLES, ids=lambda m: type(m).__name__)
def test_messages_come_back_as_they_were(message: Message) -> None:
    data = messages.encode(message, CONFIG, ME)
    assert messages.parse(data, CONFIG) == (ME, message)


@pytest.mark.parametrize("message", SAMPLES, ids=lambda m: type(m).__name__)
def test_truncations_and_changed_bytes_are_refused(message: Message) -> None:
    data = messages.encode(message, CONFIG, ME)
    for size in range(len(data)):
        with pytest.raises(Refusal):
            messages.parse(data[:size], CONFIG)
    for i in range(len(data)):
        with pytest.raises(Refusal):
            messages.parse(data[:i] + bytes([data[i] ^ 0x5A]) + data[i + 1 :], CONFIG)


@given(st.binary(max_size=120), st.integers(0, 255))
@settings(max_examples=400, deadline=None)
def test_noise_behind_a_valid_head_is_read_or_refused(body: bytes, kind: int) -> None:
    import zlib

    head = b"DM" + bytes([1, kind]) + CONFIG.fleet_id + CONFIG.parameters_id + ME
    data = head + body
    try:
        _, message = messages.parse(data + zlib.crc32(data).to_bytes(4, "little"), CONFIG)
    except Refusal:
        return
    assert messages.parse(messages.encode(message, CONFIG, ME), CONFIG)[1] == message


def test_other_fleets_and_parameters_are_told_plainly() -> None:
    data = messages.encode(Want(), CONFIG, ME)
    other = msgspec.structs.replace(CONFIG, fleet="other")
    stranger = agent("a", other)
    assert stranger.receive(data, 0.0)[0].reason is Reason.FLEET
    tuned = msgspec.structs.replace(CONFIG, fold=FoldConfig(delta=0.04))
    assert agent("a", tuned).receive(data, 0.0)[0].reason is Reason.PARAMETERS


def test_no_bad_message_raises_or_changes_the_digest() -> None:
    talker, listener = agent("talker"), agent("listener")
    for cycle in cycles(1, count=3):
        talker.observe(cycle, cycle.stamp)
    talker.tick(3.0)
    sent = [out.data for out in talker.outbox()]
    for data in sent:
        listener.receive(data, 3.0)
    digest, held = listener.digest(), len(listener.ledger)
    assert held and digest == talker.digest()
    for data in sent:
        for i in range(0, len(data), max(1, len(data) // 150)):
            for bad in (data[:i], data[:i] + bytes([data[i] ^ 1]) + data[i + 1 :]):
                events = listener.receive(bad, 4.0)
                assert len(events) == 1 and isinstance(events[0], Rejected), (i, events)
    assert (listener.digest(), len(listener.ledger)) == (digest, held)


def test_a_bad_transaction_in_a_good_message_is_a_rejection() -> None:
    listener = agent("listener")
    good = Author("a", QUICK).make().data
    bad = good[:-1] + bytes([good[-1] ^ 1])
    events = listener.receive(messages.encode(Transactions((good, bad)), QUICK, ME), 0.0)
    assert [type(e).__name__ for e in events] == ["Accepted", "Rejected"]
    assert events[1].reason is Reason.SIGNATURE


def test_messages_stay_below_their_size() -> None:
    with pytest.raises(ValueError, match="at most"):
        messages.encode(Transactions((b"x" * MAX_MESSAGE,)), CONFIG, ME)
    assert isinstance(agent("a").receive(b"x" * (MAX_MESSAGE + 1), 0.0)[0], Rejected)
