"""The socket that answers `dagmap status`."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dagmap import DagmapError
from dagmap.io.queues import Inbox
from dagmap.io.status import StatusServer, ask
from dagmap.model import StoreError


@contextmanager
def answering(path: Path, answer: dict[str, object] | None) -> Iterator[None]:
    """A server whose agent gives this answer to every question."""
    inbox, over = Inbox(1, 1), threading.Event()

    def work() -> None:
        while not over.is_set():
            for question in inbox.take(0.05).questions:
                question.answer = answer
                question.answered.set()

    agent = threading.Thread(target=work)
    agent.start()
    try:
        with StatusServer(path, inbox):
            yield
    finally:
        over.set()
        agent.join()


class TestSocket:
    def test_question_and_answer(self, tmp_path: Path) -> None:
        path = tmp_path / "s.sock"
        with answering(path, {"digest": "00" * 100_000}):
            assert path.stat().st_mode & 0o777 == 0o600  # for this user only
            for _ in range(3):
                assert ask(path) == {"digest": "00" * 100_000}
        assert not path.exists()

    def test_a_path_longer_than_an_address(self, tmp_path: Path) -> None:
        folder = tmp_path / ("long" * 40)
        folder.mkdir()
        with answering(folder / "s.sock", {"x": 1}):
            assert ask(folder / "s.sock") == {"x": 1}
        assert list(folder.iterdir()) == []

    def test_a_socket_that_a_killed_process_left(self, tmp_path: Path) -> None:
        path = tmp_path / "s.sock"
        with socket.socket(socket.AF_UNIX) as left:
            left.bind(str(path))
        with answering(path, {"x": 1}):
            assert ask(path) == {"x": 1}

    def test_a_file_that_is_no_socket_stays(self, tmp_path: Path) -> None:
        path = tmp_path / "ledger.db"
        path.write_text("precious")
        with pytest.raises(StoreError, match=r"ledger\.db: no status socket .* in use"):
            StatusServer(path, Inbox(1, 1))
        assert path.read_text() == "precious"

    def test_nobody_is_there(self, tmp_path: Path) -> None:
        with pytest.raises(DagmapError, match=r"s\.sock: no agent answers here .*is it running"):
            ask(tmp_path / "s.sock")

    def test_an_agent_that_is_stopping(self, tmp_path: Path) -> None:
        with answering(tmp_path / "s.sock", None), pytest.raises(DagmapError, match="ask again"):
            ask(tmp_path / "s.sock")

    def test_a_place_where_no_socket_can_be(self, tmp_path: Path) -> None:
        with pytest.raises(StoreError, match=r"s\.sock: no status socket .*\[control\]"):
            StatusServer(tmp_path / "missing" / "s.sock", Inbox(1, 1))
