"""The fleet's network: the agent's messages over Zenoh.

Key space (`docs/protocol.md`): what is for everybody goes to `dagmap/FLEET/all`, what is for one
robot to `dagmap/FLEET/to/AUTHOR`; who is here holds a liveliness token `dagmap/FLEET/here/AUTHOR`.
Subscriptions are wildcards on purpose: after a path-MTU blackhole samples have come under a wrong
key where subscriptions were exact. A key decides nothing but the way; what counts is signed.
"""

from __future__ import annotations

import json
import threading
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from datetime import datetime, timezone
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..messages import MAX_MESSAGE, kind_of, sender_of
from ..model import AuthorId, NetworkError, Outgoing
from .closing import Closing
from .queues import Inbox, SendQueue
from .settings import NetworkConfig
from .tls import tls_doubts

if TYPE_CHECKING:
    import zenoh

_SEND_BUFFER = 65_536  # bytes in the kernel: what waits there can no longer be dropped or overtaken
_RETRY = {"period_init_ms": 250, "period_max_ms": 2000, "period_increase_factor": 2.0}
_LARGEST = 65_536  # bytes that Zenoh puts together of what comes in: a message, its key and more


class Traffic:
    """Messages and bytes by direction and kind, as the agent handed them over and got them.

    A message to everybody is counted once, whatever the number of robots in reach.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._messages: Counter[tuple[str, str]] = Counter()
        self._bytes: Counter[tuple[str, str]] = Counter()

    def count(self, direction: str, data: bytes) -> None:
        kind = kind_of(data)
        key = direction, "other" if kind is None else kind.name.lower()
        with self._lock:
            self._messages[key] += 1
            self._bytes[key] += len(data)

    def bytes(self, direction: str) -> int:
        """Of all kinds; the direction is "sent" or "received"."""
        with self._lock:
            return sum(size for (way, _), size in self._bytes.items() if way == direction)

    def table(self) -> dict[str, dict[str, dict[str, int]]]:
        """{direction: {kind: {"messages": n, "bytes": n}}}."""
        out: dict[str, dict[str, dict[str, int]]] = {"sent": {}, "received": {}}
        with self._lock:
            for (way, kind), count in sorted(self._messages.items()):
                out[way][kind] = {"messages": count, "bytes": self._bytes[way, kind]}
        return out


class Transport(Closing):
    """One robot's place on the network. `send` never waits; what arrives goes into the inbox."""

    def __init__(
        self, network: NetworkConfig, folder: Path, fleet_id: bytes, me: AuthorId, inbox: Inbox
    ) -> None:
        """Open the session. Raises NetworkError that names the endpoint or the missing extra."""
        self._zenoh = load_zenoh()
        self._me, self._inbox = me, inbox
        self._most_robots = network.robots_remembered
        self._prefix = f"dagmap/{fleet_id.hex()}"
        self._here: set[AuthorId] = set()
        self._queue = SendQueue(network.send_bytes)
        self._refused = 0  # messages that Zenoh did not take
        self.traffic = Traffic()
        self._session = open_session(self._zenoh, network, folder, largest=_LARGEST)
        self._declared = self._declare()
        self._sender = threading.Thread(target=self._publish, name="dagmap send", daemon=True)
        self._sender.start()

    def send(self, messages: Iterable[Outgoing]) -> None:
        """Hand messages to the thread that publishes. Never waits for the network."""
        self._queue.put(messages)

    @property
    def here(self) -> frozenset[AuthorId]:
        """The robots in reach, this one not among them."""
        return frozenset(self._here)

    @property
    def waiting_bytes(self) -> int:
        """Bytes that the network has not taken yet."""
        return self._queue.size

    @property
    def dropped(self) -> int:
        """Messages that never left: too many waited, or Zenoh did not take one."""
        return self._queue.dropped + self._refused

    def close(self, patience: float = 1.0) -> None:
        """Send what waits, for so many seconds at most, and leave. Closing twice is harmless.

        Zenoh takes its time to leave a link that is stuck: that, too, gets `patience` seconds.
        """
        self._queue.close()
        self._sender.join(patience)
        leaving = threading.Thread(target=self._leave, name="dagmap leave", daemon=True)
        leaving.start()
        leaving.join(patience)

    def _leave(self) -> None:
        with suppress(self._zenoh.ZError):  # it gave up on a link; the process ends anyway
            self._session.close()  # type: ignore[no-untyped-call]

    def _declare(self) -> list[object]:
        """What the session is to keep: two subscriptions, the token and those of the others."""
        others, live = self._zenoh.Locality.REMOTE, self._session.liveliness()
        keys = f"{self._prefix}/all/**", f"{self._prefix}/to/{self._me.hex()}/**"
        declared: list[object] = [
            self._session.declare_subscriber(key, self._receive, allowed_origin=others)
            for key in keys
        ]
        token = live.declare_token(f"{self._prefix}/here/{self._me.hex()}")
        seen = live.declare_subscriber(f"{self._prefix}/here/*", self._see, history=True)
        return [*declared, token, seen]

    def _receive(self, sample: zenoh.Sample) -> None:
        """In a thread of Zenoh's: look at the size and the sender only, and pass on."""
        if sample.kind != self._zenoh.SampleKind.PUT:
            return
        if len(sample.payload) > MAX_MESSAGE:
            self._inbox.drop()
            return
        data = sample.payload.to_bytes()
        self.traffic.count("received", data)
        if sender_of(data) != self._me:
            self._inbox.put_message(data)

    def _see(self, sample: zenoh.Sample) -> None:
        try:
            author = bytes.fromhex(str(sample.key_expr).rpartition("/")[2])
        except ValueError:
            return
        if sample.kind == self._zenoh.SampleKind.DELETE:
            self._here = self._here - {author}
        elif (
            len(author) == len(self._me)
            and author != self._me
            and len(self._here) < self._most_robots
        ):
            self._here = self._here | {author}

    def _publish(self) -> None:
        """The sending thread. It waits where a link stalls; nobody waits for it."""
        options: dict[str, Any] = {
            "congestion_control": self._zenoh.CongestionControl.BLOCK,
            "allowed_destination": self._zenoh.Locality.REMOTE,
        }
        while (out := self._queue.take()) is not None:
            where = "all" if out.to is None else f"to/{out.to.hex()}"
            try:
                self._session.put(f"{self._prefix}/{where}", out.data, **options)
            except self._zenoh.ZError:  # what others lack they ask for again
                if self._session.is_closed():
                    return
                self._refused += 1
                continue
            self.traffic.count("sent", out.data)


