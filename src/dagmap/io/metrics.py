"""Numbers for Prometheus: its text format under /metrics, over plain HTTP."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from ..model import NetworkError
from .closing import Closing
from .runtime import Runtime
from .transport import Transport

_PATIENCE = 10.0  # s for one asker, from the first byte to the last
_TYPE = "text/plain; version=0.0.4; charset=utf-8"
Sample = tuple[dict[str, str], float]


def exposition(runtime: Runtime, transport: Transport) -> str:
    """All metrics as text. Reads counters only, so any thread may call it."""
    lines: list[str] = []
    for name, kind, text, samples in _families(runtime, transport):
        lines += [f"# HELP dagmap_{name} {text}", f"# TYPE dagmap_{name} {kind}"]
        for labels, value in samples:
            inside = ",".join(f'{key}="{word}"' for key, word in labels.items())
            lines.append(f"dagmap_{name}{'{' + inside + '}' if inside else ''} {value:.9g}")
    return "\n".join(lines) + "\n"


def _families(
    runtime: Runtime, transport: Transport
) -> Iterator[tuple[str, str, str, Iterable[Sample]]]:
    counts = runtime.counts
    single: tuple[tuple[str, str, str, float], ...] = (
        ("uptime_seconds", "gauge", "Time since the start.", runtime.now),
        ("cycles_total", "counter", "Cycles of the SLAM.", counts.cycles),
        ("points_total", "counter", "Points that the SLAM handed in.", counts.points),
        ("issued_features_total", "counter", "Features sent.", counts.features),
        ("issued_transactions_total", "counter", "Own transactions.", counts.issued),
        ("stored_transactions_total", "counter", "Transactions stored.", counts.stored),
        ("transactions", "gauge", "Transactions held.", len(runtime.agent.ledger)),
        ("robots", "gauge", "Other robots in reach.", len(transport.here)),
        ("unsent_bytes", "gauge", "Bytes that wait for the network.", transport.waiting_bytes),
        ("observe_seconds_total", "counter", "Time spent on cycles.", counts.observe_s),
        ("observe_seconds_max", "gauge", "The longest cycle.", counts.observe_max_s),
    )
    for name, kind, text, value in single:
        yield name, kind, text, [({}, value)]
    for unit in ("messages", "bytes"):
        samples: list[Sample] = [
            ({"direction": direction, "kind": kind}, row[unit])
            for direction, table in transport.traffic.table().items()
            for kind, row in table.items()
        ]
        yield f"network_{unit}_total", "counter", f"Network traffic in {unit}.", samples
    dropped: list[Sample] = [
        ({"direction": "sent"}, transport.dropped),
        ({"direction": "received"}, runtime.inbox.dropped),
    ]
    yield "dropped_messages_total", "counter", "Dropped where too many waited.", dropped
    refused: list[Sample] = [
        ({"reason": reason.name.lower()}, count) for reason, count in dict(counts.refused).items()
    ]
    yield "refused_total", "counter", "Foreign bytes that were refused.", refused


class _Server(ThreadingHTTPServer):
    """Takes so many askers at a time, and says nothing of those who leave in the middle."""

    daemon_threads = True

    def __init__(
        self, address: tuple[str, int], handler: type[BaseHTTPRequestHandler], most: int
    ) -> None:
        self._free = threading.Semaphore(most)
        self._until: dict[Any, float] = {}  # when each asker has had its time
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        super().__init__(address, handler)

    def verify_request(self, request: object, client_address: object) -> bool:
        return self._free.acquire(blocking=False)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        self._until[request] = time.monotonic() + _PATIENCE
        try:
            super().process_request_thread(request, client_address)
        finally:
            del self._until[request]
            self._free.release()

    def service_actions(self) -> None:
        """Several times a second: hang up on who would hold a place by a byte now and then."""
        now = time.monotonic()
        for request, until in self._until.copy().items():
            if now >= until:
                with suppress(OSError):  # it left by itself
                    request.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: object, client_address: object) -> None:
        """The log is for the fleet: a line of many for everyone who hangs up would fill it."""


class MetricsServer(Closing):
    """Serves the metrics on a thread of its own."""

    def __init__(
        self,
        address: tuple[str, int],
        runtime: Runtime,
        transport: Transport,
        askers: int = 16,
    ) -> None:
        """askers: served at a time. Raises NetworkError where the address cannot be listened on."""

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                if self.path.split("?")[0] != "/metrics":
                    self.send_error(404, "only /metrics is here")
                    return
                body = exposition(runtime, transport).encode()
                self.send_response(200)
                self.send_header("Content-Type", _TYPE)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, format: str, *args: object) -> None:  # noqa: A002
                """The log is for the fleet, not for whoever reads its numbers."""

        try:
            self._server = _Server(address, Handler, askers)
        except OSError as error:
            raise NetworkError(
                f"metrics.listen: {address[0]}:{address[1]} cannot be listened on "
                f"({error.strerror}); name another address"
            ) from None
        self.address: tuple[str, int] = (address[0], self._server.server_address[1])
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.1,), name="dagmap metrics", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop listening."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
