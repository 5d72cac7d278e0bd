"""How a robot's path is bent to where other robots, already placed, have seen the same things.

A pose graph along the path of one robot (as in Choudhary et al. 2017, each robot solves for itself
with the others held where they are): between two of its keyframes the SLAM is right but for drift,
at a keyframe its described points lie where others' lie that look alike. Floats are allowed, since
what comes out are poses that their author signs.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from .config import PlacingConfig
from .consensus import Consensus
from .drift import Bend, Drift
from .keyframes import Keyframe, matrix_of
from .model import AuthorId, Floats, FrameId
from .registration import (
    WIDE,
    Views,
    Working,
    agreeing,
    carry,
    compared,
    facing,
    inverse,
    register,
    residuals,
    small,
    spread,
)

LEAST = 12  # points of two keyframes that must agree, so that it is a look
FACED = 4  # keyframes of others that are compared with one of the robot's own
NEIGHBOURS = 5  # keyframes along the path within which looks must bear each other out
LOOKS = 4  # that are borne out, at least
STEP = 0.7  # of what is lacking: robots that bend towards each other meet, and do not swing
NOISE = 0.25  # of the tolerance: how far off a described point is, and
WORTH = 6  # points of a look count, for all of them share an error
NEWS = 0.25  # of the tolerance: what fewer keyframes than `LOOKS` are off by is no news
TRUSTED = 3  # times the drift that is allowed: what is off by more is no drift
CARRIED = 16  # keyframes of others that are laid in the own frame in a unit
HELD = 16  # looks that are held against others in a unit
SOLVED = 8  # looks or steps of the path that enter the equations in a unit
GROWN = 1.1  # keyframes must have grown by so much before it is looked again


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """Points (N, 3) mm of an own keyframe, and where one of another robot's has them."""

    own: int
    other: int
    source: Floats
    target: Floats
    motion: Floats  # (4, 4) that carries the one to the other


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """The own keyframes, by time. said: (K, 4, 4) mm where the SLAM has them. motions: (K, 4, 4)
    what carries them from there to where they are taken to be; views: them there."""

    cycles: list[int]
    said: Floats
    motions: Floats
    views: Views

    def lengths(self) -> Floats:
        """(K - 1,) mm from each keyframe to the next, turns by what they move of what is seen."""
        steps = np.linalg.norm(np.diff(self.said[:, :3, 3], axis=0), axis=1)
        cosine = (np.einsum("kij,kij->k", self.said[1:, :3, :3], self.said[:-1, :3, :3]) - 1) / 2
        return np.asarray(steps + self.views.depth * np.arccos(np.clip(cosine, -1, 1)))


