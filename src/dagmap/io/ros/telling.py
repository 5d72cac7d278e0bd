"""What the robot's ROS is told of the fleet's map: messages made of a picture of the agent."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...model import FLEET_FRAME, QUATERNION_ONE, Floats, State, quantise_pose
from ...worldmap import WorldMap
from ..runtime import Runtime
from .types import Types

CLOUD = "sensor_msgs/msg/PointCloud2"
MARKERS = "visualization_msgs/msg/MarkerArray"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
_LAST = float((1 << 31) - 1)  # s, of a stamp of ROS 2
_ROW = np.dtype(
    [
        *((axis, "<f4") for axis in "xyz"),
        ("rgb", "<u4"),
        ("state", "u1"),
        ("", "V3"),  # so that the numbers behind it are aligned
        ("hits", "<u4"),
        ("misses", "<u4"),
        ("witnesses", "<u2"),
        ("", "V2"),
    ]
)
_CODES = {"u1": 2, "<u2": 4, "<u4": 6, "<f4": 7}  # of a PointField
_LINE_LIST, _LINE = 5, 0.01  # a Marker's type; m
_EDGE = (0.2, 0.7, 1.0, 0.8)  # red, green, blue, alpha
OK, WARN = 0, 1


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """What the agent's thread gives away: values that do not change any more.

    frame: (4, 4) of the robot's SLAM frame in the fleet's, or None. edges: (M, 2, 3) m in the
    SLAM frame, child and parent. said: name and value of what diagnostics show.
    """

    world: WorldMap
    frame: Floats | None
    edges: Floats
    name: str
    author: str
    said: Mapping[str, object]

    @property
    def placed(self) -> bool:
        """Whether the map is in the fleet's frame; else it is in one that nobody shares."""
        return self.frame is not None or self.world.origin == FLEET_FRAME


def take_picture(runtime: Runtime, edges: int) -> Picture:
    """To be called in the agent's thread. edges: that are shown at most, the newest ones."""
    agent, counts = runtime.agent, runtime.counts
    world = agent.map
    said: dict[str, object] = {
        "cycles": counts.cycles,
        "transactions": len(agent.ledger),
        "own transactions": counts.issued,
        "robots in reach": len(runtime.network.here),
        "waiting for": len(agent.ledger.missing()),
        "unsent bytes": runtime.network.waiting_bytes,
        "refused": counts.refused.total(),
        "map nodes": len(world),
        **{f"map {state.name.lower()}": world.count(state) for state in State},
        "digest": agent.digest().hex() if agent.settled else "being computed",
        "frames not placed": len(agent.unplaced),
    }
    author = agent.identity.author.hex()
    shown = _edges(runtime, edges)
    return Picture(world, agent.frame(), shown, agent.config.name or author, author, said)


def _edges(runtime: Runtime, most: int) -> Floats:
    """(M, 2, 3) m: from the newest features to their parents that are features."""
    graph = runtime.agent.observing.graph
    newest = np.arange(max(0, len(graph) - most), len(graph), dtype=np.int64)
    newest = newest[graph.alive(newest)]
    parents = graph.parents(newest)
    child, column = np.nonzero(parents >= 0)
    ends = graph.positions(newest[child]), graph.positions(parents[child, column])
    return np.stack(ends, axis=1)[-most:].astype(np.float64) / 1000.0


def header(types: Types, stamp: float, frame: str) -> Any:
    """stamp: s on the robot's clock; beyond what ROS can say it is the last."""
    nanoseconds = round(min(max(stamp, 0.0), _LAST) * 1e9)
    time = types.make(
        "builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9
    )
    return types.make("std_msgs/msg/Header", stamp=time, frame_id=frame)


