"""Slow, obvious twins of every kernel: they look at everything, use no arrays and undo nothing.

The adjacency DAG (sections 4.1 and 4.2), the fold with its rays (4.3, both presets), the codec.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import product
from math import isqrt

from dagmap.config import FoldConfig, GraphConfig
from dagmap.fold import Block
from dagmap.model import State

# The adjacency DAG: every search looks at everything.

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


# The fold and the ray evidence: dictionaries and fractions.

Cell = tuple[int, int, int]


def points(array: object) -> list[Point]:
    return [(x, y, z) for x, y, z in array.tolist()]  # type: ignore[attr-defined]


@dataclass
class Node:
    seed: Point
    observations: list[Point] = field(default_factory=list)
    colors: list[Point] = field(default_factory=list)
    hits: Counter[int] = field(default_factory=Counter)  # default: by author
    last: dict[int, int] = field(default_factory=dict)  # default: last counted cycle by author
    authors: set[int] = field(default_factory=set)
    seen: Counter[int] = field(default_factory=Counter)  # observations by author
    origin: Point = (0, 0, 0)  # of the sensor that saw it first
    h: int = 0  # paper
    m: int = 0  # paper
    parents: list[int] = field(default_factory=list)  # paper

    def observe(self, block: Block, i: int) -> None:
        self.observations.append(points(block.xyz)[i])
        self.authors.add(block.author)
        self.seen[block.author] += 1
        if block.colored[segment(block, i)]:
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


def segment(block: Block, i: int) -> int:
    """The segment of feature i."""
    return max(k for k, start in enumerate(block.starts[:-1].tolist()) if start <= i)


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


def naive_settled(
    config: FoldConfig, blocks: Sequence[Block], author: int, place: Point, repeats: int
) -> bool:
    """Whether an author has said of a place what counts, from a fold from scratch."""
    fold = naive_default(config, blocks)
    near = fold.nearest(range(len(fold.nodes)), place) if fold.nodes else None
    if near is None or near[0] > config.delta_mm**2:
        return False
    said = Counter[int]()
    for block in blocks:
        nodes = fold.features[block.author][block.base : block.base + len(block.xyz)]
        said[block.author] += sum(node == near[1] for node in nodes)
    authors = sum(count > 0 for count in said.values())
    return said[author] >= repeats or (said[author] > 0 and authors >= config.witnesses)


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
                fold.nodes.append(Node(point, origin=points(block.origin)[segment(block, i)]))
            numbers[block.base + i] = near[1]
            fold.nodes[near[1]].observe(block, i)
            fold.nodes[near[1]].hit(block.author, int(block.cycle[segment(block, i)]))
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


def naive_log2(value: int) -> int:
    """Sixteenths of the binary logarithm of the first nine bits: floor(16 log2)."""
    head = value << 9 >> value.bit_length()
    fraction = sum(head**16 >= 2 ** (8 * 16 + k) for k in range(1, 16))
    return 16 * (value.bit_length() - 1) + fraction


def naive_hidden(rays: NaiveRays, node: Node) -> Counter[int]:
    """Ends by author in the cells between the sensor and a node."""
    way = [s - o for s, o in zip(node.seed, node.origin, strict=True)]
    square = sum(d * d for d in way)
    length = isqrt(square - 1) + 1 if square else 0
    cells = [rays.cell_of(node.origin)]
    for s in range(rays.cell, min(length - rays.cell, rays.limit), max(1, rays.cell // 2)):
        x, y, z = (o + d * s // length for o, d in zip(node.origin, way, strict=True))
        cell = rays.cell_of((x, y, z))
        if cell != rays.cell_of(node.seed) and cells[-1:] != [cell]:
            cells.append(cell)
    return Counter({a: sum(rays.ends[a, c] for c in cells[1:]) for a in authors_of(rays)})


def cube_of(config: FoldConfig, node: Node) -> Cell:
    edge, half = 2 * config.cell_mm, 1 << 20
    x, y, z = (min(max(s // edge, 2 - half), half - 2) for s in node.seed)
    return (x, y, z)


def naive_misses(config: FoldConfig, fold: NaiveMap, rays: NaiveRays) -> list[int]:
    """What counts against each node; see `dagmap.weighing`."""
    against, support, passed, ended, hidden, moments = [], [], [], [], [], []
    for node in fold.nodes:
        cell, before = rays.cell_of(node.seed), naive_hidden(rays, node)
        passes = {a: rays.passes[a, cell] for a in authors_of(rays)}
        free = {a: max(0, n - rays.ends[a, cell]) for a, n in passes.items()}
        against.append(sum(min(config.miss_say, free[a] + before[a]) for a in passes))
        passed.append(sum(min(32, n) for n in passes.values()))
        hidden.append(sum(min(64, n) for n in before.values()))
        near = [n for n in fold.nodes if distance2(n.seed, node.seed) <= config.support_mm**2]
        parts = sum((n.seen for n in near), Counter[int]())
        support.append(sum(min(16, n) for n in parts.values()))
        last = {(a, cycle) for n in near for a, cycle in n.last.items()}
        moments.append(max(len(last), *(h for n in near for h in n.hits.values())))
        ended.append(sum(min(32, rays.ends[a, cell]) for a in passes))
    observed = sum((n.seen for n in fold.nodes), Counter[int]())
    lonely = [n for n, s, a in zip(fold.nodes, support, against, strict=True) if s <= 1 and a > 0]
    discredited = sum((n.seen for n in lonely), Counter[int]())
    all_gone = naive_gone(config, fold, moments, passed, ended)
    balances, records = [], []
    for k, node in enumerate(fold.nodes):
        record = min(naive_log2(200 * discredited[a] // observed[a] + 1) for a in node.seen)
        square = distance2(node.seed, node.origin)
        length = isqrt(square - 1) + 1 if square else 1
        balance = 6 * naive_log2(support[k])
        balance += 6 * (naive_log2(length) - naive_log2(config.delta_mm))
        balance -= naive_log2(1 + passed[k]) + 2 * naive_log2(1 + hidden[k])
        balances.append(balance - 2 * record)
        records.append(record)
    suspect = [a > b for a, b in zip(passed, ended, strict=True)]

    def naive_doubt(mine: list[int]) -> int:
        """Of 0 to 36 bits those below which suspects exceed a quarter by the most, or 36."""
        gains = []
        for bits in range(37):
            below = [suspect[k] for k in mine if balances[k] <= 16 * bits and bits > 0]
            gains.append(4 * sum(below) - len(below) + 16 * (bits == 36))
        return gains.index(max(gains))

    learned = {
        author: naive_doubt([k for k in range(len(balances)) if author in fold.nodes[k].seen])
        for author in observed
    }
    out = []
    for k, node in enumerate(fold.nodes):
        doubt = min(learned[a] for a in node.seen) if config.doubt is None else config.doubt
        gone = all_gone[k] and config.miss_say > 0
        counted = 1 if against[k] == 0 and (records[k] > 0 or gone) else against[k]
        out.append(counted if balances[k] <= 16 * doubt or gone else 0)
    return out


def naive_gone(
    config: FoldConfig, fold: NaiveMap, moments: list[int], passed: list[int], ended: list[int]
) -> list[bool]:
    """Which nodes have left together with what was seen beside them; see `dagmap.weighing`."""
    cubes = [cube_of(config, node) for node in fold.nodes]
    # that of the author who was the last to meet the node
    when = [list(node.last.items())[-1] for node in fold.nodes]
    numbers = range(len(cubes))
    about = [
        [j for j in numbers if all(abs(a - b) <= 1 for a, b in zip(cubes[j], cube, strict=True))]
        for cube in cubes
    ]
    crossed = []
    for k in numbers:
        brief = [j for j in about[k] if moments[j] < 3]
        sums = [sum(passed[j] for j in brief), sum(ended[j] for j in brief)]
        logs = [naive_log2(max(1, n)) for n in (*sums, sum(ended[j] for j in about[k]))]
        balance = logs[0] + 2 * (logs[1] - logs[2]) - 2 * naive_log2(moments[k])
        crossed.append(moments[k] < 3 and balance >= 62)
    out = []
    for k in numbers:
        together = [j for j in about[k] if when[j] == when[k]]
        left = sum(crossed[j] for j in together)
        out.append(moments[k] < 6 and left >= 4 and 2 * left >= len(together))
    return out


def naive_verdict(
    config: FoldConfig, fold: NaiveMap, rays: NaiveRays | None
) -> list[tuple[int, int, int, State]]:
    """(hits, misses, witnesses, state) of every node; without rays as Algorithm 2 counts."""
    out = []
    misses = [0] * len(fold.nodes) if rays is None else naive_misses(config, fold, rays)
    for node, against in zip(fold.nodes, misses, strict=True):
        h, m, witnesses = node.h, node.m, len(node.authors)
        if rays is not None:
            h = sum(min(config.hit_say, hits) for hits in node.hits.values())
            m = against
        state = State.CONFIRMED if witnesses >= config.witnesses else State.TENTATIVE
        out.append((h, m, witnesses, State.REJECTED if 2 * h <= h + m else state))
    return out


def authors_of(rays: NaiveRays) -> set[int]:
    return {author for author, _ in [*rays.passes, *rays.ends]}


# The codec, after its description: one big number, models in a dictionary.

Row = Sequence[int]
DEPTH = {"back": 3, "step": 4, "axis": 4, "channel": 3}
LAST_CONTEXT = {"back": 1, "step": 0, "axis": 15, "channel": 11}
NONE, INSIDE, OUTSIDE, SHARED = range(4)


class Wrong(Exception):
    """No encoder writes these bytes."""


class Models:
    """Chance of a zero in 2^-16 and count of uses, by (kind, context, bits before)."""

    def __init__(self) -> None:
        self.known: dict[object, tuple[int, int]] = {}

    def chance(self, key: object) -> int:
        return self.known.get(key, (1 << 15, 0))[0]

    def learn(self, key: object, bit: int) -> None:
        chance, uses = self.known.get(key, (1 << 15, 0))
        rate = 65536 * 5 // (5 * uses + 8)
        moved = chance - (chance * rate >> 16) if bit else chance + ((65536 - chance) * rate >> 16)
        self.known[key] = (moved, min(uses + 1, 127))


class Writer:
    def __init__(self) -> None:
        self.models, self.low, self.width, self.moved = Models(), 0, 1 << 32, 0

    def _renew(self) -> None:
        while self.width < 1 << 24:
            self.low, self.width, self.moved = self.low << 8, self.width << 8, self.moved + 1

    def bit(self, key: object, bit: int) -> int:
        bound = self.width * self.models.chance(key) >> 16
        self.low, self.width = (self.low + bound, self.width - bound) if bit else (self.low, bound)
        self.models.learn(key, bit)
        self._renew()
        return bit

    def plain(self, count: int, value: int) -> int:
        bits = f"{value:0{count}b}" if count else ""
        for at in range(0, count, 8):
            part = bits[at : at + 8]
            self.width >>= len(part)
            self.low += int(part, 2) * self.width
            self._renew()
        return value

    def end(self) -> bytes:
        return self.low.to_bytes(4 + self.moved, "big")


class Reader:
    def __init__(self, data: bytes) -> None:
        self.models, self.data, self.width, self.code, self.at = Models(), data, 1 << 32, 0, 0
        for _ in range(4):
            self._byte()

    def _byte(self) -> None:
        if self.at >= len(self.data):
            raise Wrong
        self.code = self.code * 256 + self.data[self.at]
        self.at += 1

    def _renew(self) -> None:
        while self.width < 1 << 24:
            self.width <<= 8
            self._byte()

    def bit(self, key: object, bit: int) -> int:
        bound = self.width * self.models.chance(key) >> 16
        bit = int(self.code >= bound)
        self.code, self.width = (
            (self.code - bound, self.width - bound) if bit else (self.code, bound)
        )
        self.models.learn(key, bit)
        self._renew()
        return bit

    def plain(self, count: int, value: int) -> int:
        value = 0
        while count:
            step = min(count, 8)
            count -= step
            self.width >>= step
            part = self.code // self.width
            if part >= 1 << step:
                raise Wrong
            self.code -= part * self.width
            value = value << step | part
            self._renew()
        return value

    def end(self) -> None:
        if self.code or self.at != len(self.data):
            raise Wrong


Coder = Writer | Reader


def tree(coder: Coder, key: tuple[object, ...], depth: int, value: int) -> int:
    bits = ""
    for digit in f"{value:0{depth}b}" if depth else "":
        bits += str(coder.bit((key, bits), int(digit)))
    return int(bits, 2) if bits else 0


def number(
    coder: Coder, kind: tuple[object, ...], context: int, signed: bool, value: int
) -> tuple[int, int]:
    """The number and the bit length of its magnitude."""
    name = str(kind[0])
    most = 2 ** DEPTH[name] - 1
    length = abs(value).bit_length()
    context = min(context, LAST_CONTEXT[name])
    short = tree(coder, (*kind, context), DEPTH[name], min(length, most))
    length = short
    if short == most:
        length += tree(coder, (*kind, "rare"), 6, max(abs(value).bit_length() - most, 0))
    if length > 62:
        raise Wrong
    if length == 0:
        return 0, 0
    rest = abs(value) % 2 ** (length - 1) + (2 ** (length - 1) if value < 0 else 0)
    rest = coder.plain(length - 1 + signed, rest)
    magnitude = 2 ** (length - 1) + rest % 2 ** (length - 1)
    return (-magnitude if rest >= 2 ** (length - 1) else magnitude), length


def one_parent(
    coder: Coder,
    parents: list[list[int]],
    i: int,
    slot: int,
    base: int,
    before: int,
    memory: dict[str, int],
) -> int:
    """Write or fill in one parent; returns where it is."""
    parent, first = parents[i][slot], parents[i][0]
    uncles = parents[first - base] if slot > 0 and first >= base else []
    if parent == -1:
        place = NONE
    elif parent in uncles:
        place = SHARED
    else:
        place = INSIDE if parent >= base else OUTSIDE
    place = tree(coder, ("place", slot > 0, before), 2, place)
    if place == NONE:
        parent = -1
    elif place == INSIDE:
        parent = base + i - number(coder, ("back",), slot > 0, False, base + i - parent)[0]
    elif place == OUTSIDE:
        last = memory["outside"]
        parent = memory["outside"] = last + number(coder, ("step",), 0, True, parent - last)[0]
    else:
        which = uncles.index(parent) if parent in uncles else 0
        which = tree(coder, ("which",), (len(parents[i]) - 1).bit_length(), which)
        if which >= len(uncles) or uncles[which] == -1 or uncles.index(uncles[which]) != which:
            raise Wrong
        parent = uncles[which]
    low, high = {INSIDE: (base, base + i - 1), OUTSIDE: (0, base - 1)}.get(place, (-1, base + i))
    if not low <= parent <= high or (place in (INSIDE, OUTSIDE) and parent in uncles):
        raise Wrong
    parents[i][slot] = parent
    return place


def walk(
    coder: Coder,
    position: list[list[int]],
    parents: list[list[int]],
    color: list[list[int]],
    base: int,
    starts: Row,
    colored: Row,
) -> None:
    """Write the columns, or fill them in."""
    memory = {"place": NONE, "outside": base}
    for i in range(len(position)):
        segment = max(s for s in range(len(colored)) if starts[s] <= i < starts[s + 1])
        start, places = starts[segment], [memory["place"]]
        for slot in range(len(parents[i])):
            places.append(one_parent(coder, parents, i, slot, base, places[-1], memory))
        memory["place"] = places[1] if parents[i] else NONE
        near = [parent - base for parent in parents[i] if parent >= base + start]
        j = near[0] if near else i - 1 if i > start else None
        lengths = [0]
        for axis in range(3):
            guess = 0 if j is None else position[j][axis]
            step = position[i][axis] - guess
            step, length = number(coder, ("axis", axis), lengths[-1], True, step)
            if abs(guess + step) > 2**29:
                raise Wrong
            position[i][axis] = guess + step
            lengths.append(length)
        if colored[segment]:
            _color(coder, color[i], [0, 0, 0] if j is None else color[j], max(lengths))


def _color(coder: Coder, own: list[int], other: list[int], context: int) -> None:
    shift = 0
    for channel, at in enumerate((1, 2, 0)):
        step = (own[at] - other[at] - shift + 128) % 256 - 128
        step, context = number(coder, ("channel", channel), context, True, step)
        if not -128 <= step <= 127:
            raise Wrong
        own[at] = (other[at] + shift + step) % 256
        shift = step if channel == 0 else shift


def encode(
    position: list[list[int]],
    parents: list[list[int]],
    base: int,
    starts: Row,
    color: list[list[int]],
    colored: Row,
) -> bytes:
    if not position:
        return b""
    coder = Writer()
    copies = ([list(row) for row in rows] for rows in (position, parents, color))
    walk(coder, *copies, base, starts, colored)
    return coder.end()


def decode(
    data: bytes, n: int, slots: int, base: int, starts: Row, colored: Row
) -> tuple[list[list[int]], list[list[int]], list[list[int]]] | None:
    """The columns, or None where `ok` is to be False."""
    position = [[0] * 3 for _ in range(n)]
    parents = [[-1] * slots for _ in range(n)]
    color = [[0] * 3 for _ in range(n)]
    try:
        if n == 0:
            return None if data else (position, parents, color)
        coder = Reader(data)
        walk(coder, position, parents, color, base, starts, colored)
        coder.end()
    except Wrong:
        return None
    return position, parents, color


def morton(points: list[list[int]]) -> list[int]:
    """Indices in Z order, by strings of bits."""

    def key(i: int) -> tuple[list[int], str]:
        shifted = [value + 2**19 for value in points[i]]
        bits = [f"{value % 2**20:020b}" for value in shifted]
        return [value // 2**20 for value in shifted], "".join(map("".join, zip(*bits, strict=True)))

    return sorted(range(len(points)), key=key)
