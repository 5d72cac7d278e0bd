"""The folds and the ray evidence against their twins; undo; Figure 7."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dagmap.config import FoldConfig
from dagmap.evidence import RayEvidence
from dagmap.fold import Block, Fold, NodeColumns, PaperFold, Verdict, make_fold
from dagmap.kernels.rays import ceil_sqrt
from dagmap.model import LIMIT_MM, State
from dagmap.weighing import log2_16
from naive import (
    NaiveMap,
    NaiveRays,
    naive_default,
    naive_log2,
    naive_paper,
    naive_settled,
    naive_verdict,
    points,
)

COMPILED = not numba.config.DISABLE_JIT
SOME = settings(max_examples=100 if COMPILED else 40, deadline=None)
FEW = settings(max_examples=40 if COMPILED else 20, deadline=None)
SALT = 0x0123_4567_89AB_CDEF
DEFAULT = FoldConfig(delta=0.05, cell=0.1, max_ray=1.0)
EAGER = FoldConfig(
    delta=0.05, cell=0.1, max_ray=1.0, doubt=1000
)  # whatever speaks against a node counts
PAPER = FoldConfig(preset="paper", delta=0.05)
BOTH = pytest.mark.parametrize("config", [DEFAULT, PAPER], ids=["default", "paper"])


def block(
    author: int,
    base: int,
    xyz: Any,
    *,
    cycle: int = 0,
    alive: Any = None,
    parents: Any = None,
    cores: Any = (),
    sightings: Any = (),
    origin: Any = None,
) -> Block:
    """A block with plain columns; sightings are (number, cycle); origin: one for each feature.

    Neighbours with one origin that both have a colour, or both have none, are one segment.
    """
    where = np.array(xyz, np.int32).reshape(-1, 3)
    n, colored = len(where), where[:, 0] % 3 != 0
    origins = np.zeros_like(where) if origin is None else np.array(origin, np.int32)
    new = (np.diff(origins, axis=0) != 0).any(axis=1) | (colored[1:] != colored[:-1])
    heads = np.flatnonzero(np.concatenate([np.ones(min(n, 1), np.bool_), new]))
    return Block(
        author=author,
        base=base,
        xyz=where,
        alive=np.ones(n, np.bool_) if alive is None else np.array(alive, np.bool_),
        starts=np.array([*heads, n], np.int64),
        cycle=np.full(len(heads), cycle, np.int32),
        color=(where & 255).astype(np.uint8),
        colored=colored[heads],
        parents=None if parents is None else np.array(parents, np.int64),
        cores=np.array(cores, np.int64),
        sightings=np.array([s[0] for s in sightings], np.int64),
        sighting_cycle=np.array([s[1] for s in sightings], np.int32),
        origin=origins[heads],
    )


@st.composite
def stories(draw: st.DrawFn, most: int = 8, size: int = 7) -> list[Block]:
    """Blocks of a few authors in a small space: ties, equal points, dead rows, empty blocks."""
    rng = np.random.default_rng(draw(st.integers(0, 1 << 32)))
    centre = draw(st.sampled_from([0, 0, LIMIT_MM - 200, -LIMIT_MM + 200]))
    pitch = draw(st.sampled_from([1, 25, 50]))  # 50: distances of exactly delta
    numbers, cycles = [0, 0, 0], [0, 0, 0]
    out = []
    for _ in range(draw(st.integers(1, most))):
        author, n = int(rng.integers(3)), int(rng.integers(size + 1))
        base = numbers[author] + (int(rng.integers(3)) if rng.random() < 0.2 else 0)
        cycles[author] += int(rng.integers(2))
        known = base + n
        parents = rng.integers(-1, max(base + 1, 1) + np.arange(n)[:, None], (n, 2))
        xyz = centre + pitch * rng.integers(-200 // pitch, 200 // pitch + 1, (n, 3))
        cores = sorted(rng.choice(n, int(rng.integers(n + 1)), replace=False).tolist())
        again = rng.integers(-1, known + 2, int(rng.integers(3))).tolist()
        made = block(
            author,
            base if n else 0,
            xyz,
            alive=rng.random(n) < 0.85,
            parents=parents if rng.random() < 0.9 else None,
            cores=cores,
            sightings=[(k, cycles[author] + int(rng.integers(-1, 2))) for k in again],
            origin=xyz // 2 + rng.integers(-2000, 2000, 3) * int(rng.integers(3)) // 2,
        )
        made.cycle[:] = np.sort(cycles[author] + rng.integers(0, 2, len(made.cycle)))
        numbers[author] = known if n else numbers[author]
        out.append(made)
    return out


def listed(fold: Fold) -> list[Any]:
    return list(zip(*(column.tolist() for column in fold.columns().columns()), strict=True))


def state_of(fold: Fold) -> list[bytes]:
    """Every byte that a fold answers with, and what it keeps of the authors."""
    inside: Any = fold
    store = inside._graph if isinstance(fold, PaperFold) else inside._nodes
    entries = store.entries[: int(store.sizes[1])]
    per_node = [store.first[: len(fold)]]
    if isinstance(fold, PaperFold):
        per_node += [store.hits, store.misses, store.witnesses]
        entries = np.append(entries, [p for row in fold.parents().tolist() for p in row if p >= 0])
    arrays = [*fold.columns().columns(), *(fold.feature_nodes(a) for a in range(4))]
    return [a.tobytes() for a in [*arrays, *(p[: len(fold)] for p in per_node), entries]]


def naive(config: FoldConfig, blocks: list[Block]) -> NaiveMap:
    return (naive_paper if config.preset == "paper" else naive_default)(config, blocks)


def applied(config: FoldConfig, blocks: list[Block], salt: int = SALT) -> Fold:
    fold = make_fold(config, salt)
    for one in blocks:
        fold.apply(one)
    return fold


def no_rays() -> RayEvidence:
    return RayEvidence(DEFAULT.cell_mm, DEFAULT.max_ray_mm)


def verdicts(verdict: Verdict) -> list[Any]:
    return list(zip(*(column.tolist() for column in verdict.columns()), strict=True))


def assert_same(config: FoldConfig, fold: Fold, blocks: list[Block]) -> None:
    twin = naive(config, blocks)
    expected = [
        (list(s), list(o), count, list(c), colored)
        for s, o, count, c, colored in (node.columns() for node in twin.nodes)
    ]
    assert listed(fold) == [tuple(row) for row in expected]
    for author in range(4):
        assert fold.feature_nodes(author).tolist() == twin.features.get(author, [])
    rays = None if config.preset == "paper" else NaiveRays(100, 1000)
    assert verdicts(fold.evaluate(no_rays())) == naive_verdict(config, twin, rays)
    if isinstance(fold, PaperFold):
        parents = [[p for p in row if p >= 0] for row in fold.parents().tolist()]
        assert parents == [node.parents for node in twin.nodes]


@BOTH
@SOME
@given(blocks=stories())
def test_fold_equals_its_twin(config: FoldConfig, blocks: list[Block]) -> None:
    fold = make_fold(config, SALT)
    for i, one in enumerate(blocks):
        fold.apply(one)
        if i % 3 == 2 or i == len(blocks) - 1:
            assert_same(config, fold, blocks[: i + 1])


@BOTH
@SOME
@given(blocks=stories(most=10), data=st.data())
def test_undo_is_the_exact_inverse(
    config: FoldConfig, blocks: list[Block], data: st.DataObject
) -> None:
    states = [state_of(applied(config, blocks[:i])) for i in range(len(blocks) + 1)]
    fold, done = make_fold(config, SALT), 0
    while done < len(blocks):
        fold.apply(blocks[done])
        done += 1
        assert state_of(fold) == states[done]
        if data.draw(st.integers(0, 3)) == 0:
            depth = data.draw(st.integers(0, done))
            for _ in range(depth):
                done -= 1
                fold.undo(blocks[done])
                assert state_of(fold) == states[done]
        if data.draw(st.integers(0, 30)) == 0:
            break


@FEW
@given(blocks=stories(most=6), repeats=st.integers(1, 3), author=st.integers(0, 2))
def test_settled_is_what_was_said_often_enough(
    blocks: list[Block], repeats: int, author: int
) -> None:
    """By the author itself, or once where enough others say it too."""
    fold = applied(DEFAULT, blocks)
    seen = np.concatenate([np.zeros((1, 3), np.int32), *(b.xyz for b in blocks)])
    wanted = [naive_settled(DEFAULT, blocks, author, p, repeats) for p in points(seen)]
    assert fold.settled(author, seen, repeats).tolist() == wanted


def test_algorithm_2_wants_to_hear_everything() -> None:
    blocks = [block(0, 0, [(0, 0, 0)] * 3), block(1, 0, [(0, 0, 0)])]
    fold = applied(PAPER, blocks)
    assert not fold.settled(0, blocks[0].xyz, 1).any()


@BOTH
def test_many_nodes(config: FoldConfig) -> None:
    """Buckets and columns grow, also between undo and redo."""
    rng = np.random.default_rng(5)
    blocks = []
    for k in range(6):
        parents = rng.integers(-1, 60 * (k // 2) + np.arange(60)[:, None] + 1, (60, 2)) - 1
        where = rng.integers(-300, 300, (60, 3))
        blocks.append(block(k % 2, 60 * (k // 2), where, parents=parents, cores=range(9, 60, 10)))
    fold = applied(config, blocks[:2])
    states = [state_of(fold)]
    for one in blocks[2:]:
        fold.apply(one)
        states.append(state_of(fold))
    assert_same(config, fold, blocks)
    for one in blocks[:1:-1]:
        assert state_of(fold) == states.pop()
        fold.undo(one)
    assert state_of(fold) == states[0]
    for one in blocks[2:]:
        fold.apply(one)
    assert_same(config, fold, blocks)


@BOTH
@FEW
@given(blocks=stories(most=6))
def test_nothing_depends_on_salt_or_numbering(config: FoldConfig, blocks: list[Block]) -> None:
    first = applied(config, blocks, salt=1)
    renamed = [replace(one, author=(one.author + 2) % 3) for one in blocks]
    for other, shift in ((applied(config, blocks, salt=2), 0), (applied(config, renamed), 2)):
        assert listed(other) == listed(first)
        assert verdicts(other.evaluate(no_rays())) == verdicts(first.evaluate(no_rays()))
        for author in range(3):
            mine = first.feature_nodes(author).tolist()
            assert other.feature_nodes((author + shift) % 3).tolist() == mine


def test_a_twin_is_the_nearest_seed_within_delta() -> None:
    fold = applied(DEFAULT, [block(0, 0, [(0, 0, 0), (90, 0, 0), (45, 0, 0), (0, 50, 0)])])
    assert fold.feature_nodes(0).tolist() == [0, 1, 0, 0]  # tie to the lower id; exactly delta
    fold.apply(block(0, 4, [(0, 51, 0), (0, 0, -51), (46, 0, 0)]))
    assert fold.feature_nodes(0).tolist()[4:] == [2, 3, 1]


def test_a_hit_counts_once_per_author_and_cycle() -> None:
    blocks = [
        block(0, 0, [(0, 0, 0), (1, 0, 0)], cycle=5),
        block(0, 2, [(2, 0, 0)], cycle=5, sightings=[(0, 5), (0, 6), (1, 6), (9, 7), (-1, 7)]),
        block(1, 0, [(3, 0, 0)], cycle=2),
        block(0, 3, [(0, 0, 1)], cycle=4),  # an older cycle, late
    ]
    config = FoldConfig(delta=0.05, hit_say=100)
    verdict = applied(config, blocks).evaluate(no_rays())
    assert verdicts(verdict) == [(3, 0, 2, State.CONFIRMED)]  # cycles 5 and 6, and author 1
    assert applied(config, blocks).columns().count.tolist() == [5]


def test_each_author_has_a_bounded_say() -> None:
    """Two liars' rays do not outvote what three saw, nor do many hits of one author count."""
    config = FoldConfig(delta=0.05, hit_say=1, miss_say=1, doubt=1000)  # every miss counts
    seen = [block(a, k, [(0, 0, 0)], cycle=k) for a in (0, 1, 2) for k in range(4)]
    rays = no_rays()
    for _ in range(9):
        for liar in (3, 4):
            walk(rays, liar, [(-150, 0, 0)], [0, 1], [(350, 0, 0)])
    assert verdicts(applied(config, seen).evaluate(rays)) == [(3, 2, 3, State.CONFIRMED)]
    walk(rays, 5, [(-150, 0, 0)], [0, 1], [(350, 0, 0)])
    assert verdicts(applied(config, seen).evaluate(rays)) == [(3, 3, 3, State.REJECTED)]
    assert verdicts(applied(config, seen[:1]).evaluate(no_rays())) == [(1, 0, 1, State.TENTATIVE)]


