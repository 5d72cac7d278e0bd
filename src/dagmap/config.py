"""Every parameter in one frozen tree, checked when it is made. TOML files are read by msgspec.

Lengths are metres and times seconds here, as people write them; the properties ending in `_mm`
are what the integer core uses.
"""

from __future__ import annotations

import hashlib
import re
from functools import cached_property
from pathlib import Path
from typing import Literal, TypeVar

import msgspec

from .model import (
    LIMIT_MM,
    MAX_DESCRIBED,
    MAX_KEYFRAMES,
    MAX_NAME,
    ConfigError,
    CycleError,
    quantise_pose,
)
from .text import printable


class _Checked(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A frozen group of parameters; `_require` names the one that is wrong and what is wanted."""

    def _require(self, holds: bool, name: str, wanted: str) -> None:
        if not holds:
            value = getattr(self, name)
            raise ConfigError(f"{type(self).__name__}: {name} = {value!r}, but {wanted}")

    def _require_range(self, name: str, low: float, high: float) -> None:
        value = getattr(self, name)
        holds = isinstance(value, (int, float)) and not isinstance(value, bool)
        self._require(holds and low <= value <= high, name, f"{low} to {high} is wanted")


class GraphConfig(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Section 4.1: the adjacency DAG. `n_p`, `n_c_max` are fleet-wide: receivers check them."""

    n_p: int = 2  # N_p, parents of a node at most
    n_c: int = 2  # N_c, children at which a node leaves the terminals; the start value
    n_c_max: int = 8  # the bound within which the controller moves N_c
    v_th: int = 1  # V_th: a node whose validity exceeds it becomes the core of a bundle
    reference_pitch: float = 0.05  # m, of the lattice of reference nodes
    max_parent_distance: float | None = 0.15  # m; None: parents may be any distance away
    issued_validity: Literal["inherit", "reset"] = "inherit"

    def __post_init__(self) -> None:
        self._require_range("n_p", 1, 8)
        self._require_range("n_c", 1, 255)
        self._require_range("n_c_max", 1, 255)
        self._require(
            self.n_c >= self.n_p,
            "n_c",
            f"N_c >= N_p = {self.n_p} is needed: below it the terminals run dry",
        )
        self._require(self.n_c_max >= self.n_c, "n_c_max", f"at least n_c = {self.n_c} is wanted")
        self._require_range("v_th", 0, 1 << 62)
        self._require_range("reference_pitch", 0.01, 1000.0)
        if self.max_parent_distance is not None:
            self._require_range("max_parent_distance", 0.001, 2 * LIMIT_MM / 1000)

    @property
    def pitch_mm(self) -> int:
        return round(self.reference_pitch * 1000)

    @property
    def reach_mm(self) -> int:
        """Largest distance to a parent, mm; -1 where unlimited."""
        return -1 if self.max_parent_distance is None else round(self.max_parent_distance * 1000)


class IssuanceConfig(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Section 4.2 and Eq. (6): how much goes out, and when."""

    features_per_bundle: int = 1400  # N'_f: what a bundle holds at most; the furthest are cut
    features_per_transaction: int = 1400  # so that a transaction fits in one message
    features_per_second: float | None = None  # the robot's budget; None: as fast as they are valid
    repeats: int = 16  # how often a robot says that it saw one place; 0: every time
    seal_period: float = 0.25  # s between transactions under a budget, so that envelopes stay few
    spread_from: float = (
        2.0  # s: what a cycle that lasts so long makes valid goes out spread over it
    )
    cycle_period: float = 0.0  # s that a cycle is taken to last until two were seen

    def __post_init__(self) -> None:
        self._require_range("features_per_bundle", 1, 1 << 20)
        self._require_range("features_per_transaction", 1, 1400)
        self._require_range("seal_period", 0.0, 3600.0)
        self._require_range("repeats", 0, 1 << 30)
        self._require_range("spread_from", 0.0, 1e9)
        self._require_range("cycle_period", 0.0, 3600.0)
        if self.features_per_second is not None:
            self._require_range("features_per_second", 0.1, 1e9)


class TransactionConfig(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Section 4.2: the envelope. Fleet-wide, since every receiver judges by it."""

    proof_of_work_bits: int = 6  # hashcash: 2^bits hashes to issue, one to check
    max_references: int = 2  # tips of other authors that a transaction refers to

    def __post_init__(self) -> None:
        self._require_range("proof_of_work_bits", 0, 24)
        self._require_range("max_references", 0, 16)


class FoldConfig(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Section 4.3: the map consensus. All of it is fleet-wide."""

    preset: Literal["default", "paper"] = "default"
    delta: float = 0.03  # m: observations within it are twins (Algorithm 2's delta)
    witnesses: int = 2  # authors that a confirmed node needs
    hit_say: int = 1  # what one author's hits count for in one node, at most
    miss_say: int = 1  # what one author's misses count for in one node, at most
    # Bits that what speaks for a node must outweigh, or misses count; None: each robot's are
    # learned from how its own nodes fare, see `weighing.doubts`.
    doubt: int | None = None
    cell: float = 0.10  # m: cell of the ray evidence
    max_ray: float = 5.0  # m: a ray is walked so far from its sensor

    def __post_init__(self) -> None:
        self._require_range("delta", 0.001, 10.0)
        self._require_range("witnesses", 1, 1000)
        self._require_range("hit_say", 1, 1000)
        self._require_range("miss_say", 0, 1000)
        if self.doubt is not None:
            self._require_range("doubt", 0, 1000)
        self._require_range("cell", 0.005, 10.0)
        self._require_range("max_ray", 0.0, 100.0)
        self._require(
            self.max_ray / self.cell <= 4096, "max_ray", f"at most 4096 cells of {self.cell} m"
        )

    @property
    def delta_mm(self) -> int:
        return round(self.delta * 1000)

    @property
    def support_mm(self) -> int:
        """What lies so near to a node supports it, mm: two and a half delta."""
        return 5 * self.delta_mm // 2

    @property
    def cell_mm(self) -> int:
        return round(self.cell * 1000)

    @property
    def max_ray_mm(self) -> int:
        return round(self.max_ray * 1000)


class LedgerConfig(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Bounds on what is kept for others; a bound never decides what is valid."""

    waiting_transactions: int = 4096  # the waiting room: transactions without their references
    waiting_bytes: int = 64 << 20
    # Observations whose folding can be undone after a checkpoint, at 4 bytes each. What comes from
    # before them costs a fold of everything, which is less than undoing and applying everything.
    undo_kept: int = 1_000_000
    fold_per_tick: int = 25_000  # work of a tick, in features folded; a unit is about 1 us
    # s from when all is folded until ticks fold again; 0: every tick folds. Where much comes late,
    # as over many hops, each fold undoes and repeats some of the last one: seldom costs less.
    fold_period: float = 0.0

    def __post_init__(self) -> None:
        self._require_range("waiting_transactions", 1, 1 << 24)
        self._require_range("waiting_bytes", 1 << 16, 1 << 40)
        self._require_range("undo_kept", 0, 1 << 40)
        self._require_range("fold_per_tick", 1, 1 << 40)
        self._require_range("fold_period", 0.0, 3600.0)


class SyncConfig(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Spreading and repair."""

    announce_period: float = 1.0  # s between announcements of the heads
    retry_period: float = 1.0  # s after which an unanswered question is asked again
    chunk_bytes: int = 256 << 10  # an answer holds so much at most; the asker then asks on
    # Who announces or asks is not authenticated: what is kept and looked up for them is bounded.
    peers_remembered: int = 256  # the ones that were silent longest are forgotten
    heads_remembered: int = 1800  # of a peer, of those that promise what is lacking here
    ids_per_question: int = 256  # more of one question are not looked up

    def __post_init__(self) -> None:
        self._require_range("peers_remembered", 1, 1 << 20)
        self._require_range("heads_remembered", 1, 1 << 20)
        self._require_range("ids_per_question", 1, 1024)
        self._require_range("announce_period", 0.01, 3600.0)
        self._require_range("retry_period", 0.01, 3600.0)
        self._require_range("chunk_bytes", 1 << 16, 1 << 30)


class OverheadConfig(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Section 5: what DAGmap may cost. Without a limit nothing is held back or left for later."""

    fleet_bytes_per_second: float | None = None  # C_Th of Eq. (6), shared by the robots in reach
    robot_bytes_per_second: float | None = None  # cap on all that this robot sends
    cycle_share: float | None = None  # of the cycle time T that the overhead S may take, Eq. (2)
    longest_delay: float = 1.0  # s one way: a slower link carries too much; used with a byte limit
    backlog: int = 1_000_000  # points that wait to be inserted at most; the oldest are dropped

    def __post_init__(self) -> None:
        for name in ("fleet_bytes_per_second", "robot_bytes_per_second"):
            if getattr(self, name) is not None:
                self._require_range(name, 500.0, 1e12)
        if self.cycle_share is not None:
            self._require_range("cycle_share", 0.01, 1.0)
        self._require_range("longest_delay", 0.01, 3600.0)
        self._require_range("backlog", 1, 1 << 30)

    @property
    def caps_bytes(self) -> bool:
        return not (self.fleet_bytes_per_second is None and self.robot_bytes_per_second is None)


class PlacingConfig(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How robots that share no frame find each other's. A robot's own policy, see docs/placing.md.

    Lengths follow the sensor: `tolerance` is how far apart two robots may see one point.
    """

    tolerance: float = 0.08  # m: about four times the noise of a depth camera at 3 m
    points: int = 200  # described points of a keyframe that are sent, the first of the cycle
    keyframes: int = 100  # of a session, at most
    keyframe_distance: float = 0.3  # m between keyframes that look the same way
    keyframe_turn: float = 15.0  # degrees between keyframes of one place
    inliers: int = 30  # points that must agree before a link is published
    # Whether frames without descriptors are placed by their shape. Rooms that are alike to the
    # centimetre, each seen by one robot only, would be laid on each other: so it is to be wanted.
    surfaces: bool = False
    # m that this robot's SLAM drifts per m and does not correct: 0.01 to 0.02 for an odometry. Then
    # its path is bent to what others, placed already, have seen. 0: it is not, for what others show
    # could bend a path that is right; so leave it where the SLAM closes its loops.
    drift: float = 0.0
    # Work of a tick: comparing two keyframes of 200 points is two units, half a ms together. So a
    # tick stays under 10 ms, a fifth of what a SLAM can spare; a piece of work ends later at most.
    units_per_tick: int = 24

    def __post_init__(self) -> None:
        self._require_range("tolerance", 0.005, 10.0)
        self._require_range("points", 3, MAX_DESCRIBED)
        self._require_range("keyframes", 0, MAX_KEYFRAMES)
        self._require_range("keyframe_distance", 0.01, 1000.0)
        self._require_range("keyframe_turn", 1.0, 180.0)
        self._require_range("inliers", 12, 1 << 20)
        self._require_range("drift", 0.0, 0.1)
        self._require(
            self.drift == 0 or self.drift >= 1e-4, "drift", "0, or 0.0001 at least, is wanted"
        )
        self._require_range("units_per_tick", 1, 10_000)

    @property
    def tolerance_mm(self) -> int:
        return round(self.tolerance * 1000)


class Config(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True, dict=True):
    """All parameters of one participant.

    fleet: name of the fleet. Its hash, with that of the fleet-wide parameters, heads every message.
    fleet_key: the fleet's public key, 64 hexadecimal digits (`dagmap keys` makes it). With it the
        fleet is closed: only robots that hold a certificate of this key take part. Empty: an open
        fleet, where any key may sign, for a first try.
    name: what people call this robot; empty: the hexadecimal author id. In a closed fleet the
        certificate names it.
    start_pose: (4, 4) rows of the robot's first SLAM frame in the fleet frame, metres, published as
        a link; default identity: the robots share one frame. None, or [] in a file: unknown.
    start_sigma: metres, standard deviation of `start_pose`; 0: it is exact. Else the robot is
        merged there at once, and moved to where it is found to be among the others.
    same_origin: whether a new session of the SLAM starts in the frame of the one before.
    """

    fleet: str = "dagmap"
    fleet_key: str = ""
    name: str = ""
    start_pose: tuple[tuple[float, float, float, float], ...] | None = (
        (1.0, 0.0, 0.0, 0.0),
        (0.0, 1.0, 0.0, 0.0),
        (0.0, 0.0, 1.0, 0.0),
        (0.0, 0.0, 0.0, 1.0),
    )
    start_sigma: float = 0.0
    same_origin: bool = False
    graph: GraphConfig = GraphConfig()
    issuance: IssuanceConfig = IssuanceConfig()
    transaction: TransactionConfig = TransactionConfig()
    fold: FoldConfig = FoldConfig()
    ledger: LedgerConfig = LedgerConfig()
    sync: SyncConfig = SyncConfig()
    placing: PlacingConfig = PlacingConfig()
    overhead: OverheadConfig = OverheadConfig()

    def __post_init__(self) -> None:
        fits = len(self.name.encode()) <= MAX_NAME
        self._require(fits, "name", f"at most {MAX_NAME} bytes of UTF-8 are wanted")
        self._require(printable(self.name), "name", "printable characters are wanted")
        self._require(
            not self.fleet_key or re.fullmatch("[0-9a-f]{64}", self.fleet_key) is not None,
            "fleet_key",
            "the 64 lower case hexadecimal digits are wanted that stand in the fleet's fleet.toml",
        )
        self._require_range("start_sigma", 0.0, 100.0)
        if self.start_pose:
            try:
                quantise_pose(self.start_pose, "Config: start_pose")
            except CycleError as error:
                raise ConfigError(str(error)) from None

    @cached_property  # every message is asked for it
    def fleet_id(self) -> bytes:
        """8 bytes that name the fleet: a closed one by its key and its name."""
        named = b"dagmap fleet 1\0" + self.fleet.encode()
        if self.closed:
            named = b"dagmap closed fleet 1\0" + self.fleet_public_key + self.fleet.encode()
        return hashlib.blake2b(named, digest_size=8).digest()

    @property
    def closed(self) -> bool:
        """Whether only robots with a certificate of the fleet key take part."""
        return bool(self.fleet_key)

    @property
    def fleet_public_key(self) -> bytes:
        """The 32 bytes of the fleet key; none in an open fleet."""
        return bytes.fromhex(self.fleet_key)

    @cached_property
    def parameters_id(self) -> bytes:
        """8 bytes over all that every robot must hold alike, or it would compute another map."""
        graph = [self.graph.n_p, self.graph.n_c_max]
        shared = msgspec.json.encode([self.fold, self.transaction, graph])
        return hashlib.blake2b(b"dagmap parameters 1\0" + shared, digest_size=8).digest()


C = TypeVar("C", bound=Config)
T = TypeVar("T")


def load_config(path: Path, kind: type[C] = Config) -> C:  # type: ignore[assignment]
    """Read a TOML file. Raises ConfigError that names the file, the key and what is wanted.

    kind: a kind of `Config` with further tables, where the file has them.
    """
    return read_toml(path, kind)


def read_toml(path: Path, kind: type[T]) -> T:
    """What a TOML file holds, checked. Raises ConfigError as `load_config` does."""
    try:
        return msgspec.toml.decode(path.read_bytes(), type=kind)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: not a text file in UTF-8") from None
    except msgspec.ValidationError as error:
        raise ConfigError(f"{path}: {error}") from None
    except msgspec.DecodeError as error:
        raise ConfigError(f"{path}: not valid TOML ({error})") from None
    except (ValueError, RecursionError):  # Python's own limits, which its TOML reader lets through
        raise ConfigError(f"{path}: a number is too long or something nested too deep") from None
