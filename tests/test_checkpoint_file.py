"""The checkpoint in the data folder: used when it fits, never needed, never trusted blindly."""

from __future__ import annotations

import io
import threading
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import pytest

import scene
from dagmap import Agent
from dagmap.io import checkpoint_file
from dagmap.io.checkpoint_file import CheckpointFile, read_checkpoint
from dagmap.io.log import Log
from dagmap.io.store import Store
from dagmap.model import Accepted


def mapped(path: Path, count: int = 6) -> tuple[Agent, Store]:
    """A robot that has mapped and stored."""
    agent = scene.agent("robot")
    store = Store.open(path / "ledger.db", agent.config.fleet_id, agent.identity.author)
    go_on(agent, store, count)
    return agent, store


def go_on(agent: Agent, store: Store, count: int, session: int = 0) -> None:
    for cycle in scene.cycles(1, count=count, churn=False):
        events = agent.observe(replace(cycle, session=session), now=cycle.stamp)
        rows = [(event.id, event.data) for event in events if isinstance(event, Accepted)]
        store.append_many(rows)


def restored(agent: Agent, store: Store, monkeypatch: pytest.MonkeyPatch) -> tuple[Agent, int]:
    """The agent that a restart gives, and how many transactions it had to judge for that."""
    judged = 0
    through = Agent._through_the_door

    def counted(self: Agent, data: bytes, again: bool = False) -> object:
        nonlocal judged
        judged += 1
        return through(self, data, again)

    with monkeypatch.context() as patch:
        patch.setattr(Agent, "_through_the_door", counted)
        again = Agent.restore(
            agent.identity, agent.config, store, checkpoint=read_checkpoint(store)
        )
    return again, judged


def test_a_restart_judges_only_what_came_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent, store = mapped(tmp_path)
    with store:
        CheckpointFile(store, Log(io.StringIO())).write(agent)
        again, judged = restored(agent, store, monkeypatch)
        assert judged == 0 and again.digest() == agent.digest()
        before = len(store)
        go_on(agent, store, 3, session=1)
        again, judged = restored(agent, store, monkeypatch)
        assert judged == len(store) - before > 0 and again.digest() == agent.digest()
        assert (tmp_path / "checkpoint").stat().st_mode & 0o077 == 0


@pytest.mark.parametrize("damage", ["gone", "cut", "noise", "folder"])
def test_without_a_good_one_the_ledger_is_read(
    damage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent, store = mapped(tmp_path)
    path = tmp_path / "checkpoint"
    with store:
        CheckpointFile(store, Log(io.StringIO())).write(agent)
        data = path.read_bytes()
        path.unlink()
        if damage == "cut":
            path.write_bytes(data[:-100])
        elif damage == "noise":
            path.write_bytes(bytes(len(data)))
        elif damage == "folder":
            path.mkdir()
        again, judged = restored(agent, store, monkeypatch)
        assert judged == len(store) and again.digest() == agent.digest()


def test_what_a_killed_process_left_is_removed(tmp_path: Path) -> None:
    """Each is as large as the map, and named after a process that is no more."""
    agent, store = mapped(tmp_path, 1)
    with store:
        (tmp_path / ".checkpoint.77.part").write_bytes(b"half")
        CheckpointFile(store, Log(io.StringIO())).write(agent)
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"checkpoint", "ledger.db"}


def test_trouble_with_it_is_logged_and_no_more(tmp_path: Path) -> None:
    agent, store = mapped(tmp_path)
    (tmp_path / "checkpoint").mkdir()
    said = io.StringIO()
    with store:
        CheckpointFile(store, Log(said)).write(agent)
    assert "no checkpoint" in said.getvalue()


def test_a_disk_that_is_slow_holds_up_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent, store = mapped(tmp_path)
    asked, freed = threading.Event(), threading.Event()
    written = checkpoint_file.atomic_write

    def slow(path: Path, mode: int) -> AbstractContextManager[BinaryIO]:
        asked.set()
        assert freed.wait(60)
        return written(path, mode)

    monkeypatch.setattr(checkpoint_file, "atomic_write", slow)
    monkeypatch.setattr(checkpoint_file, "_PERIOD", 0.0)
    with store:
        kept = CheckpointFile(store, Log(io.StringIO()))
        agent.settle()
        kept.keep(agent)  # returns, although nothing is on the disk
        assert asked.wait(60) and read_checkpoint(store) is None
        go_on(agent, store, 6, session=1)
        agent.settle()
        kept.keep(agent)  # nor does a second one pile up behind the first
        freed.set()
        kept.write(agent)
        again, judged = restored(agent, store, monkeypatch)
        assert judged == 0 and again.digest() == agent.digest()