@given(value=st.integers(1, 1 << 31))
@SOME
def test_logarithms_are_whole_and_exact(value: int) -> None:
    assert log2_16(np.array([value])).tolist() == [naive_log2(value)]
    assert log2_16(np.array([1, 2, 3, 4, 1 << 20])).tolist() == [0, 16, 25, 32, 320]


def lone(x: int) -> tuple[int, int, int]:
    return (x, 50, 50)


def seen_from_afar(author: int, base: int, xyz: Any, rays: RayEvidence) -> Block:
    """Points seen from the origin, their rays walked too."""
    walk(rays, author, [(0, 50, 50)], [0, len(xyz)], xyz)
    return block(author, base, xyz, cycle=base, origin=[(0, 50, 50)] * len(xyz))


def test_a_lone_point_falls_to_a_ray_and_a_supported_one_does_not() -> None:
    config = FoldConfig(delta=0.03, cell=0.1, max_ray=5.0)
    rays = RayEvidence(config.cell_mm, config.max_ray_mm)
    wall = [(1250, 50 + 31 * y, 50 + 31 * z) for y in range(-3, 4) for z in range(-3, 4)]
    fold = applied(config, [seen_from_afar(0, 0, [lone(1250)], rays)])
    assert fold.evaluate(rays).states.tolist() == [State.TENTATIVE]  # nothing speaks against it
    walk(rays, 1, [(0, 50, 50)], [0, 1], [lone(2000)])
    assert verdicts(fold.evaluate(rays)) == [(1, 1, 1, State.REJECTED)]
    rays = RayEvidence(config.cell_mm, config.max_ray_mm)
    fold = applied(config, [seen_from_afar(0, 0, wall, rays)])
    walk(rays, 1, [(0, 50, 50)], [0, 1], [lone(2000)])
    assert set(fold.evaluate(rays).states.tolist()) == {State.TENTATIVE}


