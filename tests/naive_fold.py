"""Slow, obvious twins of `dagmap.fold` and `dagmap.evidence`: dictionaries, fractions, no undo."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from math import isqrt

from dagmap.config import FoldConfig
from dagmap.fold import Block
from dagmap.model import State

Point = tuple[int, int, int]
Cell = tuple[int, int, int]


def points(array: object) -> list[Point]:
    return [(x, y, z) for x, y, z in array.tolist()]  # type: ignore[attr-defined]


def distance2(a: Point, b: Point) -> int:
    return sum((i - j) ** 2 for i, j in zip(a, b, strict=True))


@dataclass
class Node:
    seed: Point
    observations: list[Point] = field(default_factory=list)
    colors: list[Point] = field(default_factory=list)
    hits: Counter[int] = field(default_factory=Counter)  # default: by author
    last: dict[int, int] = field(default_factory=dict)  # default: last counted cycle by author
    authors: set[int] = field(default_factory=set)
    h: int = 0  # paper
    m: int = 0  # paper
    parents: list[int] = field(default_factory=list)  # paper

    def observe(self, block: Block, i: int) -> None:
        self.observations.append(points(block.xyz)[i])
        self.authors.add(block.author)
        if block.colored[i]:
            self.colors.append(points(block.color)[i])

    def hit(self, author: int, cycle: int) -> None:
        if cycle > self.last.get(author, -1):
            self.last[author] = cycle
            self.hits[author] += 1

    def columns(self) -> tuple[Point, Point, int, Point, int]:
        offsets = [tuple(p[k] - self.seed[k] for k in range(3)) for p in self.observations]
        total = tuple(sum(o[k] for o in offsets) for k in range(3))
        color = tuple(sum(c[k] for c in self.colors) for k in range(3))
        return self.seed, total, len(self.observations), color, len(self.colors)  # type: ignore[return-value]


@dataclass
class NaiveMap:
    nodes: list[Node] = field(default_factory=list)
    features: dict[int, list[int]] = field(default_factory=lambda: defaultdict(list))

    def begin(self, block: Block) -> list[int]:
        """The author's list of nodes, filled with -1 up to where the block's rows end."""
        numbers = self.features[block.author]
        if len(block.xyz):
            numbers += [-1] * (block.base + len(block.xyz) - len(numbers))
        return numbers

    def nearest(self, where: Iterable[int], point: Point) -> tuple[int, int]:
        """(squared distance, node), ties to the lower id."""
        return min((distance2(self.nodes[k].seed, point), k) for k in where)


def naive_default(config: FoldConfig, blocks: Sequence[Block]) -> NaiveMap:
    """The fold of these blocks from scratch."""
    fold = NaiveMap()
    for block in blocks:
        numbers = fold.begin(block)
        for i, point in enumerate(points(block.xyz)):
            if not block.alive[i]:
                continue
            near = fold.nearest(range(len(fold.nodes)), point) if fold.nodes else None
            if near is None or near[0] > config.delta_mm**2:
                near = (0, len(fold.nodes))
                fold.nodes.append(Node(point))
            numbers[block.base + i] = near[1]
            fold.nodes[near[1]].observe(block, i)
            fold.nodes[near[1]].hit(block.author, int(block.cycle[i]))
        for number, cycle in zip(
            block.sightings.tolist(), block.sighting_cycle.tolist(), strict=True
        ):
            if 0 <= number < len(numbers) and numbers[number] >= 0:
                fold.nodes[numbers[number]].hit(block.author, cycle)
    return fold


def naive_bundles(block: Block) -> list[list[int]]:
    """Bundles of the living, the core (the highest number) first, the others ascending."""
    taken: set[int] = set()
    bundles = []
    for core in block.cores.tolist():
        wanted, members = [core], set()
        while wanted:
            i = wanted.pop()
            if i in taken or i in members:
                continue
            members.add(i)
            parents = [] if block.parents is None else block.parents[i].tolist()
            wanted += [p - block.base for p in parents if block.base <= p < block.base + i]
        taken |= members
        living = sorted(i for i in members if block.alive[i])
        bundles.append(living[-1:] + living[:-1])
    return [bundle for bundle in bundles if bundle]


def naive_ascendants(fold: NaiveMap, node: int) -> set[int]:
    found: set[int] = set()
    wanted = list(fold.nodes[node].parents)
    while wanted:
        k = wanted.pop()
        if k not in found:
            found.add(k)
            wanted += fold.nodes[k].parents
    return found


def naive_paper(config: FoldConfig, blocks: Sequence[Block]) -> NaiveMap:
    """Algorithm 2, line by line, over these blocks from scratch."""
    fold = NaiveMap()
    for block in blocks:
        fold.begin(block)
        for bundle in naive_bundles(block):
            naive_merge(fold, config.delta_mm, block, bundle)
    return fold


def naive_merge(fold: NaiveMap, delta: int, block: Block, bundle: list[int]) -> None:
    numbers, where = fold.features[block.author], points(block.xyz)
    added: list[int] = []

    def add(i: int) -> Node:
        numbers[block.base + i] = len(fold.nodes)
        fold.nodes.append(Node(where[i]))
        added.append(i)
        return fold.nodes[-1]

    n, others = bundle[0], bundle[1:]
    twin = fold.nearest(range(len(fold.nodes)), where[n])[1] if fold.nodes else -1
    ascendants = naive_ascendants(fold, twin) if fold.nodes else set()
    if not ascendants:
        for i in bundle:
            add(i)
    else:
        for i in bundle:
            if i in others:
                twin = fold.nearest(ascendants, where[i])[1]
            if distance2(fold.nodes[twin].seed, where[i]) < delta**2:
                fold.nodes[twin].h += 1
                numbers[block.base + i] = twin  # ChangeParent
            else:
                add(i).m += 1
                fold.nodes[twin].m += 1
    for i in bundle:
        fold.nodes[numbers[block.base + i]].observe(block, i)
    for i in added:
        parents = [] if block.parents is None else block.parents[i].tolist()
        known = [numbers[p] for p in parents if 0 <= p < block.base + i and numbers[p] >= 0]
        fold.nodes[numbers[block.base + i]].parents = known


def naive_ray(cell: int, limit: int, origin: Point, end: Point) -> set[Cell]:
    """The cells from the origin towards the end, at most `limit` mm; every crossing is a step."""
    ray = [e - o for e, o in zip(end, origin, strict=True)]
    square = sum(d * d for d in ray)
    if square > limit * limit:
        length = isqrt(square - 1) + 1
        ray = [abs(d) * limit // length * (1 if d > 0 else -1) for d in ray]
    crossings = []
    for axis, (o, d) in enumerate(zip(origin, ray, strict=True)):
        for border in range(min(o, o + d) // cell, max(o, o + d) // cell):
            t = Fraction(abs((border + 1) * cell - o), abs(d))
            crossings.append((t, d < 0, axis))  # at equal times the climbing axes go first
    here = [o // cell for o in origin]
    cells = {(here[0], here[1], here[2])}
    for _, falling, axis in sorted(crossings):
        here[axis] += -1 if falling else 1
        cells.add((here[0], here[1], here[2]))
    assert here == [(o + d) // cell for o, d in zip(origin, ray, strict=True)]
    return cells


class NaiveRays:
    """Counters in dictionaries."""

    def __init__(self, cell: int, limit: int) -> None:
        self.cell, self.limit = cell, limit
        self.passes: Counter[tuple[int, Cell]] = Counter()
        self.ends: Counter[tuple[int, Cell]] = Counter()

    def cell_of(self, point: Point) -> Cell:
        return (point[0] // self.cell, point[1] // self.cell, point[2] // self.cell)

    def walk(
        self,
        author: int,
        origins: list[Point],
        starts: list[int],
        xyz: list[Point],
        alive: list[bool],
        sign: int,
    ) -> None:
        crossed: set[Cell] = set()
        ended = {self.cell_of(p) for p, a in zip(xyz, alive, strict=True) if a}
        for k, origin in enumerate(origins):
            for i in range(starts[k], starts[k + 1]):
                if alive[i] and self.limit > 0:
                    crossed |= naive_ray(self.cell, self.limit, origin, xyz[i])
        for cell in crossed - ended:
            self.passes[author, cell] += sign
        for cell in ended:
            self.ends[author, cell] += sign


def naive_verdict(
    config: FoldConfig, fold: NaiveMap, rays: NaiveRays | None
) -> list[tuple[int, int, int, State]]:
    """(hits, misses, witnesses, state) of every node; without rays as Algorithm 2 counts."""
    out = []
    for node in fold.nodes:
        h, m, witnesses = node.h, node.m, len(node.authors)
        if rays is not None:
            cell = rays.cell_of(node.seed)
            h = sum(min(config.hit_say, hits) for hits in node.hits.values())
            free = [rays.passes[a, cell] - rays.ends[a, cell] for a in authors_of(rays)]
            m = sum(min(config.miss_say, max(0, f)) for f in free)
        state = State.CONFIRMED if witnesses >= config.witnesses else State.TENTATIVE
        out.append((h, m, witnesses, State.REJECTED if 2 * h <= h + m else state))
    return out


def authors_of(rays: NaiveRays) -> set[int]:
    return {author for author, _ in [*rays.passes, *rays.ends]}