def load_zenoh() -> Any:
    """The module `zenoh`. Raises NetworkError that names the extra where it is missing."""
    try:
        return import_module("zenoh")
    except ImportError as error:
        raise NetworkError(
            f"a fleet's network needs Zenoh ({error}); install it by pip install 'dagmap[fleet]'"
        ) from None


def session_config(
    network: NetworkConfig, folder: Path, largest: int | None = None
) -> dict[str, object]:
    """What Zenoh is told: its configuration keys and values. largest: see `open_session`."""
    protocol = "tcp" if network.tls is None else "tls"
    listen = network.listen
    if not listen and network.mode == "peer":
        listen = (f"{protocol}/[::]:0",)
    out: dict[str, object] = {
        "mode": network.mode,
        "listen/endpoints": listen,
        "connect/endpoints": network.connect,
        "connect/retry": _RETRY,
        # A client is nothing without its router; others go on trying (-1) while they work.
        "connect/timeout_ms": 10_000 if network.mode == "client" else -1,
        "connect/exit_on_failure": network.mode == "client",
        "listen/exit_on_failure": True,
        "scouting/multicast/enabled": network.scouting,
        "scouting/gossip/enabled": network.gossip,
        "transport/shared_memory/enabled": False,  # its bytes would escape the count
        "transport/link/tcp/so_sndbuf": _SEND_BUFFER,
        "transport/link/tls/so_sndbuf": _SEND_BUFFER,
    }
    if largest is not None:  # by default Zenoh takes a gigabyte, of anybody
        out["transport/link/rx/max_message_size"] = largest
    if network.tls is not None:
        path = {
            name: str(folder / getattr(network.tls, name)) for name in ("ca", "certificate", "key")
        }
        out |= {
            "transport/link/protocols": ["tls"],  # nobody comes in unproven by another door
            "transport/link/tls/root_ca_certificate": path["ca"],
            "transport/link/tls/listen_certificate": path["certificate"],
            "transport/link/tls/listen_private_key": path["key"],
            "transport/link/tls/connect_certificate": path["certificate"],
            "transport/link/tls/connect_private_key": path["key"],
            "transport/link/tls/enable_mtls": True,
            "transport/link/tls/verify_name_on_connect": False,  # robots have no addresses of old
        }
    return out


def open_session(
    module: Any,
    network: NetworkConfig,
    folder: Path,
    table: str = "network",
    largest: int | None = None,
) -> zenoh.Session:
    """A session as the configuration wants it; table: what it is called in the robot's file.

    largest: bytes of a message; of what is larger nothing is kept. None: what Zenoh takes.
    Raises NetworkError that names the endpoint or the file.
    """
    if network.tls is not None:
        tls_doubts(network.tls, folder, datetime.now(timezone.utc))
    config = module.Config()
    for key, value in session_config(network, folder, largest).items():
        try:
            config.insert_json5(key, json.dumps(value))
        except module.ZError as error:
            raise NetworkError(f"{table}: {json.dumps(value)}: {_brief(error)}") from None
    try:
        return module.open(config)  # type: ignore[no-any-return]
    except module.ZError as error:
        ends = ", ".join((*network.listen, *network.connect)) or "no endpoint"
        raise NetworkError(f"{table} ({ends}): {_brief(error)}; correct [{table}]") from None


def _brief(error: Exception) -> str:
    """What Zenoh says, without the places in its sources."""
    return str(error).split(" at /")[0].strip().rstrip(".!")