def test_what_lies_behind_a_wall_is_not_believed() -> None:
    config = FoldConfig(delta=0.03, cell=0.1, max_ray=5.0)
    rays = RayEvidence(config.cell_mm, config.max_ray_mm)
    wall = [(1050, 50 + 31 * y, 50 + 31 * z) for y in range(-3, 4) for z in range(-3, 4)]
    fold = applied(config, [seen_from_afar(0, 0, wall, rays)])
    fold.apply(seen_from_afar(1, 0, [lone(1450)], rays))
    verdict = fold.evaluate(rays)
    assert verdict.states[-1] == State.REJECTED and verdict.misses[-1] >= 1
    assert set(verdict.states[:-1].tolist()) == {State.TENTATIVE}


@pytest.mark.parametrize("liars", [1, 2, 3])
def test_liars_do_not_outvote_one_honest_witness_more(liars: int) -> None:
    """However often they walk rays through it and put walls before it."""
    config = FoldConfig(delta=0.03, cell=0.1, max_ray=5.0)
    rays = RayEvidence(config.cell_mm, config.max_ray_mm)
    fold = make_fold(config, SALT)
    for honest in range(liars + 1):
        fold.apply(seen_from_afar(honest, 0, [lone(1250)], rays))
    for k in range(200):
        liar = liars + 1 + k % liars
        walk(rays, liar, [(0, 50, 50)], [0, 1], [lone(2000)])
        walk(rays, liar, [(0, 50, 50)], [0, 3], [lone(650), lone(750), lone(850)])
    verdict = fold.evaluate(rays)
    assert verdict.hits.tolist() == [liars + 1] and verdict.misses.tolist() == [liars]
    assert verdict.states.tolist() == [State.CONFIRMED]


