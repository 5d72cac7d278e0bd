"""ROS messages as arrays, whichever version of ROS wrote them. No ROS is needed."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from ...model import Floats, Uint8s
from ._cloud import doubles
from ._poses import matrix
from ._rgbd import complete

CLOUD = "sensor_msgs/msg/PointCloud2"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA = "sensor_msgs/msg/CameraInfo"
ODOMETRY = "nav_msgs/msg/Odometry"
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
POSE = "geometry_msgs/msg/PoseStamped"
POSE_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"

_CODES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_ENCODINGS = {
    **dict.fromkeys(("mono8", "8UC1"), ("u1", 1)),
    **dict.fromkeys(("rgb8", "bgr8", "8UC3"), ("u1", 3)),
    **dict.fromkeys(("rgba8", "bgra8", "8UC4"), ("u1", 4)),
    **dict.fromkeys(("mono16", "16UC1"), ("u2", 1)),
    "32FC1": ("f4", 1),
}
LATEST = 2.0**31  # s: no clock of ROS goes further
_FILLER = "structure_needs_at_least_one_member"  # of what is empty; in ROS 1 it takes no bytes
_NAME, _ARRAY, _SEQUENCE = 2, 3, 4  # kinds of fields in rosbags' definitions
_MOST_FRAME = 1000  # bytes of a frame's name
_COMPRESSED_DEPTH = 12  # bytes before the PNG of a compressedDepth picture


class Unusable(Exception):
    """What is wrong with a message."""


def peek(raw: bytes, ros2: bool) -> tuple[float, str]:
    """Stamp (s) and frame of a message that begins with a header. Raises Unusable."""
    order = "<" if not ros2 or raw[1:2] == b"\1" else ">"
    try:  # after 4 bytes, which differ between ROS 1 and 2
        seconds, nanoseconds, size = struct.unpack_from(f"{order}iII", raw, 4)
    except struct.error:
        raise Unusable(f"{len(raw)} bytes are no header") from None
    name = bytes(raw[16 : 16 + size])
    if size > _MOST_FRAME or len(name) < size:
        raise Unusable(f"a frame of {size} bytes in a message of {len(raw)}")
    return seconds + nanoseconds / 1e9, frame_name(name.decode("utf-8", "replace"))


def frame_name(name: str) -> str:
    """ROS 1 allowed a slash before it, ROS 2 writes its terminating zero."""
    return name.rstrip("\0").lstrip("/")


def boundless(fielddefs: Any) -> str | None:
    """The name of a type that is repeated without taking bytes, so that a few bytes can claim any
    number of them; None where there is none. fielddefs: of a typestore of rosbags."""

    def takes_none(what: Any) -> bool:
        kind, of = int(what[0]), what[1]
        if kind == _NAME and of in fielddefs:
            return all(takes_none(inner) for name, inner in fielddefs[of][1] if name != _FILLER)
        return kind == _ARRAY and (of[1] == 0 or takes_none(of[0]))

    for _, fields in fielddefs.values():
        for _, (kind, of) in fields:
            if int(kind) in (_ARRAY, _SEQUENCE) and takes_none(of[0]):
                return str(of[0][1])
    return None


def stamp_of(message: Any) -> float:
    """s, of the header. Raises Unusable where it is empty."""
    stamp = message.header.stamp
    seconds = _seconds(stamp)
    if not seconds:
        raise Unusable("its header has no stamp; the driver must give it one")
    return seconds


def _seconds(stamp: Any) -> float:
    seconds = float(stamp.sec + stamp.nanosec / 1e9)
    if not 0 <= seconds < LATEST:
        raise Unusable(f"its stamp {seconds:.6f} is none that a clock shows")
    return seconds


def cloud_arrays(message: Any) -> tuple[Floats, Uint8s | None]:
    """(N, 3) m and (N, 3) RGB or None of a PointCloud2. Raises Unusable."""
    fields = {f.name: f for f in message.fields}
    missing = [axis for axis in "xyz" if axis not in fields]
    if missing:
        raise Unusable(f"no field {missing[0]} among {', '.join(fields) or 'none'}")
    order = ">" if message.is_bigendian else "<"
    wanted = [name for name in ("x", "y", "z", "rgb", "rgba") if name in fields]
    kinds, places = [], []
    for name in wanted:
        code = _CODES.get(int(fields[name].datatype))
        if code is None:
            raise Unusable(f"field {name} is of the unknown type {fields[name].datatype}")
        kinds.append(order + ("u4" if name in ("rgb", "rgba") and code in ("f4", "u4") else code))
        places.append(int(fields[name].offset))
    step, row = int(message.point_step), int(message.row_step)
    width, height = int(message.width), int(message.height)
    ends = [place + int(kind[2]) for place, kind in zip(places, kinds, strict=True)]
    data = np.asarray(message.data, np.uint8)
    row = row or step * width
    if step < max(ends) or row < step * width or row * height > len(data):
        raise Unusable(
            f"{width} x {height} points of {step} bytes are promised, {len(data)} bytes are there"
        )
    kind = np.dtype({"names": wanted, "formats": kinds, "offsets": places, "itemsize": step})
    data = data[: row * height].reshape(height, row)[:, : step * width]
    rows = np.frombuffer(data.tobytes(), kind)
    with np.errstate(invalid="ignore"):  # signalling NaNs stay what they are
        points = np.stack([doubles(rows[axis]) for axis in "xyz"], axis=1)
    color = next((name for name in ("rgb", "rgba") if name in wanted), None)
    if color is None or rows.dtype[color].itemsize != 4:
        return points, None
    packed = rows[color].astype(np.uint32)
    return points, np.stack([packed >> 16, packed >> 8, packed], axis=1).astype(np.uint8)


def image_array(message: Any) -> np.ndarray:
    """(H, W) or (H, W, C) of an Image, as its encoding stores it. Raises Unusable."""
    name = str(message.encoding)
    if name not in _ENCODINGS:
        raise Unusable(f"pictures of the encoding {name[:40]!r} are not read")
    code, channels = _ENCODINGS[name]
    width, height, step = int(message.width), int(message.height), int(message.step)
    size = np.dtype(code).itemsize * channels
    data = np.asarray(message.data, np.uint8)
    if step < width * size or step * height > len(data) or not width * height:
        raise Unusable(
            f"{width} x {height} pixels of {size} bytes are promised, {len(data)} bytes are there"
        )
    rows = data[: step * height].reshape(height, step)[:, : width * size]
    order = ">" if message.is_bigendian else "<"
    pixels = np.frombuffer(rows.tobytes(), order + code).reshape(height, width, channels)
    return pixels[:, :, 0] if channels == 1 else pixels


def color_picture(cv2: Any, kind: str, message: Any) -> Uint8s:
    """(H, W, 3) BGR. Raises Unusable."""
    if kind == COMPRESSED:
        return np.asarray(_decoded(cv2, bytes(message.data), cv2.IMREAD_COLOR), np.uint8)
    pixels, name = image_array(message), str(message.encoding)
    if pixels.dtype != np.uint8:
        raise Unusable(f"a colour picture is wanted, this is {name}")
    if pixels.ndim == 2:
        return np.repeat(pixels[:, :, None], 3, axis=2)
    return np.ascontiguousarray(pixels[:, :, 2::-1] if "rgb" in name else pixels[:, :, :3])


def depth_picture(cv2: Any, kind: str, message: Any) -> Floats:
    """(H, W) m, NaN where there is none. Raises Unusable."""
    if kind == COMPRESSED:
        form = str(message.format)
        data = bytes(message.data)
        if "rvl" in form.lower():
            raise Unusable("depth that is compressed by RVL is not read; record it as PNG")
        at = _COMPRESSED_DEPTH if "compressedDepth" in form else 0
        pixels = _decoded(cv2, data[at:], cv2.IMREAD_UNCHANGED)
        if pixels.ndim == 2 and pixels.dtype == np.uint16 and "32FC1" in form:
            quantum, offset = struct.unpack_from("<ff", data, 4)
            with np.errstate(divide="ignore", invalid="ignore"):
                metres = quantum / (pixels.astype(np.float64) - offset)
            return np.where(pixels > 0, metres, np.nan)
    else:
        pixels = image_array(message)
    if pixels.ndim != 2 or pixels.dtype.kind not in "uf" or pixels.dtype.itemsize < 2:
        raise Unusable(f"a depth picture is wanted, this is {pixels.dtype} {pixels.shape}")
    metres = pixels.astype(np.float64)
    return np.asarray(metres if pixels.dtype.kind == "f" else metres / 1000.0)  # REP 118


def _decoded(cv2: Any, data: bytes, flags: int) -> Any:
    if not complete(data):
        raise Unusable("the compressed picture is cut short or damaged")
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        picture = None
    if picture is None:
        raise Unusable("OpenCV cannot read the compressed picture")
    return np.asarray(picture)


def pose_of(message: Any) -> tuple[str, float, Floats]:
    """What moves ("" where it is not said), stamp (s) and (4, 4) of an Odometry or a PoseStamped.

    Raises Unusable.
    """
    pose, stamp = message.pose, _seconds(message.header.stamp)
    pose = getattr(pose, "pose", pose)
    found = _matrix(pose.position, pose.orientation)
    if found is None:
        raise Unusable("its orientation is no unit quaternion, or its position not finite")
    child = frame_name(getattr(message, "child_frame_id", ""))
    return child, stamp, found


def transforms(message: Any) -> list[tuple[str, str, float, Floats]]:
    """(parent, child, stamp, pose) of a TFMessage; what is no pose is left out."""
    found = []
    for item in message.transforms:
        pose = _matrix(item.transform.translation, item.transform.rotation)
        stamp = item.header.stamp
        seconds = float(stamp.sec + stamp.nanosec / 1e9)
        if pose is not None and 0 <= seconds < LATEST:
            frames = frame_name(item.header.frame_id), frame_name(item.child_frame_id)
            found.append((*frames, seconds, pose))
    return found


def _matrix(place: Any, turn: Any) -> Floats | None:
    return matrix(np.array([place.x, place.y, place.z]), np.array([turn.x, turn.y, turn.z, turn.w]))
