"""What one robot's process is told: the parameters of `Config` and the tables of its surroundings.

Relative paths in the file are meant from the folder that the file is in.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec

from ..config import Config, _Checked, load_config
from ..model import ConfigError
from .ros.config import RosConfig
from .sources import Options

_MAX_FILE_NAME = 255  # bytes, of one part of a path


class SourceConfig(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The recording that stands in for a SLAM. Without this table the robot only listens."""

    path: str  # any recording that `dagmap inspect` knows
    max_features: int = 1000  # points that a frame of pictures gives at most
    camera: str | None = None  # a camera.json to use instead of the recording's own
    poses: str | None = None  # a file of poses: TUM, or KITTI beside clouds
    body_poses: bool = False  # poses of a SLAM are the body's (IMU), not the camera's
    max_depth: float | None = None  # m, points beyond are dropped
    topics: tuple[str, ...] = ()  # of a bag; what is not named is found by its type
    frame: str | None = None  # of a bag with tf: the frame that stands still
    same_frame: bool = False  # poses are those of the sensor, whatever their frames are called
    voxel: float = 0.1  # m: of a cloud one point a voxel is kept
    keep_going: bool = False  # leave out what cannot be read

    def options(self, camera: Path | None, poses: Path | None = None) -> Options:
        """What the readers take. Raises ConfigError where one is out of its range."""
        return Options(
            camera=camera,
            poses=poses,
            max_features=self.max_features,
            max_depth=self.max_depth,
            topics=self.topics,
            frame=self.frame,
            same_frame=self.same_frame,
            voxel=self.voxel,
            keep_going=self.keep_going,
            body_poses=self.body_poses,
        )


