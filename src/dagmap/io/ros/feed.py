"""Messages of one robot's SLAM, as they come, made into cycles. What waits is bounded."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ...model import Cycle, Floats, RecordingError, Uint8s
from ..sources import _ros as ros
from ..sources._cloud import thinned
from ..sources._poses import SensorPoses, inverse
from ..sources._rtabmap_graph import GraphFollower
from ..sources._rtabmap_msgs import MAP_DATA, MAP_GRAPH
from ..sources._source import checked
from .config import RosConfig

_WAITING = 32  # clouds that wait for their poses
_KEPT = 30.0  # s of poses behind the newest cloud
_FRAMES = 1000  # of tf, with a parent each
_AHEAD = 3600.0  # s: nor does a clock go on by more at once
_SURE = 3  # messages in a row after which what is odd is so
_JUMP = 5.0  # s: a clock that goes back by more was started anew, as a bag that is played again
_EVERY = 200  # messages of poses after which old ones are let go of


class Topic(NamedTuple):
    """What is listened to. role: a field of `RosConfig`. kind: the type's name."""

    role: str
    name: str
    kind: str


def wanted(config: RosConfig) -> tuple[Topic, ...]:
    """The topics that a robot of this configuration is fed from."""
    if config.map_data:
        out = [Topic("map_data", config.map_data, MAP_DATA[0])]
        if config.map_graph:
            out.append(Topic("map_graph", config.map_graph, MAP_GRAPH[0]))
        return tuple(out)
    out = [Topic("cloud", config.cloud, ros.CLOUD)]
    if config.odometry:
        out.append(Topic("odometry", config.odometry, ros.ODOMETRY))
    out += [Topic("tf", config.tf, ros.TF[0]), Topic("tf_static", config.tf_static, ros.TF[0])]
    return tuple(out)


@dataclass(slots=True)
class _Cloud:
    came: float  # on the clock of whoever feeds
    stamp: float
    frame: str
    points: Floats
    colors: Uint8s | None


@dataclass(slots=True)
class _Clock:
    """The stamps of one topic. A few that do not fit are refused; when more follow, they count."""

    newest: float = -np.inf
    _odd: float = -np.inf
    _in_a_row: int = 0

    def went_back(self, stamp: float) -> bool:
        """Whether the clock was started anew. Raises Unusable where that is not sure."""
        if self.newest == -np.inf or -_JUMP <= stamp - self.newest <= _AHEAD:
            self.newest, self._in_a_row = max(self.newest, stamp), 0
            return False
        again = -_JUMP <= stamp - self._odd <= _AHEAD
        self._odd, self._in_a_row = stamp, self._in_a_row + 1 if again else 1
        if self._in_a_row < _SURE:
            raise ros.Unusable(f"its stamp {stamp:.6f} is far from that of the one before")
        back, self.newest, self._in_a_row = stamp < self.newest, stamp, 0
        return back


