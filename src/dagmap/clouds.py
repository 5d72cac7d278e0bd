"""The points of every SLAM frame as their author has published them, for a look at their shape.

They are read from the ledger again where they are wanted: in a fleet that shares its frame nothing
is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .config import Config
from .kernels.columns import grown
from .keyframes import matrix_of
from .ledger import Chain
from .model import Bools, Floats, Int32s, Int64s
from .payload import Anchor
from .transaction import Transaction

MOST_POINTS = 60_000  # of one author that are kept; of more those with even numbers, then by four


@dataclass(slots=True, eq=False)
class _Segment:
    """Points of one cycle."""

    cycle: int
    numbers: Int64s  # (N,) the author's numbers of the features
    points: Int32s  # (N, 3) mm in the frame of the cycle's anchor


@dataclass(slots=True, eq=False)
class Cloud:
    """What one author has published. `moves` counts anchors that came with another pose."""

    read: int = 0  # transactions of the chain
    count: int = 0  # points published in all
    moves: int = 0
    anchors: dict[int, Anchor] = field(default_factory=dict)  # newest, by cycle
    sessions: dict[int, int] = field(default_factory=dict)  # points of each
    _segments: list[_Segment] = field(default_factory=list)
    _retracted: Bools = field(default_factory=lambda: np.zeros(0, np.bool_))  # by feature number
    _kept: int = 0
    _every: int = 1

    def read_on(self, chain: Chain, config: Config) -> int:
        """Take the next transaction of the chain. Returns its features, -1 where there is none."""
        if chain.end < self.read:  # a fork or a revocation has cut it
            self.__init__()  # type: ignore[misc]
        if self.read >= chain.end:
            return -1
        tx = chain.main[self.read]
        self.read += 1
        self._take(tx, config)
        return tx.features

    def gather(self, session: int, apart: float) -> tuple[Floats, Floats, Int64s]:
        """Of a session: points (N, 3) mm, the places of the sensor (N, 3) mm, and the number of
        the keyframe (N,): a new one begins where the sensor has moved by `apart` mm."""
        points, origins, groups = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0, np.int64)]
        last, group = np.full(3, np.inf), -1
        for segment in sorted(self._segments, key=lambda segment: segment.cycle):
            anchor = self.anchors.get(segment.cycle)
            if anchor is None or anchor.session != session:
                continue
            pose = matrix_of(anchor.pose)
            place = pose[:3, 3]
            if not np.linalg.norm(place - last) < apart:
                last, group = place, group + 1
            mine = segment.points[~self._retracted[segment.numbers]] @ pose[:3, :3].T + place
            points.append(mine)
            origins.append(np.repeat(place[None], len(mine), axis=0))
            groups.append(np.full(len(mine), group))
        return np.concatenate(points), np.concatenate(origins), np.concatenate(groups)

    def _take(self, tx: Transaction, config: Config) -> None:
        for anchor in tx.payload.anchors:
            before = self.anchors.get(anchor.cycle)
            self.moves += before is not None and not np.array_equal(before.pose, anchor.pose)
            self.anchors[anchor.cycle] = anchor
        self._retracted[tx.payload.retracted] = True  # of features that were issued, so known
        bundle = tx.decode_again(config).bundle if tx.features else None
        if bundle is None:
            return
        self.count += len(bundle.position)
        self._retracted = grown(self._retracted, self.count, False)
        for cycle, low, high in zip(
            bundle.cycles.tolist(),
            bundle.starts[:-1].tolist(),
            bundle.starts[1:].tolist(),
            strict=True,
        ):
            numbers = np.arange(bundle.base + low, bundle.base + high)
            segment = _Segment(cycle, numbers, bundle.position[low:high])
            self._keep(segment)
            known = self.anchors.get(cycle)
            if known is not None:
                self.sessions[known.session] = self.sessions.get(known.session, 0) + high - low
        while self._kept > MOST_POINTS:
            self._every *= 2
            segments, self._segments, self._kept = self._segments, [], 0
            for segment in segments:
                self._keep(segment)

    def _keep(self, segment: _Segment) -> None:
        """Its share of the points, if it has one."""
        left = segment.numbers % self._every == 0
        if left.any():
            self._segments.append(
                _Segment(segment.cycle, segment.numbers[left], segment.points[left])
            )
            self._kept += int(left.sum())
