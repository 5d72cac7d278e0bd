"""The network itself: who hears what, who may come in, and what is counted."""

from __future__ import annotations

import datetime as dt
import socket
import struct
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from dagmap import Config
from dagmap.io import metrics
from dagmap.io.log import Log
from dagmap.io.metrics import MetricsServer
from dagmap.io.queues import Inbox
from dagmap.io.runtime import Runtime
from dagmap.io.settings import NetworkConfig, TlsConfig
from dagmap.io.transport import Transport
from dagmap.messages import Want, encode
from dagmap.model import NetworkError, Outgoing
from robots import free_port, until
from scene import agent as scene_agent

FLEET = Config(fleet="transport test")
HUGE = """import sys, zenoh
config = zenoh.Config()
config.insert_json5("connect/endpoints", '["' + sys.argv[1] + '"]')
config.insert_json5("scouting/multicast/enabled", "false")
session = zenoh.open(config)
session.put(sys.argv[2], bytes(1 << 27), congestion_control=zenoh.CongestionControl.BLOCK)
session.put(sys.argv[2], bytes.fromhex(sys.argv[3]))
sys.stdin.read()
"""
NAMES = (b"robot..a", b"robot..b", b"robot..c")


@pytest.fixture
def opened() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def station(
    stack: ExitStack, name: bytes, port: int, *others: int, tls: TlsConfig | None = None
) -> tuple[Transport, Inbox]:
    inbox, protocol = Inbox(1 << 20, 1 << 20), "tcp" if tls is None else "tls"
    network = NetworkConfig(
        listen=(f"{protocol}/127.0.0.1:{port}",),
        connect=tuple(f"{protocol}/127.0.0.1:{other}" for other in others),
        scouting=False,
        gossip=False,
        tls=tls,
    )
    transport = Transport(network, Path("/"), FLEET.fleet_id, name, inbox)
    return stack.enter_context(transport), inbox


def hello(sender: bytes) -> bytes:
    return encode(Want(), FLEET, sender)


