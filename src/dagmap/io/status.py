"""How a running agent stands, as one JSON object: asked over a socket, answered by its thread."""

from __future__ import annotations

import json
import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..agent import Agent
from ..model import AuthorId, DagmapError, State, StoreError
from .closing import Closing
from .queues import Inbox, Question
from .runtime import Runtime
from .transport import Transport

_PATIENCE = 30.0  # s for an answer: an agent that copies a map works on it meanwhile
_MOST = 64 << 20  # bytes of an answer
_PAUSE = 0.5  # s before the next try, where nobody can be let in
_PATH = 100  # bytes that the address of a socket has room for, and some


def report(runtime: Runtime, transport: Transport) -> dict[str, object]:
    """Everything that `dagmap status` shows. To be called in the agent's thread."""
    agent = runtime.agent
    pending = not agent.settled
    world = agent.map
    return {
        "name": agent.config.name,
        "author": agent.identity.author.hex(),
        "fleet": agent.config.fleet,
        "digest": agent.digest().hex() if agent.settled else None,  # it may take long to settle
        "uptime_s": round(runtime.now, 3),
        "transactions": len(agent.ledger),
        "cycles": runtime.counts.cycles,
        "map": {"nodes": len(world), **{s.name.lower(): world.count(s) for s in State}},
        "placed": agent.frame() is not None,
        "unplaced": unplaced(agent),
        "heads": _heads(agent),
        "peers": _peers(agent, transport, runtime.now),
        "lag": {
            "missing": len(agent.ledger.missing()),
            "not_folded": pending,
            "to_issue": agent.holds_back,
            "unsent_bytes": transport.waiting_bytes,
        },
        "overhead": _overhead(agent),
        "traffic": transport.traffic.table()
        | {"dropped": {"sent": transport.dropped, "received": runtime.inbox.dropped}},
        "refused": {reason.value: count for reason, count in runtime.counts.refused.items()},
    }


def unplaced(agent: Agent) -> list[dict[str, object]]:
    """SLAM frames of which the robot does not know where they are, and why."""
    return [
        {"author": f.author.hex(), "name": _name(agent, f.author), "session": f.session, "why": why}
        for f, why in sorted(agent.unplaced.items())
    ]


def _overhead(agent: Agent) -> dict[str, object]:
    """Section 5: what the last cycle took, what may be done (None: anything), what costs what."""
    steering = agent.steering.controller
    insert, send, merge = (1e6 * cost for cost in steering.model.costs.tolist())
    return {
        "cycle_s": steering.period,
        "load": round(steering.load, 4),
        "n_c": steering.n_c,
        "features_sent_a_cycle": steering.n_f,
        "features_inserted_a_cycle": steering.features,
        "bytes_per_second": None if steering.rate is None else round(steering.rate),
        "us_a_feature": {
            "inserted": round(insert, 3),
            "sent": round(send, 3),
            "merged": round(merge, 3),
        },
    }


def _heads(agent: Agent) -> dict[str, object]:
    """Every author's chain as it is held here."""
    return {
        author.hex(): {
            "name": _name(agent, author),
            "length": chain.end,
            "tip": chain.main[chain.end - 1].id.hex()[:16] if chain.end else None,
            "forked_at": chain.cut,
        }
        for author, chain in sorted(agent.ledger.chains.items())
    }


def _peers(agent: Agent, transport: Transport, now: float) -> dict[str, object]:
    """The robots in reach, and those that were heard through others."""
    here, heard = transport.here, agent.sync.peers
    out: dict[str, object] = {}
    for author in sorted(here | heard.keys()):
        peer = heard.get(author)
        delay = None if peer is None else peer.delay
        out[author.hex()] = {
            "name": _name(agent, author),
            "here": author in here,
            "delay_ms": None if delay is None else round(1000 * delay, 1),
            "heard_s_ago": None if peer is None else round(now - peer.heard, 1),
        }
    return out


def _name(agent: Agent, author: AuthorId) -> str:
    known = agent.consensus.authors.get(author)
    return (known.name if known is not None else None) or author.hex()


class StatusServer(Closing):
    """Answers everybody who may open the socket: this user. One thread, one asker at a time."""

    def __init__(self, path: Path, inbox: Inbox) -> None:
        """Raises StoreError where the socket cannot be made."""
        self._path, self._inbox = path, inbox
        self._socket = socket.socket(socket.AF_UNIX)
        mask = os.umask(0o177)
        try:
            if path.is_socket():  # of a process that was killed; the ledger is ours alone
                path.unlink()
            with _reachable(path) as address:
                self._socket.bind(address)
            self._socket.listen()
        except OSError as error:
            self._socket.close()
            raise StoreError(
                f"{path}: no status socket can be made ({error.strerror or error}); name another "
                "`path` under [control]"
            ) from None
        finally:
            os.umask(mask)
        self._thread = threading.Thread(target=self._serve, name="dagmap status", daemon=True)
        self._closed = threading.Event()
        self._thread.start()

    def close(self) -> None:
        """Stop answering and remove the socket."""
        self._closed.set()
        self._socket.shutdown(socket.SHUT_RDWR)  # wakes `accept`
        self._socket.close()
        self._thread.join()
        self._path.unlink(missing_ok=True)

    def _serve(self) -> None:
        while not self._closed.is_set():
            try:
                asker, _ = self._socket.accept()
            except OSError:  # closed; or too many files are open, which may pass
                self._closed.wait(_PAUSE)
                continue
            with asker:
                self._answer(asker)

    def _answer(self, asker: socket.socket) -> None:
        question = Question()
        self._inbox.put_question(question)
        waited = 0.0
        while not question.answered.wait(0.1) and waited < _PATIENCE and not self._closed.is_set():
            waited += 0.1
        try:
            asker.settimeout(_PATIENCE)
            asker.sendall(json.dumps(question.answer).encode())
        except OSError:
            return  # the asker has left


def ask(path: Path) -> dict[str, Any]:
    """The report of the agent whose socket this is. Raises DagmapError where none answers."""
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(_PATIENCE + 5)
        try:
            with _reachable(path) as address:
                connection.connect(address)
            parts, size = [], 0
            while (part := connection.recv(1 << 16)) and size <= _MOST:
                parts.append(part)
                size += len(part)
        except OSError as error:
            raise DagmapError(
                f"{path}: no agent answers here ({error.strerror or error}); is it running, "
                "and by this user?"
            ) from None
    try:
        answer = json.loads(b"".join(parts))
    except ValueError:
        answer = None
    if not isinstance(answer, dict):
        raise DagmapError(f"{path}: the agent was too busy to answer or is stopping; ask again")
    return answer


@contextmanager
def _reachable(path: Path) -> Iterator[str]:
    """The path as the system's addresses of sockets can hold it: long ones by way of the folder."""
    if len(os.fsencode(path)) <= _PATH:
        yield str(path)
        return
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        yield f"/proc/self/fd/{folder}/{path.name}"
    finally:
        os.close(folder)
