"""What a run's map is worth, judged with what only a simulator knows: the truth, and who lied."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec

import msgspec
import numpy as np

from ..agent import Agent
from ..consensus import Consensus
from ..contribution import Author
from ..fold import DefaultFold
from ..metrics import nearest, thin
from ..model import AuthorId, Bools, Floats, FrameId, Int32s, State
from ..transaction import Transaction
from ..worldmap import WorldMap
from .robot import Robot
from .scene import Scene, Walker

NEAR = 0.05  # m at which a point counts as found
FALSE = 0.15  # m from everything real: a point that is confirmed there was invented


class Quality(msgspec.Struct, frozen=True, kw_only=True):
    """The map (confirmed and tentative nodes, thinned) against the scene, or a reference."""

    accuracy: float  # m, mean distance of a node to the nearest surface (of a scene: exact)
    completeness: float  # m, mean distance of a true place that was seen to the nearest node
    precision: float  # share of nodes within `NEAR` of a surface
    recall: float  # share of places within `NEAR` of a node
    f_score: float


class Lies(msgspec.Struct, frozen=True, kw_only=True):
    """What the liars did to the map, beside the fold of the honest transactions alone."""

    liars: int
    honest_points: int  # features of honest robots that are in the map without the liars
    honest_lost: int  # of these, rejected with the liars
    proven_nodes: int  # more honest robots saw them than liars and honest ones can speak against,
    # and all that these saw of them is in nodes that began with an honest observation
    proven_lost: int  # of these, no observation is in a node that is kept: must be 0
    usurped_nodes: int  # the same with a liar's observation first, from whose pose they are judged
    usurped_lost: int  # of these, likewise: may be more than 0
    liars_only: int  # nodes that no honest robot saw
    liars_confirmed: int  # of these, confirmed: must be 0 where `witnesses` exceeds the liars
    false_confirmed: int  # confirmed nodes that no honest robot saw, far from every surface


def judge_quality(
    world: WorldMap, places: Floats, distance: Callable[[Floats], Floats]
) -> Quality | None:
    """How near the map is to the truth.

    places: (N, 3) m that a complete map holds. distance: of points (M, 3) m from what is there.
    None where the map or the places are empty, or scipy is missing (the extra `evaluate`).
    """
    nodes = world.positions[world.kept]
    if not len(nodes) or not len(places) or find_spec("scipy") is None:
        return None
    cloud, wanted = thin(nodes), thin(places)
    there, back = distance(cloud), nearest(wanted, cloud)
    precision, recall = float((there <= NEAR).mean()), float((back <= NEAR).mean())
    both = precision + recall
    return Quality(
        accuracy=float(there.mean()),
        completeness=float(back.mean()),
        precision=precision,
        recall=recall,
        f_score=2 * precision * recall / both if both else 0.0,
    )


def seen_by(walkers: Mapping[str, Walker], honest: Sequence[Robot]) -> Floats:
    """(N, 3) m: what these robots' sensors truly saw of the scene."""
    seen = [walkers[robot.name].seen().reference for robot in honest if robot.name in walkers]
    return np.concatenate([np.zeros((0, 3)), *seen])


def judge_lies(
    robot: Robot, honest: Sequence[Robot], liars: int, scene: Scene | None = None
) -> Lies:
    """Compare an honest robot's map with the fold of the honest robots' transactions alone."""
    good = {other.author for other in honest}
    alone = _honest_fold(robot.agent, good)
    origin, say = robot.agent.map.origin, robot.agent.config.fold.miss_say
    with_liars, without = robot.agent.consensus.folded.nodes(origin), alone.folded.nodes(origin)
    if with_liars is None or without is None:
        return Lies(**dict.fromkeys(Lies.__struct_fields__, 0) | {"liars": liars})
    states, before = with_liars[1].states, without[1]
    truly = _seen_by(robot.agent.consensus, origin, good, len(states))
    confirmed = (states == State.CONFIRMED) & ~truly
    far = np.zeros(len(states), np.bool_)
    if scene is not None and confirmed.any():
        far[confirmed] = scene.distance(robot.agent.map.positions[confirmed]) > FALSE
    pairs = list(_pairs(robot.agent.consensus, alone, origin, good))
    was, now = (np.concatenate([np.zeros(0, np.int32), *side]) for side in zip(*pairs, strict=True))
    kept = before.states[was] != State.REJECTED
    lost = kept & (states[now] == State.REJECTED)
    proven = before.hits > alone.folded.against(origin) + liars * say  # whatever misses they add
    proven &= before.states != State.REJECTED  # with no liar, a robot's own record may do that
    survives = np.zeros(len(before.states), np.bool_)
    survives[was[~(states[now] == State.REJECTED)]] = True
    seen = np.zeros(len(before.states), np.bool_)
    seen[was] = True
    usurped = np.zeros(len(before.states), np.bool_)
    usurped[was[~_began_with(robot.agent.consensus, origin, good)[now]]] = True
    gone = proven & seen & ~survives
    return Lies(
        liars=liars,
        honest_points=int(kept.sum()),
        honest_lost=int(lost.sum()),
        proven_nodes=int((proven & ~usurped).sum()),
        proven_lost=int((gone & ~usurped).sum()),
        usurped_nodes=int((proven & usurped).sum()),
        usurped_lost=int((gone & usurped).sum()),
        liars_only=int((~truly).sum()),
        liars_confirmed=int(confirmed.sum()),
        false_confirmed=int((confirmed & far).sum()),
    )


def _honest_fold(agent: Agent, good: set[AuthorId]) -> Consensus:
    fold = Consensus(agent.config)
    for tx in transactions_anew(agent):
        if tx.author in good:
            fold.add(tx)
    fold.advance()
    return fold


def transactions_anew(agent: Agent) -> Iterator[Transaction]:
    """What counts in an agent's ledger, its payload decoded again, in canonical order."""
    counting = sorted((tx for tx in agent.ledger if agent.ledger.counts(tx)), key=lambda tx: tx.key)
    return (replace(tx, payload=tx.decode_again(agent.config)) for tx in counting)


def _authors(fold: Consensus, good: set[AuthorId]) -> list[Author]:
    return [author for id_, author in sorted(fold.authors.items()) if id_ in good]


def _seen_by(fold: Consensus, origin: FrameId, good: set[AuthorId], count: int) -> Bools:
    """Nodes that one of these authors observed."""
    seen = np.zeros(count, np.bool_)
    for author in _authors(fold, good):
        nodes = fold.folded.feature_nodes(origin, author.index)
        seen[nodes[nodes >= 0]] = True
    return seen


def _began_with(fold: Consensus, origin: FrameId, good: set[AuthorId]) -> Bools:
    """Nodes that began with an observation of one of these authors."""
    found = fold.folded.components[origin].fold
    if not isinstance(found, DefaultFold):  # Algorithm 2 judges nothing from there
        return np.ones(len(found), np.bool_)
    return np.isin(found.first_authors(), [author.index for author in _authors(fold, good)])


def _pairs(
    fold: Consensus, alone: Consensus, origin: FrameId, good: set[AuthorId]
) -> Iterable[tuple[Int32s, Int32s]]:
    """The node of every honest feature without and with the liars."""
    for author in _authors(fold, good):
        now = fold.folded.feature_nodes(origin, author.index)
        was = alone.folded.feature_nodes(origin, alone.author(author.id).index)
        both = (was[: len(now)] >= 0) & (now[: len(was)] >= 0)
        yield was[: len(now)][both], now[: len(was)][both]
