"""The node of ROS 2, against the little of rclpy's interface that it uses: it cannot be had here.

What is shown: parameters, names, QoS, bytes in and out. What is not: rclpy itself.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bags import Make, room
from dagmap.cli import ros as command
from dagmap.cli.agent import AgentCommand
from dagmap.io.log import Log
from dagmap.io.queues import Inbox
from dagmap.io.ros.bridge import Bridge
from dagmap.io.ros.config import RosConfig
from dagmap.io.ros.over_rclpy import RclpyLink
from dagmap.model import NetworkError
from robots import until


class Reliability(Enum):
    RELIABLE = 1
    BEST_EFFORT = 2


class Durability(Enum):
    TRANSIENT_LOCAL = 1
    VOLATILE = 2


class Executor:
    def __init__(self) -> None:
        self._over = threading.Event()

    def add_node(self, node: Any) -> None:
        self.node = node

    def spin(self) -> None:
        self._over.wait()

    def shutdown(self) -> None:
        self._over.set()


class FakeNode:
    def __init__(self, parameters: dict[str, Any] | None = None) -> None:
        self.parameters = parameters or {}
        self.subscriptions: dict[str, tuple[Any, Any, Any]] = {}
        self.published: dict[str, list[bytes]] = {}
        self.profiles: dict[str, Any] = {}
        self.gone = False

    def create_subscription(self, kind: Any, name: str, take: Any, qos: Any, raw: bool) -> None:
        assert raw
        self.subscriptions[name] = kind, take, qos

    def create_publisher(self, kind: Any, name: str, qos: Any) -> Any:
        self.profiles[name] = qos
        said = self.published.setdefault(name, [])
        return SimpleNamespace(publish=said.append)

    def get_parameters_by_prefix(self, prefix: str) -> dict[str, Any]:
        assert prefix == ""
        return {name: SimpleNamespace(value=value) for name, value in self.parameters.items()}

    def destroy_node(self) -> None:
        self.gone = True


def get_message(kind: str) -> str:
    if kind.startswith("visualization_msgs"):
        raise ModuleNotFoundError("No module named 'visualization_msgs'")
    return kind


@pytest.fixture
def rclpy(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    qos = {"QoSProfile": SimpleNamespace, "ReliabilityPolicy": Reliability}
    parts: dict[str, dict[str, Any]] = {
        "rclpy": {"try_shutdown": lambda: None},
        "rclpy.qos": {**qos, "DurabilityPolicy": Durability},
        "rclpy.executors": {"SingleThreadedExecutor": Executor},
        "rclpy.signals": {"SignalHandlerOptions": SimpleNamespace(NO="no")},
        "rosidl_runtime_py": {},
        "rosidl_runtime_py.utilities": {"get_message": get_message},
    }
    for name, values in parts.items():
        module = ModuleType(name)
        vars(module).update(values)
        monkeypatch.setitem(sys.modules, name, module)
    yield sys.modules["rclpy"]


def test_clouds_become_cycles_with_the_quality_that_sensors_have(rclpy: Any) -> None:
    make, node = Make(ros2=True), FakeNode()
    inbox = Inbox(1 << 20, 1 << 20)
    config = RosConfig(graph="", patience=60.0)
    bridge = Bridge(config, RclpyLink(rclpy, node), inbox, Log(sys.stderr, "error"))
    qualities = {
        name: (qos.reliability.name, qos.durability.name)
        for name, (_, _, qos) in node.subscriptions.items()
    }
    assert qualities == {
        "points": ("BEST_EFFORT", "VOLATILE"),
        "odom": ("BEST_EFFORT", "VOLATILE"),
        "/tf": ("RELIABLE", "VOLATILE"),
        "/tf_static": ("RELIABLE", "TRANSIENT_LOCAL"),
    }
    told = node.profiles["~/map"]
    assert (told.reliability, told.durability) == (Reliability.RELIABLE, Durability.TRANSIENT_LOCAL)
    assert told.depth == 1
    said = [make.mount(), make.odometry(1.0), make.odometry(1.1), make.cloud(1.05, room())]
    with bridge:
        bridge.start()
        for topic, kind, _, message in said:
            name = topic if topic.startswith("/tf") else topic.strip("/")
            of, take, _ = node.subscriptions[name]
            assert of == kind
            take(bytes(make.types.serialize_cdr(message, kind)))
        (cycle,) = until(lambda: inbox.take(0.05).cycles, "a cycle")
        assert np.allclose(cycle.pose, make.sensor(1.05), atol=1e-9)
    assert node.gone and bridge.error is None


def test_a_type_that_is_not_installed_is_named(rclpy: Any) -> None:
    link = RclpyLink(rclpy, FakeNode())
    with pytest.raises(NetworkError, match="install the ROS package visualization_msgs"):
        Bridge(RosConfig(), link, Inbox(1 << 20, 1 << 20), Log(sys.stderr, "error"))
    link.close()


class TestCommand:
    def run(
        self, rclpy: Any, monkeypatch: pytest.MonkeyPatch, parameters: dict[str, Any]
    ) -> tuple[int, AgentCommand | None]:
        node, started = FakeNode(parameters), []

        def run(self: AgentCommand) -> int:
            started.append((self, self._settings()))
            return 0

        def create_node(name: str, **options: Any) -> FakeNode:
            assert options == {"automatically_declare_parameters_from_overrides": True}
            return node

        rclpy.init = lambda **options: None
        rclpy.create_node = create_node
        monkeypatch.setattr(AgentCommand, "run", run)
        with pytest.raises(SystemExit) as end:
            command.ros2()
        self.settings = started[0][1] if started else None
        return int(end.value.code or 0), started[0][0] if started else None

    def test_parameters_replace_keys_of_the_file(
        self, rclpy: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        path = tmp_path / "r1.toml"
        path.write_text('[store]\npath = "ledger.db"\n[ros]\nvoxel = 0.3\nodometry = "o"\n')
        given = {"config": str(path), "cloud": "lidar/points", "use_sim_time": True, "patience": 3}
        code, started = self.run(rclpy, monkeypatch, given)
        assert code == 0 and started is not None and started.link is not None
        ros = self.settings.config.ros
        assert (ros.cloud, ros.odometry, ros.voxel, ros.patience) == ("lidar/points", "o", 0.3, 3)

    @pytest.mark.parametrize(
        ("parameters", "said"),
        [
            ({}, "parameter config: the path of the robot's TOML file is wanted"),
            ({"config": "FILE", "voxle": 1}, "unknown field `voxle`"),
            ({"config": "FILE", "cloud": 5}, "cloud"),
        ],
    )
    def test_wrong_ones_are_named_in_one_line(
        self,
        rclpy: Any,
        monkeypatch: pytest.MonkeyPatch,
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
        parameters: dict[str, Any],
        said: str,
    ) -> None:
        path = tmp_path / "r1.toml"
        path.write_text('[store]\npath = "ledger.db"\n')
        if "config" in parameters:
            parameters = {**parameters, "config": str(path)}
        code, _ = self.run(rclpy, monkeypatch, parameters)
        err = capsys.readouterr().err
        assert code == 2 and said in err and err.count("\n") == 1


@pytest.mark.parametrize(("entry", "name"), [(command.ros2, "rclpy"), (command.ros1, "rospy")])
def test_without_ros_it_says_what_to_do(
    entry: Any, name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, name, None)  # as where it is not installed
    with pytest.raises(SystemExit) as end:
        entry()
    err = capsys.readouterr().err
    assert end.value.code == 2 and f"needs {name}" in err and "`dagmap agent`" in err
