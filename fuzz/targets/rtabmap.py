"""RTAB-Map's databases: rows and blobs of a good one change, or the file's bytes.

An input is statements that are applied to a good database, or, where it begins like one, a file.
"""

from __future__ import annotations

import sqlite3
import struct
import zlib
from collections.abc import Iterable
from contextlib import closing, suppress
from random import Random

import numpy as np

from dagmap.io.sources import Options, rtabmap
from dagmap.model import DagmapError
from grammar import Flip
from targets import Target
from targets._files import workplace

_HOME = workplace()
_FILE = _HOME / "walk.db"
_CHANGES = (
    b"UPDATE Node SET pose = x'%s' WHERE id = 2",
    b"UPDATE Node SET stamp = %s WHERE id = 2",
    b"UPDATE Node SET map_id = %s",
    b"UPDATE Node SET map_id = %s WHERE id = 2",
    b"UPDATE Node SET id = %s WHERE id = 1",
    b"UPDATE Feature SET depth_x = %s",
    b"UPDATE Feature SET depth_z = %s WHERE word_id = 1",
    b"UPDATE Admin SET opt_ids = x'%s'",
    b"UPDATE Admin SET opt_poses = x'%s'",
    b"UPDATE Admin SET version = %s",
    b"DELETE FROM Node",
    b"DELETE FROM Admin",
    b"DELETE FROM Feature WHERE node_id = 2",
    b"DROP TABLE Admin",
    b"DROP TABLE Node",
    b"DROP TABLE Admin; CREATE TABLE Admin (version TEXT)",
    b"CREATE TABLE Map_Node_Word (a)",
    b"CREATE TABLE meta (a); CREATE TABLE transactions (a)",
    b"ALTER TABLE Node RENAME COLUMN pose TO other",
    b"INSERT INTO Node SELECT * FROM Node",
    b"UPDATE Node SET stamp = CAST(x'ff' AS TEXT) WHERE id = 2",
    b"ALTER TABLE Node RENAME TO Other; CREATE VIEW Node AS SELECT * FROM Other",
    b"ALTER TABLE Feature ADD COLUMN more AS (zeroblob(1000000000))",
)
_VALUES = (
    b"NULL",
    b"0",
    b"-1",
    b"1",
    b"2",
    b"1.5",
    b"9e999",
    b"-9e999",
    b"1e300",
    b"'x'",
    b"x'00'",
)
_VALUES += (b"9223372036854775807", b"-9223372036854775808", b"1e9", b"x'ff'", b"'\xff'")


def run(data: bytes) -> bool:
    _FILE.unlink(missing_ok=True)
    _FILE.write_bytes(data if data.startswith(b"SQLite") else _good())
    if not data.startswith(b"SQLite"):
        refused = (sqlite3.Error, sqlite3.Warning, ValueError)  # such statements change nothing
        with closing(sqlite3.connect(_FILE)) as database, suppress(*refused):
            database.executescript(data.decode("utf-8", "replace"))
    try:
        if not rtabmap.matches(_FILE):
            return False
        for keep_going in (True, False):
            options = Options(max_features=5, max_depth=10.0, keep_going=keep_going)
            source = rtabmap.open(_FILE, options)
            cycles = list(source)
            rtabmap.describe(_FILE, options)
    except DagmapError as error:
        assert str(error).startswith(str(_FILE)) and "\n" not in str(error)
        return False
    assert len(cycles) == len(source) > 0
    return True


_KEPT: dict[str, bytes] = {}


def _good() -> bytes:
    """The database that statements change."""
    if "good" not in _KEPT:
        file = _HOME / "good.db"
        with closing(sqlite3.connect(file)) as database, database:
            database.execute("CREATE TABLE Node (id, map_id, weight, stamp, pose)")
            database.execute(
                "CREATE TABLE Feature (node_id, word_id, response, depth_x, depth_y, depth_z)"
            )
            database.execute("CREATE TABLE Admin (version, opt_ids, opt_poses)")
            database.execute(
                "INSERT INTO Admin VALUES ('0.23.0', ?, ?)",
                (matrix(np.arange(1, 3, dtype="<i4"), 4), matrix(np.tile(_place(0.1), 2), 5)),
            )
            for node in (1, 2):
                row = (node, 0, 0, float(node), _place(0.2).tobytes())
                database.execute("INSERT INTO Node VALUES (?, ?, ?, ?, ?)", row)
                for word in range(8):
                    point = (1.0, 0.1 * word, 2.0) if word else (None, None, None)
                    database.execute(
                        "INSERT INTO Feature VALUES (?, ?, ?, ?, ?, ?)", (node, word, 1.0, *point)
                    )
        _KEPT["good"] = file.read_bytes()
    return _KEPT["good"]


def _place(x: float) -> np.ndarray:
    return np.array([1, 0, 0, x, 0, 1, 0, 0, 0, 0, 1, 0], "<f4")


def matrix(values: np.ndarray, kind: int, rows: int = 1, columns: int = -1) -> bytes:
    """As RTAB-Map packs one."""
    columns = values.size if columns < 0 else columns
    return zlib.compress(values.tobytes()) + struct.pack("<iii", rows, columns, kind)


def mutate(data: bytes, rng: Random, flip: Flip) -> bytes:
    """A statement comes, goes, or gets other values; blobs are hexadecimal in them."""
    if data.startswith(b"SQLite"):
        return flip(data)
    lines = data.split(b";\n")
    i = rng.randrange(len(lines))
    line = lines[i]
    if rng.random() < 0.5 and b"x'" in line:
        head, _, rest = line.partition(b"x'")
        blob, _, tail = rest.partition(b"'")
        try:
            plain = bytes.fromhex(blob.decode())
        except ValueError:
            plain = b""
        lines[i] = head + b"x'" + flip(plain).hex().encode() + b"'" + tail
    elif rng.random() < 0.3:
        del lines[i]
    else:
        made = rng.choice(_CHANGES)
        if b"x'%s'" in made:
            blob = rng.choice((matrix(np.arange(1, 3, dtype="<i4"), 4), _place(1.0).tobytes()))
            made %= blob.hex().encode()
        elif b"%s" in made:
            made %= rng.choice(_VALUES)
        lines.insert(i, made)
    return b";\n".join(lines)


def _blobs() -> Iterable[bytes]:
    ids = np.arange(2, dtype="<i4")
    yield from (b"", b"1", _place(1.0).tobytes(), _place(np.nan).tobytes(), bytes(40), bytes(48))
    yield from (matrix(np.arange(3, dtype="<i4"), 4), matrix(_place(0.0), 5))
    yield from (matrix(np.tile(_place(0.0), 2), 5), matrix(np.zeros(24, "<f4"), 5))
    yield from (matrix(ids, 4, 1 << 20, 1 << 10), matrix(ids, 4, 1, 3))
    yield from (b"damaged" + struct.pack("<iii", 1, size, kind) for size, kind in ((2, 4), (24, 5)))


def seeds() -> Iterable[bytes]:
    yield b""
    yield _good()
    yield _good()[:-5000]
    yield b"SQLite"
    for made in _CHANGES:
        if b"x'%s'" in made:
            yield from (made % blob.hex().encode() for blob in _blobs())
        elif b"%s" in made:
            yield from (made % value for value in _VALUES)
        else:
            yield made


TARGET = Target(run, mutate, seeds, {"dagmap.io.sources.rtabmap": ()}, max_len=32_768)
