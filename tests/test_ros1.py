"""ROS 1 for real: roscore, a bag for each of three robots, and their agents as rospy nodes."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ros1
from bags import Make, Message, room, write_bag
from robots import Robot, agreed, until

WHY_NOT = ros1.missing()
needs_ros = pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT)
EXAMPLES = Path(__file__).parents[1] / "examples" / "ros"
ROS = "[ros]\nvoxel = 0.02\nmax_features = 5000\npublish_period = 0.2\npatience = 60.0\n"


class Listener:
    """What somebody on the same master hears."""

    def __init__(self, port: int, *topics: str) -> None:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        self.process = ros1.start(port, "listen", *topics, **pipes)
        self._last: dict[str, Any] = {}
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            said = json.loads(line)
            self._last[said["topic"]] = said

    def last(self, topic: str) -> Any:
        return self._last.get(topic)

    def __enter__(self) -> Listener:
        return self

    def __exit__(self, *raised: object) -> None:
        with ended(self.process):
            assert self.process.stdin is not None
            self.process.stdin.close()  # it says its last line, and ends
            self._thread.join(60)


@contextmanager
def ended(*processes: subprocess.Popen[str]) -> Iterator[None]:
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait(30)
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    pipe.close()


def walk(make: Make, number: int) -> list[Message]:
    """The robot `number` of three sees its part of the room and 1 m of the next one's."""
    world = room()
    low = -3 + 2 * number
    part = world[(world[:, 1] >= low - 0.5) & (world[:, 1] <= low + 2.5)]
    out = [make.mount(f"lidar{number}"), *make.odometries()]
    for i in range(5):
        stamp = 1.05 + 0.1 * i
        sensor = make.sensor(stamp)
        seen = (part - sensor[:3, 3]) @ sensor[:3, :3]
        out.append(make.cloud(stamp, seen, f"lidar{number}"))
    return sorted(out, key=lambda message: message[2])


def start_node(port: int, robot: Robot, *more: str) -> subprocess.Popen[str]:
    """`dagmap-ros1` in a namespace that is called like the robot."""
    argv = ["-c", "from dagmap.cli.ros import ros1; ros1()"]
    remaps = [f"_config:={robot.write()}", f"__ns:=/{robot.name}", *more]
    with (robot.folder / f"{robot.name}.err").open("w") as log:
        return subprocess.Popen(
            [sys.executable, *argv, *remaps], env=ros1.environment(port), stderr=log, text=True
        )


@needs_ros
def test_three_agents_map_what_is_played_and_the_merged_cloud_comes_back(tmp_path: Path) -> None:
    make = Make(ros2=False)
    a, b, c = (Robot(None, tmp_path, name, more=ROS) for name in "abc")  # type: ignore[arg-type]
    b.connect, c.connect = (a.port,), (b.port,)
    bags = [write_bag(tmp_path / f"{i}.bag", make, walk(make, i)) for i in range(3)]
    topics = ("/a/dagmap/map", "/b/dagmap/map", "/c/dagmap/map", "/a/dagmap/graph")
    with ExitStack() as stack:
        port = stack.enter_context(ros1.roscore())
        nodes = [start_node(port, robot) for robot in (a, b, c)]
        stack.enter_context(ended(*nodes))
        listener = stack.enter_context(Listener(port, *topics, "/diagnostics", "/tf"))
        players = [
            ros1.start(port, "play", str(bag), f"/{name}", stdin=subprocess.PIPE)
            for bag, name in zip(bags, "abc", strict=True)
        ]
        stack.enter_context(ended(*players))
        until(lambda: agreed(a, b, c, authors=3), "three robots to agree")

        def whole(topic: str) -> Any:
            said = listener.last(topic)
            if not said or not said["rows"]:
                return None
            rows = np.array(said["rows"])
            ends = rows[:, 1].min(), rows[:, 1].max()
            both = rows[:, said["names"].index("witnesses")].max() == 2
            return said if ends[0] < -2.9 and ends[1] > 2.9 and both else None

        for topic in topics[:3]:
            said = until(lambda topic=topic: whole(topic), f"the merged cloud on {topic}")
            names = ["x", "y", "z", "rgb", "state", "hits", "misses", "witnesses"]
            assert (said["frame"], said["names"]) == ("fleet", names)
            rows = np.array(said["rows"])
            off = np.abs(rows[:, :3, None] - [[-4, 4], [-3, 3], [-1, 2]]).min(axis=(1, 2))
            assert np.quantile(off, 0.99) < 0.02
        graph = until(lambda: listener.last("/a/dagmap/graph"), "the DAG")
        assert graph["type"] == 5 and graph["points"] > 100
        assert until(lambda: listener.last("/diagnostics"), "diagnostics")["level"] == 0
        until(lambda: ["fleet", "odom"] in (listener.last("/tf") or {"frames": []})["frames"])
        for node in nodes:
            node.terminate()
        assert [node.wait(60) for node in nodes] == [0, 0, 0]


