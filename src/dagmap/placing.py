"""Robots that share no frame: finds how a foreign SLAM frame lies to one of this robot's own.

Everything is read from the ledger: described points of keyframes, anchors, others' links. What is
found is published as a link, which the others may confirm or not (`frames`). Floats are allowed
here, since a link is its author's word; where frames lie follows from the links, in integers.

A proposal comes from one pair of keyframes, or is what the other end has published. It is believed
when it brings together, over all keyframes that look the same way, described points that look alike
(`registration.Evidence`): enough of them, from pairs of keyframes that have nothing in common, not
all in one plane, and so that the clouds fit there and not a little beside it. Two proposals that
contradict each other and are both believable are an ambiguity: then none is published.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from .config import PlacingConfig
from .consensus import Consensus
from .frames import Placed
from .keyframes import Keyframe, matrix_of, views
from .ledger import Ledger
from .model import (
    LIMIT_MM,
    MAX_KEYFRAMES,
    AuthorId,
    Floats,
    FrameId,
    quantise_pose,
)
from .payload import CERTAIN, Described, Link
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


@dataclass(slots=True, eq=False)
class _Candidate:
    """A proposal that was judged."""

    pose: Floats  # (4, 4) mm, source into target
    evidence: Evidence
    between: Floats | None  # (4, 4) mm the same from the one to the other keyframe that agree best
    seen: int  # keyframes of both frames when it was judged


class _Relation:
    """How one own frame lies to one other: what was compared, proposed and published."""

    def __init__(self, config: PlacingConfig, source: FrameId, target: FrameId) -> None:
        self._config, self.source, self.target = config, source, target
        self.here: list[Keyframe] = []
        self.there: list[Keyframe] = []
        self.candidates: list[_Candidate] = []
        self.resumed = False  # whether it was seen what an earlier run of this robot has published
        self.published: Link | None = None  # by this robot
        self._weight = 0.0  # of the evidence for it
        self.answer: Link | None = None  # by the other end
        self._answered: Link | None = None  # judged already
        self.reason = "nothing in common was seen yet"
        self.news: list[Link] = []  # to be published
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
        pose = best.pose
        if self.answer is not None and self.target < self.source:  # the lower one's pose counts
            said = inverse(matrix_of(self.answer.pose))
            if best.evidence.apart(said, pose) <= self._config.tolerance_mm / 2:
                pose = said
        if np.abs(pose[:3, 3]).max() >= LIMIT_MM:
            self.reason = "it lies beyond 2^29 mm"
            return self._withdraw()
        return self._publish(pose, best.evidence)

    def _publish(self, pose: Floats, evidence: Evidence) -> Link | None:
        before = self.published
        if before is not None:
            moved = evidence.apart(matrix_of(before.pose), pose) > self._config.tolerance_mm / 2
            if not moved and evidence.weight < GROWTH * self._weight:
                return None
        self._weight = evidence.weight
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


class Placing:
    """One robot's search for the frames of others. `step` a little in every tick."""

    def __init__(self, config: PlacingConfig, me: AuthorId) -> None:
        self._config, self._me = config, me
        self._read: dict[AuthorId, int] = {}  # transactions of each chain that were looked at
        self._waiting: dict[AuthorId, list[Described]] = {}  # their anchors are not known yet
        self._keyframes: dict[FrameId, list[Keyframe]] = {}
        self._relations: dict[tuple[FrameId, FrameId], _Relation] = {}
        self._turn = 0
        self.spent = 0  # units of work of the last step

    def step(self, ledger: Ledger, consensus: Consensus) -> tuple[list[Link], bool]:
        """Links to publish, and whether this robot's described points are wanted."""
        strange = self._strange(consensus, consensus.firm)
        self.spent = 0
        if not strange and not self._keyframes:
            return [], False  # everybody shares one frame
        self._take_in(ledger, consensus)
        links = self._search(consensus)
        measured = any(r.published or r.answer for r in self._relations.values())
        return links, bool(strange) or measured

    @property
    def busy(self) -> bool:
        """Whether the last step found something to compare."""
        return self.spent > 0

    def why(self, consensus: Consensus) -> dict[FrameId, str]:
        """Of each frame outside of this robot's components: why it is not placed there."""
        reasons = dict.fromkeys(
            sorted(self._strange(consensus, consensus.frames)), "no described points came yet"
        )
        for (_, target), relation in sorted(self._relations.items()):
            if target in reasons and relation.there and relation.reason:
                reasons[target] = relation.reason
        return reasons

    def _strange(self, consensus: Consensus, placed: Placed) -> set[FrameId]:
        """Frames of others, in which something was seen, that no chain of links leads to."""

        def component(frame: FrameId) -> FrameId:
            return placed[frame][0] if frame in placed else frame

        frames = {
            author.id: {FrameId(author.id, session) for session in author.sessions}
            for author in consensus.authors.values()
        }
        mine = frames.pop(self._me, set())
        here = {component(frame) for frame in mine}
        if len(here) > 1:  # a session of its own that is not placed is strange too
            return set().union(*frames.values(), mine)
        return {
            frame
            for theirs in frames.values()
            for frame in theirs
            if mine and component(frame) not in here
        }

    def _take_in(self, ledger: Ledger, consensus: Consensus) -> None:
        """Read on in every chain, and carry along what a loop closure has moved."""
        for author, chain in sorted(ledger.chains.items()):
            read = self._read.get(author, 0)
            if chain.end < read:
                self._forget(author)
                read = 0
            for tx in chain.main[read : chain.end]:
                self._waiting.setdefault(author, []).extend(tx.payload.described)
            self._read[author] = chain.end
        for author, waiting in self._waiting.items():
            late = [
                keyframe for keyframe in waiting if not self._enter(author, keyframe, consensus)
            ]
            self._waiting[author] = late[:MAX_KEYFRAMES]
        self._follow(consensus)

    def _forget(self, author: AuthorId) -> None:
        """A fork or a revocation has cut a chain: begin anew with its author."""
        self._waiting.pop(author, None)
        for frame in [frame for frame in self._keyframes if frame.author == author]:
            self._drop(frame)

    def _drop(self, frame: FrameId) -> None:
        del self._keyframes[frame]
        for ends in [ends for ends in self._relations if frame in ends]:
            del self._relations[ends]

    def _enter(self, author: AuthorId, keyframe: Described, consensus: Consensus) -> bool:
        """Compare from now on; where the author has too many, instead of its oldest session.

        False: its anchor is not known yet.
        """
        known = consensus.authors.get(author)
        anchor = None if known is None else known.anchors.get(keyframe.cycle)
        if anchor is None:
            return False
        frame = FrameId(author, anchor.session)
        theirs = [f for f in self._keyframes if f.author == author]
        if sum(len(self._keyframes[f]) for f in theirs) >= MAX_KEYFRAMES:
            if min(theirs) >= frame:
                return True
            self._drop(min(theirs))
        self._keyframes.setdefault(frame, []).append(Keyframe(author, keyframe, anchor.pose))
        self._relate(frame)
        return True

    def _relate(self, frame: FrameId) -> None:
        """Every own frame against every other one; of two own ones the later one is the source."""
        for other in sorted(self._keyframes):
            mine = [f for f in (frame, other) if f.author == self._me]
            if other != frame and mine:
                source = max(mine)
                target = other if source == frame else frame
                if (source, target) not in self._relations:
                    relation = _Relation(self._config, source, target)
                    relation.here = self._keyframes[source]
                    relation.there = self._keyframes[target]
                    self._relations[source, target] = relation

    def _follow(self, consensus: Consensus) -> None:
        for frame, keyframes in self._keyframes.items():
            anchors, far = consensus.authors[frame.author].anchors, False
            for keyframe in keyframes:
                anchor = anchors.get(keyframe.described.cycle)
                if anchor is not None and anchor.pose is not keyframe.pose:
                    keyframe.move(anchor.pose)
                    far |= keyframe.went_beyond(self._config.tolerance_mm / 2)
            for relation in self._relations.values() if far else ():
                if frame in (relation.source, relation.target):
                    relation.judge_anew()

    def _search(self, consensus: Consensus) -> list[Link]:
        """Spend this tick's units on the relations in turn."""
        links: list[Link] = []
        idle = 0
        turns = sorted(self._relations)
        while self.spent < self._config.units_per_tick and idle < len(turns):
            relation = self._relations[turns[self._turn % len(turns)]]
            self._turn += 1
            self._hear(relation, consensus)
            cost = next(relation.work)
            idle = idle + 1 if cost == 0 else 0
            self.spent += cost
            links += relation.news
            relation.news.clear()
        return links

    def _hear(self, relation: _Relation, consensus: Consensus) -> None:
        """What both ends have published so far."""
        ends = relation.source, relation.target
        mine = None if relation.resumed else consensus.author(self._me).links.get(ends)
        if mine is not None and 0 < mine.inliers < CERTAIN:
            relation.published = mine
        relation.resumed = True
        theirs = consensus.authors.get(relation.target.author)
        answer = None if theirs is None else theirs.links.get((relation.target, relation.source))
        relation.answer = answer if answer is not None and answer.inliers else None
