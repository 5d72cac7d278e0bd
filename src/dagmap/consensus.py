"""Section 4.3: the map as a pure function of the set of accepted transactions.

The fold takes transactions in canonical order. What sorts before something already applied, or
changes what was applied (a moved anchor, a retraction, a new link, a proven fork), only leaves a
mark; `advance` then undoes down to the lowest mark and applies up again, once for all of them.
Ray evidence commutes, so it stays outside the undo: a contribution that changes walks again.
"""

from __future__ import annotations

import hashlib
from bisect import insort
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from .config import Config
from .contribution import Author, Contribution, Key, Placement
from .fold import DefaultFold, Fold, NodeColumns, RayEvidence, Verdict, make_fold
from .frames import IDENTITY_POSE, place_frames
from .kernels.geometry import apply_pose
from .model import AuthorId, Bools, FrameId, Int32s
from .payload import Anchor
from .transaction import Transaction

MAX_SESSIONS = 256  # of one author that others look for; its features count in any case
MAX_LINKS = 256  # of one author, the first in its chain: bounds what placing frames costs


@dataclass(slots=True)
class Component:
    """The nodes and the ray evidence of one connected component of frames."""

    fold: Fold
    rays: RayEvidence
    verdict: Verdict | None = None  # of the nodes as they are, once it was asked for


