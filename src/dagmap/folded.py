"""What is folded by now: components of frames, the contributions in them, and how to go a step on
or back. A picture of a component is what a map is built from; a copy of it outlasts a revision.
"""

from __future__ import annotations

import hashlib
import pickle
from collections import Counter
from dataclasses import dataclass

import numpy as np

from .config import FoldConfig
from .contribution import Contribution
from .fold import DefaultFold, Fold, NodeColumns, RayEvidence, Verdict, make_fold
from .model import FrameId, Int32s, Uint8s

# A unit of work takes about as long as folding one new feature: a microsecond, say.
TRANSACTION = 32  # units for each, beside its features
_OBSERVATIONS = 2  # that meet their nodes in a unit
_RAY_CELLS = 32  # that a ray crosses in a unit
_BYTES = 1024  # copied in a unit
_DECODED = 2  # units for each feature that is read from the wire again


@dataclass(slots=True)
class Component:
    """The nodes and the ray evidence of one connected component of frames."""

    fold: Fold
    rays: RayEvidence
    verdict: Verdict | None = None  # of the nodes as they are, once it was asked for

    def nodes(self) -> tuple[NodeColumns, Verdict] | None:
        """The nodes and what the fleet thinks of them; None where there is no node."""
        if len(self.fold) == 0:
            return None
        if self.verdict is None:  # weighed once, however often it is read
            self.verdict = self.fold.evaluate(self.rays)
        return self.fold.columns(), self.verdict


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """One component after the contributions that are folded into it, in canonical order."""

    origin: FrameId
    component: Component | None  # None: nothing was ever folded into it
    contributions: tuple[Contribution, ...]


class Copying:
    """A copy of a component, made step by step; the component must not change meanwhile."""

    def __init__(self, picture: Picture) -> None:
        self.picture = picture
        self._sources: list[Uint8s] = []
        self._head = pickle.dumps(picture.component, 5, buffer_callback=self._hold)
        self._copies = [np.empty_like(source) for source in self._sources]
        self._array = self._byte = 0  # where the next step goes on

    @property
    def done(self) -> bool:
        return self._array == len(self._sources)

    def step(self, units: int) -> int:
        """Copy on, for so many units of work at most. Returns how many it took."""
        left = units * _BYTES
        while left > 0 and not self.done:
            source = self._sources[self._array]
            rows = slice(self._byte, self._byte + left)
            self._copies[self._array][rows] = source[rows]
            left -= len(source[rows])
            self._byte += len(source[rows])
            if self._byte == len(source):
                self._array, self._byte = self._array + 1, 0
        return units - max(left, 0) // _BYTES

    def finished(self) -> Picture:
        """The copy, once it is done."""
        component = pickle.loads(self._head, buffers=self._copies)
        return Picture(self.picture.origin, component, self.picture.contributions)

    def _hold(self, buffer: pickle.PickleBuffer) -> None:
        self._sources.append(np.frombuffer(buffer.raw(), np.uint8))


