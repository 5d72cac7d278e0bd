"""RTAB-Map's `MapData` and `MapGraph` messages as cycles, from a bag or as they come."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from ...model import DESCRIPTOR, Cycle, Floats, RecordingError, Uint8s
from ._poses import inverse, matrix
from ._ros import LATEST, Unusable
from ._source import Options, checked
from .rtabmap import UINT8, unpack_rows

_STILL = 5e-4  # m, and in a rotation: what moves less has not moved
_FARTHEST = 5e5  # m from where the session began: what an agent takes
_AFTER = 1e-3  # s after the last node: when a mere correction is dated
_LATE = 5.0  # s: a graph that is older than the newest one by more is of another clock


class GraphFollower:
    """Each node becomes a cycle once; what a later optimisation moves comes as `moved`.

    Poses are told in the frame of the session's first node: RTAB-Map may optimise from another
    node, or join an older map, and then moves its map frame as a whole. A graph that shares no
    node with the one before is a new session, and so is one whose nodes were numbered anew.
    The newest graph counts: topics overtake each other, and an older one moves nothing back.
    A message counts whole or not at all: what one that raises would have moved, the next one does.
    skip: is told what was left out.
    """

    def __init__(self, options: Options, skip: Callable[[str], None]) -> None:
        self._options, self._skip = options, skip
        self._told: dict[int, Floats] = {}  # pose by node
        self._stamps: dict[int, float] = {}
        self._last = -np.inf
        self._newest: tuple[float, dict[int, Floats]] = -np.inf, {}  # stamp and poses of a graph
        self.session = 0
        self.map_frame = ""  # what RTAB-Map calls it
        self.map: Floats = np.eye(4)  # pose of RTAB-Map's map frame in the session's frame

    def data(self, message: Any) -> list[Cycle]:
        """The nodes of a MapData that are new, and what has moved. Raises Unusable."""
        return self._whole(self._data, message)

    def graph(self, message: Any) -> list[Cycle]:
        """What a MapGraph has moved. Raises Unusable."""
        return self._whole(lambda m: self._with_moves([], self._moved(self._enter(m))), message)

    def _whole(self, take: Callable[[Any], list[Cycle]], message: Any) -> list[Cycle]:
        told, stamps = dict(self._told), dict(self._stamps)
        rest = self._last, self._newest, self.session, self.map_frame, self.map
        try:
            return take(message)
        except BaseException:
            self._told, self._stamps = told, stamps
            self._last, self._newest, self.session, self.map_frame, self.map = rest
            raise

    def _data(self, message: Any) -> list[Cycle]:
        stamps = {int(node.id): float(node.stamp) for node in message.nodes}
        for id_, stamp in stamps.items():
            if self._stamps.get(id_, stamp) != stamp and abs(stamp) < LATEST:
                self._begin_anew()
        poses = self._enter(message.graph)
        moved = self._moved(poses)
        found = []
        for node in sorted(message.nodes, key=lambda node: int(node.id)):
            cycle = self._node(node, message.graph, poses)
            if cycle is not None:
                found.append(cycle)
        return self._with_moves(found, moved)

    def _enter(self, graph: Any) -> dict[int, Floats]:
        """Optimised poses by node, in RTAB-Map's map frame."""
        poses, stamp = optimised(graph), _stamp(graph)
        newest, counting = self._newest
        if newest - _LATE <= stamp < newest:
            return _brought_over(poses, counting)
        self._newest = stamp, poses
        self.map_frame = str(graph.header.frame_id).lstrip("/")
        known = poses.keys() & self._told.keys()
        if known:
            first = min(known)
            self.map = self._told[first] @ inverse(poses[first])
        elif poses and self._told:
            self._begin_anew()
        return poses

    def _begin_anew(self) -> None:
        self._told, self._stamps, self._last, self._newest = {}, {}, -np.inf, (-np.inf, {})
        self.session, self.map = self.session + 1, np.eye(4)

    def _moved(self, poses: dict[int, Floats]) -> dict[float, Floats]:
        """New poses by stamp, of nodes that were told elsewhere."""
        moved = {}
        for id_ in sorted(poses.keys() & self._told.keys()):
            pose = self.map @ poses[id_]
            if np.abs(pose).max() > _FARTHEST:
                self._skip(f"node {id_} would be {np.abs(pose).max():.3g} m away")
            elif np.abs(pose - self._told[id_]).max() > _STILL:
                moved[self._stamps[id_]] = self._told[id_] = pose
        return moved

    def _node(self, node: Any, graph: Any, poses: dict[int, Floats]) -> Cycle | None:
        id_, stamp = int(node.id), float(node.stamp)
        if id_ <= 0 or id_ in self._told:
            return None
        pose = poses.get(id_)
        if pose is None:  # not optimised yet: as the odometry has it
            here, there = _pose(node.pose), _transform(_either(graph, "map_to_odom", "mapToOdom"))
            pose = None if here is None or there is None else there @ here
        if pose is None:
            self._skip(f"node {id_} has no pose")
            return None
        if not self._last < stamp < LATEST:
            self._skip(f"node {id_}: its stamp {stamp} does not come after {self._last}")
            return None
        points, described = _chosen(node, self._options)
        if not len(points):
            return None  # a bare wall has no words
        pose = self.map @ pose
        try:
            cycle = Cycle(stamp, pose, points, session=self.session, descriptors=described)
            cycle = checked(cycle, f"node {id_}")
        except RecordingError as error:
            self._skip(str(error))
            return None
        self._last = self._stamps[id_] = stamp
        self._told[id_] = pose
        return cycle

    def _with_moves(self, cycles: list[Cycle], moved: dict[float, Floats]) -> list[Cycle]:
        """The moves go with the first cycle, or in one without points."""
        if not moved:
            return cycles
        pairs = np.array(list(moved)), np.array(list(moved.values()))
        if cycles:
            return [replace(cycles[0], moved=pairs), *cycles[1:]]
        self._last += _AFTER
        latest = max(self._stamps, key=self._stamps.__getitem__)
        nothing = np.zeros((0, 3))
        return [Cycle(self._last, self._told[latest], nothing, moved=pairs, session=self.session)]