def test_the_record_of_a_witness_tells_on_what_nobody_contradicts() -> None:
    """A robot whose lone points are contradicted elsewhere is not believed about a lone point."""
    config = FoldConfig(delta=0.03, cell=0.1, max_ray=5.0, witnesses=1)
    rays = RayEvidence(config.cell_mm, config.max_ray_mm)
    aside = (50, 1250, 50)
    fold = applied(config, [block(0, 0, [aside], origin=[(0, 50, 50)])])
    assert fold.evaluate(rays).states.tolist() == [State.CONFIRMED]
    bad = [lone(550 + 200 * k) for k in range(6)]
    fold.apply(block(0, 1, bad, origin=[(0, 50, 50)] * 6))
    walk(rays, 1, [(0, 50, 50)], [0, 1], [lone(2550)])
    verdict = fold.evaluate(rays)
    assert verdict.states.tolist() == [State.REJECTED] * 7
    assert verdict.misses.tolist() == [1] * 7
    fold.apply(block(1, 0, [aside], origin=[(0, 50, 50)]))  # a reliable one has seen it too
    assert fold.evaluate(rays).states[0] == State.CONFIRMED


def test_somebody_who_walked_by_is_gone_and_what_was_seen_often_stays() -> None:
    """A dense patch of one cycle, in space that others then see through."""
    config = FoldConfig(delta=0.03, cell=0.1, max_ray=5.0)
    patch = [(1250 + (y * z) % 3, 50 + 31 * y, 50 + 31 * z) for y in range(5) for z in range(5)]
    for cycles, state in ((1, State.REJECTED), (2, State.REJECTED), (3, State.TENTATIVE)):
        rays = RayEvidence(config.cell_mm, config.max_ray_mm)
        fold = make_fold(config)
        for k in range(cycles):
            fold.apply(seen_from_afar(0, 25 * k, patch, rays))
        for _ in range(8):
            through = [(2 * x, 2 * y - 50, 2 * z - 50) for x, y, z in patch]
            walk(rays, 1, [(0, 50, 50)], [0, 25], through)
        assert set(fold.evaluate(rays).states.tolist()) == {state}


