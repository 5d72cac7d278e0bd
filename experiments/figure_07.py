"""Figure 7: the merging of two bundles by Algorithm 2, drawn from two agents that do it.

Two robots insert nine features each, of which five are common to within delta, and exchange what
becomes valid: a core and its eight ascendants. `--out DIR`; seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt

import common
from common import GREEN, INK, ORANGE, RED, Row
from dagmap import Agent, Config, Cycle, GraphConfig, Identity, Issued
from dagmap.config import FoldConfig, IssuanceConfig, TransactionConfig
from dagmap.io.panels import open_figure, put_legend, save
from dagmap.paper_fold import PaperFold

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NAME = "figure_07"
PAPER = "5 nodes hit, 4 nodes miss, and finally 13 nodes appear, except the reference nodes"
CONFIG = Config(
    graph=GraphConfig(v_th=4, reference_pitch=0.5, max_parent_distance=0.7),
    fold=FoldConfig(preset="paper", delta=0.05),
    issuance=IssuanceConfig(repeats=0),
    transaction=TransactionConfig(proof_of_work_bits=0),
)
# (x, y) m on a wall. The second robot sees five of them within 5 cm, and four other ones.
FIRST = (
    (0.25, 0.12), (0.44, 0.50), (0.19, 0.55), (0.21, 0.82), (0.45, 0.76),
    (0.53, 0.21), (0.85, 0.10), (0.83, 0.48), (0.76, 0.76),
)  # fmt: skip
SECOND = (
    (0.28, 0.12), (0.46, 0.50), (0.17, 0.55), (0.29, 0.70), (0.53, 0.88),
    (0.45, 0.33), (0.78, 0.22), (0.85, 0.48), (0.78, 0.76),
)  # fmt: skip
Columns = npt.NDArray[Any]


class Drawn(NamedTuple):
    """A graph to draw. positions: (N, 2) m; edges: (E, 2) rows child, parent; fills: a node."""

    positions: Columns
    edges: Columns
    fills: Sequence[str]


class Told(NamedTuple):
    """A robot that has seen its points, and what it broadcast of them."""

    agent: Agent
    messages: list[bytes]
    features: int
    bundles: int


def robot(number: int, seen: Sequence[tuple[float, float]]) -> Told:
    """A robot that looks at these points of a wall 1 m ahead."""
    agent = Agent(Identity.from_seed(bytes([number]) * 32), CONFIG)
    points = np.array([(x, y, 1.0) for x, y in seen])
    events = agent.observe(Cycle(0.0, np.eye(4), points), 0.0)
    issued = [event for event in events if isinstance(event, Issued)]
    messages = [out.data for out in agent.outbox() if out.to is None]
    return Told(agent, messages, sum(e.features for e in issued), sum(e.bundles for e in issued))


def fold_of(agent: Agent) -> PaperFold:
    (component,) = agent.consensus.folded.components.values()
    return cast(PaperFold, component.fold)


def run(out: Path) -> Row:
    robots = [robot(1, FIRST), robot(2, SECOND)]
    # Both were alone, so their Lamport times are equal: the lower author's is folded first.
    one, other = sorted(robots, key=lambda told: told.agent.identity.author)
    one.agent.settle()
    before = len(one.agent.map)
    for listener, speaker in ((one, other), (other, one)):
        for data in speaker.messages:
            listener.agent.receive(data, 1.0)
    same = one.agent.digest() == other.agent.digest()
    world = one.agent.map
    met, added = world.hits > 0, np.arange(len(world)) >= before
    data = {
        "features_sent": [told.features for told in (one, other)],
        "bundles_sent": [told.bundles for told in (one, other)],
        "nodes": len(world),
        "nodes_hit": int(met.sum()),
        "nodes_added": int(added.sum()),
        "added_with_a_miss": int((world.misses[added] == 1).sum()),
        "misses": int(world.misses.sum()),
        "same_map_on_both": same,
    }
    draw(out / f"{NAME}.png", one.agent, other.agent, before)
    hit, missed = data["nodes_hit"], data["added_with_a_miss"]
    measured = [
        f"{hit} nodes hit, {missed} added with a miss each, {data['nodes']} nodes in the end",
        f"{data['misses']} misses in all: the nearest losers, which the text leaves out, have one",
        f"broadcaster and receiver hold {'the same map' if same else 'DIFFERENT MAPS'}",
    ]
    return common.written(out, NAME, PAPER, measured, **data)


def graph_of(agent: Agent, fill: str) -> Drawn:
    """The robot's own adjacency DAG."""
    graph = agent.observing.graph
    parents = graph.parents()
    child, slot = np.nonzero(parents >= 0)
    edges = np.stack([child, parents[child, slot]], axis=1)
    return Drawn(graph.positions()[:, :2] / 1000.0, edges, [fill] * len(parents))


def merged_graph(agent: Agent, before: int) -> Drawn:
    """U of Algorithm 2; its first nodes, so many, are the receiver's."""
    parents, world = fold_of(agent).parents(), agent.map
    child, slot = np.nonzero(parents >= 0)
    edges = np.stack([child, parents[child, slot]], axis=1)
    fills = [ORANGE if h else (GREEN if i < before else RED) for i, h in enumerate(world.hits)]
    return Drawn(world.positions[:, :2], edges, fills)


def draw(path: Path, one: Agent, other: Agent, before: int) -> None:
    with open_figure((10.0, 4.0), 1, 3) as (figure, axes):
        titles = ("the receiver's graph", "the bundle that comes in", "merged")
        graphs = (graph_of(one, GREEN), graph_of(other, RED), merged_graph(one, before))
        for axis, title, graph in zip(axes, titles, graphs, strict=True):
            draw_graph(axis, graph)
            axis.set_title(f"{title}: {len(graph.positions)} nodes", fontsize=10.0)
        named = [("only the receiver saw it", GREEN), ("hit", ORANGE), ("added, with a miss", RED)]
        put_legend(axes[1], named)
        save(path, figure)


def draw_graph(axis: Axes, graph: Drawn) -> None:
    """Arrows lead from a child to its parent; what has none hangs on reference nodes."""
    for child, parent in graph.edges:
        axis.annotate(
            "",
            graph.positions[parent],
            graph.positions[child],
            arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 0.7, "shrinkA": 6, "shrinkB": 6},
        )
    axis.scatter(*graph.positions.T, s=90, c=graph.fills, edgecolors=INK, linewidths=0.6, zorder=3)
    style = {"color": "white", "ha": "center", "va": "center", "fontsize": 6, "zorder": 4}
    for number, at in enumerate(graph.positions):
        axis.annotate(str(number), at, **style)
    axis.set_xlim(0.05, 1.0)
    axis.set_ylim(0.0, 1.0)
    axis.set_aspect("equal")
    axis.set_xticks([])
    axis.set_yticks([])


if __name__ == "__main__":
    common.main(run)
