"""RTAB-Map's databases: the features of every node with their 3D positions, in SQLite.

Nodes come with the pose of the odometry, as RTAB-Map saw them; with the last one come the poses
that its optimisation has given all of them, as after a loop closure.
"""

from __future__ import annotations

import sqlite3
import struct
import zlib
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...model import Cycle, Floats, RecordingError
from ._source import Description, Item, Options, Skips, checked
from ._storage import DAMAGED, SQLITE, cut_short, one_line, require_plain

UNDERSTANDS = "an RTAB-Map database (.db)"
_NODES = "SELECT id, map_id, stamp, pose FROM Node WHERE id > 0 ORDER BY id"
_FEATURES = """SELECT depth_x, depth_y, depth_z FROM Feature WHERE node_id = ?
    AND depth_x IS NOT NULL ORDER BY response DESC, rowid LIMIT ?"""
_TABLES = ("Node", "Feature", "Admin")
_COUNT = "SELECT count(*) FROM Feature WHERE depth_x IS NOT NULL"
UINT8, _INT32, _FLOAT32 = 0, 4, 5  # OpenCV's types, one channel
_TYPES: dict[int, np.dtype[Any]] = {
    UINT8: np.dtype("u1"),
    _INT32: np.dtype("<i4"),
    _FLOAT32: np.dtype("<f4"),
}
_AFTER = 1e-3  # s after the last node: when a mere correction is dated
_MOST_SMALLER = 1100  # zlib makes nothing smaller than by this factor


@dataclass(frozen=True, slots=True)
class _Node:
    id: int
    session: int
    stamp: float
    pose: Floats
    moved: Floats | None  # by the optimisation


def matches(path: Path) -> bool:
    """Whether this is a file called `.db`."""
    return path.is_file() and path.suffix.lower() == ".db"


def open(path: Path, options: Options) -> RtabmapDatabase:  # noqa: A001
    """Open a database. Raises RecordingError."""
    return RtabmapDatabase(path, options)


def describe(path: Path, options: Options) -> Description:
    """Nodes, features with a position, and optimised poses."""
    source = open(path, options)
    with _database(path) as database:
        features = int(database.execute(_COUNT).fetchone()[0])
    items = (
        Item("Node", "poses", len(source), "cycles"),
        Item("Feature", "3D points", features, "points"),
        Item("Admin", "optimised poses", source.optimised, "moved" if source.optimised else ""),
    )
    return Description(f"RTAB-Map {source.version} database", items, len(source))


