"""`Store.open` and reading: a ledger on disk, damaged as a file or wrong as a database."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable
from contextlib import closing
from random import Random

from dagmap.io.store import Store
from dagmap.model import DagmapError
from dagmap.transaction import id_of
from grammar import Flip
from targets import Target
from targets._files import workplace, write
from targets._wire import CONFIG, ROBOTS

_FILE = workplace() / "robot.db"
_VALUES = ("NULL", "1", "''", "x''", "x'00ff'", "'fleet'", "x'31'", "1.5", "x'32'")
_ANEW = "DROP TABLE transactions; CREATE TABLE transactions (position, id, data);"
_CHANGES = (
    "UPDATE meta SET value = {0} WHERE key = 'format'",
    "UPDATE meta SET value = {0}",
    "UPDATE meta SET key = {0} WHERE key = 'fleet'",
    "DELETE FROM meta WHERE key = 'fleet'",
    "DELETE FROM meta",
    "UPDATE transactions SET data = {0} WHERE position = 1",
    "UPDATE transactions SET id = {0} WHERE position = 1",
    "INSERT INTO transactions (id, data) VALUES ({0}, {1})",
    "DROP TABLE transactions",
    "DROP TABLE meta",
    "ALTER TABLE transactions RENAME COLUMN data TO other",
    "ALTER TABLE meta RENAME COLUMN value TO other",
    "DROP TABLE meta; CREATE TABLE meta (key, value); INSERT INTO meta VALUES ({0}, {1})",
    _ANEW + "INSERT INTO transactions VALUES ({0}, {1}, {0})",
    "CREATE TABLE other (a)",
)  # fmt: skip


def run(data: bytes) -> bool:
    for name in (_FILE, _FILE.with_name("robot.db-wal"), _FILE.with_name("robot.db-shm")):
        name.unlink(missing_ok=True)
    write(_FILE, data)
    try:
        if not data:
            Store.open(_FILE)  # what is not there is not made without a fleet
        with Store.open(_FILE, CONFIG.fleet_id, ROBOTS[0].author) as store:
            kept = list(store)
            assert len(store) == len(kept) == len(store.ids()) and all(
                isinstance(item, bytes) for item in kept
            )
            store.append(id_of(b"next"), b"next")
        Store.open(_FILE).close()
    except DagmapError as error:
        assert str(error).startswith(str(_FILE)) and "\n" not in str(error)
        return False
    return True


def mutate(data: bytes, rng: Random, flip: Flip) -> bytes:
    """What SQL can spoil, or bytes of the file."""
    if rng.random() < 0.5:
        return flip(data)
    _FILE.write_bytes(data)
    statement = rng.choice(_CHANGES).format(rng.choice(_VALUES), rng.choice(_VALUES))
    try:
        with closing(sqlite3.connect(_FILE)) as database:
            database.executescript(statement)
    except (sqlite3.Error, UnicodeDecodeError, MemoryError):
        return flip(data)
    return _FILE.read_bytes()


def seeds() -> Iterable[bytes]:
    for author, count in ((None, 0), (ROBOTS[1].author, 1), (ROBOTS[0].author, 3)):
        _FILE.unlink(missing_ok=True)
        with closing(sqlite3.connect(_FILE)) as database:
            database.execute("PRAGMA page_size = 512")
            database.execute("CREATE TABLE a (a)")
            database.execute("DROP TABLE a")
        with Store.open(_FILE, CONFIG.fleet_id, author) as store:
            store.append_many(
                (id_of(data), data) for data in (bytes([i]) * 9 for i in range(count))
            )
        yield _FILE.read_bytes()
    whole = _FILE.read_bytes()
    for table in ("meta", "transactions"):
        _FILE.write_bytes(whole)
        with closing(sqlite3.connect(_FILE)) as database:
            database.execute(f"DROP TABLE {table}")
        yield _FILE.read_bytes()


ENCODERS = ("Store.append*", "Store.__bool__", "Store._create", "Store.close", "Store._in_use")
TARGET = Target(run, mutate, seeds, {"dagmap.io.store": ENCODERS}, max_len=16_384, generated=(b"",))
