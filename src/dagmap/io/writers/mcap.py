"""MCAP with one sensor_msgs/PointCloud2, for Foxglove, rviz and `ros2 bag play`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..export import atomic_write
from ..exported import MapTable
from ._writer import WriteOptions, library
from .pcd import point_rows

SUFFIXES = (".mcap",)
ABOUT = "MCAP, ROS 2: PointCloud2 on /dagmap/map"
TOPIC, FRAME = "/dagmap/map", "fleet"
_TYPE = "sensor_msgs/msg/PointCloud2"
_CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
_QOS = """- history: 1
  depth: 1
  reliability: 1
  durability: 1
"""


def write(path: Path, table: MapTable, options: WriteOptions) -> None:
    mcap = library("mcap.writer", "ros", path)
    stores = library("rosbags.typesys", "ros", path)
    types = stores.get_typestore(stores.Stores.ROS2_HUMBLE)
    stamp = _stamp(table)
    message = types.serialize_cdr(cloud_message(types, table, stamp), _TYPE)
    text, _ = types.generate_msgdef(_TYPE, ros_version=2)
    with atomic_write(path) as file:
        out = mcap.Writer(file)
        out.start(profile="ros2", library="dagmap")
        schema = out.register_schema(_TYPE, "ros2msg", text.encode())
        topic = out.register_channel(TOPIC, "cdr", schema, {"offered_qos_profiles": _QOS})
        out.add_message(topic, log_time=stamp, publish_time=stamp, data=bytes(message))
        out.finish()


def _stamp(table: MapTable) -> int:
    """ns, of the newest observation; 0 where none is known."""
    newest = np.nanmax(np.append(table.fields.get("stamp", np.zeros(0)), 0.0))
    return int(newest * 1e9)


def cloud_message(types: Any, table: MapTable, stamp: int) -> Any:
    """The table as a PointCloud2 of the type store. stamp: ns."""
    of = types.types
    rows = point_rows(table)
    places: Any = rows.dtype.fields
    fields = [
        of["sensor_msgs/msg/PointField"](name, int(offset), _CODES[kind.str[1:]], 1)
        for name, (kind, offset) in places.items()
    ]
    time = of["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
    return of[_TYPE](
        header=of["std_msgs/msg/Header"](time, FRAME),
        height=1,
        width=len(rows),
        fields=fields,
        is_bigendian=False,
        point_step=rows.dtype.itemsize,
        row_step=rows.dtype.itemsize * len(rows),
        data=np.frombuffer(rows.tobytes(), np.uint8),
        is_dense=True,
    )
