"""How the surfels of one SLAM frame lie to those of another: every way in which they might, and
what speaks for the best one.

The search is exhaustive over what planes allow, since what must be known is not only the best
alignment but that there is no other. Rotations bring axes that many surfaces face onto such axes;
for each one, shifts bring planes onto planes along three of them. A shift of a sample of surfels
counts where a surface of the same direction is, and counts against it where rays saw free space.
The best ones are refined, point to plane, and judged by everything, in both directions.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from .kernels.voxels import SHIFT, nearest_facing, tally
from .model import Floats, Int64s
from .registration import SHARED, Working, carry, inverse, small
from .surfels import FACING, FREE, Surfels, facing, kinds_of

SAMPLE = 256  # surfels that shifts are tried with
PEAKS = 24  # shifts along each of three axes
PENALTY = 2  # of a surfel in free space, in the first look
AGAINST = 8  # the same where everything is judged
CONTRAST = 16  # the same where two poses are compared
KEPT = 24  # alignments that are refined
_ROTATIONS = 96
_SAME_TURN = np.radians(4.0)
_ALONG = 0.95  # cosine: a surfel that faces along an axis
ALIKE = round(0.8 * FACING**2)  # cosine of the normals of two surfels that are one surface
_REACHES = (2.0, 1.5, 1.0, 0.75, 0.5, 0.5, 0.5, 0.5)  # cells from a plane, of what is brought there
_REFINED, _FEWEST = 1200, 6  # surfels that are, at most and at least
_TURNED, _DAMPING = 1e-4, 1e-5  # rad that count as a mm; of the points, as if at rest
_STEEP = 0.35  # volume that three axes span at least
_TALLIED = 1_600_000  # look-ups in one go, some twelve units


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """What speaks for a motion. pose: (4, 4) mm, source into target.

    support, against: surfels of both that lie on the other's surface, and in its free space.
    details: surfels of the source's that agree, beside the largest plane in each direction;
    planes: how many planes these lie in.
    firm: (6,) ascending, how many surfels fix the least fixed direction. independent: pairs of
    keyframes that agree and have none in common.
    """

    pose: Floats
    support: float = 0
    against: float = 0
    details: int = 0
    planes: int = 0
    firm: Floats = field(default_factory=lambda: np.zeros(6))
    independent: int = 0
    centre: Floats = field(default_factory=lambda: np.zeros(3))
    radius: float = 0.0

    @property
    def inliers(self) -> int:
        """What it is published with: as scarce as points that look alike."""
        return self.details

    @property
    def contrary(self) -> float:
        """Share of what contradicts it."""
        return self.against / max(self.support + self.against, 1e-9)

    @property
    def score(self) -> float:
        """How far what agrees outweighs what contradicts."""
        return self.support - AGAINST * self.against

    def rivalled(self, other: Agreement) -> float:
        """What agrees with another pose, less what contradicts that one more often than this one,
        where people, drift and noise may do so."""
        usual = self.contrary * (other.support + other.against)
        return other.support - CONTRAST * max(0.0, other.against - usual)

    def apart(self, one: Floats, other: Floats) -> float:
        """How far two poses (4, 4) carry the agreeing surfels apart at most, mm, about."""
        shift = np.linalg.norm(carry(one, self.centre[None]) - carry(other, self.centre[None]))
        return float(shift + self.radius * np.linalg.norm(one[:3, :3] - other[:3, :3], 2))

    def between(self, source: Floats, target: Floats) -> Agreement:
        """The same where the frames' places are counted from elsewhere: their origins were here."""
        pose = self.pose.copy()
        pose[:3, 3] += target - pose[:3, :3] @ source
        return replace(self, pose=pose, centre=self.centre + source)

    def back(self) -> Agreement:
        """The same of the motion from target into source."""
        centre = carry(self.pose, self.centre[None])[0]
        return replace(self, pose=inverse(self.pose), centre=centre)