class RtabmapDatabase:
    """The nodes of a database as cycles. version: of RTAB-Map. optimised: nodes that were moved."""

    def __init__(self, path: Path, options: Options) -> None:
        self.name, self._path, self._options = path.stem, path, options
        self.skips = Skips(options.keep_going)
        self.notes: tuple[str, ...] = ()
        _check_size(path, self.skips)
        with _database(path) as database:
            if options.keep_going:
                database.execute(DAMAGED)
            self.version = _version(path, database)
            optimised = self._optimised(database)
            self._nodes = self._read_nodes(database, optimised)
        self.optimised = sum(node.moved is not None for node in self._nodes)
        if not self._nodes:
            raise RecordingError(f"{path}: no node has a pose; record with odometry")

    def __len__(self) -> int:
        return len(self._nodes)

    def __iter__(self) -> Iterator[Cycle]:
        try:
            yield from self._cycles()
        except RecordingError as error:
            self.skips.note(error)

    def _cycles(self) -> Iterator[Cycle]:
        given: list[_Node] = []  # what is left out cannot be moved
        with _database(self._path) as database:
            if self._options.keep_going:
                database.execute(DAMAGED)
            for i, node in enumerate(self._nodes):
                last = i == len(self._nodes) - 1
                rows = database.execute(_FEATURES, (node.id, 4 * self._options.max_features))
                try:
                    cycle = Cycle(
                        node.stamp,
                        node.moved if last and node.moved is not None else node.pose,
                        self._chosen(self._positions(node, rows.fetchall())),
                        moved=_moves(given) if last else None,
                        session=node.session,
                    )
                    cycle = checked(cycle, self._path)
                except RecordingError as error:
                    self.skips.note(error)
                    continue
                given.append(node)
                yield cycle
        moves = _moves(given)
        if moves is not None and given[-1] is not self._nodes[-1]:  # the one to bring them lacks
            here, nothing = given[-1], np.zeros((0, 3))
            pose = here.pose if here.moved is None else here.moved
            cycle = Cycle(here.stamp + _AFTER, pose, nothing, moved=moves, session=here.session)
            yield checked(cycle, self._path)

    def _positions(self, node: _Node, rows: list[tuple[Any, ...]]) -> Floats:
        """(N, 3) m; SQLite keeps anything in any column."""
        try:
            return np.array(rows, np.float64).reshape(-1, 3)
        except (TypeError, ValueError) as error:
            raise RecordingError(
                f"{self._path}: node {node.id}: a position is no number ({one_line(error)}); copy "
                "it anew"
            ) from None

    def _chosen(self, points: Floats) -> Floats:
        """With a position, near enough, the strongest ones. In the robot's frame."""
        most = np.inf if self._options.max_depth is None else self._options.max_depth
        with np.errstate(over="ignore", invalid="ignore"):
            distance = np.sqrt((points**2).sum(axis=1))
        near = points[(distance > 0) & (distance <= most)]
        return np.asarray(near[: self._options.max_features])

    def _read_nodes(
        self, database: sqlite3.Connection, optimised: dict[int, Floats]
    ) -> list[_Node]:
        """Of several sessions those in one frame: that of the optimisation, where there is one."""
        rows = self._rows(database)
        together = len({map_id for _, map_id, _, _ in rows}) > 1 and bool(optimised)
        nodes: list[_Node] = []
        last: dict[int, float] = {}
        for id_, map_id, stamp, blob in rows:
            pose = optimised.get(id_) if together else _pose(blob)
            if pose is None:
                continue  # it was not localised
            session = map_id if isinstance(map_id, int) and map_id > 0 and not together else 0
            try:
                rising = float(stamp) > last.get(session, -np.inf)
            except (TypeError, ValueError):
                rising = False
            if not rising:
                self.skips.note(
                    RecordingError(
                        f"{self._path}: node {id_}: its stamp {repr(stamp)[:40]} does not come "
                        f"after {last.get(session)}, that of the node before"
                    )
                )
                continue
            last[session] = float(stamp)
            moved = None if together else optimised.get(id_)
            nodes.append(_Node(id_, session, float(stamp), pose, moved))
        return nodes

    def _rows(self, database: sqlite3.Connection) -> list[tuple[Any, ...]]:
        """Of the nodes, as far as SQLite can read them where that is asked for."""
        rows: list[tuple[Any, ...]] = []
        try:
            rows.extend(database.execute(_NODES))
        except sqlite3.DatabaseError as error:
            if not rows:
                raise
            self.skips.note(
                RecordingError(
                    f"{self._path}: Node: damaged after {len(rows)} nodes ({one_line(error)})"
                )
            )
        return rows

    def _optimised(self, database: sqlite3.Connection) -> dict[int, Floats]:
        columns = {row[1] for row in database.execute("PRAGMA table_info(Admin)")}
        if not {"opt_ids", "opt_poses"} <= columns:
            return {}
        row = database.execute("SELECT opt_ids, opt_poses FROM Admin").fetchone()
        if row is None or not row[0] or not row[1]:
            return {}
        try:
            ids, poses = unpack_matrix(row[0], _INT32), unpack_matrix(row[1], _FLOAT32)
            if len(poses) != 12 * len(ids):
                raise ValueError(f"{len(ids)} ids for {len(poses)} numbers")
        except ValueError as error:
            self.skips.note(
                RecordingError(f"{self._path}: Admin: the optimised poses are damaged ({error})")
            )
            return {}
        found = {}
        for id_, numbers in zip(ids.tolist(), poses.reshape(-1, 12), strict=True):
            pose = _pose(numbers.astype("<f4").tobytes())
            if pose is not None:
                found[int(id_)] = pose
        return found


