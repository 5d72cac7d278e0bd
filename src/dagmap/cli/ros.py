"""`dagmap-ros1` and `dagmap-ros2`: an agent as a node, where rospy or rclpy is installed.

The robot's file is named by the parameter `config`; other parameters replace keys of its [ros].
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from ..io.ros.bridge import Link
from ..io.ros.over_rclpy import RclpyLink
from ..io.ros.over_rospy import RospyLink
from ..model import ConfigError, DagmapError, NetworkError
from .agent import AgentCommand, level_named

_NODE = "dagmap"
_OF_ROS = ("use_sim_time", "start_type_description_service")  # parameters that every node has


def ros1() -> None:
    """Entry point of `dagmap-ros1`: `rosrun`'s and `roslaunch`'s arguments, private parameters."""
    _main(_ros1)


def ros2() -> None:
    """Entry point of `dagmap-ros2`: `--ros-args` with parameters, a namespace, remappings."""
    _main(_ros2)


def _main(node: Callable[[], int]) -> None:
    try:
        sys.exit(node())
    except DagmapError as error:
        sys.stderr.write(f"dagmap: {error}\n")
        sys.exit(2)


def _ros1() -> int:
    rospy = _module("rospy", "dagmap-ros1")
    left = rospy.myargv(sys.argv)[1:]
    if left:
        raise ConfigError(f"{left[0]}: no such argument; parameters are given as _config:=FILE")
    rospy.init_node(_NODE, disable_signals=True)
    stopping = False

    def stop() -> None:  # `rosnode kill`, or another node took the name
        if not stopping:
            os.kill(os.getpid(), signal.SIGTERM)

    rospy.on_shutdown(stop)
    try:
        return _run(rospy.get_param("~", {}), lambda: RospyLink(rospy))
    finally:
        stopping = True
        rospy.signal_shutdown("the agent has ended")


def _ros2() -> int:
    rclpy = _module("rclpy", "dagmap-ros2")
    no_handlers = import_module("rclpy.signals").SignalHandlerOptions.NO
    rclpy.init(args=sys.argv, signal_handler_options=no_handlers)
    node = rclpy.create_node(_NODE, automatically_declare_parameters_from_overrides=True)
    given = {name: each.value for name, each in node.get_parameters_by_prefix("").items()}
    return _run(given, lambda: RclpyLink(rclpy, node))


def _run(given: dict[str, Any], link: Callable[[], Link]) -> int:
    """given: the node's parameters. Raises DagmapError."""
    given = {k: v for k, v in given.items() if k not in _OF_ROS and not k.startswith("qos_")}
    config, level = given.pop("config", None), str(given.pop("log", "info"))
    if not config:
        raise ConfigError("parameter config: the path of the robot's TOML file is wanted")
    return AgentCommand(
        Path(str(config)),
        speed=1.0,
        wait_for=0,
        until_agreed=None,
        check=False,
        level=level_named(level),
        json=False,
        link=link,
        ros=given,
    ).run()


def _module(name: str, command: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise NetworkError(
            f"{command} needs {name} ({error}); source ROS's setup file and run it with ROS's "
            "Python; without ROS give the robot's file a [ros] table and run `dagmap agent`"
        ) from None
