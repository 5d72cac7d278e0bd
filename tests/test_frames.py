"""Frames: the same tree and the same integers on every robot."""

from __future__ import annotations

import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dagmap.frames import place_frames
from dagmap.kernels.geometry import apply_pose, compose, invert
from dagmap.model import FLEET_FRAME, LIMIT_MM, FrameId, pose_matrix, quantise_pose
from dagmap.payload import CERTAIN, Link
from scene import pose

A, B, C, D = (FrameId(bytes([n]) * 8) for n in (1, 2, 3, 4))


def both(source: FrameId, target: FrameId, inliers: int, x: float = 0.0) -> list[Link]:
    """What both ends say, alike."""
    return [link(source, target, inliers, x), link(target, source, inliers, -x)]


def link(source: FrameId, target: FrameId, inliers: int, x: float = 0.0, yaw: float = 0.0) -> Link:
    return Link(source, target, quantise_pose(pose(x, 0, 0, yaw)), inliers)


def test_the_lowest_author_is_the_origin() -> None:
    placed = place_frames([link(B, A, 5, 1.0), link(C, B, 5, 1.0)])
    assert {frame: origin for frame, (origin, _) in placed.items()} == dict.fromkeys([A, B, C], A)
    assert placed[C][1][4:].tolist() == [2000, 0, 0]
    with_fleet = place_frames([link(B, A, 5, 1.0), link(A, FLEET_FRAME, 1, 10.0)])
    assert with_fleet[B][0] == FLEET_FRAME and with_fleet[B][1][4] == 11000


def start(frame: FrameId, x: float, sigma_mm: int) -> Link:
    return link(frame, FLEET_FRAME, CERTAIN - sigma_mm, x)


def test_a_rough_start_is_refined_by_what_was_measured() -> None:
    rough = [start(A, 0.0, 50), start(B, 2.0, 50), start(C, 9.0, 20)]
    merged = place_frames(rough)
    assert [merged[frame][1][4] for frame in (A, B, C)] == [0, 2000, 9000]
    refined = place_frames([*rough, *both(B, A, 40, 2.06), *both(B, C, 40, -7.0)])
    assert {refined[frame][0] for frame in (A, B, C)} == {FLEET_FRAME}
    # the least uncertain start counts, the others follow by what was measured
    assert [refined[frame][1][4] for frame in (A, B, C)] == [-60, 2000, 9000]
    exact = place_frames([*rough[1:], start(A, 0.0, 0), *both(B, A, 40, 2.06)])
    assert [exact[frame][1][4] for frame in (A, B)] == [0, 2060]


def test_a_link_far_from_the_configured_starts_is_not_used() -> None:
    rough = [start(A, 0.0, 50), start(B, 2.0, 50)]
    for x, expected in ((2.59, 2590), (2.61, 2000)):  # 300 mm and three times 50 mm at each end
        assert place_frames([*rough, *both(B, A, 90, x)])[B][1][4] == expected
    assert place_frames([*rough, link(B, A, 90, 2.1)])[B][1][4] == 2000  # one end's word alone


def test_components_stay_apart_until_a_link_joins_them() -> None:
    links = [*both(B, A, 5), *both(D, C, 5)]
    placed = place_frames(links)
    assert placed[B][0] == A and placed[D][0] == C
    joined = place_frames([*links, *both(C, B, 1, 3.0)])
    assert joined[D][0] == A and joined[D][1][4] == 3000


def test_the_tree_takes_the_best_links() -> None:
    links = [*both(B, A, 9, 1.0), *both(C, A, 2, 100.0), *both(C, B, 8, 1.0)]
    assert place_frames(links)[C][1][4] == 2000


@given(st.randoms(use_true_random=False))
@settings(max_examples=30, deadline=None)
def test_the_order_of_links_does_not_matter(rng: random.Random) -> None:
    frames = [FrameId(bytes([n]) * 8) for n in range(6)]
    links = [
        link(*rng.sample(frames, 2), rng.randint(1, 3), rng.uniform(-5, 5), rng.uniform(-3, 3))
        for _ in range(9)
    ]
    shuffled = links[:]
    rng.shuffle(shuffled)
    one, two = place_frames(links), place_frames(shuffled)
    assert one.keys() == two.keys()
    assert all(one[f][0] == two[f][0] and np.array_equal(one[f][1], two[f][1]) for f in one)


def matrices(seed: int) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(seed)
    out = np.eye(4)
    out[:3, :3] = Rotation.random(rng=rng).as_matrix()
    out[:3, 3] = rng.uniform(-50, 50, 3)
    return out


@pytest.mark.parametrize("seed", range(30))
def test_poses_agree_with_floating_point_to_the_rounding(seed: int) -> None:
    one, two = matrices(seed), matrices(100 + seed)
    a, b = quantise_pose(one), quantise_pose(two)
    assert np.allclose(pose_matrix(a), one, atol=6e-4)
    assert np.allclose(pose_matrix(compose(a, b)), one @ two, atol=2e-3)
    assert np.allclose(pose_matrix(invert(a)), np.linalg.inv(one), atol=2e-3)
    points = np.random.default_rng(seed).integers(-90_000, 90_000, (200, 3)).astype(np.int32)
    out, inside = np.empty_like(points), np.ones(200, np.bool_)
    apply_pose(a, points, out, inside)
    exact = points @ one[:3, :3].T + one[:3, 3] * 1000
    assert inside.all() and np.abs(out - exact).max() <= 1.01


def test_poses_are_applied_exactly_as_in_unbounded_integers() -> None:
    rng = np.random.default_rng(1)
    for seed in range(20):
        a = quantise_pose(matrices(seed))
        w, x, y, z, *t = a.tolist()
        one = 1 << 60
        rows = [
            [one - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), one - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), one - 2 * (x * x + y * y)],
        ]
        rounded = [[(v + (1 << 29)) >> 30 for v in row] for row in rows]
        points = rng.integers(-LIMIT_MM, LIMIT_MM + 1, (50, 3)).astype(np.int32)
        out, inside = np.empty_like(points), np.ones(50, np.bool_)
        apply_pose(a, points, out, inside)
        for i, point in enumerate(points.tolist()):
            moved = [
                ((sum(r * p for r, p in zip(row, point, strict=True)) + (1 << 29)) >> 30) + shift
                for row, shift in zip(rounded, t, strict=True)
            ]
            assert inside[i] == (max(map(abs, moved)) <= LIMIT_MM)
            assert out[i].tolist() == (moved if inside[i] else [0, 0, 0])
