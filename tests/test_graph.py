"""The adjacency DAG against its twin, and what must hold in any graph."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dagmap.config import GraphConfig
from dagmap.graph import AdjacencyDag
from dagmap.model import LIMIT_MM, CycleError
from naive import MOST, NaiveDag, Point

COMPILED = not numba.config.DISABLE_JIT
SOME = settings(max_examples=150 if COMPILED else 60, deadline=None)
SALT = 0x0123_4567_89AB_CDEF


def rows(points: list[Point]) -> Any:
    return np.array(points, np.int32).reshape(-1, 3)


def both(config: GraphConfig) -> tuple[AdjacencyDag, NaiveDag]:
    return AdjacencyDag(config, salt=SALT), NaiveDag(config)


def assert_same(dag: AdjacencyDag, twin: NaiveDag) -> None:
    n = len(twin.points)
    assert len(dag) == n
    parents = [[p if isinstance(p, int) else -1 for p in row] for row in twin.parents]
    assert dag.parents().tolist() == parents
    assert dag.validity().tolist() == twin.validity()
    assert dag.terminals().tolist() == twin.terminals()
    assert dag.alive().tolist() == twin.alive
    assert dag.issued().tolist() == twin.issued
    assert dag.children_count().tolist() == [len(twin.children(i)) for i in range(n)]
    assert dag.positions().tolist() == [list(p) for p in twin.points]


def assert_sound(dag: AdjacencyDag, config: GraphConfig) -> None:
    """The invariants, from what the graph says of itself."""
    n = len(dag)
    parents, validity, count = dag.parents(), dag.validity(), dag.children_count()
    assert (parents < np.arange(n)[:, None]).all()  # older only: no cycle
    assert (np.bincount(parents[parents >= 0], minlength=n) == count).all()
    assert (count <= config.n_c_max).all()
    ordered = np.sort(parents, axis=1)
    assert ((np.diff(ordered, axis=1) > 0) | (ordered[:, :-1] < 0)).all()  # none twice
    assert (dag.terminals() == np.flatnonzero(dag.alive() & (count < dag.n_c))).all()
    here = dag.alive() | dag.issued()
    fixed = dag.issued() & (config.issued_validity == "reset")
    total = np.where(parents >= 0, validity[parents].astype(object), 0).sum(axis=1)
    lattice = np.minimum(total + (parents < 0).sum(axis=1), MOST)  # where -1 is a lattice node
    most, least = np.maximum(lattice, 1), np.maximum(np.minimum(total, MOST), 1)
    assert ((least <= validity) & (validity <= most) | ~here | fixed).all()
    assert (validity[fixed] == 1).all()
    assert (validity[~here] == 0).all()
    assert (parents[~here] == -1).all()


@st.composite
def configs(draw: st.DrawFn) -> GraphConfig:
    n_p = draw(st.integers(1, 4))
    n_c = draw(st.integers(n_p, n_p + 2))
    pitch = draw(st.sampled_from([0.01, 0.011, 0.1, 0.25]))
    return GraphConfig(
        n_p=n_p,
        n_c=n_c,
        n_c_max=n_c + draw(st.integers(0, 2)),
        reference_pitch=pitch,
        max_parent_distance=draw(st.sampled_from([None, 0.001, pitch, 2.5 * pitch])),
        issued_validity=draw(st.sampled_from(["inherit", "reset"])),
    )


@st.composite
def clouds(draw: st.DrawFn, most: int = 30) -> list[Point]:
    """Points on coarse and fine grids, so that distances tie, in the middle or at the edge."""
    unit = draw(st.sampled_from([1, 5, 50, 125, 250]))
    edge = LIMIT_MM - 4 * unit
    base = draw(st.sampled_from([(0, 0, 0), (1, -2, 7), (edge, edge, edge), (-edge, 3, edge)]))
    step = st.integers(-4, 4)
    cells = draw(st.lists(st.tuples(step, step, step), max_size=most))
    return [(base[0] + x * unit, base[1] + y * unit, base[2] + z * unit) for x, y, z in cells]


@SOME
@given(configs(), clouds(), st.integers(0, 30))
def test_insertion(config: GraphConfig, cloud: list[Point], cut: int) -> None:
    dag, twin = both(config)
    for part in (cloud[:cut], cloud[cut:]):
        first = len(twin.points)
        assert dag.insert(rows(part)).tolist() == list(range(first, first + len(part)))
        twin.insert(part)
        assert_same(dag, twin)
    assert_sound(dag, config)


@SOME
@given(configs(), st.data())
def test_anything_in_any_order(config: GraphConfig, data: st.DataObject) -> None:
    dag, twin = both(config)
    acts = ["insert", "insert", "withdraw", "issue", "take", "n_c"]
    for _ in range(data.draw(st.integers(1, 8))):
        act = data.draw(st.sampled_from(acts))
        alive = [i for i, a in enumerate(twin.alive) if a]
        some = data.draw(
            st.lists(st.sampled_from(alive), unique=True, max_size=8) if alive else st.just([])
        )
        if act == "insert":
            cloud = data.draw(clouds(most=16))
            dag.insert(rows(cloud))
            twin.insert(cloud)
        elif act == "withdraw":
            assert dag.withdraw(some).tolist() == twin.withdraw(some)
        elif act == "issue":
            assert dag.mark_issued(some).tolist() == twin.mark_issued(some)
        elif act == "take":
            most, total = data.draw(st.integers(1, 6)), data.draw(st.integers(0, 20))
            ids, frontier, done, changed = dag.take(np.array(some, np.int64), most, total)
            mine = (ids.tolist(), frontier.tolist(), done, changed.tolist())
            assert mine == twin.take(some, most, total)
        else:
            dag.n_c = twin.n_c = data.draw(st.integers(config.n_p, config.n_c_max))
        assert_same(dag, twin)
        for core in [i for i in some if twin.here[i]]:
            limit = data.draw(st.integers(1, 6))
            kept, frontier = dag.bundle(core, limit)
            assert (kept.tolist(), frontier.tolist()) == twin.bundle(core, limit)
    assert_sound(dag, config)


@pytest.mark.parametrize("span", [1, 2, 3, 40])
@pytest.mark.parametrize("reach", [None, 0.02])
def test_a_cell_full_of_terminals(span: int, reach: float | None) -> None:
    """More terminals in a cell than its list holds: a tree of boxes, then (span 1) of ids."""
    rng = np.random.default_rng(span)
    config = GraphConfig(n_p=2, n_c=4, n_c_max=5, reference_pitch=0.05, max_parent_distance=reach)
    dag, twin = both(config)
    for count in (40, 60) if COMPILED else (40,):
        points = [(int(x), int(y), int(z)) for x, y, z in rng.integers(0, span, (count, 3)) - 12]
        dag.insert(rows(points))
        twin.insert(points)
        assert_same(dag, twin)
        for n_c in (5, 3):
            dag.n_c = twin.n_c = n_c
            ids = rng.permutation(np.flatnonzero(dag.alive()))[:5].tolist()
            assert dag.withdraw(ids).tolist() == twin.withdraw(ids)
            assert_same(dag, twin)
    assert_sound(dag, config)


def test_small_or_large_batches_and_any_salt_give_the_same_graph() -> None:
    rng = np.random.default_rng(3)
    points = rng.integers(-3000, 3000, (4000 if COMPILED else 200, 3)).astype(np.int32)
    config = GraphConfig(n_c=3, reference_pitch=0.05, max_parent_distance=None)
    whole, parts = AdjacencyDag(config), AdjacencyDag(config, salt=SALT)
    whole.insert(points)
    for part in np.array_split(points, 50):
        parts.insert(part)
    assert (whole.parents() == parts.parents()).all()
    assert (whole.validity() == parts.validity()).all()
    assert (whole.terminals() == parts.terminals()).all()
    assert_sound(whole, config)


def test_a_large_graph_is_sound_after_withdrawals() -> None:
    rng = np.random.default_rng(4)
    config = GraphConfig(n_c=3, n_c_max=4, issued_validity="reset")
    dag = AdjacencyDag(config, SALT)
    for _ in range(4):
        dag.insert(rng.integers(0, 900, (2000 if COMPILED else 60, 3)))
        before = dag.validity()
        sent = rng.permutation(np.flatnonzero(dag.alive()))[: len(dag) // 8]
        changed = dag.mark_issued(sent)
        assert (changed == np.flatnonzero(dag.validity() != before)).all()
        before = dag.validity()
        leaving = rng.permutation(np.flatnonzero(dag.alive()))[: len(dag) // 4]
        changed = dag.withdraw(leaving)
        here = dag.alive() | dag.issued()
        assert (changed == np.flatnonzero((dag.validity() != before) & here)).all()
        assert_sound(dag, config)
        dag.n_c = 7 - dag.n_c


def test_validity_doubles_and_saturates() -> None:
    dag = AdjacencyDag(GraphConfig(n_p=2, n_c=2, max_parent_distance=None))
    dag.insert(np.zeros((200, 3), np.int32))
    validity = dag.validity()
    assert validity[0] == 2  # two lattice nodes
    assert validity[-1] == MOST
    assert validity.min() == 2


def test_a_point_out_of_reach_of_everything_is_a_root() -> None:
    dag = AdjacencyDag(GraphConfig(reference_pitch=0.25, max_parent_distance=0.1))
    assert dag.insert([[125, 125, 125]]).tolist() == [0]
    assert dag.parents().tolist() == [[-1, -1]]
    assert dag.validity().tolist() == [1]
    dag.insert([[125, 125, 126], [0, 0, 0]])
    assert dag.parents().tolist() == [[-1, -1], [0, -1], [-1, -1]]
    assert dag.validity().tolist() == [1, 1, 1]


def test_empty() -> None:
    dag = AdjacencyDag(GraphConfig())
    for nothing in ([], np.empty((0, 3), np.int32)):
        assert dag.insert(nothing).shape == (0,)
    assert len(dag) == 0
    assert dag.parents().shape == (0, 2)
    assert dag.positions().shape == (0, 3)
    assert dag.terminals().shape == dag.validity().shape == dag.withdraw([]).shape == (0,)
    assert dag.mark_issued([]).shape == (0,)
    assert [len(part) for part in dag.take(np.empty(0, np.int64), 5, 5)[:2]] == [0, 0]
    dag.n_c = 5
    assert dag.n_c == 5


def test_memory_is_told() -> None:
    rng = np.random.default_rng(5)
    dag = AdjacencyDag(GraphConfig(reference_pitch=0.25, max_parent_distance=0.75))
    count = 20_000 if COMPILED else 500
    dag.insert(rng.integers(0, [4000, 4000, 20], (count, 3)))
    assert 52 * count < dag.nbytes < 120 * count + 60_000


WRONG: list[tuple[str, Callable[[AdjacencyDag], object]]] = [
    ("float64", lambda dag: dag.insert([[0.5, 0.0, 0.0]])),
    (r"\(1, 2\)", lambda dag: dag.insert([[1, 2]])),
    ("beyond", lambda dag: dag.insert([[0, 0, LIMIT_MM + 1]])),
    ("beyond", lambda dag: dag.insert([[0, -LIMIT_MM - 1, 0]])),
    ("feature 4 is unknown", lambda dag: dag.withdraw([4])),
    ("feature -1 is unknown", lambda dag: dag.validity([-1])),
    ("whole numbers", lambda dag: dag.parents([0.0])),
    ("feature 1 has been withdrawn", lambda dag: dag.withdraw([0, 1])),
    ("twice", lambda dag: dag.withdraw([0, 0])),
    ("feature 1 has been withdrawn", lambda dag: dag.mark_issued([0, 1])),
    ("feature 1 has been withdrawn", lambda dag: dag.bundle(1, 10)),
    ("feature 1 has been withdrawn", lambda dag: dag.take(np.array([0, 1]), 10, 10)),
    ("at least 1", lambda dag: dag.bundle(0, 0)),
    ("at least 1", lambda dag: dag.take(np.array([0]), 0, 10)),
    ("n_c = 1", lambda dag: setattr(dag, "n_c", 1)),
    ("n_c = 9", lambda dag: setattr(dag, "n_c", 9)),
]


@pytest.mark.parametrize(("message", "call"), WRONG)
def test_bad_input_changes_nothing(message: str, call: Callable[[AdjacencyDag], object]) -> None:
    dag = AdjacencyDag(GraphConfig(n_c_max=8))
    dag.insert([[0, 0, 0], [1, 0, 0], [2, 0, 0], [LIMIT_MM, -LIMIT_MM, 0]])
    dag.withdraw([1])
    with pytest.raises(CycleError, match=message):
        call(dag)
    assert dag.alive().tolist() == [True, False, True, True]
    assert not dag.issued().any()
    assert len(dag) == 4
    assert dag.n_c == 2
