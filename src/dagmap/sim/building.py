"""A building of rooms, doors and boxes, from a seed: rays and distances that are exact.

Free space is a set of convex cells: a box for every room and one for every doorway. A ray leaves
its cell through a face; where that face has a gate there, it goes on in the next cell, else it
ends. So nothing is seen through a wall, and a ray costs the same in a building of any size.

The frame is the fleet's: x and y along the walls from one corner of the building, z up from the
floor, metres. Cells are numbered: rooms (i, j) as i * rooms in y + j, then doorways.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..config import _Checked
from ..model import Bools, Floats, Int64s

DOOR_HEIGHT = 2.0  # m
BOXES = 16  # places for boxes in a room: 2 x 2 in each corner, off the ways from door to door
_ROWS = 4096  # points whose distances are taken at a time, which bounds the memory
_TINY = 1e-12


class SceneConfig(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The table [scene]: a building whose rooms stand in a grid."""

    rooms: tuple[int, int] = (2, 2)  # in x and in y
    room: float = 5.0  # m, edge of a room, from the middle of one wall to that of the next
    height: float = 2.5  # m
    wall: float = 0.15  # m, how thick walls are
    door: float = 1.0  # m, how wide doors are; they stand in the middle of walls
    doors: float = 0.7  # share of walls that have a door, of those that need none to connect all
    objects: int = 3  # boxes in a room
    people: int = 0  # who walk about in the whole building: seen, but no part of the truth

    def __post_init__(self) -> None:
        low, high = min(self.rooms), max(self.rooms)
        self._require(low >= 1 and high <= 100, "rooms", "1 to 100 in x and in y are wanted")
        self._require_range("room", 3.0, 50.0)
        self._require_range("height", DOOR_HEIGHT + 0.1, 20.0)
        self._require_range("wall", 0.02, 0.5)
        self._require_range("door", 0.6, 1.2)
        self._require_range("doors", 0.0, 1.0)
        self._require_range("objects", 0, BOXES)
        self._require_range("people", 0, 1000)