class Consensus:
    """Orders, places and folds. What is read from it is up to date after `advance()`."""

    def __init__(self, config: Config, salt: int = 0) -> None:
        self._config, self._salt = config, salt
        self.authors: dict[AuthorId, Author] = {}
        self.frames: dict[FrameId, Placement] = {}
        self._components: dict[FrameId, Component] = {}
        self._order: list[Key] = []
        self._contributions: dict[Key, Contribution] = {}
        self._applied: list[Key] = []  # what is in the folds: a prefix of the order, once unmarked
        self._mark: Key | None = None  # from this key on nothing is applied as it should be
        self._stale: set[Key] = set()  # to be placed (again) before they are applied
        self._links_changed = False

    @property
    def pending(self) -> bool:
        """Whether `advance` has something to do."""
        behind = len(self._applied) < len(self._order)
        return behind or self._mark is not None or self._links_changed

    def author(self, id_: AuthorId) -> Author:
        """What is known of an author; a new one gets the next local index."""
        known = self.authors.get(id_)
        return known or self.authors.setdefault(id_, Author(id_, len(self.authors)))

    def contributions(self) -> Iterator[Contribution]:
        """All of them, in canonical order."""
        return (self._contributions[key] for key in self._order)

    def __contains__(self, tx: Transaction) -> bool:
        return tx.key in self._contributions

    def add(self, tx: Transaction) -> None:
        """Take a transaction that counts. Per author they come in sequence."""
        contribution = Contribution(tx, self.author(tx.author), self._config)
        self._contributions[tx.key] = contribution
        insort(self._order, tx.key)
        self._restale((tx.key,))
        self._note(contribution)
        tx.drop_columns()

    def cut(self, id_: AuthorId, sequence: int) -> None:
        """Leave out everything of an author from `sequence` on: a fork, or a revocation."""
        mine = [key for key in self._order if key[1] == id_]
        gone = [key for key in mine if key[2] >= sequence]
        if not gone:
            return
        self._restale(mine)
        self._undo()
        for key in gone:
            self._walk(self._contributions.pop(key), -1)
            self._stale.discard(key)
            self._order.remove(key)
        self.authors[id_] = Author(id_, self.authors[id_].index)
        self._links_changed = True
        for key in mine[: len(mine) - len(gone)]:
            self._contributions[key].author = self.authors[id_]
            self._note(self._contributions[key])

    def advance(self, budget: int | None = None) -> tuple[int, int]:
        """Undo and apply until the fold is that of the set, or `budget` features are applied.

        Returns how many transactions were undone and applied.
        """
        if self._links_changed:
            self._update_frames()
        undone, applied, work = self._undo(), 0, 0
        while len(self._applied) < len(self._order) and (budget is None or work < budget):
            contribution = self._contributions[self._order[len(self._applied)]]
            self._apply(contribution)
            applied += 1
            work += 1 + len(contribution.xyz)
        return undone, applied

    def placement(self, author: AuthorId, session: int) -> Placement:
        """The component of a SLAM frame and the (7,) pose of the frame in it."""
        frame = FrameId(author, session)
        return self.frames.get(frame) or (frame, np.array(IDENTITY_POSE, np.int32))

    def nodes(self, component: FrameId) -> tuple[NodeColumns, Verdict] | None:
        """The nodes of a component and what the fleet thinks of them (`advance` first)."""
        found = self._components.get(component)
        if found is None or len(found.fold) == 0:
            return None
        if found.verdict is None:  # weighed once, however often it is read
            found.verdict = found.fold.evaluate(found.rays)
        return found.fold.columns(), found.verdict

    def settled(self, author: AuthorId, session: int, points: Int32s, repeats: int) -> Bools:
        """(N,) points (N, 3) mm in an author's SLAM frame of which it has said all that counts."""
        component, pose = self.placement(author, session)
        found, known = self._components.get(component), self.authors.get(author)
        if found is None or known is None:
            return np.zeros(len(points), np.bool_)
        placed, inside = np.empty_like(points), np.ones(len(points), np.bool_)
        apply_pose(pose, points, placed, inside)
        return found.fold.settled(known.index, placed, repeats) & inside

    def against(self, component: FrameId) -> Int32s:
        """(N,) what speaks against each node of a component, whether it counts or not."""
        found = self._components[component]
        if isinstance(found.fold, DefaultFold):
            return found.fold.weigh(found.rays).against
        return found.fold.evaluate(found.rays).misses

    def feature_nodes(self, component: FrameId, author: Author) -> Int32s:
        """The node of each feature number of an author in a component, -1 where none."""
        return self._components[component].fold.feature_nodes(author.index)

    def digest(self) -> bytes:
        """32 bytes over all components (nodes, their evidence, their states) and the frames."""
        self.advance()
        digest = hashlib.blake2b(digest_size=32, person=b"dagmap map 1")
        for component in sorted(self._components):
            found = self.nodes(component)
            if found is None:
                continue
            digest.update(_frame_bytes(component))
            for column in (*found[0].columns(), *found[1].columns()):
                little = np.ascontiguousarray(column, column.dtype.newbyteorder("<"))
                digest.update(b"%s %d;" % (little.dtype.str.encode(), little.size))
                digest.update(little.data)
        for frame, (origin, pose) in sorted(self.frames.items()):
            digest.update(_frame_bytes(frame) + _frame_bytes(origin) + pose.astype("<i4").tobytes())
        return digest.digest()

    @property
    def nbytes(self) -> int:
        """Memory held by folds, ray evidence and placed features."""
        folds = sum(c.fold.nbytes + c.rays.nbytes for c in self._components.values())
        return folds + sum(c.xyz.nbytes + c.color.nbytes for c in self._contributions.values())

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
            if len(author.sessions) < MAX_SESSIONS:
                author.sessions.add(anchor.session)
            if known is None or not _same(known, anchor):
                self._restale(author.seen_in.get(anchor.cycle, ()))
        self._restale(author.retract(tx.payload.retracted))
        for link in tx.payload.links:
            ends = (link.source, link.target)
            room = ends in author.links or len(author.links) < MAX_LINKS
            if link.source.author == tx.author and room:  # a robot places its own frames only
                author.links[ends] = link
                self._links_changed = True
        author.name = author.name if tx.payload.robot is None else tx.payload.robot

    def _update_frames(self) -> None:
        before = self.frames
        links = (link for author in self.authors.values() for link in author.links.values())
        self.frames, self._links_changed = place_frames(links), False
        for author in self.authors.values():
            for cycle, keys in author.seen_in.items():
                anchor = author.anchors.get(cycle)
                frame = None if anchor is None else FrameId(author.id, anchor.session)
                if frame is not None and not _alike(before.get(frame), self.frames.get(frame)):
                    self._restale(keys)

    def _undo(self) -> int:
        """Take back everything from the mark on."""
        if self._mark is None:
            return 0
        undone = 0
        while self._applied and self._applied[-1] >= self._mark:
            contribution = self._contributions[self._applied.pop()]
            for part in reversed(contribution.parts):
                self._component(part.component).fold.undo(contribution.block(part))
            undone += 1
        self._mark = None
        return undone

    def _apply(self, contribution: Contribution) -> None:
        if contribution.key in self._stale:
            self._walk(contribution, -1)
            contribution.place(self.placement, self._config)
            self._walk(contribution, +1)
            self._stale.discard(contribution.key)
        for part in contribution.parts:
            self._component(part.component).fold.apply(contribution.block(part))
        self._applied.append(contribution.key)

    def _walk(self, contribution: Contribution, sign: int) -> None:
        if self._config.fold.preset == "paper":  # Algorithm 2 knows no rays
            return
        for part in contribution.parts:
            self._component(part.component).rays.walk(
                contribution.author.index,
                part.origins,
                contribution.starts,
                contribution.xyz,
                contribution.alive(part),
                sign,
            )

    def _component(self, id_: FrameId) -> Component:
        """A component that is about to change."""
        found = self._components.get(id_)
        if found is not None:
            found.verdict = None
        if found is None:
            fold = self._config.fold
            rays = RayEvidence(fold.cell_mm, fold.max_ray_mm, self._salt)
            found = self._components[id_] = Component(make_fold(fold, self._salt), rays)
        return found


def _same(a: Anchor, b: Anchor) -> bool:
    return a.session == b.session and np.array_equal(a.pose, b.pose)


def _alike(a: Placement | None, b: Placement | None) -> bool:
    if a is None or b is None:
        return a is b
    return a[0] == b[0] and np.array_equal(a[1], b[1])


def _frame_bytes(frame: FrameId) -> bytes:
    return frame.author + frame.session.to_bytes(4, "little")