class Bending:
    """Looks for the drift of one robot, a little in every tick."""

    def __init__(self, config: PlacingConfig, me: AuthorId, drift: Drift) -> None:
        self._config, self._me, self._drift = config, me, drift
        self._keyframes: Mapping[FrameId, Sequence[Keyframe]] = {}
        self._places: dict[FrameId, Floats] = {}  # (4, 4) mm of others' frames in the own one
        self._moves = 0
        self._looked: tuple[object, ...] = ()  # at what the last time, and
        self._counted = 0  # so many keyframes
        self._work = self._search()

    def step(
        self,
        keyframes: Mapping[FrameId, Sequence[Keyframe]],
        consensus: Consensus,
        moves: int,
        budget: int,
    ) -> int:
        """Search for about `budget` units; what is found is in the drift. Returns the units spent.

        moves: rises whenever keyframes have moved.
        """
        if not self._drift.rate:
            return 0
        self._keyframes, self._moves = keyframes, moves
        self._place(consensus)
        spent = 0
        while spent < budget:
            cost = next(self._work)
            if cost == 0:
                break
            spent += cost
        return spent

    def _place(self, consensus: Consensus) -> None:
        frame, placed = FrameId(self._me, self._drift.session), consensus.firm
        self._places = {}
        if frame not in placed or frame not in self._keyframes:
            return
        back = inverse(matrix_of(placed[frame][1]))
        for other in sorted(self._keyframes):
            here = other in placed and placed[other][0] == placed[frame][0]
            if here and other.author != self._me:
                self._places[other] = back @ matrix_of(placed[other][1])

    def _search(self) -> Iterator[int]:
        """Endless: what the last piece of work cost in units, 0 when there was nothing to do."""
        while True:
            count = sum(len(self._keyframes[f]) for f in self._places)
            path = self._path() if self._places and self._news(count) else None
            if path is None:
                yield 0
                continue
            version = self._drift.version
            self._looked, self._counted = self._state(), self._counts(count)
            others = yield from self._others()
            looks = yield from seek(path.views, others, self._config.tolerance_mm)
            motions = yield from bent(path, looks, self._config)
            yield 1
            if motions is not None and version == self._drift.version:
                self._drift.bend(map(Bend, path.cycles, motions))

    def _state(self) -> tuple[object, ...]:
        places = tuple(place.tobytes() for place in self._places.values())
        return self._drift.session, self._drift.version, self._moves, places

    def _counts(self, others: int) -> int:
        return others + len(self._keyframes[FrameId(self._me, self._drift.session)])

    def _news(self, others: int) -> bool:
        return self._state() != self._looked or self._counts(others) >= GROWN * self._counted

    def _path(self) -> Path | None:
        own = self._keyframes[FrameId(self._me, self._drift.session)]
        known = []
        for keyframe in sorted(own, key=lambda keyframe: keyframe.described.cycle):
            said = self._drift.said(keyframe.described.cycle)
            if said is not None:
                known.append((keyframe, said))
        if len(known) < LOOKS:
            return None
        cycles = [keyframe.described.cycle for keyframe, _ in known]
        motions = np.array([self._drift.at(cycle) for cycle in cycles])
        said = np.array([said for _, said in known])
        poses = motions @ said
        points = [
            carry(pose, keyframe.described.position.astype(np.float64))
            for pose, (keyframe, _) in zip(poses, known, strict=True)
        ]
        # points at the sensor itself would leave nothing that resists a turn
        depth = max(1.0, float(np.median([keyframe.depth for keyframe, _ in known])))
        views = Views(poses, points, [keyframe.descriptors for keyframe, _ in known], depth)
        return Path(cycles, said, motions, views)

    def _others(self) -> Working[Views]:
        """All keyframes of the others, in the own frame."""
        held = [(place, k) for frame, place in self._places.items() for k in self._keyframes[frame]]
        points = []
        for n, (place, keyframe) in enumerate(held):
            if n % CARRIED == 0:
                yield 1
            points.append(carry(place, keyframe.points))
        return Views(
            np.array([place @ keyframe.place for place, keyframe in held]),
            points,
            [keyframe.descriptors for _, keyframe in held],
            float(np.median([keyframe.depth for _, keyframe in held])),
        )


def seek(own: Views, others: Views, tolerance: float) -> Working[list[Look]]:
    """Looks along the path, each from where the one before has led, so that drift may add up to
    more than what is looked at in one: forth, and back where nothing was found on the way."""
    found: dict[int, list[Look]] = {}
    for turn in (1, -1):
        guess = np.eye(4)
        for k in range(len(own.points))[::turn]:
            if not found.get(k):
                found[k] = yield from _looks(own, others, k, guess, tolerance)
            if found[k]:
                guess = max(found[k], key=lambda look: len(look.source)).motion
    every = [look for k in sorted(found) for look in found[k]]
    return (yield from borne_out(every, tolerance))


def _looks(
    own: Views, others: Views, k: int, guess: Floats, tolerance: float
) -> Working[list[Look]]:
    here = Views(own.poses[k : k + 1], own.points[k : k + 1], own.descriptors[k : k + 1], own.depth)
    out = []
    for i, j in facing(here, others, guess)[:FACED]:
        source, target = agreeing(here, others, i, j, guess, tolerance, wide=True)
        found = register(source, target, tolerance / 2)
        yield compared(here.descriptors[i], others.descriptors[j]) + 1
        if found is None or found[1].sum() < LEAST:
            continue
        motion, inliers = found
        source, target = source[inliers], target[inliers]
        beside = np.linalg.norm(carry(motion, source) - carry(guess, source), axis=1).max()
        if spread(source)[1] >= 2 * tolerance and beside <= WIDE * tolerance:
            out.append(Look(k, j, source, target, motion))
    return out


def borne_out(looks: list[Look], tolerance: float) -> Working[list[Look]]:
    """Those that another one agrees with: of a keyframe near by, with another one of others."""
    of: defaultdict[int, list[Look]] = defaultdict(list)
    for look in looks:
        of[look.own].append(look)
    out, held_against = [], 0
    for look in looks:
        near = range(look.own - NEIGHBOURS, look.own + NEIGHBOURS + 1)
        for other in (each for k in near if k != look.own for each in of.get(k, ())):
            if look.other == other.other:
                continue
            held_against += 1
            if held_against % HELD == 0:
                yield 1
            if residuals(other.motion, look.source, look.target).mean() <= tolerance:
                out.append(look)
                break
    return out