class Feed:
    """The cycles of one robot. Messages are decoded ones, of ROS 1 or 2; `now` is any clock in s.

    problem: what keeps clouds from becoming cycles, for people; None where all is well.
    dropped: clouds and nodes that were left out, by reason.
    """

    def __init__(self, config: RosConfig, session: int = 0) -> None:
        self._config, self._options = config, config.options()
        self.problem: str | None = None
        self.dropped: Counter[str] = Counter()
        self.newest = -np.inf  # stamp of any message, on the robot's clock, s
        self._session, self._last = session, -np.inf
        self._clouds: deque[_Cloud] = deque()
        self._poses_since = 0
        self._pose_frame = ""
        self._clocks = {"cloud": _Clock(), "odometry": _Clock()}
        self._child = ""  # what the odometry is of
        self._others: list[tuple[str, str]] = []  # (frame, child) of odometry that is another one
        self._poses = self._no_poses()
        self._follower = GraphFollower(self._options, self._skip)

    def take(self, role: str, message: Any, now: float) -> list[Cycle]:
        """The cycles that are known now. Raises Unusable, and then the message is left out."""
        if role in ("map_data", "map_graph"):
            cycles = self._follow(role, message)
        else:
            {"cloud": self._cloud, "odometry": self._odometry}.get(role, self._frames)(
                role, message, now
            )
            cycles = self._ready(now)
        for cycle in cycles:
            self.newest = max(self.newest, float(cycle.stamp))
        return cycles

    def tick(self, now: float) -> list[Cycle]:
        """Time passes: clouds that have waited too long go, with or without their poses."""
        return self._ready(now)

    @property
    def waiting(self) -> int:
        """Clouds whose poses are not known yet."""
        return len(self._clouds)

    def map_frame(self) -> tuple[str, Floats] | None:
        """The frame that tf is told of, and its pose (4, 4) in the SLAM frame of the cycles."""
        if self._config.map_data:
            name = self._config.map_frame or self._follower.map_frame
            return (name, self._follower.map) if name else None
        if not self._pose_frame:
            return None
        tree, here = self._poses.tree, self._pose_frame
        name = self._config.map_frame or tree.above(here)[-1]
        if name == here:
            return here, np.eye(4)
        at = min(self.newest, tree.reached(name, here))
        pose = tree.pose(name, here, at)
        return None if pose is None else (name, inverse(pose))

    @property
    def assumed(self) -> str:
        """What the poses of cycles were taken for without being told; empty where it was said."""
        return self._poses.assumed if self._last > -np.inf else ""

    @property
    def lost_frame(self) -> str:
        """The frame of the poses, where no tf leads from it to the one that is to be told of."""
        return "" if self.map_frame() is not None else self._pose_frame

    def _follow(self, role: str, message: Any) -> list[Cycle]:
        follower, self.problem = self._follower, None
        found = follower.data(message) if role == "map_data" else follower.graph(message)
        return [self._checked(cycle, self._session + cycle.session) for cycle in found]

    def _cloud(self, role: str, message: Any, now: float) -> None:
        stamp = ros.stamp_of(message)
        if self._clocks[role].went_back(stamp):
            self._begin_anew()
        if stamp <= max(self._last, self._clouds[-1].stamp if self._clouds else -np.inf):
            raise ros.Unusable(f"its stamp {stamp:.6f} does not come after the one before")
        points, colors = thinned(*ros.cloud_arrays(message), self._options)
        frame = ros.frame_name(str(message.header.frame_id))
        self._clouds.append(_Cloud(now, stamp, frame, points, colors))
        self.newest = max(self.newest, stamp)
        if len(self._clouds) > _WAITING:
            self._clouds.popleft()
            self._drop("no pose in time")

    def _odometry(self, role: str, message: Any, now: float) -> None:
        child, stamp, pose = ros.pose_of(message)
        ros.stamp_of(message)  # an empty one is none
        frame = ros.frame_name(str(message.header.frame_id))
        if self._is_another(frame, child) or self._clocks[role].went_back(stamp):
            self._begin_anew()
        self._pose_frame, self._child = frame, child
        self._poses.add_pose(child, stamp, pose)
        self.newest = max(self.newest, stamp)
        self._tidy()

    def _is_another(self, frame: str, child: str) -> bool:
        """Whether odometry is of other frames from now on. Raises Unusable where it is not sure."""
        if not self._pose_frame or (frame, child) == (self._pose_frame, self._child):
            self._others.clear()
            return False
        if self._others and self._others[-1] != (frame, child):
            self._others.clear()
        self._others.append((frame, child))
        if len(self._others) < _SURE:
            raise ros.Unusable(
                f"it tells of {child!r} in {frame!r}, the ones before it of {self._child!r} in "
                f"{self._pose_frame!r}; one topic for one odometry is wanted"
            )
        self._others.clear()
        return True

    def _frames(self, role: str, message: Any, now: float) -> None:
        fleet = self._config.fleet_frame
        found = [each for each in ros.transforms(message) if each[0] != fleet]  # not its own
        tree = self._poses.tree
        for each in found:
            if len(tree) < _FRAMES or tree.knows(each[1]):
                self._poses.add_frames([each], still=role == "tf_static")
        self._tidy(len(found))

    def _tidy(self, count: int = 1) -> None:
        self._poses_since += count
        if self._poses_since >= _EVERY:
            self._poses_since = 0
            # Where no cloud waits, none will come for what is long past on the topic's own clock.
            oldest = self._clouds[0].stamp - _KEPT if self._clouds else -np.inf
            kept = np.inf if self._clouds else _KEPT
            self._poses.trajectory.forget(oldest, kept)
            self._poses.tree.forget(oldest, kept)

    def _ready(self, now: float) -> list[Cycle]:
        """The oldest clouds, as far as their poses are known or will not be waited for."""
        out = []
        while self._clouds:
            cloud = self._clouds[0]
            late = now - cloud.came >= self._config.patience
            try:
                known = self._poses.known and self._poses.reached(cloud.frame) >= cloud.stamp
                pose = self._poses.at(cloud.stamp, cloud.frame) if known or late else None
                why = "no pose for its moment"
            except RecordingError as error:
                pose, why = None, str(error)
            if pose is None and not late:
                break
            self._clouds.popleft()
            if pose is None:
                self._drop(why)
                continue
            if not self._config.odometry:
                self._hold(self._poses.fixed(cloud.frame))
            out += self._made(cloud, pose)
        return out

    def _hold(self, fixed: str) -> None:
        """Cycles of one session are in one frame: where tf leads to it no more, another begins."""
        if self._poses.held and fixed != self._poses.held and self._last > -np.inf:
            self._session += 1
        self._pose_frame = self._poses.held = fixed

    def _made(self, cloud: _Cloud, pose: Floats) -> list[Cycle]:
        cycle = Cycle(cloud.stamp, pose, cloud.points, colors=cloud.colors)
        try:
            cycle = self._checked(cycle, self._session)
        except ros.Unusable as fault:
            self._drop(str(fault))
            return []
        self._last, self.problem = cloud.stamp, None
        return [cycle]

    def _checked(self, cycle: Cycle, session: int) -> Cycle:
        try:
            return checked(replace(cycle, session=session), "[ros]")
        except RecordingError as error:
            raise ros.Unusable(str(error)) from None

    def _begin_anew(self) -> None:
        """The clock or the odometry is another one: nothing of before belongs to what comes."""
        still = self._poses.tree.still
        self._clouds.clear()
        self._poses = self._no_poses()
        self._poses.add_frames(still, still=True)
        if self._last > -np.inf:
            self._session += 1
        self._last = self.newest = -np.inf
        self._clocks = {"cloud": _Clock(), "odometry": _Clock()}
        self._pose_frame = self._child = ""

    def _no_poses(self) -> SensorPoses:
        config = self._config
        return SensorPoses("[ros]", config.odometry, config.frame, config.same_frame)

    def _drop(self, why: str) -> None:
        self.dropped["clouds"] += 1
        self.problem = why

    def _skip(self, what: str) -> None:
        self.dropped["nodes"] += 1
        self.problem = what