def align(source: Surfels, target: Surfels) -> Working[list[Agreement]]:
    """Ways in which the source may lie in the target, refined and distinct, the best first."""
    proposals: list[tuple[int, Floats]] = []
    rows = _sample(source)
    turns = yield from _rotations(source.axes, target.axes)
    for turn in turns:
        found = yield from _shifts(source, target, turn, rows)
        proposals += found
    proposals.sort(key=lambda proposal: -proposal[0])
    distinct = yield from _distinct(proposals, source, target.cell)
    out: list[Agreement] = []
    for pose in distinct:
        pose = yield from refine(source, target, pose)
        known = np.array([agreement.pose for agreement in out]).reshape(-1, 4, 4)
        if (_apart(source, known, pose) > 2 * target.cell).all():
            found_one = yield from judge(source, target, pose)
            out.append(found_one)
    out.sort(key=lambda agreement: -agreement.score)
    return [agreement.between(source.origin, target.origin) for agreement in out]


def _sample(source: Surfels) -> Int64s:
    """Rows of surfels, the rare ones more often: walls and floors are everywhere."""
    total = np.cumsum(source.rarity)
    wanted = (np.arange(SAMPLE) + 0.5) / SAMPLE * total[-1]
    return np.unique(np.searchsorted(total, wanted))


def _rotations(here: Floats, there: Floats) -> Working[list[Floats]]:
    """Rotations (3, 3) that bring two axes onto two others, either way, without those alike."""
    out: list[Floats] = []
    for a, b in _pairs(there):
        aim = _triad(there[a], there[b])
        for i, j in _pairs(here):
            for s, t in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
                one, two = s * here[i], t * here[j]
                if abs(_between(one, two) - _between(there[a], there[b])) > _SAME_TURN:
                    continue
                turn = aim @ _triad(one, two).T
                if all(_angle(turn @ known.T) > _SAME_TURN for known in out):
                    out.append(turn)
                if len(out) >= _ROTATIONS:
                    return out
        yield 8
    return out


def _between(one: Floats, two: Floats) -> float:
    """Angle of two directions, rad."""
    return float(np.arccos(np.clip(one @ two, -1, 1)))


def _pairs(axes: Floats) -> list[tuple[int, int]]:
    """Of axes that are not parallel, both ways; those of the most surfels first."""
    n = range(len(axes))
    some = [(a, b) for a in n for b in n if a != b and abs(axes[a] @ axes[b]) < 0.9]
    return sorted(some, key=lambda pair: (max(pair), pair))


def _triad(one: Floats, two: Floats) -> Floats:
    """(3, 3) columns: between them, across, and out of their plane."""
    middle, out = one + two, np.cross(one, two)
    middle, out = middle / np.linalg.norm(middle), out / np.linalg.norm(out)
    return np.stack([middle, np.cross(out, middle), out], axis=1)


def _angle(turn: Floats) -> float:
    return float(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))


