"""Whatever comes in is read or refused with a typed error, within bounds: the fuzzing's corpus,
what it has found, and a seeded slice of its mutations. The long runs are `make fuzz`.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import resource
import signal
import sqlite3
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from random import Random
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pytest

import targets
from dagmap.config import Config, FoldConfig
from dagmap.io.settings import load_settings
from dagmap.messages import parse
from dagmap.model import ConfigError
from dagmap.payload import Kind, encode_payload
from dagmap.wire import Reader, Refusal
from grammar import flipper, rest, tree
from targets import _wire, tum
from targets._folders import files_of, pack

ROOT = Path(__file__).parents[1]
NAMES = targets.names()
MUTATIONS = {
    "agent": 150,
    "closed": 1000,
    "closed_agent": 150,
    "columns": 1500,
    "envelope": 1000,
    "colmap": 1500,
    "euroc": 300,
    "npz": 1500,
    "orbslam": 1500,
    "rtabmap": 400,
    "scans": 800,
    "store": 300,
    "tum": 200,
}  # of slow targets
SECONDS, KILOBYTES = 30, 1 << 20  # for one input and for all of a test, far more than any needs


@contextmanager
def bounded() -> Iterator[None]:
    """TimeoutError or AssertionError where inputs take what they may not."""

    def stop(*_: object) -> None:
        raise TimeoutError("an input that takes too long")

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    handler = signal.signal(signal.SIGALRM, stop)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, handler)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < KILOBYTES


def run(target: targets.Target, data: bytes) -> bool:
    """The target, within `bounded`: its handler takes the alarm that is set here."""
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    return target.run(data)


@pytest.mark.parametrize("name", NAMES)
def test_the_corpus_is_read_or_refused(name: str) -> None:
    target = targets.load(name)
    with bounded():
        taken = [run(target, data) for data in targets.corpus(name)]
    assert any(taken) and not all(taken), "a corpus holds what is taken and what is refused"


@pytest.mark.parametrize("name", NAMES)
def test_mutations_are_read_or_refused(name: str) -> None:
    """Structure-aware mutations of the corpus, as the fuzzer makes them, always the same ones."""
    target, rng = targets.load(name), Random(name)
    pool, flip, taken = targets.corpus(name), flipper(rng), 0
    count = MUTATIONS.get(name, 4000)
    with bounded():
        for _ in range(count):
            data = target.mutate(rng.choice(pool), rng, flip)[: target.max_len]
            try:
                taken += run(target, data)
            except Exception as error:
                error.args = (*error.args, f"{name}: {data!r}")
                raise
    assert count // 100 < taken < count, "the mutator makes nothing that is taken, or nothing else"


def stream(
    more: dict[str, bytes] | None = None, **changed: bytes | Callable[[bytes], bytes]
) -> bytes:
    """A small cycle stream with more members, or with other headers of its arrays."""
    data = next(iter(targets.load("npz").seeds()))
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        arrays = {name: archive.read(name) for name in archive.namelist()}
    for name, new in changed.items():
        old = arrays[f"{name}.npy"]
        head = new if isinstance(new, bytes) else new(old[10:128])
        arrays[f"{name}.npy"] = old[:8] + len(head).to_bytes(2, "little") + head + old[128:]
    return packed(arrays | (more or {}), zipfile.ZIP_STORED)


def header(text: str) -> bytes:
    return b"\x93NUMPY\1\0" + len(text).to_bytes(2, "little") + text.encode()


def packed(arrays: dict[str, bytes], method: int) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        for name, data in arrays.items():
            archive.writestr(name, data)
    return out.getvalue()


def damaged(method: int) -> bytes:
    """A zip member whose packed bytes are no code of its method."""
    data = bytearray(packed({"version.npy": bytes(200)}, method))
    at = data.index(b"version.npy") + len(b"version.npy")
    data[at + 4 : at + 14] = b"\xff" * 10
    return bytes(data)


def far_pose() -> bytes:
    out = io.BytesIO()
    np.savez(
        out, stamp=[0.0], pose=np.full((1, 4, 4), 1e200), points=np.zeros((0, 3)), offsets=[0, 0]
    )
    return out.getvalue()


def folder(**changed: bytes) -> bytes:
    files = dict(files_of(next(iter(tum.seeds()))))
    new = {name.replace("_", ".").encode(): data for name, data in changed.items()}
    return tum.pack((files | new).items())


def camera(width: str) -> bytes:
    return b'{"fx":1,"fy":1,"cx":1,"cy":1,"height":1,"depth_scale":1,"width":%s}' % width.encode()


def ledger(tmp_path: Path, script: str) -> bytes:
    path = tmp_path / "ledger.db"
    path.write_bytes(list(targets.load("store").seeds())[2])
    with closing(sqlite3.connect(path)) as database:
        database.executescript(script)
    return path.read_bytes()


def cloud(**changed: npt.NDArray[Any] | bytes) -> bytes:
    """A cloud of two points; bytes stand for the whole of a member."""
    arrays: dict[str, Any] = {"points": np.ones((2, 3))}
    out = io.BytesIO()
    np.savez(out, **(arrays | {k: v for k, v in changed.items() if not isinstance(v, bytes)}))
    with zipfile.ZipFile(out, "a") as archive:
        for name, data in changed.items():
            if isinstance(data, bytes):
                archive.writestr(f"{name}.npy", data)
    return out.getvalue()


TUM = b"1 0 0 0 0 0 0 1\n1.5 0 0 1 0 0 0 1\n"


def euroc(list_of_right: bytes) -> bytes:
    files = dict(files_of(next(iter(targets.load("euroc").seeds()))))
    return pack((files | {b"mav0/cam1/data.csv": list_of_right}).items())


def kitti(row: bytes, mounted: bytes = b"Tr: " + b"1e200 " * 12) -> bytes:
    files = dict(files_of(next(iter(targets.load("scans").seeds()))))
    return pack((files | {b"poses.txt": 2 * row, b"calib.txt": mounted}).items())


def colmap(name: bytes) -> bytes:
    """A picture that lies too far away."""
    seeds = (dict(files_of(data)) for data in targets.load("colmap").seeds())
    far = next(f for f in seeds if np.float64(1e9).tobytes() in f.get(b"images.bin", b""))
    return pack((far | {b"images.bin": far[b"images.bin"].replace(b"a.png", name)}).items())


def ascii_cloud(*lines: str) -> bytes:
    fields = "".join(f"property float {name}\n" for name in ("x", "y", "z", "state"))
    head = f"ply\nformat ascii 1.0\nelement vertex {len(lines)}\n{fields}end_header\n"
    return (head + "\n".join(lines)).encode()


POSE = np.eye(4)[None]
FOUND: dict[str, tuple[str, Callable[[], bytes]]] = {
    "a number of 5000 digits": ("config", lambda: b"name = " + b"9" * 5000),
    "arrays in arrays": ("config", lambda: b"name = " + b"[" * 3000),
    "an unfinished header": ("npz", lambda: stream(points=b"{'descr': '<f4', (")),
    "a header with a list as key": ("npz", lambda: stream(points=b"{[]: 1}")),
    "a header of Python 2": ("npz", lambda: stream(points=lambda old: old.replace(b"3)", b"3L)"))),
    "a version that ends early": (
        "npz",
        lambda: packed(
            {"version.npy": header("{'descr':'<i8','fortran_order':False,'shape':()}")}, 0
        ),
    ),
    "a name of two lines": ("npz", lambda: stream(more={"two\nlines.npy": b""})),
    "a damaged LZMA member": ("npz", lambda: damaged(zipfile.ZIP_LZMA)),
    "a pose whose square overflows": ("npz", far_pose),
    "a quaternion that overflows": (
        "tum",
        lambda: folder(groundtruth_txt=b"1 0 0 0 1e300 0 0 1"),
    ),
    "a width beyond floats": ("tum", lambda: folder(camera_json=camera("1" + "0" * 400))),
    "objects in objects": ("tum", lambda: folder(camera_json=b'{"a":' * 5000)),
    "a name that no file may have": (
        "tum",
        lambda: folder(associations_txt=b"1 rgb/1.0.png 1 " + b"x" * 300),
    ),
    "a home of nobody": ("config", lambda: b"store.path = '~nobody-at-all/x.db'"),
    "a path with a zero": ("config", lambda: b'store.path = "a\\u0000b"'),
    "a path that no file may have": ("config", lambda: b'store.path = "%s"' % (b"x" * 5000)),
    "faults without end": ("config", lambda: b"chaos.crashes = 4611686018427387905"),
    "faults that last for ever": (
        "config",
        lambda: b"chaos.crashes = 1\nchaos.down = [inf, inf]",
    ),
    "a cloud's unfinished header": (
        "ply",
        lambda: cloud(states=header("{'descr': '|u1', (") + bytes(2)),
    ),
    "a cloud's header with a list as key": ("ply", lambda: cloud(states=header("{[]: 1}"))),
    "a cloud's member that is no array": ("ply", lambda: cloud(states=b"text")),
    "a cloud packed by LZMA": ("ply", lambda: damaged(zipfile.ZIP_LZMA)),
    "states that are no numbers": ("ply", lambda: cloud(states=np.full(2, np.nan))),
    "offsets that are one number": ("ply", lambda: cloud(pose=POSE, offsets=np.array(2))),
    "offsets in rows": ("ply", lambda: cloud(pose=POSE, offsets=np.zeros((2, 2), np.int64))),
    "offsets that end early": ("ply", lambda: cloud(pose=POSE, offsets=np.array([0, 1]))),
    "a vertex whose state is infinite": ("ply", lambda: ascii_cloud("1 2 3 1e300")),
    "a vertex that is a comment": ("ply", lambda: ascii_cloud("# 1 2 3")),
}
FOUND |= {
    "a hidden cloud": ("scans", lambda: pack([(b".pcd", b""), (b"poses.txt", TUM)])),
    "a scan too sparse for odometry": ("scans", lambda: pack([(b"0.bin", bytes(range(1, 33)))])),
    "a picture's name with a zero": ("euroc", lambda: euroc(b"1000000000,\0.png\n")),
    "a pose whose product overflows": ("scans", lambda: kitti(b"1e200 " * 11 + b"1\n")),
    "a line of one comma": ("scans", lambda: kitti(b"1 " * 12 + b"\n", mounted=b",\n")),
    "a picture's name of two lines": ("colmap", lambda: colmap(b"a\nb")),
    "a place that is no number": ("rtabmap", lambda: b"UPDATE Feature SET depth_x = x'ff'"),
}
LEDGERS = {
    "a ledger of no fleet": "DELETE FROM meta WHERE key = 'fleet'",
    "data that is text": "UPDATE transactions SET data = 'text' WHERE position = 1",
    "data that is a number": "UPDATE transactions SET data = 1 WHERE position = 1",
    "rows without a position": "DROP TABLE transactions;"
    "CREATE TABLE transactions (position, id, data);"
    "INSERT INTO transactions VALUES (NULL, x'00', x'00')",
}


@pytest.mark.parametrize("what", FOUND)
def test_what_the_fuzzing_found_is_refused(what: str) -> None:
    name, make = FOUND[what]
    with bounded():
        assert run(targets.load(name), make()) is False


@pytest.mark.parametrize("path", sorted(targets.FOUND.glob("*/*")), ids=lambda path: path.name)
def test_files_that_the_fuzzing_found_are_refused(path: Path) -> None:
    with bounded():
        assert run(targets.load(path.parent.name), path.read_bytes()) is False


@pytest.mark.parametrize("what", LEDGERS)
def test_what_the_fuzzing_found_in_ledgers_is_refused(what: str, tmp_path: Path) -> None:
    with bounded():
        assert run(targets.load("store"), ledger(tmp_path, LEDGERS[what])) is False


def test_no_message_waits_for_a_kernel() -> None:
    """What `dagmap` compiles beforehand is all that the agent's corpus runs."""
    script = """
import targets
from rich.console import Console
from dagmap.cli import kernels
from dagmap.kernels.jit import KERNELS
kernels.warm_graph_and_codec(), kernels.warm_fold(), kernels.warm_up(Console(quiet=True))
before = {id(kernel): len(kernel.signatures) for kernel in KERNELS}
agent = targets.load("agent")
for data in targets.corpus("agent"):
    agent.run(data)
late = [k for k in KERNELS if len(k.signatures) > before.get(id(k), 0)]
assert not late, late
"""
    paths = os.pathsep.join((str(ROOT / "src"), str(ROOT / "fuzz")))
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.parametrize("name", ["message", "records", "envelope", "closed", "agent", "columns"])
def test_trees_lose_nothing(name: str) -> None:
    """A mutation that changes nothing is the input: so what a tree leaves alone stays in order."""
    grammars = {
        "message": _wire.message(rest),
        "records": _wire.PAYLOAD,
        "envelope": _wire.TRANSACTION,
    }
    for data in targets.corpus(name):
        for grammar in (grammars.get(name, rest), *grammars.values()):
            assert tree(data, grammar).dump() == data