class Building:
    """The static world. `low`, `high`: (cells, 3) m, the boxes of free space."""

    def __init__(self, config: SceneConfig, rng: np.random.Generator) -> None:
        self.config = config
        self.rooms = config.rooms[0] * config.rooms[1]
        self._lay_out_rooms()
        self._cut_doors(_doors(config, rng))
        self._put_boxes(rng)
        self._faces: dict[int, Floats] = {}

    def centre(self, room: int) -> tuple[float, float]:
        """(x, y) of the middle of a room, m; lines between those of `neighbours` are free."""
        i, j = divmod(room, self.config.rooms[1])
        return (i + 0.5) * self.config.room, (j + 0.5) * self.config.room

    def neighbours(self, room: int) -> list[int]:
        """Rooms behind the doors of a room."""
        return self._neighbours[room]

    def room_of(self, points: Floats) -> Int64s:
        """(N,) room of (N, 3) points, walls split in their middle; outside, the nearest room."""
        x, y = self.config.rooms
        cells = np.floor(points[:, :2] / self.config.room)
        cells = np.clip(cells, 0, (x - 1, y - 1)).astype(np.int64)
        return np.asarray(cells[:, 0] * y + cells[:, 1], np.int64)

    def cells_of(self, points: Floats) -> Int64s:
        """(N,) cells in which points (N, 3) of free space lie."""
        rooms = self.room_of(points)
        cells = rooms.copy()
        for side in range(4):
            axis, bounds = side // 2, self.high if side % 2 else self.low
            out = (points[:, axis] - bounds[rooms, axis]) * (1 if side % 2 else -1) > 0
            gates = self._gates[rooms, side]
            cells = np.where(out & (gates >= 0), gates, cells)
        return cells

    def cast(self, origins: Floats, directions: Floats, limit: float) -> tuple[Floats, Int64s]:
        """Where rays end: (N, R) m, inf beyond `limit`; (N, R) numbers of the surfaces they hit.

        origins: (N, 3) in free space. directions: (N, R, 3) of length 1, R rays from each.
        """
        each = directions.shape[1]
        directions = directions.reshape(-1, 3)
        inverses = inverse(directions)
        ahead = inverses > 0
        origin = np.repeat(origins, each, axis=0)
        depth = np.full(len(directions), np.inf)
        surface = np.full(len(directions), -1, np.int64)
        rows, cell = np.arange(len(directions)), np.repeat(self.cells_of(origins), each)
        while len(rows):
            at, inv, up = origin[rows], inverses[rows], ahead[rows]
            way = (np.where(up, self.high[cell], self.low[cell]) - at) * inv
            index, axis = np.arange(len(rows)), way.argmin(axis=1)
            end, side = way[index, axis], 2 * axis + up[index, axis]
            gate = self._gates[cell, side]
            on = gate >= 0
            point = at[on] + directions[rows[on]] * end[on, None]
            on[on] = self._through(gate[on], point, axis[on])
            if self.config.objects:
                reach, number = enter(at, inv, self._box_low[cell], self._box_high[cell])
                nearer = reach < end
                end, side = np.where(nearer, reach, end), np.where(nearer, 6 + number, side)
                on &= ~nearer
            done = ~on & (end <= limit)
            depth[rows[done]] = end[done]
            surface[rows[done]] = cell[done] * (6 + BOXES) + side[done]
            on &= end < limit
            rows, cell = rows[on], gate[on]
        return depth.reshape(-1, each), surface.reshape(-1, each)

    def _through(self, gate: Int64s, points: Floats, axis: Int64s) -> Bools:
        """(N,) whether points (N, 3) on the faces across `axis` lie where the next cell begins."""
        inside = (self.low[gate] <= points) & (points <= self.high[gate])
        inside[np.arange(len(gate)), axis] = True  # up to rounding
        return np.asarray(inside.all(axis=1))

    def distance(self, points: npt.ArrayLike) -> Floats:
        """(N,) m from (N, 3) points anywhere to the nearest static surface, exactly.

        It is one of the point's own room or of its doorways: what lies behind them is further.
        """
        points = np.asarray(points, np.float64).reshape(-1, 3)
        out = np.empty(len(points))
        rooms = self.room_of(points)
        order = np.argsort(rooms, kind="stable")
        names, counts = np.unique(rooms, return_counts=True)
        ends = np.cumsum(counts)
        for room, end, count in zip(names.tolist(), ends, counts, strict=True):
            rows = order[end - count : end]
            cells = [room, *(gate for gate in self._gates[room].tolist() if gate >= 0)]
            faces = np.concatenate([self.faces(cell) for cell in cells])
            for i in range(0, len(rows), _ROWS):
                part = rows[i : i + _ROWS]
                out[part] = _distances(points[part], faces)
        return out

    def truth(self, spacing: float) -> Floats:
        """(M, 3) points on all static surfaces, no further apart than `spacing` (m) along both."""
        cells = range(len(self.low))
        return np.concatenate([_grid(face, spacing) for c in cells for face in self.faces(c)])

    def faces(self, cell: int) -> Floats:
        """(F, 2, 3) corners of the rectangles that a cell shows: walls, floor, boxes."""
        if cell not in self._faces:
            self._faces[cell] = self._rectangles(cell)
        return self._faces[cell]

    def _lay_out_rooms(self) -> None:
        config, (x, y) = self.config, self.config.rooms
        corner = np.stack(np.meshgrid(range(x), range(y), indexing="ij"), -1).reshape(-1, 2)
        half = config.wall / 2
        self.low = np.zeros((self.rooms, 3))
        self.high = np.full((self.rooms, 3), config.height)
        self.low[:, :2] = corner * config.room + half
        self.high[:, :2] = (corner + 1) * config.room - half

    def _cut_doors(self, doors: list[tuple[int, int, int]]) -> None:
        """A cell for every doorway, and the gates between it and its two rooms."""
        count = self.rooms + len(doors)
        self._gates = np.full((count, 6), -1, np.int64)  # sides: -x, +x, -y, +y, floor, ceiling
        self._neighbours: list[list[int]] = [[] for _ in range(self.rooms)]
        self.low = np.concatenate([self.low, np.zeros((len(doors), 3))])
        self.high = np.concatenate([self.high, np.full((len(doors), 3), DOOR_HEIGHT)])
        for cell, (room, other, axis) in enumerate(doors, self.rooms):
            middle, half = self.centre(room)[1 - axis], self.config.door / 2
            self.low[cell, 1 - axis], self.high[cell, 1 - axis] = middle - half, middle + half
            self.low[cell, axis] = self.high[room, axis]
            self.high[cell, axis] = self.low[other, axis]
            self._gates[room, 2 * axis + 1] = self._gates[other, 2 * axis] = cell
            self._gates[cell, 2 * axis : 2 * axis + 2] = room, other
            self._neighbours[room].append(other)
            self._neighbours[other].append(room)

    def _put_boxes(self, rng: np.random.Generator) -> None:
        """Boxes on the floor, in the corners of rooms: each in a place of its own."""
        config, shape = self.config, (self.rooms, self.config.objects)
        everywhere = (len(self.low), config.objects, 3)
        free = config.door / 2 + 0.2  # m to both sides of the way from door to door
        edge = (config.room / 2 - config.wall / 2 - free) / 2
        starts = np.array([-free - 2 * edge, -free - edge, free, free + edge])
        places = rng.permuted(np.tile(np.arange(BOXES), (self.rooms, 1)), axis=1)
        chosen = places[:, : config.objects]
        centres = (self.low[: self.rooms, :2] + self.high[: self.rooms, :2])[:, None] / 2
        size = rng.uniform(0.4, 0.9, (*shape, 2)) * edge
        room_left = edge - size
        corner = centres + np.stack([starts[chosen // 4], starts[chosen % 4]], axis=-1)
        corner = corner + room_left * rng.uniform(0.1, 0.9, (*shape, 2))
        self._box_low = np.full(everywhere, np.inf)  # none in doorways: boxes out of reach
        self._box_high = np.full(everywhere, np.inf)
        rooms = slice(self.rooms)
        self._box_low[rooms, :, :2], self._box_low[rooms, :, 2] = corner, 0.0
        self._box_high[rooms, :, :2] = corner + size
        self._box_high[rooms, :, 2] = rng.uniform(0.3, 1.9, shape)

    def _rectangles(self, cell: int) -> Floats:
        out = []
        boxes: list[_Rectangle] = []
        if cell < self.rooms:
            boxes = list(zip(self._box_low[cell], self._box_high[cell], strict=True))
        for side in range(6):
            face = _face(self.low[cell], self.high[cell], side)
            gate = int(self._gates[cell, side])
            holes = [(self.low[gate], self.high[gate])] if gate >= 0 else []
            holes += boxes if side == 4 else []  # the floor below a box is nobody's surface
            out += _cut([face], holes, [axis for axis in range(3) if axis != side // 2])
        for low, high in boxes:
            out += [_face(low, high, side) for side in (0, 1, 2, 3, 5)]
        return np.array(out)


def inverse(directions: Floats) -> Floats:
    """1 / direction, finite: what runs along an axis deviates by next to nothing."""
    return np.asarray(1.0 / np.where(np.abs(directions) < _TINY, _TINY, directions))


def enter(origin: Floats, inverse: Floats, low: Floats, high: Floats) -> tuple[Floats, Int64s]:
    """Where (N,) rays enter the first of their boxes, m (inf: none), and which box that is.

    origin: (N, 3). inverse: (N, 3), 1 / direction. low, high: (N, K, 3). A box around the origin
    does not count.
    """
    entry, leave = np.zeros(low.shape[:2]), np.full(low.shape[:2], np.inf)
    for axis in range(3):  # column by column: numpy is slow at the maximum of three
        at, inv = origin[:, axis, None], inverse[:, axis, None]
        one, two = (low[..., axis] - at) * inv, (high[..., axis] - at) * inv
        np.maximum(entry, np.minimum(one, two), out=entry)
        np.minimum(leave, np.maximum(one, two), out=leave)
    entry[(entry > leave) | (entry == 0)] = np.inf
    number = entry.argmin(axis=1)
    return entry[np.arange(len(entry)), number], number


def _doors(config: SceneConfig, rng: np.random.Generator) -> list[tuple[int, int, int]]:
    """(room, room behind, axis): a random tree that connects all rooms, and a share of the rest."""
    x, y = config.rooms
    walls = [(i * y + j, (i + 1) * y + j, 0) for i in range(x - 1) for j in range(y)]
    walls += [(i * y + j, i * y + j + 1, 1) for i in range(x) for j in range(y - 1)]
    group = list(range(x * y))
    wanted = rng.random(len(walls)) < config.doors
    out = []
    for n in rng.permutation(len(walls)).tolist():
        one, two = _root(group, walls[n][0]), _root(group, walls[n][1])
        if one != two or wanted[n]:
            group[one] = two
            out.append(walls[n])
    return sorted(out)


def _root(group: list[int], room: int) -> int:
    while group[room] != room:
        group[room] = room = group[group[room]]
    return room


_Rectangle = tuple[Floats, Floats]  # low and high corner; equal along one axis


def _face(low: Floats, high: Floats, side: int) -> _Rectangle:
    low, high = low.copy(), high.copy()
    at = high if side % 2 else low
    low[side // 2] = high[side // 2] = at[side // 2]
    return low, high


def _cut(
    rectangles: list[_Rectangle], holes: list[_Rectangle], axes: list[int]
) -> list[_Rectangle]:
    """What is left of rectangles in the plane of `axes` without the holes."""
    for hole_low, hole_high in holes:
        left: list[_Rectangle] = []
        for low, high in rectangles:
            if (hole_low[axes] >= high[axes]).any() or (hole_high[axes] <= low[axes]).any():
                left.append((low, high))
                continue
            low, high = low.copy(), high.copy()
            for axis in axes:  # take off what lies beside the hole, first along one axis
                if hole_low[axis] > low[axis]:
                    left.append((low.copy(), high.copy()))
                    left[-1][1][axis] = low[axis] = hole_low[axis]
                if hole_high[axis] < high[axis]:
                    left.append((low.copy(), high.copy()))
                    left[-1][0][axis] = high[axis] = hole_high[axis]
        rectangles = left
    return rectangles


def _distances(points: Floats, faces: Floats) -> Floats:
    outside = np.maximum(faces[:, 0] - points[:, None], points[:, None] - faces[:, 1])
    np.maximum(outside, 0.0, out=outside)
    return np.asarray(np.sqrt((outside**2).sum(axis=2).min(axis=1)))


def _grid(face: Floats, spacing: float) -> Floats:
    """Middles of the smallest grid on a rectangle whose pitch is `spacing` at most."""
    counts = np.maximum(np.ceil((face[1] - face[0]) / spacing), 1).astype(np.int64)
    steps = [(np.arange(n) + 0.5) / n for n in counts]
    grid = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(face[0] + grid * (face[1] - face[0]))
