"""Algorithm 2 as printed: the fold of preset `paper`, for comparison (section 4.3)."""

from __future__ import annotations

import numpy as np

from .blocks import Block, Features, NodeColumns, Verdict, columns_of, verdict_of, view
from .config import FoldConfig
from .evidence import RayEvidence, plain, with_room
from .kernels import algorithm2
from .model import Bools, Int32s, Int64s


class PaperFold:
    """Algorithm 2 as printed; see `kernels.algorithm2`. O(N) a bundle.

    It knows neither rays nor sightings. Hits and misses start at 0, so a node is rejected until it
    was hit more often than missed.
    """

    def __init__(self, config: FoldConfig, salt: int = 0) -> None:
        self._config = config  # no hashing here: the salt changes nothing
        self._features = Features()
        self._graph = algorithm2.Graph(
            sizes=np.zeros(3, np.int64),
            seed=np.zeros((0, 3), np.int32),
            offset=np.zeros((0, 3), np.int64),
            observed=np.zeros(0, np.int32),
            color=np.zeros((0, 3), np.int64),
            color_count=np.zeros(0, np.int32),
            hits=np.zeros(0, np.int32),
            misses=np.zeros(0, np.int32),
            witnesses=np.zeros(0, np.int32),
            first=np.zeros(0, np.int32),
            entries=np.zeros((0, 3), np.int32),
            parents=np.zeros((0, 1), np.int32),
            found=np.zeros(0, np.int32),
            visited=np.zeros(0, np.int64),
        )

    def __len__(self) -> int:
        return int(self._graph.sizes[algorithm2.NODES])

    def apply(self, block: Block) -> None:
        seen, (order, starts) = _graph_seen(block), _bundles(block)
        self._make_room(len(block.xyz), seen.parents.shape[1])
        base, features, losers = self._features.open(block)
        delta2 = self._config.delta_mm**2
        algorithm2.apply(
            self._graph, delta2, block.author, seen, base, order, starts, features, losers
        )

    def undo(self, block: Block) -> None:
        order, starts = _bundles(block)
        base, features, losers = self._features.last(block)
        algorithm2.revert(
            self._graph,
            block.author,
            _graph_seen(block),
            base,
            order,
            int(starts[-1]),
            features,
            losers,
        )
        self._features.close(block)

    def drop_records(self, keep: int) -> None:
        self._features.drop(keep)

    def feature_nodes(self, author: int) -> Int32s:
        return self._features.of(author)

    def columns(self) -> NodeColumns:
        return columns_of(self._graph, len(self))

    def parents(self) -> Int32s:
        """(N, P) nodes that each node refers to, -1 none; read-only."""
        return view(self._graph.parents, len(self))

    def settled(self, author: int, xyz: Int32s, repeats: int) -> Bools:
        return np.zeros(len(xyz), np.bool_)  # in Algorithm 2 every observation counts

    def evaluate(self, rays: RayEvidence) -> Verdict:
        graph, n = self._graph, len(self)
        hits, misses, witnesses = graph.hits[:n], graph.misses[:n], graph.witnesses[:n]
        return verdict_of(hits.copy(), misses.copy(), witnesses.copy(), self._config.witnesses)

    @property
    def nbytes(self) -> int:
        return self._features.nbytes + sum(array.nbytes for array in self._graph)

    def _make_room(self, n: int, width: int) -> None:
        graph = self._graph
        nodes, entries = int(graph.sizes[0]) + n, int(graph.sizes[1]) + n
        if width > graph.parents.shape[1]:
            wider = np.full((len(graph.parents), width), -1, np.int32)
            wider[:, : graph.parents.shape[1]] = graph.parents
            graph = graph._replace(parents=wider)
        rows = dict.fromkeys(graph._fields[1:], nodes) | {"entries": entries}
        self._graph = graph._replace(
            **{name: with_room(getattr(graph, name), size) for name, size in rows.items()}
        )


def _bundles(block: Block) -> tuple[Int64s, Int64s]:
    order = np.zeros(len(block.xyz), np.int64)
    starts = np.zeros(len(block.cores) + 1, np.int64)
    alive, cores = plain(block.alive), plain(block.cores)
    room = order.copy(), starts.copy()
    algorithm2.split(block.base, alive, _parents(block), cores, order, starts, *room)
    return order, starts


def _parents(block: Block) -> Int64s:
    none = np.full((len(block.xyz), 1), -1, np.int64)
    return none if block.parents is None else plain(block.parents)


def _graph_seen(block: Block) -> algorithm2.Seen:
    return algorithm2.Seen(
        plain(block.xyz),
        plain(block.color),
        block.colored.repeat(block.starts[1:] - block.starts[:-1]),
        _parents(block),
    )