def test_every_kind_of_record_has_a_grammar_and_a_sample() -> None:
    kinds = set()
    for sample in _wire.payloads():
        reader = Reader(encode_payload(sample))
        while reader.left:
            kinds.add(reader.number())
            reader.take(reader.number())
    assert set(_wire.RECORDS) == kinds == set(Kind), "a new kind belongs into targets/_wire.py"


def test_the_corpus_does_not_follow_the_defaults() -> None:
    """What was found once stays of use: another default or parameter is no other fleet."""
    other = msgspec.structs.replace(_wire.CONFIG, fold=FoldConfig(witnesses=9, delta=0.5))
    assert Config(fold=other.fold).parameters_id != Config().parameters_id
    for data in targets.corpus("message"):
        assert heard(data, other) == heard(data, _wire.CONFIG)


def heard(data: bytes, config: Config) -> bool:
    try:
        parse(data, config)
    except Refusal:
        return False
    return True


def test_a_file_whose_name_no_robot_may_have_is_refused(tmp_path: Path) -> None:
    """The one way out of `load_settings` that no bytes lead to."""
    path = tmp_path / f"{'x' * 70}.toml"
    path.write_text("store.path = 'a'")
    with pytest.raises(ConfigError, match="give the robot a `name`"):
        load_settings(path)


def test_the_corpus_is_small_and_named_by_content() -> None:
    files = [path for path in targets.CORPUS.rglob("*") if path.is_file()]
    parsers = len([path for path in targets.CORPUS.iterdir() if path.is_dir()])
    assert sum(path.stat().st_size for path in files) < 40_000 * parsers
    for path in files:
        assert path.name == hashlib.sha1(path.read_bytes(), usedforsecurity=False).hexdigest()


def test_the_corpus_reaches_every_line_of_the_parsers() -> None:
    """Kernels as plain Python; fuzz/unreachable.json names what no input reaches, and why."""
    done = subprocess.run(
        [sys.executable, str(ROOT / "fuzz" / "lines.py")],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
    assert all(json.loads((ROOT / "fuzz" / "unreachable.json").read_text()).values())