def _shifts(
    source: Surfels, target: Surfels, turn: Floats, rows: Int64s
) -> Working[list[tuple[int, Floats]]]:
    """The best poses (4, 4) with this rotation, each with its tally."""
    points, normals = source.points @ turn.T, source.normals @ turn.T
    axes, offsets = _offsets(points, normals, target)
    yield 12
    if axes is None:
        return []
    grid = np.stack(np.meshgrid(*offsets, indexing="ij"), axis=-1).reshape(-1, 3)
    shifts = grid @ np.linalg.inv(axes).T
    kinds = kinds_of(normals[rows], target.axes)
    marks = (1 << kinds).astype(np.int32)
    places = target.steps(points[rows])
    moves = np.floor(np.clip(shifts / target.cell, -1e6, 1e6) * (1 << SHIFT)).astype(np.int32)
    out = np.zeros(len(moves), np.int64)
    step = max(1, _TALLIED // len(rows))
    for at in range(0, len(moves), step):
        part = slice(at, at + step)
        tally(target.cells, target.shape, places, marks, moves[part], FREE, PENALTY, out[part])
        yield 12
    best = np.argsort(-out, kind="stable")[: 2 * KEPT]
    found = []
    for k in best[out[best] > 0].tolist():
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, shifts[k]
        found.append((int(out[k]), pose))
    return found


def _offsets(
    points: Floats, normals: Floats, target: Surfels
) -> tuple[Floats | None, list[Floats]]:
    """Three axes (3, 3) of the target, and along each the shifts that bring planes onto planes."""
    chosen: list[Floats] = []
    offsets: list[Floats] = []
    for axis in target.axes:
        volume = _volume([*chosen, axis])
        if volume < (1.0, 0.6, _STEEP)[len(chosen)] * 0.999:
            continue
        found = _peaks(points, normals, target, axis)
        if len(found):
            chosen.append(axis)
            offsets.append(found)
        if len(chosen) == 3:
            return np.array(chosen), offsets
    return None, []


def _volume(axes: list[Floats]) -> float:
    rows = np.array(axes)
    return float(np.sqrt(max(0.0, np.linalg.det(rows @ rows.T))))


def _peaks(points: Floats, normals: Floats, target: Surfels, axis: Floats) -> Floats:
    """Shifts (P,) mm along an axis under which planes across it come to lie on planes."""
    total, pitch = np.zeros(0), target.cell
    here, there = points @ axis, target.points @ axis
    low, base = np.floor(here.min() / pitch), np.floor(there.min() / pitch)
    n, m = (
        int(np.ceil((x.max() - b * pitch) / pitch)) + 1 for x, b in ((here, low), (there, base))
    )
    total = np.zeros(n + m - 1)
    some = False
    for sign in (1, -1):
        mine, theirs = sign * (normals @ axis) > _ALONG, sign * (target.normals @ axis) > _ALONG
        if not mine.any() or not theirs.any():
            continue
        one = np.bincount((here[mine] / pitch - low).astype(np.int64), minlength=n)
        two = np.bincount((there[theirs] / pitch - base).astype(np.int64), minlength=m)
        total += np.convolve(np.sqrt(two), np.sqrt(one)[::-1])
        some = True
    if not some:
        return np.zeros(0)
    smooth = np.convolve(total, (0.5, 1.0, 0.5), "same")
    padded = np.pad(smooth, 1)
    top = np.flatnonzero((smooth > 0) & (smooth >= padded[:-2]) & (smooth > padded[2:]))
    top = top[np.argsort(-smooth[top], kind="stable")[:PEAKS]]
    return np.asarray((top - (n - 1) + base - low) * pitch, np.float64)


def _distinct(
    proposals: list[tuple[int, Floats]], source: Surfels, cell: float
) -> Working[list[Floats]]:
    """The first ones (4, 4) of those that lie apart."""
    poses = np.array([pose for _, pose in proposals]).reshape(-1, 4, 4)
    out: list[Floats] = []
    while len(poses) and len(out) < KEPT:
        out.append(poses[0])
        poses = poses[_apart(source, poses, out[-1]) > 3 * cell]
        yield 1
    return out


def _apart(source: Surfels, poses: Floats, other: Floats) -> Floats:
    """(N,) how far poses (N, 4, 4) and another carry the source's middle apart, and its surfels by
    their turn, mm."""
    change = poses - other
    shift = change[:, :3, :3] @ source.centre + change[:, :3, 3]
    turn = np.sqrt((change[:, :3, :3] ** 2).sum(axis=(1, 2)) / 2)
    return np.asarray(np.linalg.norm(shift, axis=1) + source.radius * turn)


def _matched(points: Floats, normals: Floats, target: Surfels, reach: int) -> tuple[Int64s, Int64s]:
    """Rows of points (N, 3) near which a surfel of the target's faces as they do, and the nearest
    such one."""
    out = np.empty(len(points), np.int64)
    nearest_facing(
        target.which, target.shape, target.places, target.facings, target.steps(points),
        facing(normals), reach, ALIKE, out,
    )  # fmt: skip
    rows = np.flatnonzero(out >= 0)
    return rows, out[rows]


def refine(source: Surfels, target: Surfels, pose: Floats) -> Working[Floats]:
    """Bring surfels onto the planes of those near them, from coarse to fine."""
    step = 1 + len(source) // _REFINED
    points, normals = source.points[::step], source.normals[::step]
    for reach in _REACHES:
        moved, wide = carry(pose, points), reach > 1.0
        rows, other = _matched(moved, normals @ pose[:3, :3].T, target, 2 if wide else 1)
        yield 10 if wide else 4
        place, normal = moved[rows], target.normals[other]
        away = ((target.points[other] - place) * normal).sum(axis=1)
        near = np.abs(away) < reach * target.cell
        if near.sum() < _FEWEST:
            break
        pose = _step(place[near], normal[near], away[near]) @ pose
    return pose


def _step(points: Floats, normals: Floats, away: Floats) -> Floats:
    """(4, 4) the small motion that brings points (N, 3) nearest to planes that lie `away` (N,)
    along normals (N, 3); what these do not fix hardly moves."""
    centre = points.mean(axis=0)
    scale = np.array([_TURNED] * 3 + [1.0] * 3)
    jacobian = np.concatenate([np.cross(points - centre, normals), normals], axis=1) * scale
    damped = jacobian.T @ jacobian + _DAMPING * len(points) * np.eye(6)
    return small(scale * np.linalg.solve(damped, jacobian.T @ away), centre)


def judge(source: Surfels, target: Surfels, pose: Floats) -> Working[Agreement]:
    """What speaks for a pose."""
    back = inverse(pose)
    mine = yield from _looked(source, target, pose)
    theirs = yield from _looked(target, source, back)
    rows, other, against = mine
    support = float(source.rarity[rows].sum() + target.rarity[theirs[0]].sum())
    counts = float(source.rarity[against].sum() + target.rarity[theirs[2]].sum())
    if len(rows) < _FEWEST:
        return Agreement(pose, support, counts)
    details, planes = _details(source, rows)
    p, n = carry(pose, source.points[rows]), target.normals[other]
    centre = p.mean(axis=0)
    radius = float(np.sqrt(((p - centre) ** 2).sum(axis=1).mean()))
    jacobian = np.concatenate([np.cross(p - centre, n) / radius, n], axis=1)
    firm = np.linalg.eigvalsh(jacobian.T @ jacobian)
    independent = _independent(source.groups[rows], target.groups[other])
    middle = source.points[rows].mean(axis=0)
    yield 15
    return Agreement(pose, support, counts, details, planes, firm, independent, middle, radius)


def _looked(
    source: Surfels, target: Surfels, pose: Floats
) -> Working[tuple[Int64s, Int64s, Int64s]]:
    """Surfels of the source's on the target's surfaces, which these are, and how many in free
    space."""
    points, normals = carry(pose, source.points), source.normals @ pose[:3, :3].T
    rows: list[Int64s] = [np.zeros(0, np.int64)]
    other: list[Int64s] = [np.zeros(0, np.int64)]
    for at in range(0, len(points), 2000):
        part = slice(at, at + 2000)
        found, nearest = _matched(points[part], normals[part], target, 1)
        off = ((target.points[nearest] - points[part][found]) * target.normals[nearest]).sum(axis=1)
        good = np.abs(off) < 0.5 * target.cell
        rows.append(found[good] + at)
        other.append(nearest[good])
        yield 10
    against = np.flatnonzero(target.bits(points) & FREE)
    return np.concatenate(rows), np.concatenate(other), against


def _details(source: Surfels, rows: Int64s) -> tuple[int, int]:
    """How many of the rows lie beside the largest plane that each direction has, and in how many
    planes of some size."""
    kinds = source.kinds[rows]
    along = (source.points[rows] * source.axes[kinds // 2]).sum(axis=1)
    bins = np.floor(along / (2 * source.cell)).astype(np.int64)
    details = planes = 0
    for kind in np.unique(kinds).tolist():
        _, counts = np.unique(bins[kinds == kind], return_counts=True)
        order = np.sort(counts)[::-1]
        rest = counts.sum() - _largest(bins[kinds == kind])
        details += int(rest)
        planes += int((order >= _FEWEST).sum()) - 1
    return details, max(0, planes)


def _largest(bins: Int64s) -> int:
    """Points in the fullest bin and its neighbours."""
    names, counts = np.unique(bins, return_counts=True)
    full = names[counts.argmax()]
    return int(counts[np.abs(names - full) <= 1].sum())


def _independent(one: Int64s, other: Int64s) -> int:
    """Pairs of keyframes with agreeing surfels that have none in common; greedily."""
    width = int(other.max(initial=0)) + 1
    pairs, counts = np.unique(one * width + other, return_counts=True)
    used: tuple[set[int], set[int]] = (set(), set())
    for k in np.argsort(-counts, kind="stable").tolist():
        a, b = divmod(int(pairs[k]), width)
        if counts[k] >= SHARED and a not in used[0] and b not in used[1]:
            used[0].add(a)
            used[1].add(b)
    return len(used[0])
