"""The cycles of a bag with RTAB-Map's messages: its nodes, and how it moved them."""

from __future__ import annotations

from collections.abc import Iterator

from ...model import Cycle, RecordingError
from ._bag import Bag
from ._rtabmap_graph import GraphFollower
from ._source import Options, Skips, checked


class MapDataBag:
    """Nodes as cycles, in the order of their messages. graph: topic of MapGraph, or empty."""

    def __init__(self, bag: Bag, data: str, graph: str, options: Options, skips: Skips) -> None:
        self.name = bag.path.stem if bag.path.is_file() else bag.path.resolve().name
        self.skips = skips
        self._bag, self._data, self._graph, self._options = bag, data, graph, options
        self.notes: tuple[str, ...] = ("nodes, optimised poses and words of RTAB-Map",)
        self._told = False  # what is left out is told of once
        self._count = sum(1 for _ in self)
        self._told = True
        if not self._count:
            raise RecordingError(
                f"{bag.path}: {data} holds no node with a pose and words with 3D positions; record "
                "it while RTAB-Map maps, not the map at its end"
            )

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[Cycle]:
        follower = GraphFollower(self._options, self._skip)
        for message in self._bag.messages({self._data, self._graph} - {""}):
            convert = follower.data if message.topic == self._data else follower.graph
            try:
                cycles = [checked(c, self._bag.path) for c in self._bag.read(message, convert)]
            except RecordingError as error:
                if not self._told or not self.skips.keep_going:
                    self.skips.note(error)
                continue
            yield from cycles

    def _skip(self, what: str) -> None:
        if not self._told or not self.skips.keep_going:
            self.skips.note(RecordingError(f"{self._bag.path}: {self._data}: {what}"))