def bent(path: Path, looks: list[Look], config: PlacingConfig) -> Working[Floats | None]:
    """(K, 4, 4) the motions by which the looks agree better; None where that is no news, or where
    it is more than drift."""
    tolerance, places = config.tolerance_mm, path.views.poses[:, :3, 3]
    for _ in range(2):
        if len(looks) < LOOKS:
            return None
        change = yield from solved(path, looks, config)
        moves = [small(change[look.own], places[look.own]) for look in looks]
        fitting = [
            look
            for look, move in zip(looks, moves, strict=True)
            if residuals(move, look.source, look.target).mean() <= tolerance
        ]
        if len(fitting) == len(looks):
            break
        looks = fitting
    change *= STEP
    seen = sorted({look.own for look in looks})
    turns, shifts = (np.linalg.norm(part[seen], axis=1) for part in np.hsplit(change, 2))
    news = path.views.depth * turns + shifts
    if (news > NEWS * tolerance).sum() < LOOKS:
        return None
    steps = [small(c, place) for c, place in zip(change, places, strict=True)]
    motions = np.array(steps) @ path.motions
    off = np.linalg.norm((motions @ path.said - path.said)[:, :3, 3], axis=1)
    turned = (np.trace(motions[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    off += path.views.depth * np.arccos(np.clip(turned, -1, 1))  # what is seen, not the sensor only
    if off.max() > TRUSTED * config.drift * path.lengths().sum() + tolerance:
        return None
    return motions


def solved(path: Path, looks: list[Look], config: PlacingConfig) -> Working[Floats]:
    """(K, 6) turn (rad) about each sensor, and shift (mm): a Gauss-Newton step."""
    count = len(path.cycles)
    diagonal, beside = np.zeros((count, 6, 6)), np.zeros((count - 1, 6, 6))
    right = np.zeros((count, 6))
    for n, look in enumerate(looks):
        if n % SOLVED == 0:
            yield 1
        arms = look.source - path.views.poses[look.own, :3, 3]
        jacobian = np.zeros((len(arms), 3, 6))
        jacobian[:, :, :3] = -_cross(arms)
        jacobian[:, :, 3:] = np.eye(3)
        weight = min(1.0, WORTH / len(arms)) / (NOISE * config.tolerance_mm) ** 2
        flat = jacobian.reshape(-1, 6)
        diagonal[look.own] += weight * flat.T @ flat
        right[look.own] += weight * flat.T @ (look.target - look.source).ravel()
    lengths = np.maximum(path.lengths(), config.tolerance_mm)
    for k, length in enumerate(lengths.tolist()):
        if k % SOLVED == 0:
            yield 1
        ahead, lacking = _drifted(path, k)
        off = config.drift * length
        firm = np.array([path.views.depth / off] * 3 + [1 / off] * 3) ** 2
        diagonal[k + 1] += np.diag(firm)
        diagonal[k] += (ahead.T * firm) @ ahead
        beside[k] -= (ahead.T * firm).T
        right[k + 1] -= firm * lacking
        right[k] += ahead.T @ (firm * lacking)
    return _tridiagonal(diagonal, beside, right)


def _drifted(path: Path, k: int) -> tuple[Floats, Floats]:
    """How a change (6,) at keyframe k carries on to the next one (6, 6), and how far that one now
    is from where the SLAM says it is as seen from k (6,)."""
    one, other = path.motions[k], path.motions[k + 1]
    place = path.said[k + 1, :3, 3]
    expected = carry(one, place[None])[0]
    ahead = np.eye(6)
    ahead[3:, :3] = -_cross((expected - path.views.poses[k, :3, 3])[None])[0]
    turn = other[:3, :3] @ one[:3, :3].T
    turned = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return ahead, np.concatenate([turned / 2, carry(other, place[None])[0] - expected])


def _tridiagonal(diagonal: Floats, beside: Floats, right: Floats) -> Floats:
    """(K, 6) the solution of a symmetric system of blocks. diagonal: (K, 6, 6). beside:
    (K - 1, 6, 6), each left of the diagonal in the row after."""
    diagonal, right = diagonal.copy(), right.copy()
    for k, left in enumerate(beside):
        factor = np.linalg.solve(diagonal[k], left.T).T
        diagonal[k + 1] -= factor @ left.T
        right[k + 1] -= factor @ right[k]
    out = np.zeros_like(right)
    out[-1] = np.linalg.solve(diagonal[-1], right[-1])
    for k in range(len(beside) - 1, -1, -1):
        out[k] = np.linalg.solve(diagonal[k], right[k] - beside[k].T @ out[k + 1])
    return out


def _cross(vectors: Floats) -> Floats:
    """(N, 3, 3) the matrices that take the cross product with vectors (N, 3)."""
    out = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -z, y, -x
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = z, -y, x
    return out
