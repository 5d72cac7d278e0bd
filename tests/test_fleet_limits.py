"""Section 5 in real processes: what a robot may say and compute, over real sockets."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from robots import Nursery, Robot, agreed, record_much, running, until

CAP = 30_000  # bytes per second
SLACK = 0.5  # s by which the sending thread of a busy machine may be late
WINDOW = 5.0  # s


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_much(tmp_path_factory.mktemp("limits") / "walk.npz")


def sent(robot: Robot) -> tuple[float, int]:
    """Its clock and all bytes that it has told the network so far."""
    status = robot.answer()
    kinds = status["traffic"]["sent"].values()
    return status["uptime_s"], sum(kind["bytes"] for kind in kinds)


def busiest(told: list[tuple[float, int]]) -> float:
    """Most bytes per second of any window."""
    pairs = ((a, b) for i, a in enumerate(told) for b in told[i:])
    return max((b[1] - a[1]) / (b[0] - a[0] + SLACK) for a, b in pairs if b[0] - a[0] >= WINDOW)


def watch(robots: tuple[Robot, ...], authors: int) -> dict[str, list[tuple[float, int]]]:
    """What each has sent, over and over until all hold one map."""
    told: dict[str, list[tuple[float, int]]] = {robot.name: [sent(robot)] for robot in robots}

    def done() -> bool:
        for robot in robots:
            told[robot.name].append(sent(robot))
        time.sleep(0.2)
        over = all(robot.answer()["cycles"] == 60 for robot in robots if robot.recording)
        lasted = min(each[-1][0] - each[0][0] for each in told.values()) >= WINDOW
        return over and lasted and bool(agreed(*robots, authors=authors))

    until(done, "one map")
    return told


def test_a_robots_cap_holds_and_all_arrives(nursery: Nursery, tmp_path: Path, walk: Path) -> None:
    limit = f"[overhead]\nrobot_bytes_per_second = {CAP}\n"
    a = Robot(nursery, tmp_path, "a", walk, more=limit)
    b = Robot(nursery, tmp_path, "b", None, (a.port,))
    with running(a, b):
        b.start()
        a.start("--speed", 30, "--wait-for", 1)
        told = watch((a, b), authors=1)["a"]
        assert told[-1][1] > 7 * CAP  # it had more to say in its two seconds of recording
        assert busiest(told) <= 1.05 * CAP
        overhead = a.answer()["overhead"]
        assert 0 < overhead["bytes_per_second"] <= CAP and overhead["load"] > 0
        assert b.answer()["overhead"]["bytes_per_second"] is None
        assert [a.stop(), b.stop()] == [0, 0]
    assert a.ids() == b.ids()


def test_two_robots_share_what_the_fleets_network_carries(
    nursery: Nursery, tmp_path: Path, walk: Path
) -> None:
    limit = f"[overhead]\nfleet_bytes_per_second = {2 * CAP}\n"
    a = Robot(nursery, tmp_path, "a", walk, more=limit)
    b = Robot(nursery, tmp_path, "b", walk, (a.port,), more=limit)
    with running(a, b):
        for robot in (a, b):
            robot.start("--speed", 30, "--wait-for", 1)
        told = watch((a, b), authors=2)
        assert busiest(told["a"]) + busiest(told["b"]) <= 1.05 * 2 * CAP
        assert [a.stop(), b.stop()] == [0, 0]
    assert a.ids() == b.ids()