def test_feet_go_with_the_body_and_what_lasts_beside_them_stays() -> None:
    """No ray comes through the feet, nor through the desk; but the feet were seen with the body."""
    config = FoldConfig(delta=0.03, cell=0.1, max_ray=5.0)
    body = [(1250, 50 + 31 * y, 50 + 31 * z) for y in range(4) for z in range(4)]
    feet = [(1250, 50 + 31 * y, -150) for y in range(4)]
    desk = [(1250, 230 + 31 * y, -150) for y in range(4)]
    rays, fold, blocks = RayEvidence(config.cell_mm, config.max_ray_mm), make_fold(config), []
    naive_rays = NaiveRays(config.cell_mm, config.max_ray_mm)
    alive, base = np.ones(20, np.bool_), 0
    for cycle, seen in enumerate([body + feet, desk, desk, desk]):
        blocks.append(block(0, base, seen, cycle=cycle, origin=[(0, 50, 50)] * len(seen)))
        fold.apply(blocks[-1])
        ray = (0, [(0, 50, 50)], [0, len(seen)], seen)
        walk(rays, *ray)
        naive_rays.walk(0, [(0, 50, 50)], [0, len(seen)], seen, alive[: len(seen)].tolist(), 1)
        base += len(seen)
    for _ in range(4):
        through = [(2 * x, 2 * y - 50, 2 * z - 50) for x, y, z in body]
        walk(rays, 1, [(0, 50, 50)], [0, 16], through)
        naive_rays.walk(1, [(0, 50, 50)], [0, 16], through, [True] * 16, 1)
    states = fold.evaluate(rays).states.tolist()
    assert states == [State.REJECTED] * 20 + [State.TENTATIVE] * 4
    twin = naive_verdict(config, naive_default(config, blocks), naive_rays)
    assert [state for *_, state in twin] == states


def test_support_that_ends_in_the_cell_counts_against_the_own_misses() -> None:
    rays = no_rays()
    fold = applied(EAGER, [block(0, 0, [(10, 10, 10)])])
    walk(rays, 0, [(-150, 10, 10)], [0, 1], [(20, 20, 20)])
    walk(rays, 0, [(-150, 10, 10)], [0, 1], [(250, 10, 10)])
    assert fold.evaluate(rays).misses.tolist() == [0]  # passed once, ended once
    walk(rays, 0, [(-150, 10, 10)], [0, 1], [(250, 10, 10)])
    assert fold.evaluate(rays).misses.tolist() == [1]
    walk(rays, 0, [(-150, 10, 10)], [0, 2], [(250, 10, 10), (30, 30, 30)])  # one transaction: ended
    assert fold.evaluate(rays).misses.tolist() == [0]
    walk(rays, 0, [(-150, 10, 10)], [0, 1], [(20, 20, 20)])
    assert fold.evaluate(rays).misses.tolist() == [0]  # ended more often than passed


@BOTH
def test_empty_blocks_and_views(config: FoldConfig) -> None:
    fold = make_fold(config, SALT)
    nothing = block(3, 0, [])
    fold.apply(nothing)
    assert len(fold) == 0 and fold.feature_nodes(3).tolist() == []
    assert verdicts(fold.evaluate(no_rays())) == []
    first = block(0, 2, [(1, 2, 3)], parents=[[-1]], cores=[0])
    fold.apply(first)
    fold.apply(block(0, 0, []))  # only sightings could be in it: its base means nothing
    assert fold.feature_nodes(0).tolist() == [-1, -1, 0]
    for column in (*fold.columns().columns(), fold.feature_nodes(0)):
        with pytest.raises(ValueError, match="read-only"):
            column[:] = 0
    assert fold.nbytes > 0
    assert len(NodeColumns.empty().seed) == len(Verdict.empty().hits) == 0


@BOTH
def test_blocks_out_of_turn_are_an_error(config: FoldConfig) -> None:
    fold, one = make_fold(config), block(0, 0, [(1, 2, 3), (4, 5, 6)])
    with pytest.raises(ValueError, match="not the last block"):
        fold.undo(one)
    fold.apply(one)
    with pytest.raises(ValueError, match="folded in before"):
        fold.apply(block(0, 1, [(1, 2, 3)]))
    with pytest.raises(ValueError, match="not the last block"):
        fold.undo(block(0, 1, [(1, 2, 3), (4, 5, 6)]))
    fold.undo(one)
    assert len(fold) == 0


