from __future__ import annotations

import hashlib
import os
import signal
import sqlite3
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dagmap.io.store import Store
from dagmap.model import StoreError

FLEET, OTHER_FLEET = b"fleet--1", b"fleet--2"
AUTHOR, OTHER_AUTHOR = b"author-1", b"author-2"


def entry(number: int, size: int = 200) -> tuple[bytes, bytes]:
    data = number.to_bytes(8, "little") * (size // 8)
    return hashlib.blake2b(data, digest_size=32).digest(), data


@contextmanager
def unprivileged() -> Iterator[None]:
    """File permissions do not bind root, so root becomes nobody for a moment."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A folder that everybody may reach, which pytest's own is not."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o777)
        yield Path(name)
        Path(name).chmod(0o700)


def test_entries_come_back_in_order_of_insertion_across_openings(tmp_path: Path) -> None:
    entries = [entry(n) for n in (5, 3, 9, 1)]
    with Store.open(tmp_path / "a.db", FLEET, AUTHOR) as store:
        store.append(*entries[0])
        store.append_many(entries[1:3])
    with Store.open(tmp_path / "a.db", FLEET, AUTHOR) as store:
        assert list(store) == [data for _, data in entries[:3]]
        store.append(*entries[3])
        assert list(store) == [data for _, data in entries]
        assert len(store) == 4
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.db"]


def test_more_entries_than_one_batch_and_appending_while_reading(tmp_path: Path) -> None:
    entries = [entry(n, 16) for n in range(1000)]
    with Store.open(tmp_path / "a.db", FLEET) as store:
        store.append_many(entries)
        seen = []
        for number, data in enumerate(store):
            seen.append(data)
            if number == 10:
                store.append(*entry(5000))
        assert seen == [data for _, data in [*entries, entry(5000)]]


def test_an_empty_store_is_true_and_empty(tmp_path: Path) -> None:
    with Store.open(tmp_path / "a.db", FLEET) as store:
        assert store
        assert len(store) == 0
        assert list(store) == []


def test_repeating_an_entry_changes_nothing(tmp_path: Path) -> None:
    with Store.open(tmp_path / "a.db", FLEET) as store:
        store.append(*entry(1))
        store.append_many([entry(2), entry(1), entry(2)])
        assert list(store) == [entry(1)[1], entry(2)[1]]


def test_an_id_of_other_data_is_refused_and_nothing_of_the_batch_stored(tmp_path: Path) -> None:
    with (
        Store.open(tmp_path / "a.db", FLEET) as store,
        pytest.raises(StoreError, match="is not the BLAKE2b-256 of its 200 bytes"),
    ):
        store.append_many([entry(1), (entry(2)[0], entry(3)[1])])
    with Store.open(tmp_path / "a.db", FLEET) as store:
        assert len(store) == 0


def test_a_store_may_change_threads(tmp_path: Path) -> None:
    with Store.open(tmp_path / "a.db", FLEET) as store:
        thread = threading.Thread(target=store.append, args=entry(1))
        thread.start()
        thread.join()
        assert len(store) == 1


def test_a_store_of_another_fleet_is_refused(tmp_path: Path) -> None:
    Store.open(tmp_path / "a.db", FLEET, AUTHOR).close()
    with pytest.raises(StoreError, match=f"a.db: the ledger of fleet {FLEET.hex()}"):
        Store.open(tmp_path / "a.db", OTHER_FLEET, AUTHOR)


def test_a_store_of_another_author_is_refused(tmp_path: Path) -> None:
    Store.open(tmp_path / "a.db", FLEET, AUTHOR).close()
    with pytest.raises(StoreError, match=f"a.db: the ledger of robot {AUTHOR.hex()}"):
        Store.open(tmp_path / "a.db", FLEET, OTHER_AUTHOR)


def test_a_store_without_an_author_becomes_that_of_the_first(tmp_path: Path) -> None:
    Store.open(tmp_path / "a.db", FLEET).close()
    Store.open(tmp_path / "a.db", FLEET, AUTHOR).close()
    with Store.open(tmp_path / "a.db") as store:
        assert (store.fleet_id, store.author) == (FLEET, AUTHOR)
    with pytest.raises(StoreError, match="the ledger of robot"):
        Store.open(tmp_path / "a.db", FLEET, OTHER_AUTHOR)


def test_reading_does_not_make_a_file(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="no ledger is here; check the path"):
        Store.open(tmp_path / "a.db")
    assert list(tmp_path.iterdir()) == []


def test_another_format_is_refused(tmp_path: Path) -> None:
    Store.open(tmp_path / "a.db", FLEET).close()
    with sqlite3.connect(tmp_path / "a.db") as database:
        database.execute("UPDATE meta SET value = '77' WHERE key = 'format'")
    database.close()
    with pytest.raises(StoreError, match="written in format 77"):
        Store.open(tmp_path / "a.db", FLEET)


def test_a_foreign_database_is_refused_and_left_alone(tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "a.db") as database:
        database.execute("CREATE TABLE wheels (size REAL)")
    database.close()
    with pytest.raises(StoreError, match="no DAGmap ledger"):
        Store.open(tmp_path / "a.db", FLEET)
    with sqlite3.connect(tmp_path / "a.db") as database:
        assert database.execute("SELECT name FROM sqlite_master").fetchall() == [("wheels",)]
    database.close()


def test_a_file_that_is_no_database_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "a.db").write_text("a shopping list\n" * 100)
    with pytest.raises(StoreError, match="this is no ledger"):
        Store.open(tmp_path / "a.db", FLEET)
    assert (tmp_path / "a.db").read_text() == "a shopping list\n" * 100


@pytest.mark.parametrize("place", ["missing/a.db", "file/a.db", "."])
def test_a_place_that_cannot_hold_a_file_is_named(tmp_path: Path, place: str) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="the folder must exist"):
        Store.open(tmp_path / place, FLEET)


def test_a_read_only_file_is_refused(open_folder: Path) -> None:
    path = open_folder / "a.db"
    Store.open(path, FLEET).close()
    path.chmod(0o444)
    with unprivileged(), pytest.raises(StoreError, match=r"a\.db: .*read-only"):
        Store.open(path, FLEET)


def test_a_read_only_folder_is_refused(open_folder: Path) -> None:
    Store.open(open_folder / "old.db", FLEET).close()
    (open_folder / "old.db").chmod(0o666)
    open_folder.chmod(0o555)
    for name in ("old.db", "new.db"):
        with unprivileged(), pytest.raises(StoreError, match=f"{name}: .*folder"):
            Store.open(open_folder / name, FLEET)


def test_one_process_at_a_time(tmp_path: Path) -> None:
    with Store.open(tmp_path / "a.db", FLEET) as store:
        with pytest.raises(StoreError, match="another process has this ledger open"):
            Store.open(tmp_path / "a.db", FLEET)
        store.append(*entry(1))
    Store.open(tmp_path / "a.db", FLEET).close()


def test_a_closed_store_says_so(tmp_path: Path) -> None:
    store = Store.open(tmp_path / "a.db", FLEET)
    store.close()
    store.close()
    for use in (lambda: store.append(*entry(1)), lambda: list(store), lambda: len(store)):
        with pytest.raises(StoreError, match="this store is closed"):
            use()


def test_a_changed_byte_of_data_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "a.db"
    with Store.open(path, FLEET) as store:
        store.append_many([entry(n) for n in range(1, 4)])
    raw = bytearray(path.read_bytes())
    at = raw.index(entry(2)[1]) + 50
    raw[at] ^= 1
    path.write_bytes(raw)
    with Store.open(path, FLEET) as store:
        reader = iter(store)
        assert next(reader) == entry(1)[1]
        with pytest.raises(StoreError, match=r"a\.db: entry 2 does not match its id.*data folder"):
            next(reader)


def test_a_corrupt_page_is_noticed_before_anything_is_appended(tmp_path: Path) -> None:
    path = tmp_path / "a.db"
    with Store.open(path, FLEET) as store:
        store.append_many([entry(n, 3000) for n in range(1, 100)])
    raw = bytearray(path.read_bytes())
    pages = len(raw) // 4096
    raw[4096 * (pages // 2) : 4096 * (pages // 2) + 200] = bytes(range(200))
    path.write_bytes(raw)
    with (
        pytest.raises(StoreError, match=r"a\.db: .*damaged.*data folder"),
        Store.open(path, FLEET),
    ):
        pass


def test_a_file_that_was_cut_short_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "a.db"
    with Store.open(path, FLEET) as store:
        store.append_many([entry(n, 3000) for n in range(1, 100)])
    path.write_bytes(path.read_bytes()[: 4096 * 20])
    with pytest.raises(StoreError, match=r"a\.db: .*damaged"):
        Store.open(path, FLEET)


APPEND_FOREVER = """
import hashlib, sys
from dagmap.io.store import Store
with Store.open(sys.argv[1], b"fleet--1", b"author-1") as store:
    number = 0
    while True:
        number += 1
        data = number.to_bytes(8, "little") * 500
        store.append(hashlib.blake2b(data, digest_size=32).digest(), data)
        sys.stdout.write(f"{number}\\n")
        sys.stdout.flush()
"""


def child(script: str, *arguments: str) -> subprocess.Popen[str]:
    source = str(Path(__file__).parents[1] / "src")
    return subprocess.Popen(
        [sys.executable, "-c", script, *arguments],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": source},
    )


@pytest.mark.parametrize("after", [1, 7, 150])
def test_a_killed_process_loses_nothing_that_append_returned_for(
    tmp_path: Path, after: int
) -> None:
    path = tmp_path / "a.db"
    with child(APPEND_FOREVER, str(path)) as process:
        assert process.stdout is not None
        said = [int(process.stdout.readline()) for _ in range(after)]
        os.kill(process.pid, signal.SIGKILL)
        said += [int(line) for line in process.stdout.read().splitlines()]
    assert process.returncode == -signal.SIGKILL
    with Store.open(path, FLEET, AUTHOR) as store:
        stored = [int.from_bytes(data[:8], "little") for data in store]
    assert stored[: len(said)] == said
    assert len(stored) - len(said) in (0, 1)  # the last may have been stored but not yet said


APPEND_UNTIL_FULL = """
import hashlib, resource, sys
from dagmap.io.store import Store
from dagmap.model import StoreError
store = Store.open(sys.argv[1], b"fleet--1", b"author-1")
resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))
number = 0
try:
    while number < 1000:
        data = (number + 1).to_bytes(8, "little") * 500
        store.append(hashlib.blake2b(data, digest_size=32).digest(), data)
        number += 1
