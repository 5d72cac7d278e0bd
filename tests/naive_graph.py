"""Slow, obvious twin of `dagmap.graph.AdjacencyDag`: every search looks at everything."""

from __future__ import annotations

from itertools import product

from dagmap.config import GraphConfig

MOST = (1 << 63) - 1

Point = tuple[int, int, int]
# A parent is a feature id or the coordinates of a lattice node.
Parent = int | Point


def distance2(a: Point, b: Point) -> int:
    return sum((i - j) ** 2 for i, j in zip(a, b, strict=True))


class NaiveDag:
    def __init__(self, config: GraphConfig) -> None:
        self.config = config
        self.n_c = config.n_c
        self.points: list[Point] = []
        self.parents: list[list[Parent | None]] = []
        self.here: list[bool] = []  # not withdrawn before it was issued
        self.alive: list[bool] = []
        self.issued: list[bool] = []

    def children(self, parent: Parent) -> list[int]:
        return [i for i, parents in enumerate(self.parents) if parent in parents]

    def terminals(self) -> list[int]:
        return [i for i, a in enumerate(self.alive) if a and len(self.children(i)) < self.n_c]

    def validity(self) -> list[int]:
        values: list[int] = []
        for i, parents in enumerate(self.parents):
            gains = [values[p] if isinstance(p, int) else 1 for p in parents if p is not None]
            value = min(sum(gains), MOST) if gains else 1
            if self.issued[i] and self.config.issued_validity == "reset":
                value = 1
            values.append(value if self.here[i] else 0)
        return values

    def nearest(self, point: Point, count: int, below: int, but: list[Parent]) -> list[Parent]:
        """The `count` nearest open nodes, features with ids under `below`, that are not in `but`.

        Lattice nodes are taken from ever larger cubes, until none outside can be among them.
        """
        pitch, reach = self.config.pitch_mm, self.config.reach_mm
        features = [(distance2(self.points[i], point), 0, i) for i in self.terminals() if i < below]
        middle = [round(c / pitch) for c in point]
        taken: dict[Point, int] = {}
        for parents in self.parents:
            for p in parents:
                if isinstance(p, tuple):
                    taken[p] = taken.get(p, 0) + 1
        r = 1
        while True:
            cube = product(*[range(m - r, m + r + 1) for m in middle])
            nodes = [(x * pitch, y * pitch, z * pitch) for x, y, z in cube]
            free = [
                (distance2(node, point), 1, node) for node in nodes if taken.get(node, 0) < self.n_c
            ]
            found = sorted(
                c for c in [*features, *free] if c[2] not in but and (reach < 0 or c[0] <= reach**2)
            )[:count]
            outside = r * pitch  # any node out there is at least so far along one axis
            if (len(found) == count and found[-1][0] < outside**2) or 0 <= reach < outside:
                return [name for _, _, name in found]
            r += 1

    def insert(self, points: list[Point]) -> None:
        for point in points:
            chosen: list[Parent | None] = []
            chosen += self.nearest(point, self.config.n_p, len(self.points), [])
            self.points.append(point)
            self.parents.append(chosen + [None] * (self.config.n_p - len(chosen)))
            self.here.append(True)
            self.alive.append(True)
            self.issued.append(False)

    def withdraw(self, ids: list[int]) -> list[int]:
        before = self.validity()
        for i in sorted(ids):
            self.alive[i] = False
            if self.issued[i]:
                continue
            self.here[i] = False
            self.parents[i] = [None] * self.config.n_p
            for child in self.children(i):
                parents = self.parents[child]
                place = parents.index(i)
                parents[place] = None
                known = [p for p in parents if p is not None]
                for parent in self.nearest(self.points[child], 1, child, known):
                    parents[place] = parent
        return self.changed(before)

    def mark_issued(self, ids: list[int]) -> list[int]:
        before = self.validity()
        for i in ids:
            self.issued[i] = True
        return self.changed(before)

    def changed(self, before: list[int]) -> list[int]:
        after = self.validity()
        return [i for i in range(len(after)) if self.here[i] and after[i] != before[i]]

    def take(
        self, cores: list[int], per_bundle: int, total: int
    ) -> tuple[list[int], list[int], int, list[int]]:
        before = self.validity()
        taken: list[int] = []
        frontiers: list[int] = []
        done = 0
        while done < len(cores) and len(taken) < total:
            kept, frontier = self.bundle(cores[done], min(per_bundle, total - len(taken)))
            for i in kept:
                self.issued[i] = True
            taken += kept
            frontiers += frontier
            done += 1
        return sorted(taken), sorted(set(frontiers)), done, self.changed(before)

    def bundle(self, core: int, limit: int) -> tuple[list[int], list[int]]:
        if self.issued[core]:
            return [], []

        def open_parents(i: int) -> list[int]:
            return [p for p in self.parents[i] if isinstance(p, int) and not self.issued[p]]

        hops = {core: 0}
        queue = [core]
        for i in queue:
            for p in open_parents(i):
                if p not in hops:
                    hops[p] = hops[i] + 1
                    queue.append(p)
        order = sorted(
            hops, key=lambda i: (hops[i], distance2(self.points[i], self.points[core]), i)
        )
        kept = set(order[:limit])
        cut = {p for i in kept for p in open_parents(i)} - kept
        return sorted(kept), sorted(cut)
