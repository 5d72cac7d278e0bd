"""RTAB-Map databases, laid out as its published schemas have it (0.16 to 0.23)."""

from __future__ import annotations

import sqlite3
import struct
import zlib
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from bags import pose_at
from dagmap.io.sources import Options, open_source
from dagmap.io.sources.rtabmap import unpack_matrix
from dagmap.model import RecordingError
from test_replay import dagmap

# The columns that matter and some that do not, in the order of the schema.
NODE = "id INTEGER NOT NULL, map_id INTEGER NOT NULL, weight INTEGER, stamp FLOAT, pose BLOB"
FEATURE = (
    "node_id INTEGER NOT NULL, word_id INTEGER NOT NULL, pos_x FLOAT NOT NULL, "
    "pos_y FLOAT NOT NULL, size INTEGER NOT NULL, dir FLOAT NOT NULL, response FLOAT NOT NULL, "
    "octave INTEGER NOT NULL, depth_x FLOAT, depth_y FLOAT, depth_z FLOAT"
)
ADMIN = "version TEXT, preview_image BLOB, opt_ids BLOB, opt_poses BLOB"
STAMPS = [1.0, 2.0, 3.0]


def blob(pose: np.ndarray) -> bytes:
    return pose[:3].astype("<f4").tobytes()


def packed(values: np.ndarray) -> bytes:
    """As `compressData` does it: one row."""
    kind = 4 if values.dtype == np.int32 else 5
    return zlib.compress(values.tobytes()) + struct.pack("<iii", 1, values.size, kind)


def drifted(stamp: float) -> np.ndarray:
    """What the odometry says; the optimisation gives `pose_at`."""
    pose = pose_at(stamp)
    pose[1, 3] += 0.1 * stamp
    return pose


def features(node: int) -> np.ndarray:
    return np.random.default_rng(node).uniform(1, 3, (20, 3)).astype(np.float32)


def write(
    path: Path,
    optimised: tuple[bytes | None, bytes | None] | None = None,
    maps: tuple[int, ...] = (0, 0, 0),
    stamps: list[float] | None = None,
) -> Path:
    ids = np.arange(1, 4, dtype=np.int32)
    if optimised is None:
        poses = np.concatenate([pose_at(stamp)[:3].ravel() for stamp in STAMPS])
        optimised = packed(ids), packed(poses.astype("<f4"))
    with closing(sqlite3.connect(path)) as db, db:
        for name, columns in (("Node", NODE), ("Feature", FEATURE), ("Admin", ADMIN)):
            db.execute(f"CREATE TABLE {name} ({columns})")
        db.execute("INSERT INTO Admin VALUES ('0.23.0', NULL, ?, ?)", optimised)
        for id_, map_id, stamp in zip(ids.tolist(), maps, stamps or STAMPS, strict=True):
            row = (id_, map_id, 0, stamp, blob(drifted(stamp)))
            db.execute("INSERT INTO Node VALUES (?, ?, ?, ?, ?)", row)
            for word, point in enumerate(features(id_).tolist()):
                row = (id_, word, 1.0, 1.0, 3, 0.0, 100.0 - word, 0, *point)
                db.execute(f"INSERT INTO Feature VALUES ({','.join('?' * 11)})", row)
            nothing = (id_, 99, 1.0, 1.0, 3, 0.0, 999.0, 0, None, None, None)
            db.execute(f"INSERT INTO Feature VALUES ({','.join('?' * 11)})", nothing)
    return path


def test_nodes_come_as_odometry_saw_them_and_are_moved_at_the_end(tmp_path: Path) -> None:
    source = open_source(write(tmp_path / "walk.db"))
    found = list(source)
    assert (source.name, len(source), len(found)) == ("walk", 3, 3)
    for i, cycle in enumerate(found):
        assert np.allclose(cycle.points, features(i + 1))
        pose = pose_at if i == 2 else drifted
        assert np.allclose(cycle.pose, pose(cycle.stamp), atol=1e-6)
    assert found[0].moved is found[1].moved is None
    stamps, poses = found[2].moved
    assert stamps.tolist() == STAMPS[:2]
    assert np.allclose(poses, [pose_at(stamp) for stamp in STAMPS[:2]], atol=1e-6)
    few = list(open_source(tmp_path / "walk.db", Options(max_features=5)))
    assert np.allclose(few[0].points, features(1)[:5])  # the strongest


def test_without_optimisation_and_with_several_sessions(tmp_path: Path) -> None:
    plain = list(open_source(write(tmp_path / "plain.db", (None, None), maps=(0, 1, 1))))
    assert [cycle.session for cycle in plain] == [0, 1, 1]
    assert all(cycle.moved is None for cycle in plain)
    both = list(open_source(write(tmp_path / "both.db", maps=(0, 1, 1))))
    assert [cycle.session for cycle in both] == [0, 0, 0]  # one frame: the optimisation's
    for cycle in both:
        assert np.allclose(cycle.pose, pose_at(cycle.stamp), atol=1e-6)