class TestReach:
    def test_who_hears_what(self, opened: ExitStack) -> None:
        ports = [free_port() for _ in NAMES]
        stations = [station(opened, n, ports[i], *ports[:i]) for i, n in enumerate(NAMES)]
        until(lambda: all(len(transport.here) == 2 for transport, _ in stations))
        a, b, c = NAMES
        (first, inbox_a), (second, inbox_b), (third, inbox_c) = stations
        first.send([Outgoing(hello(a)), Outgoing(hello(a), b), Outgoing(hello(a), c)])
        assert [len(_taken(inbox, 2)) for inbox in (inbox_b, inbox_c)] == [2, 2]
        assert inbox_a.take(0.1).messages == []  # nobody hears himself
        assert second.here == {a, c} and third.here == {a, b}
        size = len(hello(a))
        assert first.traffic.table()["sent"]["want"] == {"messages": 3, "bytes": 3 * size}
        assert second.traffic.bytes("received") == third.traffic.bytes("received") == 2 * size

    def test_a_message_that_is_not_taken_silences_nobody(
        self, opened: ExitStack, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (a, _), session = station(opened, NAMES[0], free_port()), SimpleNamespace()
        taken: list[bytes] = []

        def put(key: str, data: bytes, **options: object) -> None:
            if data == b"first":
                raise a._zenoh.ZError("no room")
            taken.append(data)

        session.put, session.is_closed = put, lambda: False
        with monkeypatch.context() as patch:
            patch.setattr(a, "_session", session)
            a.send([Outgoing(b"first", None), Outgoing(b"second", None)])
            until(lambda: taken == [b"second"], "the second message")
        assert a.dropped == 1

    def test_of_a_huge_message_nothing_is_kept(self, opened: ExitStack) -> None:
        """From another process, since both ends would count here."""
        port = free_port()
        _, inbox = station(opened, NAMES[0], port)
        key = f"dagmap/{FLEET.fleet_id.hex()}/all"
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
        before = _peak()
        sender = [sys.executable, "-c", HUGE, f"tcp/127.0.0.1:{port}", key, hello(NAMES[1]).hex()]
        with subprocess.Popen(sender, stdin=subprocess.PIPE) as process:
            try:
                assert _taken(inbox, 1) == [hello(NAMES[1])]  # what comes after it still comes
            finally:
                process.kill()
        assert _peak() - before < 64 << 20

    def test_who_leaves_is_no_longer_here(self, opened: ExitStack) -> None:
        port = free_port()
        first, _ = station(opened, NAMES[0], port)
        second, _ = station(opened, NAMES[1], free_port(), port)
        until(lambda: first.here and second.here)
        second.close()
        assert until(lambda: not first.here)
        second.close()  # twice is harmless
        second.send([Outgoing(hello(NAMES[1]))])  # to nobody

    def test_one_who_comes_back_is_found_again(self, opened: ExitStack) -> None:
        ports = free_port(), free_port()
        first, _ = station(opened, NAMES[0], ports[0])
        second, _ = station(opened, NAMES[1], ports[1], ports[0])
        until(lambda: second.here)
        first.close()
        until(lambda: not second.here)
        again, _ = station(opened, NAMES[0], ports[0])
        assert until(lambda: second.here and again.here)


class TestTls:
    def test_only_certificates_of_the_authority_come_in(
        self, opened: ExitStack, tmp_path: Path
    ) -> None:
        ours, theirs = (Authority(tmp_path / name) for name in ("ours", "theirs"))
        port = free_port()
        first, _ = station(opened, NAMES[0], port, tls=ours.enroll("a"))
        friend, inbox = station(opened, NAMES[1], free_port(), port, tls=ours.enroll("b"))
        until(lambda: first.here == {NAMES[1]} and friend.here == {NAMES[0]})
        stranger, unheard = station(opened, NAMES[2], free_port(), port, tls=theirs.enroll("c"))
        plain = NetworkConfig(connect=(f"tcp/127.0.0.1:{port}",), scouting=False, gossip=False)
        open_inbox = Inbox(1 << 20, 1 << 20)
        bare = opened.enter_context(
            Transport(plain, tmp_path, FLEET.fleet_id, b"bare....", open_inbox)
        )
        first.send([Outgoing(hello(NAMES[0]))])
        assert len(_taken(inbox, 1)) == 1
        assert unheard.take(0.5).messages == open_inbox.take(0.1).messages == []
        assert stranger.here == bare.here == frozenset() and first.here == {NAMES[1]}

    def test_a_missing_file(self, opened: ExitStack, tmp_path: Path) -> None:
        tls = Authority(tmp_path / "ours").enroll("a")
        Path(tls.key).unlink()
        with pytest.raises(NetworkError, match=r"network\.tls\.key: .*a\.key is missing"):
            station(opened, NAMES[0], free_port(), tls=tls)


class TestExtra:
    def test_without_the_extra_it_is_named(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "zenoh", None)
        with pytest.raises(NetworkError, match=r"pip install 'dagmap\[fleet\]'"):
            Transport(NetworkConfig(), Path(), FLEET.fleet_id, NAMES[0], Inbox(1, 1))


class TestMetrics:
    def test_what_prometheus_reads(self, opened: ExitStack) -> None:
        transport, inbox = station(opened, NAMES[0], free_port())
        store = SimpleNamespace(append_many=lambda rows: None)
        log = Log(sys.stderr, "error")
        runtime = Runtime(scene_agent("a"), store, transport, inbox, log, lambda runtime: {})
        inbox.put_message(b"junk")
        runtime.run(until_agreed=0.0)
        server = opened.enter_context(MetricsServer(("127.0.0.1", 0), runtime, transport))
        base = f"http://127.0.0.1:{server.address[1]}"
        until(lambda: "network_bytes_total{" in _get(f"{base}/metrics"))
        text = _get(f"{base}/metrics")
        assert 'dagmap_refused_total{reason="truncated"} 1\n' in text
        assert 'dagmap_network_messages_total{direction="sent",kind="heads"} 1\n' in text
        assert "# TYPE dagmap_cycles_total counter\ndagmap_cycles_total 0\n" in text
        with pytest.raises(urllib.error.HTTPError, match="404") as error:
            _get(f"{base}/elsewhere")
        error.value.close()

    def test_who_hangs_up_leaves_no_trace(
        self, opened: ExitStack, capfd: pytest.CaptureFixture[str]
    ) -> None:
        """Nor does one who says nothing keep others out, and there are only so many of those."""
        server = opened.enter_context(MetricsServer(("127.0.0.1", 0), *self.robot(opened)))
        for _ in range(3):
            with socket.create_connection(server.address, 10) as asker:
                asker.sendall(b"GET /metr")
                asker.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        silent = [socket.create_connection(server.address, 10) for _ in range(30)]
        until(lambda: sum(_hung_up(asker) for asker in silent) >= 14)
        assert not all(_hung_up(asker) for asker in silent)
        for asker in silent:
            asker.close()
        until(
            lambda: "dagmap_cycles_total" in _try(f"http://127.0.0.1:{server.address[1]}/metrics")
        )
        assert "Traceback" not in capfd.readouterr().err

    def test_a_byte_now_and_then_holds_no_place(
        self, opened: ExitStack, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(metrics, "_PATIENCE", 0.3)
        server = opened.enter_context(MetricsServer(("127.0.0.1", 0), *self.robot(opened), 1))
        slow = opened.enter_context(socket.create_connection(server.address, 10))
        slow.sendall(b"GET /")

        def hung_up() -> bool:
            try:
                slow.sendall(b"x")
            except ConnectionError:
                return True
            return _hung_up(slow)

        assert until(hung_up, "the one place to be free again")
        address = f"http://127.0.0.1:{server.address[1]}/metrics"
        assert until(lambda: "dagmap_cycles_total" in _try(address))

    @pytest.mark.skipif(not socket.has_ipv6, reason="there is no IPv6 on this machine")
    def test_addresses_of_ipv6(self, opened: ExitStack) -> None:
        server = opened.enter_context(MetricsServer(("::1", 0), *self.robot(opened)))
        assert "dagmap_cycles_total" in _get(f"http://[::1]:{server.address[1]}/metrics")

    def robot(self, opened: ExitStack) -> tuple[Runtime, Transport]:
        transport, inbox = station(opened, NAMES[0], free_port())
        store = SimpleNamespace(append_many=lambda rows: None)
        log = Log(sys.stderr, "error")
        return Runtime(scene_agent("a"), store, transport, inbox, log, lambda _: {}), transport

    def test_an_address_in_use(self, opened: ExitStack) -> None:
        transport, inbox = station(opened, NAMES[0], free_port())
        store = SimpleNamespace(append_many=lambda rows: None)
        runtime = Runtime(
            scene_agent("a"), store, transport, inbox, Log(sys.stderr), lambda runtime: {}
        )
        server = opened.enter_context(MetricsServer(("127.0.0.1", 0), runtime, transport))
        with pytest.raises(NetworkError, match=r"metrics\.listen: 127\.0\.0\.1:\d+ cannot be"):
            MetricsServer(server.address, runtime, transport)


class Authority:
    """A certificate authority of a fleet, for a day."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self.folder = folder
        self.key = ec.generate_private_key(ec.SECP256R1())
        self.name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, folder.name)])
        self.certificate = self._sign(self.name, self.key.public_key(), ca=True)
        (folder / "ca.pem").write_bytes(_pem(self.certificate))

    def enroll(self, robot: str) -> TlsConfig:
        key = ec.generate_private_key(ec.SECP256R1())
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, robot)])
        certificate = self._sign(name, key.public_key(), ca=False)
        paths = {part: self.folder / f"{robot}.{part}" for part in ("pem", "key")}
        paths["pem"].write_bytes(_pem(certificate))
        paths["key"].write_bytes(
            key.private_bytes(
                serialization.Encoding.PEM,
                serialization.PrivateFormat.PKCS8,
                serialization.NoEncryption(),
            )
        )
        paths["key"].chmod(0o600)
        return TlsConfig(
            ca=str(self.folder / "ca.pem"), certificate=str(paths["pem"]), key=str(paths["key"])
        )

    def _sign(self, name: x509.Name, key: ec.EllipticCurvePublicKey, ca: bool) -> x509.Certificate:
        now = dt.datetime.now(dt.timezone.utc)
        builder = (
            x509.CertificateBuilder()
            .subject_name(name)
            .issuer_name(self.name)
            .public_key(key)
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - dt.timedelta(hours=1))
            .not_valid_after(now + dt.timedelta(days=1))
            .add_extension(x509.BasicConstraints(ca, None), critical=True)
        )
        if not ca:
            names = x509.SubjectAlternativeName([x509.DNSName("robot")])
            builder = builder.add_extension(names, critical=False)
        return builder.sign(self.key, hashes.SHA256())


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _taken(inbox: Inbox, count: int) -> list[bytes]:
    messages: list[bytes] = []
    until(lambda: messages.extend(inbox.take(0.05).messages) or len(messages) >= count)
    return messages


def _get(address: str) -> str:
    with urllib.request.urlopen(address, timeout=10) as answer:
        return str(answer.read(), "utf-8")


def _try(address: str) -> str:
    try:
        return _get(address)
    except OSError:
        return ""


def _hung_up(asker: socket.socket) -> bool:
    """Whether the other end has closed the connection."""
    asker.setblocking(False)
    try:
        return asker.recv(1) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True


def _peak() -> int:
    """Largest memory of this process, bytes."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.partition("VmHWM:")[2].split()[0])
