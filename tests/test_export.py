from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np
import pytest

from dagmap.io.export import PlyMap, atomic_write, prepare_out, read_ply, write_graph_npz, write_ply
from dagmap.model import OutputError, RecordingError


def some_map(count: int = 5) -> PlyMap:
    rng = np.random.default_rng(7)
    return PlyMap(
        rng.integers(-1000, 1000, (count, 3)) / 8.0,  # exact in float32
        rng.integers(0, 256, (count, 3)).astype(np.uint8),
        rng.integers(0, 3, count).astype(np.uint8),
        rng.integers(0, 1 << 32, count),
        rng.integers(0, 1 << 32, count),
        rng.integers(0, 1 << 16, count),
    )


def parse_ply(raw: bytes) -> tuple[list[str], list[tuple[float | int, ...]]]:
    """An independent reader: the property lines as they stand, and the rows."""
    head, body = raw.split(b"end_header\n", 1)
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    row = struct.Struct("<fffBBBBIIH")
    assert len(body) == count * row.size
    return [line for line in lines if line.startswith("property")], list(row.iter_unpack(body))


def test_the_map_has_exactly_the_documented_properties_in_order(tmp_path: Path) -> None:
    world = some_map()
    write_ply(tmp_path / "map.ply", world)
    properties, rows = parse_ply((tmp_path / "map.ply").read_bytes())
    assert properties == [
        "property float x",
        "property float y",
        "property float z",
        "property uchar red",
        "property uchar green",
        "property uchar blue",
        "property uchar state",
        "property uint hits",
        "property uint misses",
        "property ushort witnesses",
    ]
    for i, row in enumerate(rows):
        assert row == (
            *world.positions[i],
            *world.colors[i],
            world.states[i],
            world.hits[i],
            world.misses[i],
            world.witnesses[i],
        )


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_a_map_comes_back_as_it_was_written(tmp_path: Path, count: int) -> None:
    world = some_map(count)
    write_ply(tmp_path / "map.ply", world)
    back = read_ply(tmp_path / "map.ply")
    for name in ("positions", "colors", "states", "hits", "misses", "witnesses"):
        assert np.array_equal(getattr(back, name), getattr(world, name)), name
        assert getattr(back, name).shape == getattr(world, name).shape


def test_counts_beyond_their_column_are_capped_not_wrapped(tmp_path: Path) -> None:
    world = some_map(1)
    large = np.array([1 << 40])
    write_ply(
        tmp_path / "map.ply",
        PlyMap(world.positions, world.colors, world.states, large, large, large),
    )
    back = read_ply(tmp_path / "map.ply")
    assert (back.hits[0], back.misses[0], back.witnesses[0]) == (2**32 - 1, 2**32 - 1, 2**16 - 1)


def test_a_map_that_another_program_saved_again_is_read(tmp_path: Path) -> None:
    names = ["witnesses", "misses", "hits", "state", "blue", "green", "red", "quality"]
    names += ["z", "y", "x"]
    head = ["ply", "format binary_little_endian 1.0", "element vertex 1"]
    kinds = {"x": "double", "y": "float64", "z": "float", "quality": "float", "hits": "int"}
    head += [f"property {kinds.get(name, 'uchar')} {name}" for name in names]
    head += ["element face 0", "property list uchar int vertex_indices", "end_header"]
    row = struct.pack("<BBiBBBBffdd", 3, 1, 70000, 2, 30, 20, 10, 0.5, 3.0, 2.0, 1.0)
    (tmp_path / "map.ply").write_bytes("\r\n".join([*head, ""]).encode() + row)
    back = read_ply(tmp_path / "map.ply")
    assert back.positions.tolist() == [[1.0, 2.0, 3.0]]
    assert back.colors.tolist() == [[10, 20, 30]]
    assert [back.states[0], back.hits[0], back.misses[0], back.witnesses[0]] == [2, 70000, 1, 3]


def header(*lines: str) -> bytes:
    return "\n".join(["ply", *lines, "end_header", ""]).encode()


LITTLE = "format binary_little_endian 1.0"


@pytest.mark.parametrize(
    ("raw", "what"),
    [
        (b"", "no PLY header"),
        (b"ply\n", "no PLY header"),
        (b"ply\n" * 10_000, "no PLY header"),
        (os.urandom(5000), "no PLY header"),
        (header("format binary_big_endian 1.0", "element vertex 0"), "binary little endian"),
        (header(LITTLE), "vertices do not come first"),
        (header(LITTLE, "element face 3", "element vertex 3"), "vertices do not come first"),
        (header(LITTLE, "element vertex -3"), "vertices do not come first"),
        (header(LITTLE, "element vertex 3", "property float x"), "lack y, z, red"),
        (header(LITTLE, "element vertex 3", "property list uchar int x"), "else than numbers"),
        (header(LITTLE, "element vertex 3", "property quad x"), "else than numbers"),
    ],
)
def test_what_is_no_map_is_named(tmp_path: Path, raw: bytes, what: str) -> None:
    (tmp_path / "map.ply").write_bytes(raw)
    with pytest.raises(RecordingError, match=f"map.ply: no usable map: .*{what}"):
        read_ply(tmp_path / "map.ply")


