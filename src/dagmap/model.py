"""Table 1 of the paper in types: what a SLAM hands in, what comes out, and what goes wrong.

Metres become int32 millimetres, poses integer quaternions; `quantising` does so for whole cycles.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

Int32s: TypeAlias = npt.NDArray[np.int32]
Int64s: TypeAlias = npt.NDArray[np.int64]
Uint8s: TypeAlias = npt.NDArray[np.uint8]
Floats: TypeAlias = npt.NDArray[np.float64]
Bools: TypeAlias = npt.NDArray[np.bool_]

LIMIT_MM = 1 << 29  # coordinates lie within +-LIMIT_MM before and after every pose
QUATERNION_ONE = 1 << 30
MAX_CYCLE = (1 << 31) - 1
MAX_DESCRIBED = 1024  # points of a keyframe: a record of them fits into a transaction
MAX_KEYFRAMES = 256  # of one author that a robot compares with its own
DESCRIPTOR = 32  # bytes of a binary descriptor
MAX_NAME = 64  # bytes of a robot's name


class DagmapError(Exception):
    """Whatever DAGmap raises on purpose; the message names the input, the place and the remedy."""


class ConfigError(DagmapError, ValueError):
    """A parameter is out of its range, or two of them contradict each other."""


class CycleError(DagmapError, ValueError):
    """The local SLAM handed in a cycle that cannot be used; nothing of it was taken."""


class RecordingError(DagmapError):
    """A recording cannot be read. What its files say is quoted, but not for pages."""

    def __str__(self) -> str:
        said = super().__str__()
        return said if len(said) <= 2000 else f"{said[:1000]} ... {said[-900:]}"


class OutputError(DagmapError):
    """A result cannot be written."""


class StoreError(DagmapError):
    """A ledger on disk cannot be opened, read or written."""


class KeysError(DagmapError):
    """A key, a certificate or the folder of a fleet cannot be made, read or trusted."""


class NetworkError(DagmapError):
    """The fleet's network cannot be opened."""


class State(IntEnum):
    """What the fleet thinks of a node (section 4.3); the numbers stand in `map.ply`."""

    CONFIRMED = 0
    TENTATIVE = 1
    REJECTED = 2


AuthorId: TypeAlias = bytes  # 8 bytes: the head of the BLAKE2b-256 of the author's public key
TransactionId: TypeAlias = bytes  # 32 bytes: the BLAKE2b-256 of the exact bytes


class FrameId(NamedTuple):
    """A SLAM frame: one per author and session. The fleet's own frame is that of author zero."""

    author: AuthorId
    session: int = 0


FLEET_FRAME = FrameId(bytes(8), 0)


@dataclass(frozen=True, slots=True, eq=False)
class Cycle:
    """What a SLAM put out in one cycle.

    stamp: seconds, strictly increasing within a session; it names the cycle as an anchor.
    pose: (4, 4) rigid transform from the sensor to the robot's SLAM frame, metres.
    points: (N, 3) metres in the sensor frame.
    ids: (N,) unsigned 64-bit names of the points in the SLAM, or None. A repeated id is a new
        observation of the same feature.
    colors: (N, 3) uint8, or None.
    moved: (stamps (M,), poses (M, 4, 4)) of earlier cycles that a loop closure has moved, or None.
    removed: ids of points that the SLAM has withdrawn, or None.
    session: another value starts a new SLAM frame and a new space of ids.
    descriptors: (N, 32) uint8 binary descriptors of the points (ORB), the most telling points
        first, or None. By them robots that share no frame find each other's.
    """

    stamp: float
    pose: npt.ArrayLike
    points: npt.ArrayLike
    ids: npt.ArrayLike | None = None
    colors: npt.ArrayLike | None = None
    moved: tuple[npt.ArrayLike, npt.ArrayLike] | None = None
    removed: npt.ArrayLike | None = None
    session: int = 0
    descriptors: npt.ArrayLike | None = None