def test_read_only_and_strided_columns_are_taken() -> None:
    wide = np.zeros((3, 6), np.int32)
    wide[:, 2] = [0, 100, 200]
    one = block(0, 0, wide[:, ::2])
    one.xyz = wide[:, 2:5]
    one.alive.flags.writeable = False
    assert len(applied(DEFAULT, [one])) == 3


def figure_7() -> tuple[Block, Block]:
    """The paper's Figure 7: core and 8 ascendants each; of 9 pairs 5 lie within delta."""
    core = [(0, 0, 0)]
    ring = [(1000 * k, 1000, 0) for k in range(1, 9)]
    tree = [[-1, -1], [-1, -1], [0, 1], [0, -1], [2, 3], [3, -1], [4, 5], [5, 6], [6, 7]]
    mine = block(0, 0, ring + core, parents=tree, cores=[8])
    near, far = [(x + 10, y, z) for x, y, z in ring[:4]], [(x, y + 300, z) for x, y, z in ring[4:]]
    return mine, block(1, 0, [*near, *far, (0, 10, 0)], parents=tree, cores=[8])


def test_figure_7() -> None:
    mine, theirs = figure_7()
    fold = applied(PAPER, [mine])
    assert len(fold) == 9
    assert fold.evaluate(no_rays()).hits.sum() == fold.evaluate(no_rays()).misses.sum() == 0
    fold.apply(theirs)
    verdict = fold.evaluate(no_rays())
    assert len(fold) == 13
    assert verdict.hits.sum() == 5 and (verdict.hits[:9] == 1).sum() == 5
    assert verdict.misses[9:].tolist() == [1, 1, 1, 1]  # on the four new nodes
    assert verdict.misses[:9].sum() == 4  # and on the nearest losers
    assert int((verdict.witnesses == 2).sum()) == 5
    met = fold.feature_nodes(1).tolist()
    assert met == [1, 2, 3, 4, 9, 10, 11, 12, 0]  # the core came first, so it is node 0
    assert fold.parents().tolist()[9:] == [[3, 4], [4, -1], [9, 10], [10, 11]]  # ChangeParent
    fold.undo(theirs)
    assert state_of(fold) == state_of(applied(PAPER, [mine]))


def test_algorithm_2_where_the_nearest_node_has_no_ascendants() -> None:
    blocks = [block(0, 0, [(0, 0, 0)], parents=[[-1]], cores=[0])]
    blocks.append(block(1, 0, [(0, 0, 9), (0, 0, 1)], parents=[[-1], [0]], cores=[1]))
    verdict = applied(PAPER, blocks).evaluate(no_rays())
    assert verdicts(verdict) == [(0, 0, 1, State.REJECTED)] * 3  # added, neither hit nor miss


def test_algorithm_2_wants_less_than_delta() -> None:
    def pair(author: int, y: int) -> Block:
        return block(author, 0, [(0, y, 0), (500, y, 0)], parents=[[-1], [0]], cores=[1])

    for y, nodes in ((49, 2), (50, 4)):
        assert len(applied(PAPER, [pair(0, 0), pair(1, y)])) == nodes


@SOME
@given(blocks=stories(most=10))
def test_algorithm_2_closes_no_cycle(blocks: list[Block]) -> None:
    fold = applied(PAPER, blocks)
    assert isinstance(fold, PaperFold)
    left = {k: {p for p in row if p >= 0} for k, row in enumerate(fold.parents().tolist())}
    while left:
        roots = [k for k, row in left.items() if not row & left.keys()]
        assert roots
        left = {k: row for k, row in left.items() if k not in roots}


def walk(
    rays: RayEvidence | NaiveRays,
    author: int,
    origins: Any,
    starts: Any,
    xyz: Any,
    alive: Any = None,
    sign: int = 1,
) -> None:
    here = [True] * len(xyz) if alive is None else alive
    if isinstance(rays, NaiveRays):
        rays.walk(author, list(origins), list(starts), list(xyz), list(here), sign)
        return
    rays.walk(
        author,
        np.array(origins, np.int32).reshape(-1, 3),
        np.array(starts, np.int64),
        np.array(xyz, np.int32).reshape(-1, 3),
        np.array(here, np.bool_),
        sign,
    )