def optimised(graph: Any) -> dict[int, Floats]:
    """Poses (4, 4) of a MapGraph by node; landmarks, of negative ids, are left out."""
    ids = np.asarray(_either(graph, "poses_id", "posesId"), np.int64).tolist()
    if len(ids) != len(graph.poses):
        raise Unusable(f"{len(ids)} nodes are named, {len(graph.poses)} poses are there")
    found = {id_: _pose(pose) for id_, pose in zip(ids, graph.poses, strict=True) if id_ > 0}
    return {id_: pose for id_, pose in found.items() if pose is not None}


def _stamp(graph: Any) -> float:
    stamp = graph.header.stamp
    return float(stamp.sec + stamp.nanosec / 1e9)


def _brought_over(old: dict[int, Floats], new: dict[int, Floats]) -> dict[int, Floats]:
    """The new poses, and those of nodes that only the old graph has, in the new one's frame."""
    common = old.keys() & new.keys()
    if not common:
        return new
    first = min(common)
    shift = new[first] @ inverse(old[first])
    return {**{id_: shift @ pose for id_, pose in old.items()}, **new}


def _chosen(node: Any, options: Options) -> tuple[Floats, Uint8s | None]:
    """(N, 3) m in the robot's frame: near enough, the strongest ones; and their (N, 32)
    descriptors, where they have some of that size."""
    packed = getattr(node, "word_descriptors", getattr(node, "wordDescriptors", b""))
    points, keys = _either(node, "word_pts", "wordPts"), _either(node, "word_kpts", "wordKpts")
    if not len(points) and hasattr(node, "data"):
        points, keys = node.data.points, node.data.key_points
        packed = getattr(node.data, "descriptors", b"")
    places = np.array([(p.x, p.y, p.z) for p in points], np.float64).reshape(-1, 3)
    order = np.arange(len(places))
    if len(keys) == len(places):
        strength = np.array([float(key.response) for key in keys])
        order = np.argsort(-np.nan_to_num(strength), kind="stable")
    most = np.inf if options.max_depth is None else options.max_depth
    with np.errstate(over="ignore", invalid="ignore"):
        distance = np.sqrt((places**2).sum(axis=1))
    near = (distance > 0) & (distance <= most) & np.isfinite(distance)
    rows = order[near[order]][: options.max_features]
    described = _descriptors(packed, len(places))
    return places[rows], None if described is None else described[rows]


def _descriptors(packed: Any, count: int) -> Uint8s | None:
    """(N, 32) of all words. None where they are of another size or kind, or damaged: the points
    are good without them."""
    try:
        found = unpack_rows(bytes(packed), UINT8)
    except (TypeError, ValueError):
        return None
    return found if count and found.shape == (count, DESCRIPTOR) else None


def _either(message: Any, *names: str) -> Any:
    """A field that ROS 1 and ROS 2 call differently. Raises Unusable."""
    for name in names:
        if hasattr(message, name):
            return getattr(message, name)
    raise Unusable(f"of a version of rtabmap_msgs that is not known: no field {names[0]}")


def _pose(pose: Any) -> Floats | None:
    return _matrix(pose.position, pose.orientation)


def _transform(transform: Any) -> Floats | None:
    return _matrix(transform.translation, transform.rotation)


def _matrix(place: Any, turn: Any) -> Floats | None:
    return matrix(np.array([place.x, place.y, place.z]), np.array([turn.x, turn.y, turn.z, turn.w]))