except StoreError as error:
    print(number, error, sep="\\n", flush=True)
"""


def test_where_the_disk_is_full_append_says_so_and_keeps_the_rest(tmp_path: Path) -> None:
    path = tmp_path / "a.db"
    with child(APPEND_UNTIL_FULL, str(path)) as process:
        assert process.stdout is not None
        number, message = process.stdout.read().splitlines()
    assert 10 < int(number) < 1000
    assert message.startswith(f"{path}: cannot be written: the disk")
    with Store.open(path, FLEET, AUTHOR) as store:
        assert [int.from_bytes(d[:8], "little") for d in store] == [*range(1, int(number) + 1)]
        store.append(*entry(7777))
        assert len(store) == int(number) + 1


def test_after_a_failed_append_the_store_goes_on(tmp_path: Path) -> None:
    with Store.open(tmp_path / "a.db", FLEET) as store:
        database = store._database
        assert database is not None
        pages = database.execute("PRAGMA page_count").fetchone()[0]
        database.execute(f"PRAGMA max_page_count = {pages + 2}")
        with pytest.raises(StoreError, match="the disk is full"):
            store.append_many([entry(n, 4000) for n in range(10)])
        assert len(store) == 0
        database.execute("PRAGMA max_page_count = 100000")
        store.append(*entry(1))
        assert list(store) == [entry(1)[1]]
