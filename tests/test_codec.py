"""`codec.py`, `rangecoder.py`, `morton.py` against their twin, and against arbitrary bytes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import naive as naive_codec
from dagmap.kernels.codec import decode_features, encode_features, morton_order

LIMIT = 1 << 29
Columns = dict[str, Any]


def columns(
    position: Any, parents: Any, base: int, starts: Any, color: Any, colored: Any, slots: int = 2
) -> Columns:
    return {
        "position": np.array(position, np.int32).reshape(-1, 3),
        "parents": np.array(parents, np.int64).reshape(len(position), slots),
        "base": base,
        "starts": np.array(starts, np.int64),
        "color": np.array(color, np.uint8).reshape(-1, 3),
        "colored": np.array(colored, np.uint8),
    }


def decode(data: Any, c: Columns, **other: Any) -> Any:
    given_ = {"n": len(c["position"]), "slots": c["parents"].shape[1]}
    given_ |= {name: c[name] for name in ("base", "starts", "colored")}
    return decode_features(np.frombuffer(bytes(data), np.uint8), **{**given_, **other})


def naive_encode(c: Columns) -> bytes:
    return naive_codec.encode(**{k: v if k == "base" else v.tolist() for k, v in c.items()})


def naive_decode(data: bytes, c: Columns) -> Any:
    n, slots = c["parents"].shape
    return naive_codec.decode(
        data, n, slots, c["base"], c["starts"].tolist(), c["colored"].tolist()
    )


def assert_round_trip(c: Columns) -> bytes:
    data = encode_features(**c)
    position, parents, color, consumed, ok = decode(data, c)
    assert ok and consumed == len(data)
    assert (position == c["position"]).all() and (parents == c["parents"]).all()
    kept = np.repeat(c["colored"] != 0, np.diff(c["starts"]))
    assert (color[kept] == c["color"][kept]).all() and not color[~kept].any()
    assert position.dtype == np.int32 and parents.dtype == np.int64 and color.dtype == np.uint8
    return data.tobytes()


coordinates = st.one_of(
    st.integers(-40, 40), st.integers(-LIMIT, LIMIT), st.sampled_from([-LIMIT, LIMIT, 0])
)
tiny = st.integers(-3, 3)


@st.composite
def any_columns(draw: st.DrawFn) -> Columns:
    n, slots = draw(st.integers(0, 12)), draw(st.sampled_from([0, 1, 2, 2, 3, 5, 8]))
    base = draw(st.one_of(st.integers(0, 5), st.sampled_from([1 << 20, (1 << 62) - n])))
    axis = draw(st.sampled_from([coordinates, tiny]))
    position = draw(st.lists(st.tuples(axis, axis, axis), min_size=n, max_size=n))
    parents = [
        [draw(st.integers(max(-1, base + i - 9) if near else -1, base + i - 1)) for near in row]
        for i, row in enumerate(
            draw(st.lists(st.lists(st.booleans(), min_size=slots, max_size=slots), min_size=n))
        )
        if i < n
    ]
    cuts = sorted(draw(st.lists(st.integers(0, n), max_size=3)))
    color = draw(st.lists(st.tuples(*[st.integers(0, 255)] * 3), min_size=n, max_size=n))
    colored = draw(st.lists(st.booleans(), min_size=len(cuts) + 1, max_size=len(cuts) + 1))
    return columns(position, parents, base, [0, *cuts, n], color, colored, slots)


def surface(n: int, seed: int = 1, base: int = 700, segments: int = 2) -> Columns:
    """Features as they come: neighbours near each other, parents mostly near, colours alike."""
    rng = np.random.default_rng(seed)
    position = np.cumsum(rng.integers(-30, 31, (n, 3)), axis=0)
    number = base + np.arange(n)[:, None]
    far = rng.random((n, 2)) < 0.1
    back = np.where(far, rng.integers(1, 900, (n, 2)), rng.integers(0, 5, (n, 2)))
    parents = np.where((back > 0) & (back <= number), number - back, -1)
    color = np.cumsum(rng.integers(-9, 10, (n, 3)), axis=0) & 255
    starts = np.linspace(0, n, segments + 1).astype(np.int64)
    return columns(position, parents, base, starts, color, [1] * segments)


@given(any_columns())
@settings(max_examples=150, deadline=None)
def test_round_trip_and_twin(c: Columns) -> None:
    data = assert_round_trip(c)
    assert data == naive_encode(c)
    twin = naive_decode(data, c)
    position, parents, color, _, _ = decode(data, c)
    assert twin == (position.tolist(), parents.tolist(), color.tolist())


def test_twin_on_a_surface() -> None:
    c = surface(300)
    data = assert_round_trip(c)
    assert data == naive_encode(c)
    assert len(data) < 9 * 300


def test_carry_runs_through_long_rows_of_ones() -> None:
    """Many short random bundles: some have a carry through one or more bytes of 255."""
    for seed in range(60):
        c = surface(20, seed)
        assert assert_round_trip(c) == naive_encode(c)


def test_empty() -> None:
    c = columns([], [], 5, [0], [], [])
    assert len(encode_features(**c)) == 0
    assert decode(b"", c)[3:] == (0, True)
    assert decode(b"\0", c)[3:] == (0, False)


def test_one_point_and_extremes() -> None:
    corners = [[x, y, z] for x in (-LIMIT, LIMIT) for y in (LIMIT, -LIMIT) for z in (LIMIT, 0)]
    for n in (1, 8):
        color = [[0, 255, 0], [255, 0, 255]] * 4
        base = (1 << 62) - n
        parents = [[0, base + i - 1] for i in range(n)]
        assert_round_trip(columns(corners[:n], parents, base, [0, n], color[:n], [1]))
    starts, colored = [0, 0, 40, 40], [1, 1, 0]
    alike = [[7, 7, 7]] * 40
    assert_round_trip(columns(alike, [[-1]] * 40, 0, starts, [[9] * 3] * 40, colored, slots=1))


def test_no_slots_for_parents() -> None:
    assert_round_trip(columns([[1, 2, 3]] * 3, [], 0, [0, 3], [[0] * 3] * 3, [0], slots=0))


def test_every_truncation_and_every_extension_is_seen() -> None:
    c = surface(60)
    data = assert_round_trip(c)
    for size in range(len(data)):
        assert not decode(data[:size], c)[4]
    for tail in (b"\0", b"\xff", bytes(9)):
        assert not decode(data + tail, c)[4]


@given(st.data())
@settings(max_examples=200, deadline=None)
def test_mutations_are_safe_and_never_two_codes_for_one_bundle(data: st.DataObject) -> None:
    c = surface(data.draw(st.integers(1, 8)), data.draw(st.integers(0, 9)), base=3)
    code = bytearray(assert_round_trip(c))
    for _ in range(data.draw(st.integers(1, 3))):
        code[data.draw(st.integers(0, len(code) - 1))] = data.draw(st.integers(0, 255))
    assert_agrees_on(bytes(code), c)


@given(st.binary(max_size=60), st.integers(0, 5), st.integers(0, 3))
@settings(max_examples=200, deadline=None)
def test_arbitrary_bytes_are_safe(data: bytes, n: int, slots: int) -> None:
    none = [[-1] * slots] * n
    assert_agrees_on(data, columns([[0] * 3] * n, none, 2, [0, n], [[0] * 3] * n, [1], slots))


def assert_agrees_on(data: bytes, c: Columns) -> None:
    position, parents, color, consumed, ok = decode(data, c)
    twin = naive_decode(data, c)
    assert ok == (twin is not None)
    if ok:
        assert twin == (position.tolist(), parents.tolist(), color.tolist())
        again = dict(c, position=position, parents=parents, color=color)
        assert encode_features(**again).tobytes() == data and consumed == len(data)


LIES = [  # (place, kind, value) of the parents of feature 2, whose first may be 0 or 1
    [(1, "back", 3)],
    [(1, "back", 0)],
    [(1, "long", 0)],
    [(2, "step", 0)],
    [(2, "step", -8)],
    [(3, "which", 0)],
    [(1, "back", 1), (3, "which", 1)],
    [(1, "back", 1), (3, "which", 2)],
    [(1, "back", 1), (1, "back", 2)],
    [(2, "step", -3), (3, "which", 0)],
]
TRUTHS = [
    [(1, "back", 1), (3, "which", 0)],
    [(1, "back", 2), (1, "back", 1)],
    [(0, "", 0), (2, "step", -7)],
]


@pytest.mark.parametrize("told", LIES + TRUTHS)
def test_parents_that_cannot_be_are_refused_when_read(told: list[Any]) -> None:
    """Codes that are well formed but for one value or the way to say it, as a liar could write."""
    coder = naive_codec.Writer()
    c = columns([[0] * 3] * 3, [[-1] * 3] * 3, 7, [0, 3], [[0] * 3] * 3, [0], slots=3)
    before = 0
    for parents in ([], [(1, "back", 1)], told):
        first = 0
        for slot, (place, kind, value) in enumerate([*parents, *[(0, "", 0)] * 3][:3]):
            naive_codec.tree(coder, ("place", slot > 0, before), 2, place)
            before, first = place, place if slot == 0 else first
            if kind == "which":
                naive_codec.tree(coder, ("which",), 2, value)
            elif kind == "long":  # a bit length of 66
                naive_codec.tree(coder, ("back", slot > 0), 3, 7)
                naive_codec.tree(coder, ("back", "rare"), 6, 59)
            elif kind:
                context = slot > 0 and kind == "back"
                naive_codec.number(coder, (kind,), context, kind == "step", value)
        before = first
        for axis in range(3):
            naive_codec.number(coder, ("axis", axis), 0, True, 0)
    code = coder.end()
    assert decode(code, c)[4] == (told in TRUTHS)
    assert_agrees_on(code, c)


@pytest.mark.parametrize("what", ["position", "color", "nothing"])
def test_values_out_of_range_are_refused_when_read(what: str) -> None:
    coder = naive_codec.Writer()
    naive_codec.tree(coder, ("place", False, 0), 2, 0)
    x = (1 << 29) + 1 if what == "position" else 0
    length = 0
    for axis in range(3):
        _, length = naive_codec.number(coder, ("axis", axis), length, True, 0 if axis else x)
    length = x.bit_length()
    for channel in range(3):
        step = 128 if what == "color" and channel == 0 else 0
        _, length = naive_codec.number(coder, ("channel", channel), length, True, step)
    c = columns([[0] * 3], [[-1]], 0, [0, 1], [[0] * 3], [1], slots=1)
    code = coder.end()
    assert decode(code, c)[4] == (what == "nothing")
    assert_agrees_on(code, c)


def test_impossible_arguments_are_not_ok() -> None:
    c = surface(5)
    data = encode_features(**c)
    ends = np.array([0, 3, 5], np.int64)
    for other in (
        {"n": -1},
        {"n": 6},
        {"slots": -1},
        {"slots": 9},
        {"base": -1},
        {"base": 1 << 62},
        {"starts": np.array([0, 6, 5])},
        {"starts": np.array([1, 2, 5])},
        {"starts": np.zeros(0, np.int64)},
        {"starts": ends, "colored": np.ones(1, np.uint8)},
    ):
        assert not decode(data, c, **other)[4]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position": np.full((5, 3), LIMIT + 1, np.int32)}, "beyond"),
        ({"position": np.zeros((5, 2), np.int32)}, r"\(n, 3\)"),
        ({"parents": np.full((5, 2), -2)}, "not before"),
        ({"parents": np.full((5, 2), 700)}, "not before"),
        ({"parents": np.zeros((4, 2), np.int64)}, r"\(n, P <= 8\)"),
        ({"parents": np.zeros((5, 9), np.int64)}, r"\(n, P <= 8\)"),
        ({"starts": np.array([0, 4, 3])}, "starts"),
        ({"base": -1}, "base"),
    ],
)
def test_columns_out_of_bounds_are_errors_of_the_caller(change: Columns, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        encode_features(**{**surface(5), **change})


@given(st.lists(st.tuples(coordinates, coordinates, coordinates), max_size=40))
@settings(deadline=None)
def test_morton_order_against_twin(points: list[Any]) -> None:
    array = np.array(points, np.int32).reshape(-1, 3)
    assert morton_order(array).tolist() == naive_codec.morton(array.tolist())


def test_morton_order_keeps_equal_points_in_order() -> None:
    points = np.zeros((100, 3), np.int32)
    assert morton_order(points).tolist() == list(range(100))
    blocks = np.array([[1 << 20, 0, 0], [0, 0, 0], [-(1 << 20), 0, 0], [0, 0, 0]], np.int32)
    assert morton_order(blocks).tolist() == [2, 1, 3, 0]
    assert morton_order(np.zeros((0, 3), np.int32)).tolist() == []
