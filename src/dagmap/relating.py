"""How one own SLAM frame lies to one other: what was compared, proposed, judged and published.

`Relation` is what all relations share; `Likeness` compares keyframes with descriptors, `surfaces`
has the one that goes by shape alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from .config import PlacingConfig
from .keyframes import Keyframe, matrix_of, views
from .model import LIMIT_MM, Floats, FrameId, quantise_pose
from .payload import Link
from .registration import (
    Evidence,
    Views,
    Working,
    compared,
    inverse,
    judge,
    match,
    register,
    rivals,
)

PAIRED = 5  # described points of two keyframes that agree: enough for a proposal
CLOSE = 0.5  # of the tolerance: so well they agree, since they may lie on one small thing
FIRM = 40  # tolerances: what agrees, by number and spread, fixes the turn so well, or it is no link
GROWTH = 2  # a link is published again once what agrees fixes it so much better
RIVAL = 0.5  # another placement with such a share of the points makes it ambiguous
REJUDGED = 1.1  # keyframes must have grown by so much before a proposal is judged again
CANDIDATES = 8  # proposals of two frames that are kept


class Fitted(Protocol):
    """What speaks for a pose, as far as publishing it goes."""

    @property
    def inliers(self) -> int: ...

    def apart(self, one: Floats, other: Floats) -> float:
        """How far two poses (4, 4) carry what agrees apart at most, mm."""


@dataclass(slots=True, eq=False)
class _Candidate:
    """A proposal that was judged."""

    pose: Floats  # (4, 4) mm, source into target
    evidence: Evidence
    between: Floats | None  # (4, 4) mm the same from the one to the other keyframe that agree best
    seen: int  # keyframes of both frames when it was judged


class Relation:
    """How one own frame, `source`, lies to one other, `target`."""

    def __init__(self, config: PlacingConfig, source: FrameId, target: FrameId) -> None:
        self._config, self.source, self.target = config, source, target
        self.resumed = False  # whether it was seen what an earlier run of this robot has published
        self.published: Link | None = None  # by this robot
        self._weight = 0.0  # of the evidence for it
        self.answer: Link | None = None  # by the other end
        self.reason = "nothing in common was seen yet"
        self.news: list[Link] = []  # to be published

    @property
    def answered(self) -> Floats | None:
        """(4, 4) mm, source into target, as the other end has it."""
        return None if self.answer is None else inverse(matrix_of(self.answer.pose))

    def _settle(self, pose: Floats, evidence: Fitted, weight: float) -> Link | None:
        """Publish a pose that is believed, if that is news: it moved, or is known much better."""
        said = self.answered
        near = self._config.tolerance_mm / 2
        # the lower one's pose counts
        if said is not None and self.target < self.source and evidence.apart(said, pose) <= near:
            pose = said
        if np.abs(pose[:3, 3]).max() >= LIMIT_MM:
            self.reason = "it lies beyond 2^29 mm"
            return self._withdraw()
        before = self.published
        if before is not None:
            moved = evidence.apart(matrix_of(before.pose), pose) > near
            if not moved and weight < GROWTH * self._weight:
                return None
        self._weight = weight
        metres = pose.copy()
        metres[:3, 3] /= 1000.0
        self.published = Link(self.source, self.target, quantise_pose(metres), evidence.inliers)
        return self.published

    def _withdraw(self) -> Link | None:
        """What was published and does not hold any more is taken back: a link of 0 inliers."""
        if self.published is None:
            return None
        gone = Link(self.source, self.target, self.published.pose, 0)
        self.published = None
        return gone


class Likeness(Relation):
    """Two frames whose keyframes have descriptors."""

    def __init__(self, config: PlacingConfig, source: FrameId, target: FrameId) -> None:
        super().__init__(config, source, target)
        self.here: list[Keyframe] = []
        self.there: list[Keyframe] = []
        self.candidates: list[_Candidate] = []
        self._answered: Link | None = None  # judged already
        self._moves = 0  # of keyframes, since the judgement began that is under way
        self.work = self._work()

    def _work(self) -> Iterator[int]:
        """Endless: what the last piece of work cost in units, 0 when there was nothing to do."""
        pairs = self._pairs()
        while True:
            if self.answer is not None and self.answer is not self._answered:
                self._answered = self.answer
                yield from self._propose(inverse(matrix_of(self.answer.pose)))
            pair = next(pairs)
            if pair is None:
                yield from self._improve()
                continue
            proposal = self._compare(*pair)
            yield compared(pair[0].descriptors, pair[1].descriptors)
            if proposal is not None and not self._known(proposal):
                yield from self._propose(proposal)

    def _pairs(self) -> Iterator[tuple[Keyframe, Keyframe] | None]:
        """Every pair of keyframes once, also of those that come later; None while there is none."""
        a = b = 0
        while True:
            if a < len(self.here) and (a <= b or b == len(self.there)):
                one, a = self.here[a], a + 1
                for other in self.there[:b]:
                    yield one, other
            elif b < len(self.there):
                other, b = self.there[b], b + 1
                for one in self.here[:a]:
                    yield one, other
            else:
                yield None

    def _compare(self, one: Keyframe, other: Keyframe) -> Floats | None:
        rows = match(one.descriptors, other.descriptors)
        if len(rows) < PAIRED:
            return None
        source, target = one.points[rows[:, 0]], other.points[rows[:, 1]]
        found = register(source, target, CLOSE * self._config.tolerance_mm)
        return None if found is None or found[1].sum() < PAIRED else found[0]

    def _known(self, pose: Floats) -> bool:
        """Whether a proposal is one of those judged already."""
        return any(self._same(pose, known) for known in self.candidates)

    def _same(self, pose: Floats, known: _Candidate) -> bool:
        return known.evidence.apart(pose, known.pose) <= 4 * self._config.tolerance_mm

    def judge_anew(self) -> None:
        """Keyframes have moved, and what was proposed with them: it is to be judged again."""
        self._moves += 1
        for known in self.candidates:
            self._follow(known)

    def _follow(self, known: _Candidate) -> None:
        known.seen = 0
        if known.between is not None:
            (i, j), *_ = known.evidence.best
            back = inverse(self.here[i].place)
            known.pose = self.there[j].place @ known.between @ back

    def _improve(self) -> Working[None]:
        """Judge again what was proposed, once there is much more to judge it by."""
        for known in self.candidates[:]:
            grown = len(self.here) + len(self.there) >= REJUDGED * known.seen
            if grown and known in self.candidates:
                self.candidates.remove(known)
                yield from self._propose(known.pose)
        yield 0

    def _propose(self, pose: Floats) -> Working[None]:
        """Judge a proposal and its rivals, and publish a link if there is news."""
        here, there, self._moves = views(self.here), views(self.there), 0
        candidate = yield from self._judge(here, there, pose)
        if self._holds(candidate):
            evidence, tolerance = candidate.evidence, self._config.tolerance_mm
            for rival in (yield from rivals(here, there, evidence, tolerance)):
                if not self._known(rival):
                    yield from self._judge(here, there, rival)
        link = self._conclude()
        if link is not None:
            self.news.append(link)

    def _judge(self, here: Views, there: Views, pose: Floats) -> Working[_Candidate]:
        """Judge a proposal and keep it; of those that are the same the best one stays."""
        evidence = yield from judge(here, there, pose, self._config.tolerance_mm)
        alike = [c for c in self.candidates if self._same(evidence.pose, c)]
        self.candidates = [c for c in self.candidates if c not in alike]
        between = None
        if evidence.best:
            (i, j), *_ = evidence.best
            between = inverse(there.poses[j]) @ evidence.pose @ here.poses[i]
        seen = len(here.points) + len(there.points)
        alike.append(_Candidate(evidence.pose, evidence, between, seen))
        if self._moves:  # keyframes have moved since the judgement began
            self._follow(alike[-1])
        best = max(alike, key=lambda c: c.evidence.inliers)  # a bad start may end up beside it
        self.candidates.append(best)
        self.candidates.sort(key=lambda c: (not self._holds(c), -c.evidence.inliers))
        del self.candidates[CANDIDATES:]
        return best

    def _holds(self, candidate: _Candidate) -> bool:
        return self._lacks(candidate.evidence) is None

    def _lacks(self, evidence: Evidence) -> str | None:
        """Why a proposal is not believed."""
        tolerance = self._config.tolerance_mm
        if evidence.inliers < self._config.inliers:
            return "too few points agree"
        if evidence.independent < 2:
            return "only one keyframe of a robot agrees"
        if evidence.spread[1] < 2 * tolerance or evidence.spread[2] < tolerance:
            return "the points that agree lie in one plane or line"
        if evidence.weight < (FIRM * tolerance) ** 2:
            return "the points that agree are too few to fix the turn"
        if not evidence.sharp:
            return "the maps fit as well a little beside it"
        return None

    def _conclude(self) -> Link | None:
        best, *others = self.candidates
        self.reason = self._lacks(best.evidence) or ""
        if self.reason:
            return self._withdraw()
        rival = RIVAL * best.evidence.inliers
        if any(self._holds(c) and c.evidence.inliers >= rival for c in others):
            self.reason = "the maps fit in more than one way"
            return self._withdraw()
        return self._settle(best.pose, best.evidence, best.evidence.weight)
