"""The cycles of a bag: clouds, or pictures with depth, each with the pose of its moment."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...model import Cycle, Floats, RecordingError
from . import _ros as ros
from ._bag import Bag, Message
from ._cloud import thinned
from ._kiss import KissIcp
from ._lens import Distortion, is_rectified, lens_of
from ._odometry import PictureOdometry
from ._poses import SLACK, SensorPoses, nearest
from ._rgbd import Camera, FrontEnd, Straight, import_cv2, load_camera
from ._source import Options, Skips, checked

_STORED = 200  # pictures that wait for their partner at most
_STORED_BYTES = 1 << 29


class BagPoses(SensorPoses):
    """Where a sensor was, by the odometry (or another pose) and the tf of a bag."""

    def __init__(self, bag: Bag, topic: str, tf: tuple[str, ...], options: Options) -> None:
        super().__init__(str(bag.path), topic, options.frame, options.same_frame)
        for message in bag.messages({topic, *tf} - {""}):
            try:
                if message.topic == topic:
                    self.add_pose(*bag.read(message, ros.pose_of))
                else:
                    found = bag.read(message, ros.transforms)
                    self.add_frames(found, still="static" in message.topic)
            except RecordingError as error:
                bag.skips.note(error)


class _Stamps:
    """The messages of a topic that rise in time: number in the topic, stamp, frame."""

    def __init__(self, bag: Bag, topic: str, skips: Skips) -> None:
        self.rows: list[tuple[int, float, str]] = []
        for number, message in enumerate(bag.messages({topic})):
            try:
                stamp, frame = ros.peek(message.raw, bag.ros2)
                stamp = stamp or message.stamp  # some drivers leave the header empty
                if self.rows and stamp <= self.rows[-1][1]:
                    raise ros.Unusable(
                        f"its stamp {stamp:.6f} does not come after {self.rows[-1][1]:.6f}"
                    )
            except ros.Unusable as fault:
                skips.note(bag.wrong(message, fault))
                continue
            self.rows.append((number, stamp, frame))
        if not self.rows:
            raise RecordingError(f"{bag.path}: {topic} holds no message that can be used")

    @property
    def stamps(self) -> Floats:
        return np.array([stamp for _, stamp, _ in self.rows])


class CloudBag:
    """Clouds as cycles. dropped: clouds without a pose. notes: what was chosen."""

    def __init__(
        self, bag: Bag, topic: str, poses: BagPoses, options: Options, skips: Skips
    ) -> None:
        self.name, self.skips = _name(bag.path), skips
        self._bag, self._topic, self._options = bag, topic, options
        rows = _Stamps(bag, topic, skips).rows
        self._poses: dict[int, Floats] | None = None
        if poses.known:
            self.notes: tuple[str, ...] = poses.notes(rows[0][2])
            self._poses = _placed(poses, rows)
            _require(bag.path, topic, len(rows), len(self._poses), poses.topic)
        else:
            KissIcp.require(bag.path)
            self.notes = ("no poses in it: odometry by KISS-ICP",)
        self._stamps = {number: stamp for number, stamp, _ in rows}
        self.dropped = 0 if self._poses is None else len(rows) - len(self._poses)

    def __len__(self) -> int:
        return len(self._stamps) if self._poses is None else len(self._poses)

    def __iter__(self) -> Iterator[Cycle]:
        odometry = None if self._poses is not None else KissIcp(self._options)
        for number, message in enumerate(self._bag.messages({self._topic})):
            if number not in (self._stamps if self._poses is None else self._poses):
                continue
            try:
                points, colors = self._bag.read(message, ros.cloud_arrays)
                if odometry is None:
                    pose = (self._poses or {})[number]
                else:
                    pose = odometry.register(points, self._bag.path)
                points, colors = thinned(points, colors, self._options)
                cycle = Cycle(self._stamps[number], pose, points, colors=colors)
                yield checked(cycle, self._bag.path)
            except RecordingError as error:
                self.skips.note(error)


class RgbdBag:
    """Pictures with depth as cycles, in the order of the depths' stamps."""

    def __init__(
        self,
        bag: Bag,
        depth: str,
        color: str,
        camera: str,
        poses: BagPoses,
        options: Options,
        skips: Skips,
    ) -> None:
        self.name, self.skips = _name(bag.path), skips
        self._bag, self._depth, self._color, self._options = bag, depth, color, options
        self._cv2 = import_cv2(bag.path)
        self._camera, bent = _camera(bag, camera, is_rectified(color), options)
        self._straight: Straight | None = None
        if bent is not None:
            self._straight = partial(bent.straight, self._cv2, self._camera)
        depths, colors = _Stamps(bag, depth, skips), _Stamps(bag, color, skips)
        self.notes: tuple[str, ...] = ("no poses in it: odometry by OpenCV",)
        placed: dict[int, Floats] | None = None
        if poses.known:
            self.notes = poses.notes(depths.rows[0][2])
            placed = _placed(poses, depths.rows)
            _require(bag.path, depth, len(depths.rows), len(placed), poses.topic)
        if bent is not None:
            self.notes += (f"{color} is raw: its {bent.model} distortion is taken out",)
        partner = nearest(colors.stamps, depths.stamps)
        self._pairs: list[tuple[int, int, float, Floats | None]] = []
        for (number, stamp, _), i in zip(depths.rows, partner, strict=True):
            pose = None if placed is None else placed.get(number)
            if abs(colors.rows[i][1] - stamp) <= SLACK and (placed is None or pose is not None):
                self._pairs.append((number, colors.rows[i][0], stamp, pose))
        self.dropped = len(depths.rows) - len(self._pairs)
        if not self._pairs:
            raise RecordingError(
                f"{bag.path}: no picture of {color} lies within 20 ms of one of {depth}; check "
                "that both use the same clock, or name others with --topic"
            )

    def __len__(self) -> int:
        return len(self._pairs)

    def __iter__(self) -> Iterator[Cycle]:
        front = FrontEnd(self._cv2, self._camera, self._options, self._straight)
        odometry = PictureOdometry(self._cv2, self._camera, self._straight)
        for stamp, pose, depth, color in self._matched():
            try:
                metres = self._bag.read(depth, partial(ros.depth_picture, self._cv2, depth.kind))
                picture = self._bag.read(color, partial(ros.color_picture, self._cv2, color.kind))
                self._check_sizes(depth, metres, picture)
                pose = odometry.register(picture, metres) if pose is None else pose
                points, colors, described = front.of(picture, metres)
                session = max(odometry.session, 0)
                cycle = Cycle(
                    stamp, pose, points, colors=colors, session=session, descriptors=described
                )
                cycle = checked(cycle, self._bag.path)
            except RecordingError as error:
                self.skips.note(error)
                continue
            yield cycle

    def _matched(self) -> Iterator[tuple[float, Floats | None, Message, Message]]:
        """Pairs as soon as both are there, in order; few messages are in memory at a time."""
        depths: dict[int, Message] = {}
        colors: dict[int, Message] = {}
        wanted = ({d for d, _, _, _ in self._pairs}, {c for _, c, _, _ in self._pairs})
        counts, at = [0, 0], 0
        for message in self._bag.messages({self._depth, self._color}):
            side = 0 if message.topic == self._depth else 1
            number, counts[side] = counts[side], counts[side] + 1
            if number in wanted[side]:
                (depths, colors)[side][number] = message
            while at < len(self._pairs):
                depth, color, stamp, pose = self._pairs[at]
                if depth not in depths or color not in colors:
                    break
                yield stamp, pose, depths.pop(depth), colors[color]
                at += 1
                for old in [c for c in colors if c < color]:
                    del colors[old]
            waiting = [*depths.values(), *colors.values()]
            size = sum(len(each.raw) for each in waiting)
            if len(waiting) > _STORED or size > _STORED_BYTES:
                raise RecordingError(
                    f"{self._bag.path}: {self._depth} and {self._color}"
                    " lie too far apart in the file: "
                    f"{len(waiting)} pictures of {size} bytes wait for their partners at "
                    f"{message.stamp:.6f} s; sort it with `ros2 bag convert`"
                )

    def _check_sizes(self, depth: Message, metres: Floats, picture: Any) -> None:
        wanted = (self._camera.height, self._camera.width)
        if metres.shape != wanted or picture.shape[:2] != wanted:
            raise self._bag.wrong(
                depth,
                f"depth {metres.shape[::-1]}, colour {picture.shape[1::-1]}, camera "
                f"{wanted[::-1]}: one size is wanted; record the depth that is registered to the "
                "colour (aligned_depth_to_color, depth_registered)",
            )


def _camera(
    bag: Bag, topic: str, rectified: bool, options: Options
) -> tuple[Camera, Distortion | None]:
    if options.camera is not None:
        return load_camera(options.camera), None
    for message in bag.messages({topic}):
        return bag.read(message, partial(lens_of, rectified=rectified))
    raise RecordingError(f"{bag.path}: {topic} holds no message; name a camera.json with --camera")


def _placed(poses: BagPoses, rows: list[tuple[int, float, str]]) -> dict[int, Floats]:
    """Poses by the number of the message, where there is one for its moment."""
    found = ((number, poses.at(stamp, frame)) for number, stamp, frame in rows)
    return {number: pose for number, pose in found if pose is not None}


def _require(path: Path, topic: str, count: int, placed: int, poses: str) -> None:
    if not placed:
        raise RecordingError(
            f"{path}: none of {count} messages of {topic} has a pose of {poses or 'tf'} for its "
            "moment; check that both use the same clock (use_sim_time)"
        )


def _name(path: Path) -> str:
    return path.stem if path.is_file() else Path(path).resolve().name
