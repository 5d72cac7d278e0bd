"""ROS bags, of ROS 1 (.bag) and ROS 2 (.mcap, .db3, a folder), read without ROS.

Clouds with poses (odometry or tf; else by KISS-ICP), RTAB-Map's MapData, or pictures with depth and
camera info.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ...model import RecordingError
from . import _ros as ros
from ._bag import Bag
from ._bagged import BagPoses, CloudBag, RgbdBag
from ._mapped import MapDataBag
from ._rtabmap_msgs import MAP_DATA, MAP_GRAPH
from ._source import Description, Item, Options, Skips, Source
from ._storage import storage_files

UNDERSTANDS = "a ROS bag (.bag, .mcap, .db3, or the folder of one)"
_SUFFIXES = (".bag", ".mcap", ".db3")
_POSES = (ros.ODOMETRY, ros.POSE, ros.POSE_COVARIANCE)


def matches(path: Path) -> bool:
    """Whether this is called like a bag, or is the folder of one."""
    if path.is_file():
        return path.suffix in _SUFFIXES
    return (path / "metadata.yaml").is_file()


def lacks(path: Path) -> str:
    """What is missing of the folder of a bag."""
    files = storage_files(path)
    if not files:
        return ""
    return (
        f"files of a bag ({files[0].name} ...), but no metadata.yaml, in which their order stands; "
        "name a file itself, or run `ros2 bag reindex` on the folder"
    )


@dataclass(frozen=True, slots=True)
class _Plan:
    """Which topic is used for what; empty where there is none."""

    cloud: str = ""
    depth: str = ""
    color: str = ""
    camera: str = ""
    pose: str = ""
    tf: tuple[str, ...] = ()
    mapped: str = ""
    graph: str = ""

    def use(self, topic: str) -> str:
        named = {self.cloud: "clouds", self.depth: "depth", self.color: "colour"}
        named |= {self.camera: "camera", self.pose: "poses"}
        named |= {self.mapped: "nodes", self.graph: "moved"}
        return named.get(topic, "frames" if topic in self.tf else "")


def open(path: Path, options: Options) -> Source:  # noqa: A001
    """Open a bag. Raises RecordingError that names what lacks."""
    skips = Skips(options.keep_going)
    bag = Bag(path, skips)
    plan = _plan(bag, options)
    if plan.mapped:
        return MapDataBag(bag, plan.mapped, plan.graph, options, skips)
    poses = BagPoses(bag, plan.pose, plan.tf, options)
    if plan.cloud:
        return CloudBag(bag, plan.cloud, poses, options, skips)
    return RgbdBag(bag, plan.depth, plan.color, plan.camera, poses, options, skips)


def describe(path: Path, options: Options) -> Description:
    """The topics, and which of them would be used."""
    bag = Bag(path, Skips(options.keep_going))
    plan, cycles, problem = _Plan(), None, None
    notes: tuple[str, ...] = ()
    try:
        plan = _plan(bag, options)
        source = open(path, options)
        cycles, notes = len(source), source.notes
    except RecordingError as error:
        problem = str(error)
    items = tuple(
        Item(name, topic.kind, topic.messages, plan.use(name))
        for name, topic in sorted(bag.topics.items())
    )
    return Description(f"ROS {2 if bag.ros2 else 1} bag", items, cycles, problem, notes)


def _plan(bag: Bag, options: Options) -> _Plan:
    """Topics by their types, those first that were asked for, then those with most messages."""
    unknown = [name for name in options.topics if name not in bag.topics]
    if unknown:
        raise RecordingError(
            f"{bag.path}: no topic {unknown[0]}; there are {', '.join(sorted(bag.topics))}"
        )
    tf = _all(bag, ros.TF)
    pose = _first(bag, options, (ros.ODOMETRY,)) or ("" if tf else _first(bag, options, _POSES))
    asked = _asked(bag, options, _POSES)
    if asked or _asked(bag, options, ros.TF):
        pose = asked
    cloud = _first(bag, options, (ros.CLOUD,))
    mapped, asked_cloud = _first(bag, options, MAP_DATA), _asked(bag, options, (ros.CLOUD,))
    depth = _picture(bag, options, depth=True)
    by_pictures = _asked(bag, options, (ros.IMAGE, ros.COMPRESSED))
    if _asked(bag, options, MAP_DATA) or (mapped and not (cloud or by_pictures)):
        return _Plan(mapped=mapped, graph=_first(bag, options, MAP_GRAPH))
    if cloud and not (by_pictures and not asked_cloud):
        return _Plan(cloud=cloud, pose=pose, tf=tf)
    if not depth:
        raise RecordingError(
            f"{bag.path}: neither clouds ({ros.CLOUD}), nor {MAP_DATA[0]}, nor pictures with depth "
            f"({ros.IMAGE} or {ros.COMPRESSED} with `depth` in the topic's name); `dagmap inspect` "
            "lists what "
            "there is, --topic names what to use"
        )
    color = _picture(bag, options, depth=False)
    camera = _camera(bag, options, depth, color)
    missing = "no colour pictures" if not color else "no camera info" if not camera else ""
    if missing and not (camera == "" and color and options.camera):
        raise RecordingError(
            f"{bag.path}: {missing} beside {depth}; record the topic too, or name it with --topic"
            + (" or a camera.json with --camera" if color else "")
        )
    return _Plan(depth=depth, color=color, camera=camera, pose=pose, tf=tf)


def _all(bag: Bag, kinds: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(sorted(name for name, topic in bag.topics.items() if topic.kind in kinds))


def _asked(bag: Bag, options: Options, kinds: tuple[str, ...]) -> str:
    return next((name for name in options.topics if bag.topics[name].kind in kinds), "")


def _first(bag: Bag, options: Options, kinds: tuple[str, ...]) -> str:
    return _asked(bag, options, kinds) or _fullest(bag, list(_all(bag, kinds)))


def _fullest(bag: Bag, names: list[str]) -> str:
    full = [name for name in names if bag.topics[name].messages]
    return min(full, key=lambda name: (-bag.topics[name].messages, name), default="")


def _picture(bag: Bag, options: Options, depth: bool) -> str:
    """Pictures tell by their topic's name whether they hold depths: everybody names it so."""

    def fits(name: str) -> bool:
        kind = bag.topics[name].kind
        return kind in (ros.IMAGE, ros.COMPRESSED) and ("depth" in name.lower()) == depth

    asked = [name for name in options.topics if fits(name)]
    found = [name for name in bag.topics if fits(name)]
    if not depth:  # a camera in colour before the eyes of a stereo camera
        found = [n for n in found if "color" in n or "rgb" in n] or found
    return asked[0] if asked else _fullest(bag, found)


def _camera(bag: Bag, options: Options, depth: str, color: str) -> str:
    """The camera info nearest to the colour pictures, by the names of the topics."""
    asked = _asked(bag, options, (ros.CAMERA,))
    found = [name for name in _all(bag, (ros.CAMERA,)) if bag.topics[name].messages]

    def alike(name: str) -> tuple[int, int, str]:
        return (-_shared(name, color), -_shared(name, depth), name)

    return asked or min(found, key=alike, default="")


def _shared(a: str, b: str) -> int:
    """Parts that two names begin with alike."""
    count = 0
    for x, y in zip(a.split("/"), b.split("/"), strict=False):
        if x != y:
            break
        count += 1
    return count