def map_message(types: Types, world: WorldMap, stamp: float, frame: str, most: int) -> bytes:
    """A PointCloud2 of what is kept; of more than `most` nodes it is thinned evenly."""
    kept = np.flatnonzero(world.kept)
    if len(kept) > most:
        kept = kept[np.arange(most) * len(kept) // most]
    rows = np.zeros(len(kept), _ROW)
    for i, axis in enumerate("xyz"):
        rows[axis] = world.positions[kept, i]
    red, green, blue = world.colors[kept].astype(np.uint32).T
    rows["rgb"] = red << 16 | green << 8 | blue
    rows["state"] = world.states[kept]
    for name in ("hits", "misses", "witnesses"):
        rows[name] = getattr(world, name)[kept]
    places: Any = _ROW.fields
    fields = [
        types.make(
            "sensor_msgs/msg/PointField",
            name=name,
            offset=int(places[name][1]),
            datatype=7 if name == "rgb" else _CODES[places[name][0].str.replace("|", "")],
            count=1,
        )
        for name in ("x", "y", "z", "rgb", "state", "hits", "misses", "witnesses")
    ]
    message = types.make(
        CLOUD,
        header=header(types, stamp, frame),
        height=1,
        width=len(rows),
        fields=fields,
        point_step=_ROW.itemsize,
        row_step=_ROW.itemsize * len(rows),
        data=np.frombuffer(rows.tobytes(), np.uint8),
        is_dense=True,
    )
    return types.encode(CLOUD, message)


def graph_message(types: Types, edges: Floats, to_frame: Floats, stamp: float, frame: str) -> bytes:
    """A MarkerArray of lines. edges: (M, 2, 3) m; to_frame: (4, 4) carries them into `frame`."""
    ends = edges.reshape(-1, 3) @ to_frame[:3, :3].T + to_frame[:3, 3]
    point = types.make("geometry_msgs/msg/Point").__class__
    red, green, blue, alpha = _EDGE
    marker = types.make(
        "visualization_msgs/msg/Marker",
        header=header(types, stamp, frame),
        ns="adjacency DAG",
        type=_LINE_LIST,
        pose=types.make("geometry_msgs/msg/Pose", orientation=_turn(types, np.eye(4))),
        scale=types.make("geometry_msgs/msg/Vector3", x=_LINE),
        color=types.make("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=alpha),
        points=[point(*end) for end in ends.tolist()],
    )
    return types.encode(MARKERS, types.make(MARKERS, markers=[marker]))


def diagnostics_message(
    types: Types, picture: Picture, feed: Mapping[str, object], problem: str | None, stamp: float
) -> bytes:
    """A DiagnosticArray with one status. feed: what there is to say of the robot's own topics."""
    if problem is None and not picture.placed:
        problem = "not placed in the fleet's frame yet"
    values = [
        types.make("diagnostic_msgs/msg/KeyValue", key=key, value=str(value))
        for key, value in {**picture.said, **feed}.items()
    ]
    status = types.make(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=OK if problem is None else WARN,
        name=f"dagmap: {picture.name}",
        message="mapping" if problem is None else problem,
        hardware_id=picture.author,
        values=values,
    )
    message = types.make(DIAGNOSTICS, header=header(types, stamp, ""), status=[status])
    return types.encode(DIAGNOSTICS, message)


def transform_message(types: Types, pose: Floats, parent: str, child: str, stamp: float) -> bytes:
    """A TFMessage: `child` has this pose (4, 4) in `parent`."""
    x, y, z = pose[:3, 3].tolist()
    one = types.make(
        "geometry_msgs/msg/TransformStamped",
        header=header(types, stamp, parent),
        child_frame_id=child,
        transform=types.make(
            "geometry_msgs/msg/Transform",
            translation=types.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=_turn(types, pose),
        ),
    )
    return types.encode(TRANSFORMS, types.make(TRANSFORMS, transforms=[one]))


def _turn(types: Types, pose: Floats) -> Any:
    only = np.eye(4)  # tf may go further than a map does: UTM coordinates are millions of metres
    only[:3, :3] = pose[:3, :3]
    w, x, y, z = (quantise_pose(only)[:4] / QUATERNION_ONE).tolist()
    return types.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