@pytest.mark.parametrize(("bad", "stamps", "moved"), [(2, [1, 3], [1]), (3, [1, 2, 2.001], [1, 2])])
def test_a_node_that_is_left_out_is_not_moved(
    tmp_path: Path, bad: int, stamps: list[float], moved: list[float]
) -> None:
    """The others are, even where the last one is to be left out, which brings the moves."""
    path = write(tmp_path / "walk.db")
    with closing(sqlite3.connect(path)) as db, db:
        db.execute("UPDATE Feature SET depth_x = 1e9 WHERE node_id = ? AND word_id = 0", (bad,))
    found = list(open_source(path, Options(keep_going=True)))
    assert [cycle.stamp for cycle in found] == pytest.approx(stamps)
    assert [cycle.moved for cycle in found[:-1]] == [None] * (len(found) - 1)
    assert found[-1].moved is not None
    there, poses = found[-1].moved
    assert there.tolist() == moved
    assert np.allclose(poses, [pose_at(stamp) for stamp in moved], atol=1e-6)
    with pytest.raises(RecordingError, match="--keep-going leaves it out"):
        list(open_source(path))


def test_a_database_becomes_a_map(tmp_path: Path) -> None:
    path = write(tmp_path / "walk.db")
    run = dagmap("inspect", path)
    assert "RTAB-Map 0.23.0 database" in run.stdout
    assert "3 cycles" in run.stdout
    run = dagmap("replay", path, "--out", tmp_path / "out", "--json")
    assert run.returncode == 0, run.stderr


BAD = packed(np.arange(1, 4, dtype=np.int32))


@pytest.mark.parametrize(
    ("ids", "poses", "said"),
    [
        (BAD, b"short", "5 bytes"),
        (BAD, zlib.compress(b"x") + struct.pack("<iii", 1 << 20, 1 << 10, 5), "1048576 x 1024"),
        (BAD, zlib.compress(b"x") + struct.pack("<iii", 1, 36, 5), "144 bytes are promised, 1 are"),
        (BAD, b"not zlib" + struct.pack("<iii", 1, 36, 5), "incorrect header"),
        (BAD, BAD, "1 x 3 of type 4"),
        (BAD, packed(np.zeros(7, "<f4")), "3 ids for 7 numbers"),
    ],
)
def test_damaged_optimised_poses(tmp_path: Path, ids: bytes, poses: bytes, said: str) -> None:
    path = write(tmp_path / "walk.db", (ids, poses))
    with pytest.raises(RecordingError, match=f"optimised poses are damaged .*{said}.*--keep-going"):
        open_source(path)
    found = list(open_source(path, Options(keep_going=True)))
    assert len(found) == 3
    assert found[2].moved is None


def test_stamps_that_do_not_rise(tmp_path: Path) -> None:
    path = write(tmp_path / "walk.db", stamps=[1.0, 3.0, 2.0])
    with pytest.raises(RecordingError, match="node 3: its stamp 2.0 does not come after"):
        open_source(path)
    assert len(open_source(path, Options(keep_going=True))) == 2


def test_what_is_no_database_is_named(tmp_path: Path) -> None:
    path = tmp_path / "walk.db"
    path.write_bytes(b"")
    with pytest.raises(RecordingError, match="walk.db: no SQLite database, or an empty file"):
        open_source(path)
    write(tmp_path / "whole.db")
    whole = (tmp_path / "whole.db").read_bytes()
    for part in (0.1, 0.5, 0.9):
        path.write_bytes(whole[: int(len(whole) * part)])
        with pytest.raises(RecordingError, match="walk.db: damaged, cut short"):
            list(open_source(path))
    for table, said in (
        ("other", "no table Node, so no database of RTAB-Map"),
        ("Map_Node_Word", "before 0.13"),
    ):
        path.unlink()
        with closing(sqlite3.connect(path)) as db, db:
            db.execute(f"CREATE TABLE {table} (x)")
        with pytest.raises(RecordingError, match=said):
            open_source(path)
    path.unlink()
    with closing(sqlite3.connect(path)) as db, db:
        db.execute("CREATE TABLE meta (x)")
        db.execute("CREATE TABLE transactions (x)")
    with pytest.raises(RecordingError, match="a ledger of DAGmap"):
        open_source(path)


def test_damaged_databases_never_crash(tmp_path: Path) -> None:
    write(tmp_path / "whole.db")
    rng, path = np.random.default_rng(1), tmp_path / "walk.db"
    whole = np.frombuffer((tmp_path / "whole.db").read_bytes(), np.uint8)
    for _ in range(150):
        damaged = whole.copy()
        damaged[rng.integers(0, len(whole), 20)] = rng.integers(0, 256, 20)
        path.write_bytes(damaged.tobytes())
        for keep_going in (False, True):
            try:
                list(open_source(path, Options(keep_going=keep_going)))
            except RecordingError as error:
                assert str(path) in str(error)


def test_a_matrix_that_is_whole() -> None:
    values = np.arange(6, dtype=np.int32)
    assert unpack_matrix(packed(values), 4).tolist() == values.tolist()
