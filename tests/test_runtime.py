"""The thread that owns the agent: what is told is on the disk, and the network never stops it."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from chains import Author
from dagmap import Agent
from dagmap.io import runtime as runtime_module
from dagmap.io.log import Log
from dagmap.io.player import Player
from dagmap.io.queues import Inbox, Question
from dagmap.io.runtime import Runtime
from dagmap.io.sources import open_source
from dagmap.messages import Heads, Transactions, encode, parse
from dagmap.model import AuthorId, Outgoing, RecordingError, StoreError, TransactionId
from dagmap.transaction import id_of
from robots import record
from scene import agent as scene_agent
from scene import cycles


@dataclass
class Disk:
    """A store that may be full."""

    stored: dict[TransactionId, bytes] = field(default_factory=dict)
    room: int = 1 << 30
    commits: int = 0

    def append_many(self, transactions: Iterable[tuple[TransactionId, bytes]]) -> None:
        rows = dict(transactions)
        self.commits += 1
        if len(self.stored) + len(rows) > self.room:
            raise StoreError("ledger.db: cannot be written: the disk is full")
        self.stored |= rows


@dataclass
class Air:
    """A network that checks that all it is told is on the disk."""

    disk: Disk
    here: frozenset[AuthorId] = frozenset()
    waiting_bytes: int = 0
    sent: list[Outgoing] = field(default_factory=list)

    def send(self, messages: Iterable[Outgoing]) -> None:
        for out in messages:
            _, message = parse(out.data, scene_agent("a").config)
            if isinstance(message, Transactions):
                assert all(id_of(data) in self.disk.stored for data in message.data)
            self.sent.append(out)


def make(agent: Agent | None = None) -> tuple[Runtime, Disk, Air, io.StringIO]:
    disk, log = Disk(), io.StringIO()
    air = Air(disk)
    runtime = Runtime(
        agent or scene_agent("a"), disk, air, Inbox(1 << 24, 1 << 24), Log(log), lambda r: {"x": 1}
    )
    return runtime, disk, air, log


def play(runtime: Runtime, path: Path, until_agreed: float = 0.2) -> Player:
    player = Player(open_source(path), runtime.inbox, 100.0)
    player.start()
    try:
        runtime.run(player, until_agreed)
    finally:
        player.stop()
    return player


class TestRuntime:
    def test_a_recording_is_on_the_disk_before_it_is_sent(self, tmp_path: Path) -> None:
        runtime, disk, air, log = make()
        play(runtime, record(tmp_path / "walk.npz", 1))
        assert runtime.counts.cycles == 8 and runtime.counts.points > 0
        assert set(disk.stored) == {tx.id for tx in runtime.agent.ledger}
        assert runtime.counts.issued == runtime.counts.stored == len(disk.stored) > 3
        assert sum(out.to is None for out in air.sent) >= len(disk.stored)
        assert "event=state" in log.getvalue()

    def test_a_full_disk_ends_the_run_and_nothing_was_told(self, tmp_path: Path) -> None:
        runtime, disk, air, _ = make()
        disk.room = 3
        with pytest.raises(StoreError, match="the disk is full"):
            play(runtime, record(tmp_path / "walk.npz", 1))
        told = [data for out in air.sent for data in _transactions(out)]
        assert {id_of(data) for data in told} == set(disk.stored)

    def test_messages_of_one_step_share_a_commit(self) -> None:
        other = scene_agent("b")
        for cycle in cycles(1):
            other.observe(cycle, cycle.stamp)
        messages = [out.data for out in other.outbox()]
        runtime, disk, _, _ = make()
        assert 1 < len(messages) <= 16  # that are taken at once
        assert all(runtime.inbox.put_message(data) for data in messages)
        runtime.run(until_agreed=0.05)
        assert disk.commits == 1 and len(disk.stored) == len(other.ledger)

    def test_messages_that_take_long_do_not_hold_up_a_cycle(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        runtime, disk, _, _ = make()
        monkeypatch.setattr(runtime_module, "_READING", 0.0)  # as if each took all of the time
        other = scene_agent("b")
        mine, *others = cycles(1, churn=False)
        for cycle in others:
            other.observe(cycle, cycle.stamp)
        messages = [out.data for out in other.outbox()]
        assert all(runtime.inbox.put_message(data) for data in messages) and len(messages) > 3
        runtime._step()
        runtime.inbox.put_cycle(mine)
        runtime._step()
        assert runtime.counts.cycles == 1 and runtime.inbox.unread
        runtime.run(until_agreed=0.05)
        assert {tx.id for tx in other.ledger} <= disk.stored.keys()

    def test_foreign_bytes_are_counted_and_seldom_logged(self) -> None:
        runtime, disk, _, log = make()
        for i in range(10):
            runtime.inbox.put_message(bytes([i]) * 50)
        runtime.run(until_agreed=0.05)
        assert runtime.counts.refused.total() == 10 and not disk.stored
        assert log.getvalue().count("event=refused") == 1

    def test_many_forks_are_one_line(self) -> None:
        """In an open fleet keys cost nothing: who forks a thousand does not fill the disk."""
        runtime, _, _, log = make()
        config, here = runtime.agent.config, runtime.agent.ledger
        for liar in (Author(f"liar {i}", config) for i in range(10)):
            both = tuple(liar.make(after=[], features=n).data for n in (2, 3))
            runtime.inbox.put_message(encode(Transactions(both), config, liar.identity.author))
        runtime.run(until_agreed=0.05)
        assert [chain.cut for chain in here.chains.values()] == [0] * 10
        assert log.getvalue().count('event="fork proven"') == 1

    def test_a_bad_cycle_does_not_stop_it(self) -> None:
        runtime, _, _, log = make()
        first = next(iter(cycles(1)))
        runtime.inbox.put_cycle(first)
        runtime._step()
        runtime.inbox.put_cycle(first)  # its stamp does not rise
        runtime._step()
        assert runtime.counts.cycles == 1
        assert 'event="cycle refused"' in log.getvalue() and "stamps must rise" in log.getvalue()

    def test_questions_are_answered_in_its_thread(self) -> None:
        runtime, _, _, _ = make()
        question = Question()
        runtime.inbox.put_question(question)
        runtime.run(until_agreed=0.0)
        assert question.answered.is_set() and question.answer == {"x": 1}

    def test_news_is_folded_soon_and_not_only_when_a_tick_is_due(self) -> None:
        runtime, _, _, _ = make()
        speaker = scene_agent("b")
        for cycle in cycles(1):
            speaker.observe(cycle, cycle.stamp)
        runtime._step()
        runtime._next_tick = time.monotonic() + 1000.0
        for out in speaker.outbox():
            runtime.inbox.put_message(out.data)
        runtime._step()
        assert runtime.agent.consensus.pending
        runtime._step()  # waits for the tick, not for a thousand seconds
        assert not runtime.agent.consensus.pending
        assert runtime.agent.digest() == speaker.digest()

    def test_what_a_person_brings_goes_through_the_door(self) -> None:
        runtime, disk, _, _ = make()
        speaker = scene_agent("b")
        speaker.observe(next(iter(cycles(1))), 0.0)
        brought = [tx.data for tx in speaker.ledger]
        runtime._brought = lambda: brought
        runtime._step()
        assert set(disk.stored) == {tx.id for tx in speaker.ledger} != set()

    def test_it_stops_when_told(self) -> None:
        runtime, _, _, _ = make()
        timer = threading.Timer(0.1, runtime.stop)
        timer.start()
        runtime.run()  # without an end of its own
        assert timer.finished.is_set(), "it ran until it was told"
        timer.join()

    def test_a_broken_recording_is_the_end(self, tmp_path: Path) -> None:
        class Broken:
            error = RecordingError("walk: frame 7 is damaged")
            over = True

        runtime, _, _, _ = make()
        with pytest.raises(RecordingError, match="frame 7"):
            runtime.run(Broken())


class TestAgreement:
    """`until_agreed` ends only where everybody in reach was heard since the last news."""

    def test_somebody_silent_in_reach_keeps_it_going(self) -> None:
        other = scene_agent("b")
        runtime, _, air, _ = make()
        air.here = frozenset({other.identity.author})
        timers = [threading.Timer(0.3, runtime.stop)]
        timers[0].start()
        runtime.run(until_agreed=0.05)
        assert runtime._stopping  # it was the timer that ended it
        timers[0].join()

    def test_somebody_heard_lets_it_end(self) -> None:
        other = scene_agent("b")
        runtime, _, air, _ = make()
        air.here = frozenset({other.identity.author})
        heads = encode(Heads(1, (), ()), other.config, other.identity.author)
        speaker = threading.Timer(0.1, runtime.inbox.put_message, [heads])
        speaker.start()
        runtime.run(until_agreed=0.05)
        assert speaker.finished.is_set(), "it waited for the one in reach"
        speaker.join()

    def test_bytes_that_wait_keep_it_going(self) -> None:
        runtime, _, air, _ = make()
        air.waiting_bytes = 1
        assert not runtime._quiet(0.0)
        air.waiting_bytes = 0
        assert runtime._quiet(0.0)


class TestPlayer:
    def test_sessions_are_shifted(self, tmp_path: Path) -> None:
        inbox = Inbox(1 << 20, 1 << 20)
        path = record(tmp_path / "walk.npz", 1, count=2)
        player = Player(open_source(path), inbox, 100.0, session=5)
        player.start()
        taken = []
        while len(taken) < 2:
            taken += inbox.take(10).cycles
        player.stop()
        assert [cycle.session for cycle in taken] == [5, 5]
        assert player.over and player.error is None

    def test_it_waits_until_the_others_are_there(self, tmp_path: Path) -> None:
        inbox, there = Inbox(1 << 20, 1 << 20), threading.Event()
        path = record(tmp_path / "walk.npz", 1, count=1)
        player = Player(open_source(path), inbox, 100.0, ready=there.is_set)
        player.start()
        assert inbox.take(0.1).cycles == []
        there.set()
        assert len(inbox.take(10).cycles) == 1
        player.stop()

    def test_stopping_does_not_wait_for_the_next_cycle(self, tmp_path: Path) -> None:
        path = record(tmp_path / "walk.npz", 1)
        player = Player(open_source(path), Inbox(1 << 20, 1 << 20), 1e-6)
        player.start()
        player.stop()  # the second cycle is due in eleven days
        assert player.over


class TestLog:
    def test_lines_are_for_people_and_programs(self) -> None:
        stream = io.StringIO()
        log = Log(stream, "warning")
        log.write("info", "left out")
        log.write("warning", "open mode", why='he said "no"\nand left', n=3, share=0.5)
        head, _, rest = stream.getvalue().partition(" ")
        assert head.startswith("time=20")
        assert rest == (
            'level=warning event="open mode" why="he said \\"no\\"\\nand left" n=3 share=0.500\n'
        )

    def test_repetitions_are_counted_not_written(self) -> None:
        stream = io.StringIO()
        log = Log(stream)
        for _ in range(100):
            log.seldom("warning", "junk", "kind one")
        log.seldom("warning", "junk", "kind two")
        assert stream.getvalue().count("\n") == 2

    def test_a_closed_stream_is_no_reason_to_stop(self) -> None:
        stream = io.StringIO()
        log = Log(stream)
        stream.close()
        log.write("info", "said to nobody")
        assert stream.closed


def _transactions(out: Outgoing) -> tuple[bytes, ...]:
    _, message = parse(out.data, scene_agent("a").config)
    return message.data if isinstance(message, Transactions) else ()