def test_a_map_that_was_cut_short_or_promises_too_much_is_named(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    write_ply(path, some_map(10))
    raw = path.read_bytes()
    path.write_bytes(raw[:-1])
    with pytest.raises(RecordingError, match="10 nodes are promised, 9 are there"):
        read_ply(path)
    path.write_bytes(raw.replace(b"vertex 10\n", b"vertex 99999999999999999999\n"))
    with pytest.raises(RecordingError, match="999999999999999 nodes are promised, 10 are there"):
        read_ply(path)


def test_a_missing_map_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"map\.ply: cannot be read \(No such file"):
        read_ply(tmp_path / "map.ply")


def test_a_graph_is_written_as_documented(tmp_path: Path) -> None:
    columns = {
        "ids": np.arange(3),
        "positions": np.zeros((3, 3)),
        "parents": np.array([[-1, -1], [0, -1], [0, 1]]),
        "validity": np.array([2, 3, 5]),
        "issued": np.array([False, True, True]),
    }
    write_graph_npz(tmp_path / "a.npz", *columns.values())
    with np.load(tmp_path / "a.npz") as back:
        assert sorted(back.files) == sorted(columns)
        for name, column in columns.items():
            assert np.array_equal(back[name], column)
            assert back[name].dtype == column.dtype


def test_a_graph_with_columns_of_unequal_length_is_refused(tmp_path: Path) -> None:
    empty = np.zeros(0, np.int64)
    with pytest.raises(ValueError, match="equally long"):
        write_graph_npz(
            tmp_path / "a.npz", np.arange(2), np.zeros((2, 3)), empty, empty, empty.astype(bool)
        )
    assert list(tmp_path.iterdir()) == []


def test_what_breaks_off_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "summary.json"
    path.write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt), atomic_write(path) as file:
        file.write(b"new, but not all of")
        raise KeyboardInterrupt
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
    with atomic_write(path) as file:
        file.write(b"new")
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_pipe_is_written_to_and_not_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        with atomic_write(pipe) as file:
            file.write(b"text")
        assert os.read(reader, 9) == b"text" and pipe.is_fifo()
    finally:
        os.close(reader)
    assert list(tmp_path.iterdir()) == [pipe]


@pytest.mark.parametrize("place", ["missing/map.ply", "file/map.ply"])
def test_a_place_that_cannot_be_written_is_named(tmp_path: Path, place: str) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=f"{place}: cannot be written"):
        write_ply(tmp_path / place, some_map())


def test_a_folder_that_takes_no_files_is_named() -> None:
    with pytest.raises(OutputError, match="map.ply: cannot be written"):
        write_ply(Path("/proc/map.ply"), some_map())


def test_a_new_folder_is_made_with_its_parents(tmp_path: Path) -> None:
    out = prepare_out(tmp_path / "a" / "b", force=False)
    assert out == tmp_path / "a" / "b"
    assert sorted(p.name for p in out.iterdir()) == ["graph", "ledgers"]
    assert not any((out / "ledgers").iterdir())


def test_an_empty_folder_is_taken(tmp_path: Path) -> None:
    assert prepare_out(tmp_path, force=False) == tmp_path


def test_a_folder_with_something_in_it_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "map.ply").write_text("precious")
    with pytest.raises(OutputError, match="not empty; .*--force"):
        prepare_out(tmp_path, force=False)
    assert [p.name for p in tmp_path.iterdir()] == ["map.ply"]


def test_force_removes_what_a_replay_writes_and_nothing_else(tmp_path: Path) -> None:
    ours = ["summary.json", "map.ply", "maps.png", "traffic.png", "report.html"]
    ours += ["ledgers/a.db", "ledgers/a.db-wal", "ledgers/a.db-shm", "graph/a.npz"]
    ours += [".map.ply.123.part", "graph/.a.npz.123.part"]
    theirs = ["notes.txt", "ledgers/readme", "graph/figure.svg", "sub/map.ply", "old.db"]
    for name in ours + theirs:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    prepare_out(tmp_path, force=True)
    left = sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file())
    assert left == sorted(theirs)


def test_force_removes_a_link_not_what_it_points_to(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("kept")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "map.ply").symlink_to(tmp_path / "precious")
    prepare_out(tmp_path / "out", force=True)
    assert (tmp_path / "precious").read_text() == "kept"
    assert not (tmp_path / "out" / "map.ply").is_symlink()


def test_a_file_in_the_place_of_the_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    with pytest.raises(OutputError, match="this is a file; name a folder"):
        prepare_out(tmp_path / "out", force=True)


def test_a_folder_that_cannot_be_made_is_named() -> None:
    with pytest.raises(OutputError, match="/proc/out: cannot be written"):
        prepare_out(Path("/proc/out"), force=False)