def quantise_points(points: npt.ArrayLike, where: str = "points") -> Int32s:
    """(N, 3) metres to int32 millimetres, halves up. Raises CycleError for NaN and out of range."""
    try:
        metres = np.asarray(points, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CycleError(f"{where}: not an array of numbers ({error})") from None
    if metres.size == 0:
        return np.zeros((0, 3), np.int32)
    if metres.ndim != 2 or metres.shape[1] != 3:
        raise CycleError(f"{where}: the shape is {metres.shape}; (N, 3) is wanted")
    with np.errstate(over="ignore"):  # to infinity, which is refused
        millimetres = np.floor(metres * 1000.0 + 0.5)
    bad = np.asarray(~(np.abs(millimetres) <= LIMIT_MM).all(axis=1))  # catches NaN too
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise CycleError(
            f"{where}: {int(bad.sum())} of {len(bad)} are not finite or beyond "
            f"{LIMIT_MM / 1000:.0f} m, the first in row {row} {metres[row].tolist()}; drop them"
        )
    return millimetres.astype(np.int32)


def quantise_pose(pose: npt.ArrayLike, where: str = "pose") -> Int32s:
    """(4, 4) rigid transform to (7,) int32: quaternion w x y z in 2^-30, translation in mm.

    Raises CycleError where the matrix is no rigid motion (to 1e-3) or its translation out of range.
    """
    try:
        matrix = np.asarray(pose, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CycleError(f"{where}: not an array of numbers ({error})") from None
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise CycleError(f"{where}: a finite (4, 4) matrix is wanted, this is {matrix.tolist()}")
    rotation = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):  # to infinity or NaN, which is not rigid
        orthonormal = np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-3
    rigid = orthonormal and np.linalg.det(rotation) > 0
    if not rigid or np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise CycleError(
            f"{where}: not a rigid motion (rotation must be orthonormal with determinant 1, "
            f"last row 0 0 0 1): {matrix.tolist()}"
        )
    translation = quantise_points(matrix[None, :3, 3], f"{where}: translation")[0]
    quaternion = np.floor(_quaternion(rotation) * QUATERNION_ONE + 0.5)
    return np.concatenate([quaternion, translation]).astype(np.int32)


def pose_matrix(pose: Int32s) -> Floats:
    """(7,) integer pose back to a (4, 4) float matrix in metres, for people and figures only."""
    w, x, y, z = (np.asarray(pose[:4], np.float64) / QUATERNION_ONE).tolist()
    out = np.eye(4)
    out[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    out[:3, 3] = np.asarray(pose[4:], np.float64) / 1000.0
    return out


def _quaternion(rotation: Floats) -> Floats:
    """Unit quaternion (w >= 0) nearest to a rotation: the top eigenvector of Bar-Itzhack's K."""
    r = rotation
    k = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [0, r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [0, 0, r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1]],
            [0, 0, 0, r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    vector = np.asarray(np.linalg.eigh(k, UPLO="U")[1][:, -1], np.float64)
    return -vector if vector[0] < 0 else vector


class Reason(Enum):
    """Why something from outside was refused. Always found in the bytes or in the set itself."""

    TRUNCATED = "truncated"
    CHECKSUM = "checksum does not match"
    VERSION = "unknown version"
    FLEET = "another fleet"
    PARAMETERS = "other fold parameters"
    MALFORMED = "malformed"
    PROOF_OF_WORK = "proof of work missing"
    CERTIFICATE = "no certificate of this fleet"
    SIGNATURE = "signature does not match"
    CHAIN = "does not continue its author's chain"
    LAMPORT = "Lamport time does not follow from its references"
    STRUCTURE = "graph structure violated"
    FORK = "beyond a proven fork of its author"
    REVOKED = "beyond the revocation of its author"


@dataclass(frozen=True, slots=True)
class Accepted:
    """A transaction went through the door. Store `data` before the outbox is sent."""

    id: TransactionId
    data: bytes


@dataclass(frozen=True, slots=True)
class Rejected:
    """Something was refused. `fault` is the author or sender it is attributed to, where known."""

    reason: Reason
    fault: AuthorId | None = None
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Waiting:
    """A transaction is kept aside until what it refers to is known.

    In a closed fleet it is not even kept where nothing certified is known of its author: it comes
    again once the author's first transaction is here.
    """

    id: TransactionId
    missing: tuple[TransactionId, ...]


@dataclass(frozen=True, slots=True)
class Issued:
    """An own transaction was sealed: how many features it carries in how many bundles."""

    id: TransactionId
    features: int
    bundles: int
    size: int


@dataclass(frozen=True, slots=True)
class Forked:
    """An author was proven to have signed two transactions with one number."""

    author: AuthorId
    sequence: int


@dataclass(frozen=True, slots=True)
class Revoked:
    """The fleet key has revoked an author: its first `count` transactions count, no others.

    count: None where the revocation does not count any more, since the fleet key itself has forked.
    """

    author: AuthorId
    count: int | None


@dataclass(frozen=True, slots=True)
class MapChanged:
    """The fold has moved: so many transactions were undone and applied."""

    undone: int
    applied: int


@dataclass(frozen=True, slots=True)
class Overloaded:
    """The overhead S came too near to the cycle time T, so fewer features are inserted a cycle.

    The others wait for a quieter time. load: S / T of the cycle. features: that a cycle inserts
    from now on, None where all are inserted again. waiting: points that are left for later;
    dropped: points for which there was no room (`overhead.backlog`).
    """

    load: float
    features: int | None
    waiting: int
    dropped: int = 0


Event: TypeAlias = (
    Accepted | Rejected | Waiting | Issued | Forked | Revoked | MapChanged | Overloaded
)


@dataclass(frozen=True, slots=True)
class Outgoing:
    """Bytes for the network: to one author, or (None) to everybody in reach."""

    data: bytes
    to: AuthorId | None = None