def _moves(nodes: list[_Node]) -> tuple[Floats, Floats] | None:
    """Stamps and poses of those that the optimisation has moved."""
    moved = [(n.stamp, n.moved) for n in nodes if n.moved is not None]
    if not moved:
        return None
    return np.array([stamp for stamp, _ in moved]), np.array([pose for _, pose in moved])


def unpack_matrix(blob: bytes, kind: int) -> np.ndarray:
    """The numbers of an OpenCV matrix, row by row. Raises ValueError."""
    return unpack_rows(blob, kind).ravel()


def unpack_rows(blob: bytes, kind: int) -> np.ndarray:
    """An OpenCV matrix as RTAB-Map packs it: zlib, then rows, columns and type. Raises ValueError.

    kind: the type that is wanted, `UINT8` or another key of `_TYPES`.
    """
    if len(blob) < 12:
        raise ValueError(f"{len(blob)} bytes")
    rows, columns, found = struct.unpack("<iii", blob[-12:])
    size = rows * columns * _TYPES[kind].itemsize
    if found != kind or min(rows, columns) < 0 or size > _MOST_SMALLER * len(blob):
        raise ValueError(f"{rows} x {columns} of type {found} in {len(blob)} bytes")
    unpacker = zlib.decompressobj()
    try:
        data = unpacker.decompress(blob[:-12], size + 1)
    except zlib.error as error:
        raise ValueError(str(error)) from None
    if len(data) != size:
        raise ValueError(f"{size} bytes are promised, {len(data)} are there")
    return np.frombuffer(data, _TYPES[kind]).reshape(rows, columns)


def _pose(blob: Any) -> Floats | None:
    """(4, 4) of 3 x 4 floats; None where it is no pose: RTAB-Map writes zeros for none."""
    if not isinstance(blob, bytes) or len(blob) != 48:
        return None
    pose = np.eye(4)
    pose[:3] = np.frombuffer(blob, "<f4").reshape(3, 4)
    turn = pose[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        fits = np.abs(turn @ turn.T - np.eye(3)).max() < 1e-3
    return pose if fits and np.isfinite(pose).all() else None


@contextmanager
def _database(path: Path) -> Iterator[sqlite3.Connection]:
    """Read only. Raises RecordingError for whatever SQLite says."""
    try:
        with path.open("rb") as file:
            head = file.read(len(SQLITE))
        if head != SQLITE:
            raise RecordingError(f"{path}: no SQLite database, or an empty file; copy it anew")
        uri = f"{path.resolve().as_uri()}?mode=ro"
        with closing(sqlite3.connect(uri, uri=True)) as database:
            yield database
    except (sqlite3.Error, OSError, OverflowError, UnicodeDecodeError) as error:
        raise RecordingError(
            f"{path}: damaged, cut short, or not of RTAB-Map ({one_line(error)}); copy it anew, or "
            "run rtabmap-recovery on it"
        ) from None


def _check_size(path: Path, skips: Skips) -> None:
    """SQLite itself misses what was cut off only where it looks for it."""
    try:
        lacking = cut_short(path)
    except OSError:
        return  # `_database` tells
    if lacking:
        skips.note(
            RecordingError(
                f"{path}: damaged, cut short: {lacking}; copy it anew, or run rtabmap-recovery "
                "on it"
            )
        )


def _version(path: Path, database: sqlite3.Connection) -> str:
    tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master")}
    if {"meta", "transactions"} <= tables:
        raise RecordingError(f"{path}: a ledger of DAGmap, no recording; `dagmap export` reads it")
    if "Map_Node_Word" in tables:
        raise RecordingError(
            f"{path}: of RTAB-Map before 0.13; open it once with a newer rtabmap-databaseViewer "
            "and save it"
        )
    missing = [name for name in _TABLES if name not in tables]
    if missing:
        raise RecordingError(f"{path}: no table {missing[0]}, so no database of RTAB-Map")
    try:
        require_plain(database, _TABLES)
    except ValueError as error:
        raise RecordingError(
            f"{path}: {one_line(error)}; copy it anew, or have RTAB-Map save it"
        ) from None
    row = database.execute("SELECT version FROM Admin").fetchone()
    return "of unknown version" if row is None else str(row[0])[:20]
