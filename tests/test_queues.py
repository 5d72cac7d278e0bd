"""The queues around the agent: bounded, and never in the way of the SLAM."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from dagmap import Accepted, Config, Cycle
from dagmap.io.queues import Inbox, Question, Rates, SendQueue
from dagmap.messages import Heads, Kind, Parsers, Transactions, Want, encode, kind_of
from dagmap.model import Outgoing, TransactionId
from dagmap.transaction import worked
from scene import agent as scene_agent
from scene import cycles

ME, YOU = b"me......", b"you....."


def message(size: int, sender: bytes = ME) -> bytes:
    return encode(Transactions((bytes(size - 36),)), Config(), sender)


def heads(token: int) -> bytes:
    return encode(Heads(token, (), ()), Config(), ME)


def cycle(stamp: float) -> Cycle:
    return Cycle(stamp, np.eye(4), np.zeros((0, 3)))


class TestInbox:
    def test_messages_come_out_in_order_and_a_few_at_a_time(self) -> None:
        inbox, few = Inbox(1 << 20, 1 << 20, at_once=5), 5
        sent = [message(100 + i) for i in range(2 * few)]
        assert all(inbox.put_message(data) for data in sent)
        assert inbox.take(0).messages == sent[:few]
        assert inbox.take(0).messages == sent[few:]
        assert inbox.take(0).messages == []

    def test_what_is_put_back_comes_first_and_counts_again(self) -> None:
        inbox = Inbox(4 * (1_000 + Inbox.HELD), 1 << 20)
        sent = [message(1_000) for _ in range(4)]
        assert all(map(inbox.put_message, sent))
        taken = inbox.take(0).messages
        inbox.put_back(taken[1:])
        assert inbox.put_message(message(1_000)) and not inbox.put_message(message(1_000))
        assert inbox.take(0).messages[:3] == sent[1:]

    def test_one_sender_cannot_crowd_out_another(self) -> None:
        inbox = Inbox(10 * (1_000 + Inbox.HELD), 4 * (1_000 + Inbox.HELD))
        taken = [inbox.put_message(message(1_000, YOU)) for _ in range(6)]
        assert taken == [True] * 4 + [False] * 2
        assert inbox.put_message(message(1_000, ME))
        assert inbox.dropped == 2

    def test_all_senders_together_are_bounded(self) -> None:
        inbox = Inbox(10 * (1_000 + Inbox.HELD), 4 * (1_000 + Inbox.HELD))
        taken = [inbox.put_message(message(1_000, bytes([i]) * 8)) for i in range(12)]
        assert sum(taken) == 10 and inbox.dropped == 2
        assert len(inbox.take(0).messages) == 10
        assert inbox.put_message(message(1_000))  # what was taken has made room

    def test_the_smallest_messages_are_bounded_too(self) -> None:
        inbox = Inbox(100 * Inbox.HELD, 100 * Inbox.HELD)
        assert sum(inbox.put_message(b"") for _ in range(1000)) == 100

    def test_a_message_too_short_to_name_its_sender(self) -> None:
        inbox = Inbox(1_000, 1_000)
        assert inbox.put_message(b"")
        assert inbox.put_message(b"DM")
        assert inbox.take(0).messages == [b"", b"DM"]

    def test_a_cycle_waits_for_the_one_before_to_be_taken(self) -> None:
        inbox = Inbox(1_000, 1_000)
        second = threading.Thread(target=lambda: inbox.put_cycle(cycle(2.0)))
        assert inbox.put_cycle(cycle(1.0))
        second.start()
        assert [each.stamp for each in inbox.take(0).cycles] == [1.0]
        second.join(10)
        assert [each.stamp for each in inbox.take(0).cycles] == [2.0]

    def test_closing_lets_go_of_the_slam(self) -> None:
        inbox, result = Inbox(1_000, 1_000), []
        assert inbox.put_cycle(cycle(1.0))
        slam = threading.Thread(target=lambda: result.append(inbox.put_cycle(cycle(2.0))))
        slam.start()
        inbox.close()
        slam.join(10)
        assert result == [False]

    def test_taking_waits_for_something(self) -> None:
        inbox, question = Inbox(1_000, 1_000), Question()
        asker = threading.Timer(0.05, inbox.put_question, [question])
        asker.start()
        assert inbox.take(30).questions == [question]
        asker.join()


class TestSendQueue:
    def test_in_order_then_closed(self) -> None:
        queue = SendQueue(1 << 20)
        sent = [Outgoing(message(100)), Outgoing(heads(1), YOU)]
        queue.put(sent)
        queue.close()
        assert [queue.take(), queue.take(), queue.take()] == [*sent, None]
        assert queue.size == 0

    def test_announcements_leave_before_transactions_the_oldest_first(self) -> None:
        queue = SendQueue(3_000)
        old, new = Outgoing(heads(1)), Outgoing(heads(2))
        transactions = [Outgoing(message(980)) for _ in range(3)]
        queue.put([transactions[0], old, transactions[1], new])
        queue.put([transactions[2]])  # 2,940 bytes and one announcement fit
        queue.close()
        left = [queue.take() for _ in range(5)]
        assert left == [transactions[0], transactions[1], new, transactions[2], None]
        assert queue.dropped == 1

    def test_without_announcements_the_oldest_leaves(self) -> None:
        queue = SendQueue(2_000)
        transactions = [Outgoing(message(800 + i)) for i in range(5)]
        queue.put(transactions)
        assert queue.dropped == 3 and queue.size <= 2_000
        assert [queue.take(), queue.take()] == transactions[3:]

    def test_announcements_that_were_taken_are_not_dropped_again(self) -> None:
        queue = SendQueue(2_000)
        queue.put([Outgoing(heads(1)), Outgoing(message(900)), Outgoing(heads(2))])
        assert queue.take() == Outgoing(heads(1))
        last = [Outgoing(message(901)), Outgoing(message(902))]
        queue.put(last)  # the second announcement leaves, and the oldest message
        queue.close()
        assert [queue.take() for _ in range(3)] == [*last, None]
        assert queue.dropped == 2 and queue.size == 0

    def test_a_full_queue_is_not_searched(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """The agent's thread puts: where a link stalls for long, that must stay cheap."""
        looked = 0

        def counted(data: bytes) -> Kind | None:
            nonlocal looked
            looked += 1
            return kind_of(data)

        monkeypatch.setattr("dagmap.io.queues.kind_of", counted)
        queue = SendQueue(100_000)
        queue.put(Outgoing(message(100)) for _ in range(1_100))
        assert queue.dropped > 0 and looked == 1_100

    def test_taking_waits_for_something(self) -> None:
        queue, out = SendQueue(1_000), Outgoing(heads(1))
        sender = threading.Timer(0.05, queue.put, [[out]])
        sender.start()
        assert queue.take() == out
        sender.join()