class Folded:
    """The components after the contributions `applied`, a stack, in canonical order.

    Ray evidence is that of all contributions that were walked, whether they are applied or not.
    """

    def __init__(self, config: FoldConfig, salt: int) -> None:
        self._config, self._salt = config, salt
        self._ray_units = 1 + config.max_ray_mm // config.cell_mm // _RAY_CELLS
        self.components: dict[FrameId, Component] = {}
        self.applied: list[Contribution] = []
        self.firm = 0  # of these, the first so many have no undo records any more

    def apply(self, contribution: Contribution) -> None:
        for part in contribution.parts:
            self._changed(part.component).fold.apply(contribution.block(part))
        self.applied.append(contribution)

    def undo(self) -> int:
        """Take back the contribution that was applied last; where its record is dropped, all of
        them, to be applied from the first on. Returns the work."""
        if self.firm == len(self.applied):
            return self._start_over()
        contribution = self.applied.pop()
        for part in reversed(contribution.parts):
            self._changed(part.component).fold.undo(contribution.block(part))
        return self.undo_units(contribution)

    def drop_records(self, keep: int) -> None:
        """Drop the undo records of all but the last contributions with `keep` observations."""
        kept, size = Counter[FrameId](), 0
        first = len(self.applied)
        while first > self.firm and size < keep:
            first -= 1
            size += self.applied[first].size
            for part in self.applied[first].parts:
                sightings = sum(len(sighting.numbers) for sighting in part.sightings)
                kept[part.component] += 1 + len(self.applied[first].xyz) + sightings
        self.firm = first
        for id_, component in self.components.items():
            component.fold.drop_records(kept[id_])

    def _start_over(self) -> int:
        self.firm = 0
        self.applied.clear()
        for id_ in self.components:
            self._changed(id_).fold = make_fold(self._config, self._salt)
        return TRANSACTION

    def walk(self, contribution: Contribution, sign: int) -> None:
        """Add a contribution's rays (+1) or take them back (-1), as it was last placed."""
        if self._config.preset == "paper":  # Algorithm 2 knows no rays
            return
        for part in contribution.parts:
            self._changed(part.component).rays.walk(
                contribution.author.index,
                part.origins,
                contribution.starts,
                contribution.xyz,
                contribution.alive(part),
                sign,
            )

    def apply_units(self, contribution: Contribution) -> int:
        """Work of applying what is placed already."""
        return TRANSACTION + contribution.size // _OBSERVATIONS

    def undo_units(self, contribution: Contribution) -> int:
        return self.apply_units(contribution) // 2

    def walk_units(self, contribution: Contribution) -> int:
        return len(contribution.xyz) * self._ray_units

    def place_units(self, contribution: Contribution) -> int:
        """Work of placing and walking (again)."""
        decoded = 0 if contribution.fresh else _DECODED * len(contribution.xyz)
        walks = 2 if contribution.parts else 1  # what was placed before is taken back first
        return decoded + walks * self.walk_units(contribution)

    def nodes(self, component: FrameId) -> tuple[NodeColumns, Verdict] | None:
        """The nodes of a component and what the fleet thinks of them."""
        found = self.components.get(component)
        return None if found is None else found.nodes()

    def against(self, component: FrameId) -> Int32s:
        """(N,) what speaks against each node of a component, whether it counts or not."""
        found = self.components[component]
        if isinstance(found.fold, DefaultFold):
            return found.fold.weigh(found.rays).against
        return found.fold.evaluate(found.rays).misses

    def feature_nodes(self, component: FrameId, author: int) -> Int32s:
        """The node of each feature number of an author (its index), -1 where none."""
        return self.components[component].fold.feature_nodes(author)

    def picture(self, origin: FrameId) -> Picture:
        """A component as it is now."""
        return Picture(origin, self.components.get(origin), tuple(self.applied))

    def digest_into(self, digest: hashlib.blake2b) -> None:
        """All components: nodes, their evidence, their states."""
        for component in sorted(self.components):
            found = self.nodes(component)
            if found is None:
                continue
            digest.update(frame_bytes(component))
            for column in (*found[0].columns(), *found[1].columns()):
                little = np.ascontiguousarray(column, column.dtype.newbyteorder("<"))
                digest.update(b"%s %d;" % (little.dtype.str.encode(), little.size))
                digest.update(little.data)

    @property
    def nbytes(self) -> int:
        """Memory held by folds and ray evidence."""
        return sum(c.fold.nbytes + c.rays.nbytes for c in self.components.values())

    def _changed(self, id_: FrameId) -> Component:
        """A component that is about to change."""
        found = self.components.get(id_)
        if found is None:
            fold = self._config
            rays = RayEvidence(fold.cell_mm, fold.max_ray_mm, self._salt)
            found = self.components[id_] = Component(make_fold(fold, self._salt), rays)
        found.verdict = None
        return found


def frame_bytes(frame: FrameId) -> bytes:
    """Twelve bytes that name a frame, for hashing."""
    return frame.author + frame.session.to_bytes(4, "little")
