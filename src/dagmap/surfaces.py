"""Robots that share no frame and have no descriptors: placed by the shape of what they saw.

The points of both are in the ledger already. Every now and then, as they grow, the surfels of two
frames are laid on each other in every way that their planes allow (`aligning`). The best one is
published where hardly anything contradicts it, where it is fixed in all directions by more than one
keyframe and by more than the walls of a plain room, and where no other way is half as good.

One search is under way at a time, in pieces, so the memory holds the grids of two frames.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

from .aligning import Agreement, align
from .clouds import Cloud
from .config import Config
from .consensus import Consensus
from .frames import Placed
from .ledger import Ledger
from .model import AuthorId, FrameId
from .payload import Link
from .registration import Working
from .relating import RIVAL, Relation
from .surfels import FINE, Surfels, survey

ENOUGH = 500  # points of a frame, before its shape is looked at
GROWN = 1.25  # times as many points: worth another search; for what is placed
SETTLED = 2.0
NEWEST = 4  # sessions of an author that are looked at
PLANES = 8  # that agree beside the largest one in each direction
CONTRARY = 0.004  # share that may contradict for each of these planes (people, drift), and at most
MOST_CONTRARY = 0.08
_DECODED = 300  # features a unit


class Shape(Relation):
    """Two frames that are compared by their surfaces."""

    def __init__(self, config: Config, source: FrameId, target: FrameId) -> None:
        super().__init__(config.placing, source, target)
        self.reason = "too little was seen yet to go by its shape"
        self.judged: tuple[int, int, int, int] | None = None  # points and moves of both ends, then
        self.heard: Link | None = None  # the answer, then

    def lacks(self, found: Agreement) -> str | None:
        """Why an alignment is not believed."""
        least = self._config.inliers
        if found.independent < 2:
            return "only one keyframe of a robot agrees"
        if found.firm[0] < least / 2:
            return "the surfaces that agree do not fix the pose"
        if found.planes < PLANES or found.inliers < 2 * least:
            return "the surfaces that agree are too plain: another room could look so"
        if found.contrary > min(CONTRARY * found.planes, MOST_CONTRARY):
            return "the one sees through what the other sees"
        return None

    def conclude(self, found: list[Agreement]) -> Link | None:
        """Publish the best of all ways (best first) if it is believed and the only one."""
        if not found:
            self.reason = "no way was found to lay the surfaces on each other"
            return self._withdraw()
        best, *others = found
        self.reason = self.lacks(best) or ""
        if self.reason:
            return self._withdraw()
        beside = 4 * self._config.tolerance_mm
        rivals = (other for other in others if best.apart(best.pose, other.pose) > beside)
        if any(best.rivalled(other) >= RIVAL * best.support for other in rivals):
            self.reason = "the maps fit in more than one way"
            return self._withdraw()
        return self._settle(best.pose, best, best.score)


class Surfaces:
    """One robot's search by shape. `step` a little in every tick."""

    def __init__(self, config: Config, me: AuthorId) -> None:
        self._config, self._me = config, me
        self._clouds: dict[AuthorId, Cloud] = {}
        self._surveyed: dict[FrameId, tuple[int, int, Surfels | None]] = {}
        self.shapes: dict[tuple[FrameId, FrameId], Shape] = {}
        self._work = self._search()

    def step(
        self, ledger: Ledger, consensus: Consensus, described: Collection[FrameId], budget: int
    ) -> int:
        """Search for about `budget` units; what is found is in the `news` of the shapes.

        described: frames whose keyframes have descriptors, which go by those among each other.
        Returns the units spent.
        """
        pairs = self._pairs(consensus, described)
        for ends in [ends for ends in self.shapes if ends not in pairs]:
            del self.shapes[ends]
        for ends in pairs:
            if ends not in self.shapes:
                self.shapes[ends] = Shape(self._config, *ends)
        spent = self._read(ledger, {frame.author for ends in pairs for frame in ends}, budget)
        while spent < budget:
            cost = next(self._work)
            if cost == 0:
                break
            spent += cost
        return spent

    def _pairs(
        self, consensus: Consensus, described: Collection[FrameId]
    ) -> set[tuple[FrameId, FrameId]]:
        """Own frames and others that are to be compared: not placed yet, or by this."""
        frames = [
            FrameId(author.id, session)
            for author in consensus.authors.values()
            for session in sorted(author.sessions)[-NEWEST:]
        ]
        mine = [frame for frame in frames if frame.author == self._me]
        out = set()
        for source in mine:
            for target in frames:
                if target.author == self._me and target >= source:
                    continue
                if source in described and target in described:
                    continue
                known = self.shapes.get((source, target))
                placed = known is not None and bool(known.published or known.answer)
                if placed or not together(source, target, consensus.firm):
                    out.add((source, target))
        return out

    def _read(self, ledger: Ledger, authors: Collection[AuthorId], budget: int) -> int:
        """Read on in the chains of those authors; the others' clouds are forgotten."""
        for author in [author for author in self._clouds if author not in authors]:
            del self._clouds[author]
        self._surveyed = {f: s for f, s in self._surveyed.items() if f.author in self._clouds}
        spent = 0
        for author in sorted(authors):
            cloud = self._clouds.setdefault(author, Cloud())
            while spent < budget:
                features = cloud.read_on(ledger.chain(author), self._config)
                if features < 0:
                    break
                spent += 1 + features // _DECODED
        return spent

    def _search(self) -> Iterator[int]:
        """Endless: what the last piece of work cost in units, 0 when there was nothing to do."""
        while True:
            shape = self._due()
            if shape is None:
                yield 0
                continue
            shape.judged, shape.heard = self._state(shape), shape.answer
            here = yield from self._surfels(shape.source)
            there = yield from self._surfels(shape.target)
            self._surveyed = {
                frame: known
                for frame, known in self._surveyed.items()
                if frame in (shape.source, shape.target)
            }
            if here is None or there is None:
                continue
            yield from _compare(shape, here, there)

    def _due(self) -> Shape | None:
        """The shape that has something new to be looked at; the longest unjudged first."""
        due = []
        for ends, shape in sorted(self.shapes.items()):
            now = self._state(shape)
            if now is not None and _news(shape, now):
                due.append((0 if shape.judged is None else shape.judged[0], ends))
        return self.shapes[min(due)[1]] if due else None

    def _state(self, shape: Shape) -> tuple[int, int, int, int] | None:
        """Points and moves of both ends; None while one has too few."""
        out = []
        for frame in (shape.source, shape.target):
            cloud = self._clouds.get(frame.author)
            count = 0 if cloud is None else cloud.sessions.get(frame.session, 0)
            if cloud is None or count < ENOUGH:
                return None
            out += [count, cloud.moves]
        return out[0], out[1], out[2], out[3]

    def _surfels(self, frame: FrameId) -> Working[Surfels | None]:
        """Those of a frame, as it is now or was when they were last made and little has come."""
        cloud = self._clouds.get(frame.author)
        if cloud is None:
            return None
        count = cloud.sessions.get(frame.session, 0)
        known = self._surveyed.get(frame)
        if known is not None and known[1] == cloud.moves and count < 1.1 * known[0]:
            return known[2]
        placing = self._config.placing
        points, origins, groups = cloud.gather(frame.session, 1000 * placing.keyframe_distance)
        yield 1 + len(points) // 4000
        surfels = None
        if len(points) >= ENOUGH:  # it may have withdrawn some
            surfels = yield from survey(points, origins, groups, FINE * placing.tolerance_mm)
        self._surveyed[frame] = count, cloud.moves, surfels
        return surfels


def together(one: FrameId, other: FrameId, placed: Placed) -> bool:
    """Whether a chain of links leads from one frame to the other."""
    ends = [placed[frame][0] if frame in placed else frame for frame in (one, other)]
    return ends[0] == ends[1]


def _news(shape: Shape, now: tuple[int, int, int, int]) -> bool:
    if shape.judged is None or shape.answer is not shape.heard:
        return True
    grown = SETTLED if shape.published else GROWN
    before = shape.judged
    if now[1] != before[1] or now[3] != before[3]:
        return True
    return now[0] >= grown * before[0] or now[2] >= grown * before[2]


def _compare(shape: Shape, here: Surfels, there: Surfels) -> Working[None]:
    """Look for the other end's frame. Both ends look in the same direction, and so find alike."""
    forth = shape.source < shape.target
    found = yield from align(*((here, there) if forth else (there, here)))
    link = shape.conclude(found if forth else [agreement.back() for agreement in found])
    if link is not None:
        shape.news.append(link)
    yield 1