@needs_ros
def test_parameters_replace_what_the_file_says_and_wrong_ones_are_named(tmp_path: Path) -> None:
    a = Robot(None, tmp_path, "a", more=ROS)  # type: ignore[arg-type]
    with ros1.roscore() as port:
        node = start_node(port, a, "_cloud:=/lidar/points", "_voxel:=0.5")
        with ended(node), Listener(port, "/a/dagmap/map") as listener:
            until(lambda: listener.last("/a/dagmap/map"), "an empty map")
            assert "/lidar/points" in _subscriptions(port)
        wrong = {"b": ("_voxle:=1", "voxle"), "c": ("_patience:=100", "0.0 to 60.0 is wanted")}
        for name, (parameter, said) in wrong.items():  # a master keeps parameters by node
            robot = Robot(None, tmp_path, name, more=ROS)  # type: ignore[arg-type]
            node = start_node(port, robot, parameter)
            with ended(node):
                assert node.wait(60) == 2
            assert said in robot.log and robot.log.count("\n") == 1


@needs_ros
def test_the_launch_file_starts_three_robots(tmp_path: Path) -> None:
    network = "[network]\nscouting = false\n"  # the robots need not meet here
    for name in ("robot1", "robot2", "robot3"):
        text = (EXAMPLES / f"{name}.toml").read_text()
        (tmp_path / f"{name}.toml").write_text(text + network)
    code = "from dagmap.cli.ros import ros1; ros1()"
    path = ros1.environment(0)["PYTHONPATH"]
    run = f"PYTHONPATH='{path}' exec {sys.executable} -c '{code}' \"$@\""
    (tmp_path / "node").write_text(f"#!/bin/sh\n{run}\n")
    (tmp_path / "node").chmod(0o755)
    with ros1.roscore() as port:
        env = {**ros1.environment(port), "ROS_PACKAGE_PATH": str(EXAMPLES), "PYTHONPATH": ""}
        env |= {"DAGMAP_ROS1": str(tmp_path / "node")}
        argv = [str(shutil.which("roslaunch")), "dagmap", "three_robots.launch"]
        with (tmp_path / "log").open("w") as log:
            launch = subprocess.Popen(
                [*argv, f"files:={tmp_path}"], env=env, stdout=log, stderr=log, text=True
            )
        maps = [f"/robot{i}/dagmap/map" for i in (1, 2, 3)]
        with ended(launch), Listener(port, *maps) as listener:
            for topic in maps:
                until(lambda topic=topic: listener.last(topic), f"a map on {topic}")
            launch.send_signal(signal.SIGINT)  # as Ctrl-C: roslaunch ends its nodes
            assert launch.wait(60) == 0


def _subscriptions(port: int) -> set[str]:
    """What the master knows."""
    code = "import rosgraph; print([t for t, _ in rosgraph.Master('/x').getSystemState()[1]])"
    argv = [sys.executable, "-c", code]
    done = subprocess.run(
        argv, env=ros1.environment(port), capture_output=True, text=True, check=True, timeout=60
    )
    return set(json.loads(done.stdout.replace("'", '"')))
