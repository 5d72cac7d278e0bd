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

from .bending import Bending
from .config import Config
from .consensus import Consensus
from .drift import Drift
from .frames import Placed
from .keyframes import Keyframe
from .ledger import Ledger
from .model import MAX_KEYFRAMES, AuthorId, FrameId
from .payload import CERTAIN, Described, Link
from .relating import Likeness, Relation
from .surfaces import Surfaces

_BY_SHAPE = " (a sensor without descriptors: surfaces = true in [placing])"
DESCRIBED = 2  # keyframes with descriptors: with fewer of them a frame is placed by its surfaces


class Placing:
    """One robot's search for the frames of others. `step` a little in every tick."""

    def __init__(self, config: Config, me: AuthorId, drift: Drift | None = None) -> None:
        self._config, self._me = config.placing, me
        self._read: dict[AuthorId, int] = {}  # transactions of each chain that were looked at
        self._waiting: dict[AuthorId, list[Described]] = {}  # their anchors are not known yet
        self._keyframes: dict[FrameId, list[Keyframe]] = {}
        self._relations: dict[tuple[FrameId, FrameId], Likeness] = {}
        self._surfaces = Surfaces(config, me)
        self._bending = Bending(config.placing, me, drift or Drift(config.placing))
        self._moves = 0  # of keyframes, by so much that they are to be looked at anew
        self._turn = 0
        self.spent = 0  # units of work of the last step

    def step(self, ledger: Ledger, consensus: Consensus) -> tuple[list[Link], bool]:
        """Links to publish, and whether this robot's described points are wanted."""
        strange = self._strange(consensus, consensus.firm)
        self.spent = 0
        if not strange and not self._keyframes and not self._surfaces.shapes:
            return [], False  # everybody shares one frame
        self._take_in(ledger, consensus)
        # first, since drift that is left would look like another way to place the frame
        share = -(-self._config.units_per_tick // 2)
        self.spent += self._bending.step(self._keyframes, consensus, self._moves, share)
        links = self._search(consensus)
        if self._config.surfaces:
            links += self._look_at_surfaces(ledger, consensus)
        measured = any(r.published or r.answer for r in self._relations.values())
        return links, bool(strange) or measured

    def _look_at_surfaces(self, ledger: Ledger, consensus: Consensus) -> list[Link]:
        """Spend what is left of the units on frames without descriptors."""
        described = {f for f, known in self._keyframes.items() if len(known) >= DESCRIBED}
        left = self._config.units_per_tick - self.spent
        for shape in self._surfaces.shapes.values():
            self._hear(shape, consensus)
        self.spent += self._surfaces.step(ledger, consensus, described, left)
        links = [link for shape in self._surfaces.shapes.values() for link in shape.news]
        for shape in self._surfaces.shapes.values():
            shape.news.clear()
        return links

    @property
    def busy(self) -> bool:
        """Whether the last step found something to compare."""
        return self.spent > 0

    def why(self, consensus: Consensus) -> dict[FrameId, str]:
        """Of each frame outside of this robot's components: why it is not placed there."""
        little = "too little came yet to compare"
        if not self._config.surfaces:
            little = "too few described points came yet" + _BY_SHAPE
        reasons = dict.fromkeys(sorted(self._strange(consensus, consensus.frames)), little)
        for (_, target), relation in sorted(self._relations.items()):
            if target in reasons and relation.there and relation.reason:
                reasons[target] = relation.reason
        for (_, target), shape in sorted(self._surfaces.shapes.items()):
            if target in reasons and shape.judged is not None and shape.reason:
                reasons[target] = shape.reason
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
                    relation = Likeness(self._config, source, target)
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
            self._moves += far
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

    def _hear(self, relation: Relation, consensus: Consensus) -> None:
        """What both ends have published so far."""
        ends = relation.source, relation.target
        mine = None if relation.resumed else consensus.author(self._me).links.get(ends)
        if mine is not None and 0 < mine.inliers < CERTAIN:
            relation.published = mine
        relation.resumed = True
        theirs = consensus.authors.get(relation.target.author)
        answer = None if theirs is None else theirs.links.get((relation.target, relation.source))
        relation.answer = answer if answer is not None and answer.inliers else None
