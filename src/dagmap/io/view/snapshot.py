"""What the view shows, taken from an agent at one moment: immutable, so any thread may read it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...config import Config
from ...model import FLEET_FRAME, AuthorId, Floats, FrameId, Int32s, Int64s, pose_matrix
from ..export import PlyMap

if TYPE_CHECKING:  # they load compiled kernels, which a first picture need not wait for
    from ...agent import Agent
    from ...contribution import Author
    from ...transaction import Transaction
    from ...worldmap import WorldMap

MAX_POSES = 2000  # of one robot's path; of more, as many evenly


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """One robot's way. poses: (C, 4, 4) of its sensor in metres, the newest last."""

    robot: str
    poses: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Said:
    """What one transaction says, placed. xyz: (n, 3) mm; feature i has the number base + i."""

    robot: str
    transaction: Transaction
    base: int
    xyz: Int32s
    stamp: float  # s, of its newest cycle; nan where it has none

    def parents(self, config: Config) -> Int64s:
        """(n, n_p) feature numbers of the author, -1 for none; decoded anew from the bytes."""
        bundle = self.transaction.decode_again(config).bundle
        return np.zeros((0, 1), np.int64) if bundle is None else bundle.parents


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """said: the transactions that count, in canonical order. paths: of robots in this map."""

    world: WorldMap | PlyMap
    said: Sequence[Said] = ()
    paths: Sequence[Path] = ()
    digest: str = ""

    @property
    def names(self) -> list[str]:
        """Of all robots that said something, sorted."""
        return sorted({each.robot for each in self.said} | {path.robot for path in self.paths})


def take(agent: Agent) -> Snapshot:
    """The agent as it stands. To be called in the thread that owns it."""
    from ...worldmap import build_map

    digest, authors = agent.digest().hex(), agent.consensus.authors
    origin = _largest(agent)
    world = agent.map
    if world.origin != origin:
        world = build_map(agent.consensus.picture(origin), agent.config.fold.cell)
    said = [
        Said(name_of(c.author), c.transaction, c.base, c.xyz, _stamp(c.author, c.cycles))
        for c in agent.consensus.contributions()
        if not c.parts or c.parts[0].component == origin
    ]
    paths = [_path(agent, authors[id_], origin) for id_ in sorted(authors)]
    return Snapshot(world, said, [path for path in paths if path is not None], digest)


def _largest(agent: Agent) -> FrameId:
    """The component of frames with the most features: who looks on has none of its own."""
    features: Counter[FrameId] = Counter({FLEET_FRAME: 0})
    for contribution in agent.consensus.contributions():
        for part in contribution.parts:
            features[part.component] += len(contribution.xyz)
    return min(features, key=lambda frame: (-features[frame], frame))


def name_of(author: Author) -> str:
    """What a robot is called in a `WorldMap`."""
    return author.name or author.id.hex()


def newest_features(said: Sequence[Said], count: int) -> Floats:
    """(N, 3) metres: what the last `count` transactions have said."""
    points = [each.xyz for each in said[-count:]] if count else []
    return np.concatenate([np.zeros((0, 3)), *points]) / 1000.0


def edges_near(
    said: Sequence[Said], config: Config, centre: Floats, radius: float, most: int
) -> tuple[Floats, list[str]]:
    """The adjacency DAG about a place: ends (E, 2, 3) m, child first, and each edge's robot.

    An edge is shown where its child lies within `radius` m of `centre` (3,); `most` at most.
    """
    chains: dict[AuthorId, list[Said]] = {}
    for each in said:
        if len(each.xyz):
            chains.setdefault(each.transaction.author, []).append(each)
    ends, robots = [np.zeros((0, 2, 3))], []
    for chain in chains.values():
        found = _edges_of(chain, config, centre, radius)
        ends.append(found)
        robots += [chain[0].robot] * len(found)
    return np.concatenate(ends)[:most], robots[:most]


def _edges_of(chain: list[Said], config: Config, centre: Floats, radius: float) -> Floats:
    """Of one author. A parent may stand in any of its earlier transactions."""
    bases = np.array([each.base for each in chain], np.int64)
    found = [np.zeros((0, 2, 3))]
    for each in chain:
        near = np.linalg.norm(each.xyz / 1000.0 - centre, axis=1) <= radius
        if not near.any():
            continue
        parents = each.parents(config)
        row, slot = np.nonzero((parents >= 0) & near[:, None])
        numbers = parents[row, slot]
        home = np.searchsorted(bases, numbers, side="right") - 1
        known = home >= 0
        ends = np.zeros((len(row), 2, 3))
        ends[:, 0] = each.xyz[row]
        for i in np.unique(home[known]).tolist():
            mine, index = np.flatnonzero(home == i), numbers[home == i] - bases[i]
            inside = index < len(chain[i].xyz)
            known[mine[~inside]] = False
            ends[mine[inside], 1] = chain[i].xyz[index[inside]]
        found.append(ends[known] / 1000.0)
    return np.concatenate(found)


def _stamp(author: Author, cycles: Int32s) -> float:
    stamps = [anchor.stamp for c in cycles.tolist() if (anchor := author.anchors.get(c))]
    return max(stamps) / 1e6 if stamps else float("nan")


def _path(agent: Agent, author: Author, origin: FrameId) -> Path | None:
    """The anchors of an author that lie in a component, in order of their cycles."""
    cycles = sorted(author.anchors)
    step = max(1, -(-len(cycles) // MAX_POSES))
    poses = []
    for cycle in cycles[::-step][::-1]:
        anchor = author.anchors[cycle]
        component, frame = agent.consensus.placement(author.id, anchor.session)
        if component == origin:
            poses.append(pose_matrix(frame) @ pose_matrix(anchor.pose))
    if not poses:
        return None
    return Path(name_of(author), np.array(poses))