class TestRates:
    def make(self, **rates: float) -> tuple[Inbox, list[float]]:
        now = [100.0]
        return Inbox(1 << 30, 1 << 30, Rates(**rates), lambda: now[0]), now  # type: ignore[arg-type]

    def put(self, inbox: Inbox, count: int, size: int = 100, sender: bytes = ME) -> int:
        return sum(inbox.put_message(message(size, sender)) for _ in range(count))

    def test_messages_of_one_sender(self) -> None:
        inbox, now = self.make(messages_of_one=10)
        assert self.put(inbox, 50) == 10 and self.put(inbox, 50, sender=YOU) == 10
        assert inbox.dropped == 80
        now[0] += 0.5
        assert self.put(inbox, 50) == 5
        now[0] += 1000.0  # silence is not saved up beyond a second
        assert self.put(inbox, 50) == 10

    def test_bytes_of_one_sender(self) -> None:
        inbox, now = self.make(bytes_of_one=10_000)
        assert self.put(inbox, 50, 1_000) == 10
        now[0] += 0.25
        assert self.put(inbox, 50, 1_000) == 2
        assert self.put(inbox, 50, 1_000, YOU) == 10

    def test_changing_ones_name_does_not_help(self) -> None:
        inbox, now = self.make(messages=20, messages_of_one=10)
        names = [i.to_bytes(8, "big") for i in range(1000)]
        assert sum(self.put(inbox, 1, sender=name) for name in names) == 20
        assert len(inbox._throttle._of_one) == Rates().senders
        now[0] += 1.0
        assert self.put(inbox, 50) == 10  # the honest robot's share is there again

    def test_bytes_of_all_hold_whoever_is_named(self) -> None:
        inbox, now = self.make(bytes=10_000, bytes_of_one=5_000, question=4_000)
        names = [i.to_bytes(8, "big") for i in range(100)]
        assert sum(self.put(inbox, 1, 1_000, sender=name) for name in names) == 10
        now[0] += 1.0
        wants = [encode(Want(((ME, 0, 1 << 30),)), Config(), name) for name in names]
        assert sum(map(inbox.put_message, wants)) == 2

    def test_what_is_refused_costs_an_honest_robot_nothing(self) -> None:
        inbox, _ = self.make(messages=20, messages_of_one=10)
        assert self.put(inbox, 1000, sender=YOU) == 10
        assert self.put(inbox, 50) == 10

    def test_a_question_counts_for_its_answer(self) -> None:
        inbox, now = self.make(bytes_of_one=10_000, question=4_000)
        want = encode(Want(((ME, 0, 1 << 30),)), Config(), ME)
        assert sum(inbox.put_message(want) for _ in range(50)) == 2
        now[0] += 1.0
        assert self.put(inbox, 50, 1_000) == 10


def test_a_replay_costs_one_look_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is held already is known by its hash: nothing of it is read, let alone verified."""
    speaker, listener = scene_agent("speaker"), scene_agent("listener")
    for each in cycles(1):
        speaker.observe(each, each.stamp)
    said = [out.data for out in speaker.outbox()]
    first = [event for data in said for event in listener.receive(data, 0.0)]
    assert sum(isinstance(event, Accepted) for event in first) == len(speaker.ledger) > 3
    hashed: list[bytes] = []

    def counted(data: bytes, config: Config) -> TransactionId:
        hashed.append(data)
        return worked(data, config)

    for name in ("add", "worth_judging"):
        monkeypatch.setattr(listener.ledger, name, None)
    listener._parsers = Parsers(worked=counted, transaction=None)  # type: ignore[arg-type]  # not to be called
    before = listener.digest()
    for _ in range(10):
        assert not [event for data in said for event in listener.receive(data, 1.0)]
    assert len(hashed) == 10 * len(speaker.ledger)
    assert listener.digest() == before and not listener.outbox()
