"""A robot's data folder: whatever others have signed, the robot starts again."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from chains import CONFIG, Author, identity
from dagmap import Agent
from dagmap.io.data_folder import open_folder, restore
from dagmap.io.revocations import Revocations
from dagmap.io.settings import AgentConfig, Settings, StoreConfig, load_settings
from dagmap.io.store import Store
from dagmap.messages import Transactions, encode
from dagmap.model import Accepted, Forked, StoreError
from dagmap.transaction import Transaction, parse, seal


def astray(liar: Author, sequence: int) -> Transaction:
    """A transaction that follows from one that nobody has ever seen."""
    body = liar.chain[-1].payload
    data = seal(liar.identity, CONFIG, sequence, b"\1" * 32, 77, (), body)
    return parse(data, CONFIG)


def test_who_forks_twice_keeps_nobody_from_starting_again(tmp_path: Path) -> None:
    """The higher proof was stored, and is of no use once the lower one is known."""
    robot, liar = identity("robot"), Author("liar")
    chain = [liar.make() for _ in range(6)]
    lower = liar.make(features=2, after=chain[:2], keep=False)
    agent = Agent(robot, CONFIG)
    config = AgentConfig(store=StoreConfig(path="ledger.db"), **msgspec.structs.asdict(CONFIG))
    forks = []
    with Store.open(tmp_path / "ledger.db", config.fleet_id, robot.author) as store:
        for tx in (*chain, astray(liar, 4), lower):
            message = encode(Transactions((tx.data,)), CONFIG, liar.identity.author)
            events = agent.receive(message, now=0.0)
            store.append_many((e.id, e.data) for e in events if isinstance(e, Accepted))
            forks += [event.sequence for event in events if isinstance(event, Forked)]
        assert forks == [4, 2] and astray(liar, 4).id in store.ids()
        again = restore(Settings(config, tmp_path), robot, store, lambda data, total: data)
        assert again.ledger.chain(liar.identity.author).cut == 2
        assert again.digest() == agent.digest()


def test_a_folder_in_place_of_the_ledger_gets_no_key(tmp_path: Path) -> None:
    (tmp_path / "robot.toml").write_text('[store]\npath = "."\n')
    with pytest.raises(StoreError, match=r"is a folder; let \[store\] path name a file in it"):
        open_folder(load_settings(tmp_path / "robot.toml"))
    assert [path.name for path in tmp_path.iterdir()] == ["robot.toml"]


def test_too_many_open_files_do_not_stop_an_agent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Revocations in a folder are looked for every second; what cannot be read now comes later."""
    (tmp_path / "0000.tx").write_bytes(b"revoked")
    revocations = Revocations(tmp_path)

    def full(folder: Path, pattern: str) -> Iterator[Path]:
        raise OSError(errno.EMFILE, "Too many open files")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "glob", full)
        assert revocations.new() == []
    assert revocations.new() == [b"revoked"]
