"""One robot's ledger on disk: the exact bytes of every accepted transaction in one SQLite file.

What `append` has returned for survives a killed process and a power cut (WAL, synchronous=FULL).
A store belongs to one fleet and one author and is open in one process at a time: two agents that
sign from one ledger would fork its author's chain.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ..model import AuthorId, StoreError, TransactionId
from .closing import Closing

FORMAT = 1
_BATCH = 256  # rows read at once, so that a long ledger never lies in memory twice
_META = "CREATE TABLE meta (key TEXT PRIMARY KEY, value BLOB NOT NULL) WITHOUT ROWID"
_TRANSACTIONS = """CREATE TABLE transactions (
    position INTEGER PRIMARY KEY, id BLOB NOT NULL UNIQUE, data BLOB NOT NULL)"""
_INSERT = "INSERT OR IGNORE INTO transactions (id, data) VALUES (?, ?)"
_SELECT = "SELECT position, id, data FROM transactions WHERE position > ? ORDER BY position LIMIT ?"
_COUNT = "SELECT count(*) FROM transactions NOT INDEXED"  # an index may be damaged on its own
_BUSY = 1.0  # s to wait for another process that is just closing the file
_AFRESH = (
    "give the robot a new data folder (in a closed fleet enroll it anew): it starts as a new one. "
    "A backup helps only where it holds all that the robot has ever sent: from an older one it "
    "would sign its numbers twice"
)
_REMEDIES = {  # by what SQLite says; its error codes are not in Python 3.10
    "malformed": f"the file is damaged; {_AFRESH}",
    "not a database": "this is no ledger; check the path, or move the file away",
    "is full": "the disk is full; free some space, nothing stored so far is lost",
    "readonly": "the file or its folder is read-only; make both writable",
    "unable to open": "the folder must exist and the file must be readable and writable",
    "is locked": "another process has this ledger open; stop it, or name another file",
    "disk I/O error": "the disk refused (full, over quota, or failing); what was stored is kept",
}


class Store(Closing):
    """An append-only list of (id, data), in order of insertion. Use it from one thread at a time.

    Every method raises StoreError that names the file, what went wrong and what helps.
    """

    def __init__(self, path: Path, database: sqlite3.Connection) -> None:
        """Use `Store.open`."""
        self.path = path
        self.fleet_id = b""
        self.author: AuthorId | None = None
        self.name = b""  # 16 random bytes that tell it from any other; made with its author
        self._database: sqlite3.Connection | None = database

    @classmethod
    def open(
        cls, path: Path | str, fleet_id: bytes | None = None, author: AuthorId | None = None
    ) -> Store:
        """Open a ledger. With a fleet id, a file that does not exist becomes a new one.

        fleet_id, author: what the file must belong to; None: whatever it belongs to. A ledger that
            was made without an author becomes that of the first who opens it.
        """
        path = Path(path)
        if fleet_id is None and not os.path.isfile(path):
            raise StoreError(f"{path}: no ledger is here; check the path")
        # Asked beforehand: of a read-only file SQLite in WAL mode says no more than "I/O error".
        effective = os.access in os.supports_effective_ids
        if os.path.isfile(path) and not os.access(path, os.R_OK | os.W_OK, effective_ids=effective):
            raise StoreError(f"{path}: cannot be opened: {_REMEDIES['readonly']}")
        with _explained(path, "cannot be opened"):
            # The runtime may open in one thread and append in another; never in two at once.
            database = sqlite3.connect(
                path, timeout=_BUSY, isolation_level=None, check_same_thread=False
            )
        store = cls(path, database)
        try:
            store._begin_use(fleet_id, author)
        except BaseException:
            store.close()
            raise
        return store

    def append(self, id_: TransactionId, data: bytes) -> None:
        """Store one transaction; once this returns, it is safe. Repeating one is harmless."""
        self.append_many([(id_, data)])

    def append_many(self, transactions: Iterable[tuple[TransactionId, bytes]]) -> None:
        """Store several (id, data) at the cost of one: all of them, or on an error none."""
        rows = list(transactions)
        for id_, data in rows:
            if _id_of(data) != id_:
                raise StoreError(
                    f"{self.path}: {id_.hex()} is not the BLAKE2b-256 of its {len(data)} bytes; "
                    "store the id and data of one Accepted event"
                )
        with self._transaction("cannot be written") as database:
            database.executemany(_INSERT, rows)

    def __iter__(self) -> Iterator[bytes]:
        """The data of all transactions in order of insertion, each checked against its id."""
        position = -1
        while True:
            with _explained(self.path, f"cannot be read after entry {position}"):
                rows = self._in_use.execute(_SELECT, (position, _BATCH)).fetchall()
            if not rows:
                return
            for position, id_, data in rows:
                if not isinstance(data, bytes) or _id_of(data) != id_:
                    raise StoreError(
                        f"{self.path}: entry {position} does not match its id; "
                        f"the file is damaged; {_AFRESH}"
                    )
                yield data

    def ids(self) -> list[TransactionId]:
        """The ids of all transactions in order of insertion."""
        with _explained(self.path, "cannot be read"):
            rows = self._in_use.execute("SELECT id FROM transactions ORDER BY position").fetchall()
        return [id_ for (id_,) in rows]

    def __len__(self) -> int:
        with _explained(self.path, "cannot be read"):
            return int(self._in_use.execute(_COUNT).fetchone()[0])

    def __bool__(self) -> bool:
        """An empty store is a store all the same."""
        return True

    def close(self) -> None:
        """Fold the write-ahead log into the file and let go of it. Closing twice is harmless."""
        if self._database is not None:
            database, self._database = self._database, None
            with _explained(self.path, "cannot be closed"):
                database.close()

    @property
    def _in_use(self) -> sqlite3.Connection:
        if self._database is None:
            raise StoreError(f"{self.path}: this store is closed; open it again")
        return self._database

    @contextmanager
    def _transaction(self, trouble: str) -> Iterator[sqlite3.Connection]:
        """All or nothing, also on Ctrl-C. The commit returns when the bytes are on the disk."""
        database = self._in_use
        with _explained(self.path, trouble):
            database.execute("BEGIN IMMEDIATE")
            try:
                yield database
                database.execute("COMMIT")
            except BaseException:
                if database.in_transaction:  # some errors have rolled back already
                    database.execute("ROLLBACK")
                raise

    def _begin_use(self, fleet_id: bytes | None, author: AuthorId | None) -> None:
        database = self._in_use
        with _explained(self.path, "cannot be opened"):
            database.execute("PRAGMA locking_mode = EXCLUSIVE")  # until it is closed
            database.execute("PRAGMA journal_mode = WAL")
            database.execute("PRAGMA synchronous = FULL")
            check = str(database.execute("PRAGMA quick_check(1)").fetchone()[0])
        if check != "ok":
            detail = " ".join(check.split())
            raise StoreError(f"{self.path}: the file is damaged ({detail}); {_AFRESH}")
        with self._transaction("cannot be opened for writing"):
            made = {sql for (sql,) in database.execute("SELECT sql FROM sqlite_master")}
            if not made and fleet_id is not None:
                self._create(database, fleet_id)
                made = {_META, _TRANSACTIONS}
            if _META not in made:
                raise StoreError(
                    f"{self.path}: a database, but no DAGmap ledger; name another file"
                )
            self._claim(database, fleet_id, author)
            if _TRANSACTIONS not in made:
                raise StoreError(f"{self.path}: the file is damaged (no table); {_AFRESH}")

    def _create(self, database: sqlite3.Connection, fleet_id: bytes) -> None:
        database.execute(_META)
        database.execute(_TRANSACTIONS)
        meta = [("format", str(FORMAT).encode()), ("fleet", fleet_id)]
        database.executemany("INSERT INTO meta VALUES (?, ?)", meta)

    def _claim(
        self, database: sqlite3.Connection, fleet_id: bytes | None, author: AuthorId | None
    ) -> None:
        """Check whose ledger this is; one without an author becomes the given author's."""
        meta: dict[str, bytes] = dict(database.execute("SELECT key, CAST(value AS BLOB) FROM meta"))
        version = meta.get("format", b"").decode("ascii", "replace")
        if version != str(FORMAT):
            raise StoreError(
                f"{self.path}: written in format {version or 'unknown'}, this version of DAGmap "
                f"reads format {FORMAT}; open it with the version that wrote it"
            )
        if "fleet" not in meta:
            raise StoreError(f"{self.path}: the file is damaged (no fleet); {_AFRESH}")
        self.fleet_id, self.author = meta["fleet"], meta.get("author")
        self.name = meta.get("name", b"")
        if fleet_id is not None and self.fleet_id != fleet_id:
            raise StoreError(
                f"{self.path}: the ledger of fleet {self.fleet_id.hex()}, but this robot is in "
                f"fleet {fleet_id.hex()}; correct `fleet` in the configuration or name another file"
            )
        if author is None:
            return
        if self.author is None:
            self.author, self.name = author, secrets.token_bytes(16)
            row = [("author", author), ("name", self.name)]
            database.executemany("INSERT INTO meta VALUES (?, ?)", row)
        elif self.author != author:
            raise StoreError(
                f"{self.path}: the ledger of robot {self.author.hex()}, but this robot is "
                f"{author.hex()}; give every robot a file of its own"
            )


def _id_of(data: bytes) -> TransactionId:
    return hashlib.blake2b(data, digest_size=32).digest()


@contextmanager
def _explained(path: Path, trouble: str) -> Iterator[None]:
    """Turn what SQLite raises into StoreError with the file, the trouble and the remedy."""
    try:
        yield
    except (sqlite3.Error, UnicodeDecodeError, MemoryError) as error:  # a damaged file asks for any
        text = " ".join(str(error).split()) if isinstance(error, sqlite3.Error) else "malformed"
        remedy = next((words for part, words in _REMEDIES.items() if part in text), text)
        raise StoreError(f"{path}: {trouble}: {remedy} ({text})") from error