class TlsConfig(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """PEM files. Both ends show a certificate of the authority, or there is no connection."""

    ca: str
    certificate: str
    key: str


class NetworkConfig(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the robots reach each other, and what is kept for them at most."""

    mode: Literal["peer", "router", "client"] = "peer"  # a router relays between its clients
    listen: tuple[str, ...] = ()  # endpoints such as "tcp/0.0.0.0:7447"; none: any free port
    connect: tuple[str, ...] = ()  # endpoints of other robots, tried again and again
    scouting: bool = True  # look for robots by multicast
    gossip: bool = True  # let robots in reach tell of further ones
    # A robot whose ledger is an older copy would sign numbers again. So one with a past waits
    # for those in reach to say how long its chain was; s at most, where nobody is there.
    hear_first: float = 5.0
    tls: TlsConfig | None = None
    send_bytes: int = 16 << 20  # waiting to be sent: a link that stalls for long costs no more
    receive_bytes: int = 32 << 20  # received and not looked at yet, from all robots
    receive_bytes_per_robot: int = 8 << 20  # of that, from one: none crowds out the others
    # To refuse a message costs 60 us: so a flood of junk costs a quarter of a core, no more.
    receive_messages_per_second: int = 4000
    # From one robot. At ten cycles a second it has ten to tell, and one announcement.
    receive_messages_per_second_per_robot: int = 1000
    # From one robot, more than can be verified and folded (6 MB). A question counts for
    # `sync.chunk_bytes`: nobody makes a robot answer faster than that by asking and asking.
    receive_bytes_per_second_per_robot: int = 16 << 20
    receive_bytes_per_second: int = 32 << 20  # from all robots: one may speak in many names
    # Whoever reaches the network can claim to be many: senders whose rate is remembered (the
    # oldest are forgotten), and robots in reach (nobody more is counted until somebody leaves).
    senders_remembered: int = 256
    robots_remembered: int = 4096
    messages_per_step: int = 16  # a cycle of the SLAM never waits behind more

    def __post_init__(self) -> None:
        for name in ("send_bytes", "receive_bytes", "receive_bytes_per_robot"):
            self._require_range(name, 1 << 16, 1 << 32)
        self._require_range("hear_first", 0.0, 3600.0)
        self._require_range("receive_messages_per_second", 10, 1 << 32)
        self._require_range("receive_messages_per_second_per_robot", 10, 1 << 32)
        self._require_range("receive_bytes_per_second_per_robot", 1 << 16, 1 << 40)
        self._require_range("receive_bytes_per_second", 1 << 16, 1 << 40)
        for name in ("senders_remembered", "robots_remembered", "messages_per_step"):
            self._require_range(name, 1, 1 << 20)
        self._require(
            self.mode != "client" or bool(self.connect) or self.scouting,
            "mode",
            "a client wants a router in `connect`, or scouting",
        )
        self._require(
            self.mode != "router" or bool(self.listen),
            "listen",
            'a router wants an endpoint that others can name, such as "tcp/0.0.0.0:7447"',
        )
        for name in ("listen", "connect"):
            ends: tuple[str, ...] = getattr(self, name)
            named = all(map(is_endpoint, ends))
            self._require(named, name, 'endpoints such as "tcp/192.168.1.7:7447" are wanted')
            secure = self.tls is None or all(end.startswith("tls/") for end in ends)
            self._require(secure, name, "with [network.tls] every endpoint begins with tls/")


def is_endpoint(text: str) -> bool:
    """Whether it names a way in or out: protocol/address, and the port where there are ports."""
    protocol, _, address = text.partition("/")
    if protocol not in ("tcp", "udp", "tls", "quic", "ws"):
        return bool(protocol and address)
    host, _, port = address.partition("?")[0].partition("#")[0].rpartition(":")
    short = port.isascii() and port.isdigit() and len(port) <= 5
    return bool(host) and short and int(port) < 1 << 16


class StoreConfig(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where the ledger is. Its folder is the robot's data folder, made where it is missing."""

    path: str


class MetricsConfig(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Numbers for Prometheus under http://LISTEN/metrics; off unless an address is given."""

    listen: str | None = None  # "127.0.0.1:9464"; anybody who reaches the address can read it
    askers: int = 16  # at a time: each has a thread for as long as it is there, 10 s

    def __post_init__(self) -> None:
        self._require_range("askers", 1, 1 << 10)
        if self.listen is not None:
            host, _, port = self.listen.rpartition(":")
            right = bool(host) and port.isdecimal() and int(port) < 1 << 16
            self._require(right, "listen", 'an address such as "127.0.0.1:9464" is wanted')

    @property
    def address(self) -> tuple[str, int] | None:
        if self.listen is None:
            return None
        host, _, port = self.listen.rpartition(":")
        return host.strip("[]"), int(port)


class ControlConfig(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The socket that `dagmap status` asks, for this user only."""

    path: str | None = None  # default: status.sock beside the ledger


class AgentConfig(Config, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A configuration file of `dagmap agent`: the keys of `Config`, and these tables."""

    store: StoreConfig
    keys: str = "."  # in a closed fleet: the folder that `dagmap keys enroll` made
    source: SourceConfig | None = None
    ros: RosConfig | None = None  # a SLAM that runs, instead of a recording
    network: NetworkConfig = NetworkConfig()
    metrics: MetricsConfig = MetricsConfig()
    control: ControlConfig = ControlConfig()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.source is not None and self.ros is not None:
            raise ConfigError("[source] and [ros]: one robot has one SLAM; remove one of the two")
        least = self.sync.chunk_bytes + (1 << 16)
        for name in ("receive_bytes_per_second_per_robot", "receive_bytes_per_second"):
            rate = getattr(self.network, name)
            if rate < least:  # no question would ever come through
                raise ConfigError(
                    f"NetworkConfig: {name} = {rate}, but a question "
                    f"counts for an answer: at least sync.chunk_bytes + 65536 = {least} is wanted"
                )


@dataclass(frozen=True, slots=True)
class Settings:
    """A configuration file and the folder that its paths are meant from."""

    config: AgentConfig
    folder: Path

    def at(self, path: str) -> Path:
        """A path of the file as one that can be opened. Raises ConfigError where none can be."""
        try:
            found = Path(os.path.normpath(self.folder / Path(path).expanduser()))
        except RuntimeError as error:
            raise ConfigError(f"path {path[:60]!r}: {error}; write the folder out") from None
        names = [os.fsencode(name) for name in found.parts]
        if b"\0" in b"".join(names) or max(map(len, names), default=0) > _MAX_FILE_NAME:
            raise ConfigError(f"path {path[:60]!r}: no file can have this name; choose another")
        return found

    @property
    def ledger(self) -> Path:
        return self.at(self.config.store.path)

    @property
    def keys(self) -> Path:
        """The robot's key and certificate, in a closed fleet."""
        return self.at(self.config.keys)

    @property
    def control(self) -> Path:
        """Of the socket that answers `dagmap status`."""
        path = self.config.control.path
        return self.ledger.parent / "status.sock" if path is None else self.at(path)


def load_settings(path: Path) -> Settings:
    """Read a configuration file. A robot without a name is called like its file, or in a closed
    fleet as its certificate says.

    Raises ConfigError that names the file, the key and what is wanted.
    """
    try:
        config = load_config(path, AgentConfig)
    except ConfigError as error:
        if "required field `store`" in str(error):
            remedy = 'add one with path = "data/ledger.db"'
            raise ConfigError(f"{path}: there is no table [store]; {remedy}") from None
        raise
    if not config.name and not config.closed:
        try:
            config = msgspec.structs.replace(config, name=path.stem)
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}; give the robot a `name`") from None
    return Settings(config, path.parent)
