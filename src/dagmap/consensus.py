"""Section 4.3: the map as a pure function of the set of accepted transactions.

The fold takes transactions in canonical order. What sorts before something already applied, or
changes what was applied (a moved anchor, a retraction, a new link, a proven fork), only leaves a
mark; `advance` then undoes down to the lowest mark and applies up again, once for all of them.
That is a revision. It may take many calls: then a copy of what was folded is there to be read
meanwhile, and what comes once the undoing is over waits for the next one, so that every revision
ends. Ray evidence commutes, so it stays outside the undo: what changes walks again.
"""

from __future__ import annotations

import hashlib
from bisect import insort
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from .config import Config
from .contribution import Author, Contribution, Key, Placement
from .folded import TRANSACTION, Copying, Folded, Picture, frame_bytes
from .frames import IDENTITY_POSE, place_frames, rough
from .kernels.geometry import apply_pose
from .model import FLEET_FRAME, AuthorId, Bools, FrameId, Int32s
from .payload import Anchor
from .transaction import Transaction

MAX_SESSIONS = 256  # of one author that others look for; its features count in any case
# What placing frames costs is bounded by the links that count: of one author to frames of one
# other, the first in its chain, so that whoever shows a robot ever new frames uses up the room for
# its own frames only; and to frames of so many authors.
MAX_LINKS, MAX_LINKED = 64, 1024


class _Cut(NamedTuple):
    """Of an author, nothing from this number on counts."""

    author: AuthorId
    sequence: int


class _Work:
    """Counts units of work (see `folded`) against a budget."""

    def __init__(self, budget: int | None) -> None:
        self.left = float("inf") if budget is None else budget
        self.bounded = budget is not None
        self.undone = self.applied = 0  # transactions

    @property
    def over(self) -> bool:
        return self.left <= 0