@st.composite
def walks(draw: st.DrawFn, most: int = 4) -> tuple[int, int, list[Any]]:
    """(cell, limit, calls); few lattice positions, so that rays run through edges and corners."""
    rng = np.random.default_rng(draw(st.integers(0, 1 << 32)))
    cell = draw(st.sampled_from([5, 10, 100, 99]))
    limit = draw(st.sampled_from([0, 1, 3 * cell, 17 * cell + 3, 40 * cell]))
    centre = draw(st.sampled_from([0, 0, LIMIT_MM - 30 * cell, -LIMIT_MM + 30 * cell]))
    pitch = draw(st.sampled_from([1, cell, max(1, cell // 2)]))
    calls = []
    for _ in range(draw(st.integers(1, most))):
        segments = int(rng.integers(1, 4))
        sizes = rng.integers(0, 4, segments)
        starts = [0, *np.cumsum(sizes).tolist()]
        reach = 30 * cell // pitch
        origins = centre + pitch * rng.integers(-reach, reach + 1, (segments, 3))
        xyz = centre + pitch * rng.integers(-reach, reach + 1, (starts[-1], 3))
        alive = rng.random(starts[-1]) < 0.9
        author = int(rng.integers(3))
        calls.append((author, points(origins), starts, points(xyz), alive.tolist()))
    return cell, limit, calls


def places(calls: list[Any], cell: int) -> Iterator[Any]:
    """Positions in and around every ray."""
    for _, origins, starts, xyz, _ in calls:
        for k, origin in enumerate(origins):
            for end in xyz[starts[k] : starts[k + 1]]:
                for part in range(0, 41, 2):
                    p = [o + (e - o) * part // 40 for o, e in zip(origin, end, strict=True)]
                    yield [min(max(v + cell * (part % 3 - 1), -LIMIT_MM), LIMIT_MM) for v in p]
        yield from xyz


def assert_same_rays(rays: RayEvidence, twin: NaiveRays, where: list[Any]) -> None:
    lowest = [tuple(c * twin.cell for c in cell) for _, cell in [*twin.passes, *twin.ends]]
    inside = [p for p in lowest if all(abs(v) <= LIMIT_MM for v in p)]
    everywhere = [tuple(p) for p in where] + inside
    passes, ends = rays.evidence(np.array(everywhere, np.int32).reshape(-1, 3))
    for author in range(rays.authors):
        cells = [twin.cell_of(p) for p in everywhere]
        assert passes[:, author].tolist() == [twin.passes[author, c] for c in cells]
        assert ends[:, author].tolist() == [twin.ends[author, c] for c in cells]


@SOME
@given(made=walks())
def test_rays_equal_their_twin(made: tuple[int, int, list[Any]]) -> None:
    cell, limit, calls = made
    rays, twin = RayEvidence(cell, limit, SALT), NaiveRays(cell, limit)
    for call in calls:
        walk(rays, *call)
        walk(twin, *call)
    assert_same_rays(rays, twin, list(places(calls, cell)))


@FEW
@given(made=walks(most=6), data=st.data())
def test_rays_commute_and_go_back_to_nothing(
    made: tuple[int, int, list[Any]], data: st.DataObject
) -> None:
    cell, limit, calls = made
    twin = NaiveRays(cell, limit)
    for call in calls[::2]:
        walk(twin, *call)
    where = np.array([p for *_, xyz, _ in calls for p in xyz], np.int32).reshape(-1, 3)
    signed = [(call, +1) for call in calls] + [(call, -1) for call in calls[1::2]]
    rays = RayEvidence(cell, limit, data.draw(st.integers(0, 1 << 64)))
    for call, sign in data.draw(st.permutations(signed)):
        walk(rays, *call, sign=sign)
    assert_same_rays(rays, twin, where.tolist())
    for call in calls[::2]:
        walk(rays, *call, sign=-1)
    assert len(rays) == 0  # not one counter is left
    assert not rays.evidence(where)[0].any() and not rays.evidence(where)[1].any()


def test_freed_memory_is_used_again() -> None:
    rays = RayEvidence(100, 5000)
    rng = np.random.default_rng(3)
    ends = rng.integers(-5000, 5000, (20 if COMPILED else 3, 3))
    walk(rays, 0, [(0, 0, 0)], [0, len(ends)], ends.tolist())
    held = rays.nbytes
    for shift in range(50 if COMPILED else 4):
        walk(rays, 0, [(0, 0, 0)], [0, len(ends)], (ends + 800 * shift).tolist(), sign=-1)
        walk(rays, 0, [(0, 0, 0)], [0, len(ends)], (ends + 800 * (shift + 1)).tolist())
    assert rays.nbytes < 2 * held


def test_growth_at_any_point_and_after_bricks_were_freed() -> None:
    rng = np.random.default_rng(11)

    def call(author: int, rays: int, reach: int) -> Any:
        ends = rng.integers(-reach, reach, (rays, 3))
        return author, [(50, -50, 50)], [0, rays], points(ends), [True] * rays

    kept, gone = call(0, 2, 4000), call(1, 6, 4000)
    for count in (3, 9, 14, 20) if COMPILED else (3, 9):
        rays, twin = RayEvidence(100, 9_000, count), NaiveRays(100, 9_000)
        walk(rays, *gone)
        many = call(2, count, 9000)
        for here in (kept, many):
            walk(rays, *here)
            walk(twin, *here)
        walk(rays, *gone, sign=-1)
        for here in (call(2, 2 * count, 9000), gone, many):
            walk(rays, *here)
            walk(twin, *here)
        assert_same_rays(rays, twin, [])


def test_counters_beyond_a_byte() -> None:
    rays = RayEvidence(100, 1000)
    call = (1, [(50, 50, 50)], [0, 1], [(350, 50, 50)])
    count = 300
    for sign in (1, -1):
        for _ in range(count):
            walk(rays, *call, sign=sign)
        passes, ends = rays.evidence(np.array([(150, 50, 50), (350, 50, 50)], np.int32))
        left = count if sign == 1 else 0
        assert passes[:, 1].tolist() == [left, 0] and ends[:, 1].tolist() == [0, left]
    for _ in range(count):
        walk(rays, *call, sign=-1)
    assert rays.evidence(np.array([(150, 50, 50)], np.int32))[0].tolist() == [[0, -count]]
    for _ in range(count):
        walk(rays, *call)
    assert len(rays) == 0


@pytest.mark.parametrize("edge", [LIMIT_MM, -LIMIT_MM])
def test_rays_from_edge_to_edge(edge: int) -> None:
    """Cut after 100 m, in the finest and in coarse cells; nothing overflows."""
    for cell, limit in ((100, 100_000), (25, 100_000), (10_000, 100_000)):
        rays, twin = RayEvidence(cell, limit), NaiveRays(cell, limit)
        straight = ((-edge, edge, edge), (edge, -edge, edge), (edge, edge, -edge))
        for end in ((-edge, -edge, -edge), (-edge, edge, 1), (edge, edge - 7, edge), *straight):
            call = (0, [(edge, edge, edge)], [0, 1], [end])
            walk(rays, *call)
            walk(twin, *call)
        assert_same_rays(rays, twin, [(edge, edge, edge), (-edge, -edge, -edge)])


def test_evidence_out_of_range_and_of_nothing() -> None:
    for cell, limit in ((0, 1), (100, -1), (100, 1 << 20), (1 << 20, 1)):
        with pytest.raises(ValueError, match="out of range"):
            RayEvidence(cell, limit)
    rays = RayEvidence(100, 1000)
    walk(rays, 4, [(0, 0, 0)], [0, 1], [(5, 5, 5)], alive=[False])
    walk(rays, 4, [], [0], [])
    assert len(rays) == 0 and rays.authors == 0
    assert rays.evidence(np.zeros((2, 3), np.int32))[0].shape == (2, 0)


@numba.njit  # type: ignore[untyped-decorator]
def root_of(value: int) -> int:
    return ceil_sqrt(value)


@given(value=st.integers(0, 1 << 62) | st.integers(0, 1 << 31).map(lambda r: r * r))
@SOME
def test_ceil_sqrt(value: int) -> None:
    for v in (value, max(value - 1, 0), value + 1):
        root = int(root_of(v))
        assert root * root >= v and (root == 0 or (root - 1) ** 2 < v)


@FEW
@given(blocks=stories(most=6), seed=st.integers(0, 1 << 32))
def test_verdict_equals_its_twin(blocks: list[Block], seed: int) -> None:
    rng = np.random.default_rng(seed)
    config = FoldConfig(
        delta=0.05,
        witnesses=int(rng.integers(1, 4)),
        hit_say=int(rng.integers(1, 4)),
        miss_say=int(rng.integers(0, 4)),
        doubt=rng.choice([None, 0, 10, 20, 36, 1000]),
        max_ray=0.4,
    )
    rays = RayEvidence(config.cell_mm, config.max_ray_mm, SALT)
    twin = NaiveRays(config.cell_mm, config.max_ray_mm)
    for one in blocks:
        if len(one.xyz) and one.alive.any():
            start = points(one.xyz[:1] + rng.integers(-300, 300, (1, 3)))
            near = [tuple(min(max(v, -LIMIT_MM), LIMIT_MM) for v in p) for p in start]
            call = (one.author, near, [0, len(one.xyz)], points(one.xyz), one.alive.tolist())
            walk(rays, *call)
            walk(twin, *call)
    fold = applied(config, blocks)
    expected = naive_verdict(config, naive_default(config, blocks), twin)
    assert verdicts(fold.evaluate(rays)) == expected
