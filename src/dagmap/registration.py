"""The rigid motion between two clouds of described points: match, sample, fit, judge.

Coordinates are float64 millimetres here: what comes out is a proposal that its finder signs, and
nothing that robots must compute alike. The same input gives the same output all the same. What
takes long is a generator: it yields what it has done in units of about half a millisecond, so that
it can go on in a later tick, and returns its result.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from .kernels.hamming import nearest
from .model import Bools, Floats, Int32s, Int64s, Uint8s

FAR = 64  # bits of 256 in which the descriptors of one thing differ at most
RATIO = 0.9  # Lowe's test: the best match is so much nearer than the second
SAMPLES = 400  # triples that are tried
FACING = 64  # pairs of keyframes that are looked at for a proposal
SHARED = 5  # points of two keyframes that agree, so that the pair counts
RIVALS = 4  # pairs of keyframes in which another placement is looked for
WIDE = 4  # times the tolerance: reach of the first look at a proposal
LOOKS = 5  # at a proposal, at most; fewer where a look adds less than a tenth to the last one
BLUNT = 0.6  # of the fit: more than that beside the place is no fit
_OPPOSITE = 3.0  # cost of two keyframes that cannot show the same
_PAIRS = 1000  # of points that triples are drawn from; of more the nearest, or every n-th
_RIVALING = 256  # described points of a keyframe in which rivals are looked for
_CLOUD = 4000  # points of a cloud that its fit is tested with; of more every n-th
_COMPARED = 40_000  # pairs of descriptors that a unit compares, and in the same time
_FITTED = 40  # pairs of points that triples are tried on, or
_DILATED = 80  # points whose cells are entered, or
_LOOKED_UP = 4000  # points that are looked up
_SHORT = 4  # times the tolerance: sides of a triple that fix a rotation

Matches = npt.NDArray[np.int64]  # (M, 2) rows of the one and of the other cloud
T = TypeVar("T")
Working: TypeAlias = Generator[int, None, T]  # yields units of work


def match(one: Uint8s, other: Uint8s) -> Matches:
    """(M, 2) rows of descriptors (N, 32) that are each other's nearest, by the ratio test.

    The nearest ones come first.
    """
    nowhere = np.zeros((max(len(one), len(other)), 3), np.int32)
    return _matched(one, other, nowhere, nowhere, -1, RATIO)


def match_near(
    one: Uint8s, other: Uint8s, here: Floats, there: Floats, reach: float, ratio: float
) -> Matches:
    """The same among points (N, 3) mm that lie within `reach` of each other.

    What looks alike elsewhere does not count, so a small reach needs no ratio test: 1.
    """
    return _matched(one, other, _rounded(here), _rounded(there), round(reach), ratio)


def compared(one: Uint8s, other: Uint8s) -> int:
    """What matching descriptors (N, 32) with (M, 32) costs, in units."""
    return 1 + len(one) * len(other) // _COMPARED


def _rounded(points: Floats) -> Int32s:
    return np.floor(points + 0.5).astype(np.int32)


def _words(descriptors: Uint8s) -> Int64s:
    return np.ascontiguousarray(descriptors).view(np.int64).reshape(-1, 4)


def _matched(
    one: Uint8s, other: Uint8s, here: Int32s, there: Int32s, reach: int, ratio: float
) -> Matches:
    n, m = len(one), len(other)
    best, first, second = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    back = np.empty(m, np.int64)
    nearest(_words(one), _words(other), here, there, reach, best, first, second, back)
    rows = np.flatnonzero((best >= 0) & (first <= FAR) & (first <= ratio * second))
    rows = rows[back[best[rows]] == rows]
    found = np.stack([rows, best[rows]], axis=1)
    return np.asarray(found[np.argsort(first[rows], kind="stable")], np.int64)


def fit(source: Floats, target: Floats) -> Floats:
    """(..., 4, 4) the rigid motions that carry (..., N, 3) best onto their targets (Kabsch)."""
    middle, aim = source.mean(axis=-2, keepdims=True), target.mean(axis=-2, keepdims=True)
    u, _, vt = np.linalg.svd(np.swapaxes(source - middle, -1, -2) @ (target - aim))
    turn = np.swapaxes(u @ vt, -1, -2)
    u[..., :, -1] *= np.where(np.linalg.det(turn) < 0, -1.0, 1.0)[..., None]  # never a mirror
    turn = np.swapaxes(u @ vt, -1, -2)
    out = np.zeros((*source.shape[:-2], 4, 4))
    out[..., :3, :3] = turn
    out[..., :3, 3] = (aim - middle @ np.swapaxes(turn, -1, -2))[..., 0, :]
    out[..., 3, 3] = 1.0
    return out


def carry(pose: Floats, points: Floats) -> Floats:
    """(..., N, 3) points through poses (..., 4, 4)."""
    turned = points @ np.swapaxes(pose[..., :3, :3], -1, -2)
    return np.asarray(turned + pose[..., None, :3, 3])


def inverse(pose: Floats) -> Floats:
    """(4, 4) the motion that undoes a rigid one."""
    out = np.eye(4)
    out[:3, :3] = pose[:3, :3].T
    out[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return out


def register(source: Floats, target: Floats, tolerance: float) -> tuple[Floats, Bools] | None:
    """The motion (4, 4) that most of the paired points (N, 3) agree on, and which ones do (N,).

    None where no three of them agree. Triples are drawn by a generator of fixed seed.
    """
    triples = _triples(source, target, tolerance)
    if len(triples) == 0:
        return None
    poses = fit(source[triples], target[triples])
    off = np.linalg.norm(carry(poses, source[None]) - target[None], axis=-1)
    inliers = off <= tolerance
    best = int(inliers.sum(axis=1).argmax())
    return refine(source, target, inliers[best], tolerance)


def refine(
    source: Floats, target: Floats, inliers: Bools, tolerance: float
) -> tuple[Floats, Bools] | None:
    """Fit again to those that agree until these stay the same."""
    for _ in range(10):
        if inliers.sum() < 3:
            return None
        pose = fit(source[inliers], target[inliers])
        before, inliers = inliers, residuals(pose, source, target) <= tolerance
        if np.array_equal(before, inliers):
            break
    return (pose, inliers) if inliers.sum() >= 3 else None


def small(change: Floats, centre: Floats) -> Floats:
    """(4, 4) of a turn (3,) rad about a place, and a shift (3,)."""
    angle = float(np.linalg.norm(change[:3]))
    out = np.eye(4)
    if angle > 1e-12:
        x, y, z = change[:3] / angle
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        out[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    out[:3, 3] = centre - out[:3, :3] @ centre + change[3:]
    return out


def residuals(pose: Floats, source: Floats, target: Floats) -> Floats:
    """(N,) how far a pose leaves the points from their targets."""
    return np.asarray(np.linalg.norm(carry(pose, source) - target, axis=-1))


def spread(points: Floats) -> Floats:
    """(3,) standard deviations along the principal axes, the largest first."""
    lengths = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return np.asarray(lengths / np.sqrt(len(points)), np.float64)


def _triples(source: Floats, target: Floats, tolerance: float) -> Int64s:
    """(T, 3) rows whose triangles are alike in both clouds, and large enough to fix a rotation."""
    if len(source) < 3:
        return np.zeros((0, 3), np.int64)
    rows = np.random.default_rng(0).integers(0, len(source), (SAMPLES, 3))
    sides = ((0, 1), (1, 2), (2, 0))
    good = np.ones(len(rows), np.bool_)
    for a, b in sides:
        here = np.linalg.norm(source[rows[:, a]] - source[rows[:, b]], axis=1)
        there = np.linalg.norm(target[rows[:, a]] - target[rows[:, b]], axis=1)
        good &= (np.abs(here - there) <= 2 * tolerance) & (here >= _SHORT * tolerance)
    return np.asarray(rows[good], np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Keyframes of one SLAM frame: sensor poses (K, 4, 4), and of each its described points."""

    poses: Floats
    points: list[Floats]  # (N, 3) mm in the SLAM frame
    descriptors: list[Uint8s]  # (N, 32)
    depth: float  # mm, median distance of a point from its sensor


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What speaks for a proposed motion.

    pose: the proposal, fitted to all points that agree; inliers: how many pairs of points that look
    alike agree on it.
    spread: (3,) mm of the agreeing points. sharp: whether the clouds fit there, and clearly less
    well wherever they are pushed or turned a little. centre, radius: of the agreeing points.
    """

    pose: Floats
    inliers: int = 0
    spread: Floats = field(default_factory=lambda: np.zeros(3))
    sharp: bool = False
    centre: Floats = field(default_factory=lambda: np.zeros(3))  # in the source frame
    radius: float = 0.0
    best: tuple[tuple[int, int], ...] = ()

    @property
    def independent(self) -> int:
        """How many pairs of keyframes have agreeing points and no keyframe in common."""
        return len(self.best)

    @property
    def weight(self) -> float:
        """How well the points that agree fix a rotation, the worst axis first: mm^2."""
        return float(self.inliers * (self.spread[1] ** 2 + self.spread[2] ** 2))

    def apart(self, one: Floats, other: Floats) -> float:
        """How far two poses carry the agreeing points apart at most, mm, about."""
        shift = np.linalg.norm(carry(one, self.centre[None]) - carry(other, self.centre[None]))
        turn = np.linalg.norm(one[:3, :3] - other[:3, :3], 2)
        return float(shift + self.radius * turn)


def judge(here: Views, there: Views, pose: Floats, tolerance: float) -> Working[Evidence]:
    """What speaks for a motion that carries `here` into `there`.

    A proposal rests on a small part of a picture, so it is off far from there. The first look is
    wide, by the ratio test; later ones see what lies near under the pose of the one before.
    """
    pose = yield from _widened(here, there, pose, tolerance)
    agreed = 0
    for _ in range(LOOKS - 1):
        pairs, source, target, sizes = yield from _seen(here, there, pose, tolerance, False)
        everything = np.ones(len(source), np.bool_)
        refined = refine(source, target, everything, 0.75 * tolerance)
        yield 1
        if refined is None:
            return Evidence(pose)
        pose, inliers = refined
        before, agreed = agreed, int(inliers.sum())
        if 10 * agreed <= 11 * before:
            break
    bounds = np.cumsum([0, *sizes])
    each = [int(inliers[a:b].sum()) for a, b in pairwise(bounds)]
    agree = source[inliers]
    centre, wide = agree.mean(axis=0), spread(agree)
    shown = [pair for pair, size in zip(pairs, each, strict=True) if size]
    sharp = yield from _sharp(
        np.concatenate([here.points[i] for i in sorted({i for i, _ in shown})]),
        np.concatenate([there.points[j] for j in sorted({j for _, j in shown})]),
        pose,
        carry(pose, centre[None])[0],
        tolerance,
    )
    radius = float(np.linalg.norm(wide))
    best = _independent(pairs, each)
    return Evidence(pose, agreed, wide, sharp, centre, radius, best)


def _widened(here: Views, there: Views, pose: Floats, tolerance: float) -> Working[Floats]:
    """The motion near a proposal that most of what looks alike there agrees on."""
    _, source, target, _ = yield from _seen(here, there, pose, tolerance, True)
    step = 1 + len(source) // _PAIRS
    found = register(source[::step], target[::step], tolerance)
    yield 1 + min(len(source), _PAIRS) // _FITTED
    return pose if found is None else found[0]


def _seen(
    here: Views, there: Views, pose: Floats, tolerance: float, wide: bool
) -> Working[tuple[list[tuple[int, int]], Floats, Floats, list[int]]]:
    """Keyframes that face each other, their points that look alike (N, 3), and how many of each."""
    pairs = facing(here, there, pose)
    found = [(np.zeros((0, 3)), np.zeros((0, 3)))]
    for i, j in pairs:
        found.append(agreeing(here, there, i, j, pose, tolerance, wide))
        yield compared(here.descriptors[i], there.descriptors[j])
    sizes = [len(source) for source, _ in found[1:]]
    source, target = (np.concatenate([pair[k] for pair in found]) for k in range(2))
    return pairs, source, target, sizes


def rivals(here: Views, there: Views, found: Evidence, tolerance: float) -> Working[list[Floats]]:
    """Other motions (4, 4) that the same keyframes might agree on, were it not for the found one.

    Matched without the ratio test: where the world repeats itself a point has several likenesses.
    """
    out = []
    for i, j in found.best[:RIVALS]:
        one, other = here.descriptors[i][:_RIVALING], there.descriptors[j][:_RIVALING]
        words = one.view(np.uint64), other.view(np.uint64)
        apart = np.bitwise_count(words[0][:, None] ^ words[1][None]).sum(axis=2)
        rows, columns = np.nonzero(apart <= FAR)
        source, target = here.points[i][rows], there.points[j][columns]
        others = np.flatnonzero(residuals(found.pose, source, target) > 2 * tolerance)
        nearest_first = np.argsort(apart[rows, columns][others], kind="stable")
        others = others[nearest_first[:_PAIRS]]
        if len(others) >= SHARED:
            motion = register(source[others], target[others], tolerance)
            if motion is not None and motion[1].sum() >= SHARED:
                out.append(motion[0])
        yield 1 + compared(one, other) + len(others) // _FITTED
    return out


def facing(here: Views, there: Views, pose: Floats) -> list[tuple[int, int]]:
    """Pairs of keyframes that should show the same, by place and direction; the nearest first."""
    places = carry(pose, here.poses[:, :3, 3])
    away = np.linalg.norm(places[:, None] - there.poses[None, :, :3, 3], axis=2)
    turned = pose[:3, :3] @ here.poses[:, :3, :3]
    cosine = (np.einsum("aij,bij->ab", turned, there.poses[:, :3, :3]) - 1) / 2
    cost = away / max(there.depth, 1.0) + 2 * (1 - cosine)
    order = np.argsort(cost, axis=None, kind="stable")[:FACING]
    order = order[cost.ravel()[order] < _OPPOSITE]
    return [(int(i) // len(there.poses), int(i) % len(there.poses)) for i in order]


def agreeing(
    here: Views, there: Views, i: int, j: int, pose: Floats, tolerance: float, wide: bool
) -> tuple[Floats, Floats]:
    """Points of two keyframes that look alike and come to lie together."""
    placed = carry(pose, here.points[i])
    one, other = here.descriptors[i], there.descriptors[j]
    reach, ratio = (WIDE * tolerance, RATIO) if wide else (tolerance, 1.0)
    rows = match_near(one, other, placed, there.points[j], reach, ratio)
    return here.points[i][rows[:, 0]], there.points[j][rows[:, 1]]


def _independent(pairs: list[tuple[int, int]], each: list[int]) -> tuple[tuple[int, int], ...]:
    """Pairs of keyframes that agree and have none in common; greedily, the best first."""
    used: tuple[set[int], set[int]] = (set(), set())
    best = []
    for size, (i, j) in sorted(zip(each, pairs, strict=True), key=lambda row: -row[0]):
        if size >= SHARED and i not in used[0] and j not in used[1]:
            used[0].add(i)
            used[1].add(j)
            best.append((i, j))
    return tuple(best)


def _sharp(
    source: Floats, target: Floats, pose: Floats, about: Floats, tolerance: float
) -> Working[bool]:
    """Whether clouds fit under a pose and clearly less under every one a little beside it."""
    source, target = (cloud[:: 1 + len(cloud) // _CLOUD] for cloud in (source, target))
    cell = tolerance / 4  # with its neighbours: fits within a quarter to a half
    filled = _dilated(np.floor(target / cell).astype(np.int64))
    yield 1 + len(target) // _DILATED
    placed = carry(pose, source) - about
    fits = _count(filled, placed + about, cell)
    for beside in _beside(placed, tolerance):
        if fits == 0 or _count(filled, carry(beside, placed) + about, cell) > BLUNT * fits:
            return False
        yield 1 + len(source) // _LOOKED_UP
    return True


def _beside(points: Floats, tolerance: float) -> Iterator[Floats]:
    """Twelve small motions of points (N, 3): along and about each axis, both ways.

    Pushed by two tolerances, and turned so that half of the points move by four: what lies near
    the axis stays wherever it turns.
    """
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        reach = float(np.median(np.hypot(points[:, a], points[:, b])))
        turn = 4 * tolerance / max(reach, 8 * tolerance)
        for sign in (-1.0, 1.0):
            moved = np.eye(4)
            moved[axis, 3] = sign * 2 * tolerance
            yield moved
            turned = np.eye(4)
            turned[a, a] = turned[b, b] = np.cos(turn)
            turned[a, b], turned[b, a] = -sign * np.sin(turn), sign * np.sin(turn)
            yield turned


def _dilated(cells: Int64s) -> Int64s:
    """Ascending keys of cells (N, 3) and all their neighbours."""
    cells = cells[np.unique(_keys(cells), return_index=True)[1]]
    steps = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.unique(_keys((cells[:, None] + steps[None]).reshape(-1, 3)))


def _count(filled: Int64s, points: Floats, cell: float) -> int:
    keys = _keys(np.floor(points / cell).astype(np.int64))
    at = np.minimum(np.searchsorted(filled, keys), len(filled) - 1)
    return int((filled[at] == keys).sum())


def _keys(cells: Int64s) -> Int64s:
    """One number a cell, in 21 bits an axis."""
    low = cells & ((1 << 21) - 1)
    return np.asarray((low[:, 0] << 42) | (low[:, 1] << 21) | low[:, 2], np.int64)