class Consensus:
    """Orders, places and folds. What is read from it is up to date after `advance()`."""

    def __init__(self, config: Config, salt: int = 0) -> None:
        self._config, self._salt = config, salt
        self.authors: dict[AuthorId, Author] = {}
        self.frames: dict[FrameId, Placement] = {}
        self.firm = self.frames  # the same without the start poses that are but rough
        self.revising = False  # something was undone that is not applied again
        self.version = 0  # of what is folded; it stays as it is in a revision
        self.folded = Folded(config.fold, salt)  # a prefix of the order, once unmarked
        self._order: list[Key] = []
        self._contributions: dict[Key, Contribution] = {}
        self._members: set[Key] = set()  # those of the order, and of what waits
        self._mark: Key | None = None  # from this key on nothing is applied as it should be
        self._stale: set[Key] = set()  # to be placed (again) before they are applied
        self._gone: list[Contribution] = []  # cut; their rays are still to be taken back
        self._links_changed = False
        self._linked: set[AuthorId] = set()  # authors to whose frames a link leads, or once led
        self._upwards = False  # the revision undoes no more
        self._late: list[Transaction | _Cut] = []  # waits for the end of a revision
        self._copying: Copying | None = None
        self._kept: Picture | None = None

    @property
    def pending(self) -> bool:
        """Whether `advance` has something to do."""
        behind = len(self.folded.applied) < len(self._order)
        marked = self._mark is not None or self._links_changed or bool(self._gone)
        return behind or marked or self.revising or bool(self._late)

    def author(self, id_: AuthorId) -> Author:
        """What is known of an author; a new one gets the next local index."""
        known = self.authors.get(id_)
        return known or self.authors.setdefault(id_, Author(id_, len(self.authors)))

    def contributions(self) -> Iterator[Contribution]:
        """All of them, in canonical order."""
        return (self._contributions[key] for key in self._order)

    def __contains__(self, tx: Transaction) -> bool:
        return tx.key in self._members

    def add(self, tx: Transaction) -> None:
        """Take a transaction that counts. Per author they come in sequence."""
        self._members.add(tx.key)
        self._take(tx)

    def cut(self, id_: AuthorId, sequence: int) -> None:
        """Leave out everything of an author from `sequence` on: a fork, or a revocation."""
        gone = {k for k in self._members if k[1] == id_ and k[2] >= sequence}
        self._members -= gone
        self._late = [w for w in self._late if isinstance(w, _Cut) or w.key not in gone]
        self._take(_Cut(id_, sequence))

    def advance(self, budget: int | None = None, keep: FrameId | None = None) -> tuple[int, int]:
        """Undo and apply until the fold is that of the set, or the budget is used up.

        budget: units of work, about the folding of one feature each; a step that has begun is
            ended. With a budget, what follows a revision is left to the next call.
        keep: component of which `picture` is to give what was folded before, should a revision
            begin that the budget does not suffice for.
        Returns how many transactions were undone and applied.
        """
        work = _Work(budget)
        while self.pending and not work.over:
            if not self.revising:
                self._admit(work)
                if self._late:  # the budget is used up
                    break
                self._begin(work, keep)
            if self._prepare(work):
                self._apply_on(work)
            if self.revising and self._upwards and len(self.folded.applied) == len(self._order):
                self.revising = self._upwards = False
                self._kept = None
                self.version += 1
                if work.bounded:
                    break
        return work.undone, work.applied

    def drop_records(self) -> None:
        """Drop the undo records of all but the newest; what comes before them later is folded
        anew from the first transaction on."""
        if not self.revising:
            self.folded.drop_records(self._config.ledger.undo_kept)

    def picture(self, origin: FrameId) -> Picture:
        """A component as it is folded; in a revision what was to be kept, as it was before it."""
        if self._kept is not None:
            return self._kept
        if self._copying is not None:
            return self._copying.picture
        return self.folded.picture(origin)

    def placement(self, author: AuthorId, session: int) -> Placement:
        """The component of a SLAM frame and the (7,) pose of the frame in it."""
        frame = FrameId(author, session)
        return self.frames.get(frame) or (frame, np.array(IDENTITY_POSE, np.int32))

    def settled(self, author: AuthorId, session: int, points: Int32s, repeats: int) -> Bools:
        """(N,) points (N, 3) mm in an author's SLAM frame of which it has said all that counts."""
        component, pose = self.placement(author, session)
        found, known = self.folded.components.get(component), self.authors.get(author)
        if found is None or known is None:
            return np.zeros(len(points), np.bool_)
        placed, inside = np.empty_like(points), np.ones(len(points), np.bool_)
        apply_pose(pose, points, placed, inside)
        return found.fold.settled(known.index, placed, repeats) & inside

    def digest(self) -> bytes:
        """32 bytes over all components (nodes, their evidence, their states) and the frames."""
        self.advance()
        digest = hashlib.blake2b(digest_size=32, person=b"dagmap map 1")
        self.folded.digest_into(digest)
        for frame, (origin, pose) in sorted(self.frames.items()):
            digest.update(frame_bytes(frame) + frame_bytes(origin) + pose.astype("<i4").tobytes())
        return digest.digest()

    @property
    def nbytes(self) -> int:
        """Memory held by folds, ray evidence and placed features."""
        return self.folded.nbytes + sum(
            c.xyz.nbytes + c.color.nbytes for c in self._contributions.values()
        )

    def _take(self, what: Transaction | _Cut) -> None:
        """Order a transaction, or do a cut; now, or once the revision under way is over."""
        if self._upwards or self._late:
            self._late.append(what)
        elif isinstance(what, _Cut):
            self._cut(*what)
        else:
            contribution = Contribution(what, self.author(what.author), self._config)
            self._contributions[what.key] = contribution
            insort(self._order, what.key)
            self._restale((what.key,))
            self._note(contribution)
            what.drop_columns()

    def _cut(self, id_: AuthorId, sequence: int) -> None:
        mine = [key for key in self._order if key[1] == id_]
        gone = {key for key in mine if key[2] >= sequence}
        if not gone:
            return
        self._restale(mine)
        self._gone += [self._contributions.pop(key) for key in sorted(gone)]
        self._stale -= gone
        self._order = [key for key in self._order if key not in gone]
        self.authors[id_] = Author(id_, self.authors[id_].index)
        self._links_changed = True
        for key in mine:
            if key not in gone:
                self._contributions[key].author = self.authors[id_]
                self._note(self._contributions[key])

    def _admit(self, work: _Work) -> None:
        """What came in the last revision."""
        late, self._late, done = self._late, [], 0
        while done < len(late) and not work.over:
            self._take(late[done])
            work.left -= TRANSACTION
            done += 1
        self._late = late[done:]

    def _begin(self, work: _Work, keep: FrameId | None) -> None:
        """See whether something is to be undone; keep a picture where that will take long."""
        changed = self._links_changed
        if changed:
            self._update_frames()
        self.revising = self._undoes or bool(self._gone)
        if not self.revising:
            self.version += changed
        elif keep is not None and self._takes_long(work):
            self._copying = Copying(self.folded.picture(keep))

    def _takes_long(self, work: _Work) -> bool:
        """Whether the budget will not suffice to undo and to apply again."""
        folded = self.folded
        left, at = work.left - sum(map(folded.walk_units, self._gone)), len(folded.applied)
        while at > 0 and self._mark is not None and folded.applied[at - 1].key >= self._mark:
            at = 0 if at == folded.firm else at - 1
            left -= folded.undo_units(folded.applied[at])
            if left <= 0:
                return True
        for key in self._order[at:]:
            left -= self._apply_units(self._contributions[key])
            if left <= 0:
                return True
        return False

    def _prepare(self, work: _Work) -> bool:
        """Copy, undo, take back the rays of what was cut. Whether all of that is done."""
        if self._upwards:
            return True
        if self._copying is not None:
            work.left -= self._copying.step(int(min(work.left, 1 << 40)))
            if not self._copying.done:
                return False
            self._kept, self._copying = self._copying.finished(), None
        if self._links_changed:
            self._update_frames()
        while self._undoes and not work.over:
            before = len(self.folded.applied)
            work.left -= self.folded.undo()
            work.undone += before - len(self.folded.applied)
        while self._gone and not self._undoes and not work.over:
            work.left -= self.folded.walk_units(self._gone[-1])
            self.folded.walk(self._gone.pop(), -1)
        if self._undoes or self._gone:
            return False
        self._mark = None
        self._upwards = self.revising
        return True

    @property
    def _undoes(self) -> bool:
        """Whether something is applied that the mark says is not as it should be."""
        applied, mark = self.folded.applied, self._mark
        return mark is not None and bool(applied) and applied[-1].key >= mark

    def _apply_on(self, work: _Work) -> None:
        """Apply what comes next in the order."""
        first = len(self.folded.applied)
        for key in self._order[first:]:
            if work.over:
                break
            contribution = self._contributions[key]
            work.left -= self._apply_units(contribution)
            work.applied += 1
            self._apply(contribution)
        if not self.revising:
            self.version += len(self.folded.applied) > first

    def _restale(self, keys: Iterable[Key]) -> None:
        """These are not placed as they should be: place and apply them (again)."""
        for key in keys:
            self._stale.add(key)
            if self._mark is None or key < self._mark:
                self._mark = key

    def _note(self, contribution: Contribution) -> None:
        """Take what a transaction says beside features, and mark what that changes."""
        author, tx = contribution.author, contribution.transaction
        for cycle in contribution.touched_cycles:
            author.seen_in.setdefault(cycle, []).append(tx.key)
        if tx.features:
            author.bases.append(contribution.base)
            author.keys.append(tx.key)
        for anchor in tx.payload.anchors:
            known = author.anchors.get(anchor.cycle)
            author.anchors[anchor.cycle] = anchor
            if anchor.session not in author.sessions and len(author.sessions) < MAX_SESSIONS:
                author.sessions.add(anchor.session)
                self._links_changed |= author.id in self._linked
            if known is None or not _same(known, anchor):
                self._restale(author.seen_in.get(anchor.cycle, ()))
        self._restale(author.retract(tx.payload.retracted))
        for link in tx.payload.links:
            # a robot places its own frames only
            if link.source.author == tx.author and author.take_link(link, MAX_LINKS, MAX_LINKED):
                self._linked.add(link.target.author)
                self._links_changed = True
        author.name = author.name if tx.payload.robot is None else tx.payload.robot

    def _update_frames(self) -> None:
        before = self.frames
        every = (link for author in self.authors.values() for link in author.links.values())
        links = [link for link in every if self._exists(link.target)]
        self.frames, self._links_changed = place_frames(links), False
        firm = [link for link in links if not rough(link)]
        self.firm = self.frames if len(firm) == len(links) else place_frames(firm)
        frames = before.keys() | self.frames.keys()
        moved = {f for f in frames if not _alike(before.get(f), self.frames.get(f))}
        authors = {frame.author for frame in moved} & self.authors.keys()
        for author in (self.authors[id_] for id_ in authors):
            for cycle, keys in author.seen_in.items():
                anchor = author.anchors.get(cycle)
                if anchor is not None and FrameId(author.id, anchor.session) in moved:
                    self._restale(keys)

    def _exists(self, frame: FrameId) -> bool:
        """Whether a frame is the fleet's or its author has seen anything in it."""
        author = self.authors.get(frame.author)
        return frame == FLEET_FRAME or (author is not None and frame.session in author.sessions)

    def _apply(self, contribution: Contribution) -> None:
        folded = self.folded
        if contribution.key in self._stale:
            folded.walk(contribution, -1)
            contribution.place(self.placement, self._config)
            folded.walk(contribution, +1)
            self._stale.discard(contribution.key)
        folded.apply(contribution)

    def _apply_units(self, contribution: Contribution) -> int:
        units = self.folded.apply_units(contribution)
        if contribution.key in self._stale:
            units += self.folded.place_units(contribution)
        return units


def _same(a: Anchor, b: Anchor) -> bool:
    return a.session == b.session and np.array_equal(a.pose, b.pose)


def _alike(a: Placement | None, b: Placement | None) -> bool:
    if a is None or b is None:
        return a is b
    return a[0] == b[0] and np.array_equal(a[1], b[1])
