"""ROS 1 as it is installed (Debian's): a master, a robot that plays its bag, somebody who listens.

Run as a program, with rospy in reach: `ros1.py play BAG NAMESPACE` or `ros1.py listen TOPIC...`.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

DEBIAN = "/usr/lib/python3/dist-packages"


def missing() -> str:
    """Why ROS 1 cannot be tried here; empty where it can."""
    if shutil.which("roscore") is None:
        return "no roscore here (Debian: apt install python3-roslaunch)"
    argv = [sys.executable, "-c", "import rospy, dagmap"]
    done = subprocess.run(argv, env=environment(0), capture_output=True, text=True, check=False)
    if done.returncode:
        return f"rospy is not for this Python: {done.stderr.strip().splitlines()[-1]}"
    return ""


def environment(port: int) -> dict[str, str]:
    """For a process that uses rospy: this Python's own packages before Debian's."""
    here = [path for path in sys.path if path]
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([*here, DEBIAN]),
        "ROS_MASTER_URI": f"http://127.0.0.1:{port}",
        "ROS_IP": "127.0.0.1",
        "ROS_HOSTNAME": "127.0.0.1",
        "ROS_HOME": os.path.join(tempfile.gettempdir(), "dagmap-tests-ros"),
    }


@contextmanager
def roscore() -> Iterator[int]:
    """A master with its parameters and rosout, on a port of loopback."""
    for _ in range(5):
        with socket.socket() as sock:
            sock.bind(("127.0.0.1", 0))
            port = int(sock.getsockname()[1])
        env = {**environment(port), "PYTHONPATH": ""}  # roscore runs under Debian's Python
        process = subprocess.Popen(
            [str(shutil.which("roscore")), "-p", str(port)],
            env=env,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            if _answers(process, port):
                yield port
                return
        finally:
            process.terminate()
            process.wait(30)
    raise AssertionError("roscore did not start")


def _answers(process: subprocess.Popen[bytes], port: int) -> bool:
    deadline = time.monotonic() + 60
    while process.poll() is None and time.monotonic() < deadline:
        with socket.socket() as sock:
            if sock.connect_ex(("127.0.0.1", port)) == 0:
                return True
        time.sleep(0.05)
    return False


def start(port: int, *argv: str, **pipes: Any) -> subprocess.Popen[str]:
    """A process of this module on that master."""
    return subprocess.Popen(
        [sys.executable, __file__, *argv], env=environment(port), text=True, **pipes
    )


def play(bag: Path, namespace: str) -> None:
    """Publish what is in a bag, in its order, below a namespace; tf is everybody's."""
    import rospy
    from rosbags.rosbag1 import Reader
    from roslib.message import get_message_class

    rospy.init_node("player", anonymous=True)
    with Reader(bag) as reader:
        publishers = {}
        for each in reader.connections:
            kind = get_message_class(each.msgtype.replace("/msg/", "/"))
            name = each.topic if each.topic.startswith("/tf") else namespace + each.topic
            latch = each.topic == "/tf_static"
            publishers[each.topic] = rospy.Publisher(name, kind, queue_size=1000, latch=latch)
        while not all(each.get_num_connections() for each in publishers.values()):
            time.sleep(0.02)
        for connection, _, raw in reader.messages():
            publisher = publishers[connection.topic]
            publisher.publish(publisher.data_class().deserialize(raw))
    sys.stdin.read()  # what was published is on its way: stay until told


def listen(topics: list[str]) -> None:
    """Print a line of JSON for each message: its topic, and what the tests look at."""
    import rospy
    from diagnostic_msgs.msg import DiagnosticArray
    from sensor_msgs.msg import PointCloud2
    from tf2_msgs.msg import TFMessage
    from visualization_msgs.msg import MarkerArray

    lock = threading.Lock()

    def say(message: Any, topic: str) -> None:
        line = json.dumps({"topic": topic, **_ABOUT[type(message).__name__](message)})
        with lock:
            print(line, flush=True)  # noqa: T201

    rospy.init_node("listener", anonymous=True)
    kinds = {"map": PointCloud2, "graph": MarkerArray, "diagnostics": DiagnosticArray}
    for topic in topics:
        kind = kinds.get(topic.rpartition("/")[2], TFMessage)
        rospy.Subscriber(topic, kind, say, topic)
    sys.stdin.read()


def _about_cloud(message: Any) -> dict[str, Any]:
    from sensor_msgs import point_cloud2

    names = [field.name for field in message.fields]
    rows = [[float(value) for value in row] for row in point_cloud2.read_points(message)]
    return {"frame": message.header.frame_id, "names": names, "rows": rows}


_ABOUT: dict[str, Callable[[Any], dict[str, Any]]] = {
    "PointCloud2": _about_cloud,
    "MarkerArray": lambda m: {"points": len(m.markers[0].points), "type": m.markers[0].type},
    "DiagnosticArray": lambda m: {"name": m.status[0].name, "level": m.status[0].level},
    "TFMessage": lambda m: {
        "frames": [[each.header.frame_id, each.child_frame_id] for each in m.transforms]
    },
}


if __name__ == "__main__":
    if sys.argv[1] == "play":
        play(Path(sys.argv[2]), sys.argv[3])
    else:
        listen(sys.argv[2:])
