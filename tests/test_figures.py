from __future__ import annotations

import builtins
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dagmap.io.export import PlyMap
from dagmap.io.figures import (
    GraphLayer,
    MapsFigure,
    RobotTraffic,
    TrafficFigure,
    _Bins,
    _edges,
    draw_maps,
    draw_traffic,
)
from dagmap.io.projection import choose_view
from dagmap.model import OutputError


def room(rng: np.random.Generator, count: int) -> np.ndarray:
    """Points on the floor and the walls of a room of 8 x 5 x 2.5 m, z up."""
    points = rng.random((count, 3)) * (8.0, 5.0, 2.5)
    side = rng.integers(0, 5, count)
    for axis, value, which in ((2, 0.0, 0), (0, 0.0, 1), (0, 8.0, 2), (1, 0.0, 3), (1, 5.0, 4)):
        points[side == which, axis] = value
    return points


def walk(count: int, down_axis: int = 1) -> np.ndarray:
    """Poses of a sensor that walks a curve 1.5 m above the floor; its `down_axis` points down."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    turn = np.linspace(0, 5, count)
    if down_axis == 1:  # a camera: x right, y down, z forward
        right, ahead = (
            [np.cos(turn), np.sin(turn), 0 * turn],
            [-np.sin(turn), np.cos(turn), 0 * turn],
        )
        poses[:, :3, 0], poses[:, :3, 2] = np.transpose(right), np.transpose(ahead)
        poses[:, :3, 1] = (0, 0, -1)
    poses[:, :3, 3] = np.stack([4 + 3 * np.cos(turn), 2.5 + 2 * np.sin(turn), 1.5 + 0 * turn], 1)
    return poses


def maps_figure(names: list[str], count: int) -> MapsFigure:
    rng = np.random.default_rng(3)
    features = [room(rng, count) for _ in names]
    graphs = []
    for points in features:
        ids = np.arange(len(points)) * 2  # with gaps, as after withdrawals
        parents = np.stack([ids - 2, ids - 3], axis=1)  # -3 and -1 are lattice nodes
        graphs.append(GraphLayer(ids, points, np.maximum(parents, -1), ids % 6 > 0, ids % 10 == 2))
    positions = np.concatenate([np.zeros((0, 3)), *features])
    ones = np.ones(len(positions), np.int64)
    world = PlyMap(
        positions,
        rng.integers(0, 256, positions.shape).astype(np.uint8),
        rng.integers(0, 3, len(positions)).astype(np.uint8),
        ones,
        ones,
        ones,
    )
    return MapsFigure(names, features, [walk(20) for _ in names], graphs, world)


def pixels(path: Path) -> np.ndarray:
    from matplotlib.image import imread

    assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert path.stat().st_size < 2_000_000
    return np.asarray(imread(path))[:, :, :3]


def share_near(image: np.ndarray, color: str) -> float:
    wanted = [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    return float((np.abs(image - wanted).max(axis=2) < 0.1).mean())


def test_the_maps_show_all_robots_and_what_became_of_their_features(tmp_path: Path) -> None:
    draw_maps(tmp_path / "maps.png", maps_figure(["ada", "bob", "cleo"], 2000))
    image = pixels(tmp_path / "maps.png")
    assert 0.01 < float((image < 0.95).any(axis=2).mean()) < 0.7
    for color in ("#1d9a3c", "#d7301f", "#2166d1", "#8a2fb8", "#b4b4b4", "#e0261b"):
        assert share_near(image, color) > 2e-4, color
    height, width = np.array(image.shape[:2]) // 2
    quarters = [image[:height, :width], image[:height, width:], image[height:, :width]]
    for quarter in [*quarters, image[height:, width:]]:
        assert len(np.unique((quarter[::3, ::3] * 15).astype(int).reshape(-1, 3), axis=0)) > 50


@pytest.mark.parametrize(
    "names", [[], ["solo"], ["_a", "$b$", "c_d^e"], [f"r{i}" for i in range(12)]]
)
@pytest.mark.parametrize("count", [0, 1, 40])
def test_any_number_of_robots_and_points_can_be_drawn(
    tmp_path: Path, names: list[str], count: int
) -> None:
    draw_maps(tmp_path / "maps.png", maps_figure(names, count))
    assert pixels(tmp_path / "maps.png").std() > 0.01


def test_a_map_that_lies_far_away_or_on_one_spot_can_be_drawn(tmp_path: Path) -> None:
    data = maps_figure(["a"], 30)
    for points in (data.features[0], data.world.positions, data.graphs[0].positions):
        points[:] = (5e5, -5e5, 1e5)
    still = MapsFigure(["a"], data.features, [np.zeros((0, 4, 4))], data.graphs, data.world)
    draw_maps(tmp_path / "maps.png", still)
    assert pixels(tmp_path / "maps.png").std() > 0.01


def test_edges_lead_from_children_to_parents_that_are_there() -> None:
    ids = np.array([0, 2, 5])
    parents = np.array([[-1, -1], [0, 1], [2, 0]])  # 1 was withdrawn
    layer = GraphLayer(
        ids, np.zeros((3, 3)), parents, np.array([True, True, False]), np.array([True, False, True])
    )
    empty = GraphLayer(ids[:0], np.zeros((0, 3)), parents[:0], ids[:0] > 0, ids[:0] > 0)
    edges, kinds, positions = _edges([empty, layer, layer])
    assert sorted(map(tuple, edges.tolist())) == [(1, 0), (2, 0), (2, 1), (4, 3), (5, 3), (5, 4)]
    assert kinds.tolist() == [3, 1, 4, 3, 2, 4]  # 0 to 2: robots, 3: merged, 4: not broadcast
    assert len(positions) == 6


def test_the_traffic_shows_every_robot_and_the_total(tmp_path: Path) -> None:
    at = np.arange(0, 30, 0.5)
    robots = [
        RobotTraffic(name, at + 0.3, np.full(60, 40), at, np.arange(60) * 5)
        for name in ("a", "$b$", "_c")
    ]
    draw_traffic(tmp_path / "traffic.png", TrafficFigure(robots))
    image = pixels(tmp_path / "traffic.png")
    assert share_near(image, "#2166d1") > 0.003
    assert share_near(image, "#d6d6d6") > 0.02


@pytest.mark.parametrize("count", [0, 1, 30])
def test_traffic_of_no_or_many_robots_can_be_drawn(tmp_path: Path, count: int) -> None:
    nothing, none = np.zeros(0), np.zeros(0, np.int64)
    robots = [RobotTraffic(str(i), nothing, none, nothing, none) for i in range(count)]
    draw_traffic(tmp_path / "traffic.png", TrafficFigure(robots))
    assert pixels(tmp_path / "traffic.png").std() > 0.01


def test_features_are_counted_in_the_second_in_which_they_fall() -> None:
    at = np.array([100.0, 100.9, 101.0, 103.2])
    bins = _Bins.over([at])
    assert bins.count(at, np.array([1, 2, 4, 8])).tolist() == [3, 4, 0, 8]
    assert bins.edges.tolist() == [0, 1, 2, 3, 4]


def test_no_burst_of_a_long_mission_is_averaged_away() -> None:
    at = np.arange(0.0, 4000.0, 5.0)  # 400 features every five seconds, which is too much to show
    bins = _Bins.over([at, np.array([3999.0])])
    shown = bins.largest(bins.count(at, np.full(len(at), 400)))
    assert len(shown) + 1 == len(bins.edges) <= 1201
    assert shown.max() == 400.0 and bins.edges[-1] == 4000.0


def test_robots_whose_clocks_are_years_apart_do_not_take_all_memory() -> None:
    bins = _Bins.over([np.array([0.0, 2e9])])
    assert bins.number <= 1_000_001 and len(bins.edges) <= 1201
    assert bins.count(np.array([0.0, 2e9]), np.array([3, 4])).sum() == 7


@pytest.mark.parametrize("down_axis", [1, 2])
def test_up_is_found_from_the_way_of_the_sensor(down_axis: int) -> None:
    rng = np.random.default_rng(0)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))  # some frame with any axis up
    points, poses = room(rng, 3000) @ turn.T, walk(50, down_axis)
    poses[:, :3] = turn @ poses[:, :3]
    view = choose_view(points, poses)
    up = turn[:, 2]
    assert view.axes @ view.axes.T == pytest.approx(np.eye(3), abs=1e-9)
    assert view.axes[0] @ up == pytest.approx(0, abs=1e-6)  # level on the page
    assert view.axes[1] @ up == pytest.approx(np.cos(np.radians(58)), abs=1e-6)
    assert view.axes[2] @ up == pytest.approx(np.sin(np.radians(58)), abs=1e-6)  # from above
    assert abs(view.axes[0] @ turn[:, 0]) == pytest.approx(1, abs=0.03)  # long walls lie level


def test_up_is_found_from_the_points_where_the_sensor_stood_or_drove_straight() -> None:
    points = room(np.random.default_rng(0), 3000)
    poses = np.tile(np.eye(4), (30, 1, 1))
    assert choose_view(points, poses).axes[2, 2] == pytest.approx(np.sin(np.radians(58)), abs=0.02)
    poses[:, 0, 3] = np.arange(30)
    assert choose_view(points, poses).axes[2, 2] == pytest.approx(np.sin(np.radians(58)), abs=0.02)


def test_near_points_are_painted_last() -> None:
    view = choose_view(room(np.random.default_rng(0), 3000), walk(50))
    heights = np.array([[4.0, 2.0, z] for z in (1.0, 3.0, 2.0)])
    assert view.far_to_near(heights).tolist() == [0, 2, 1]


def test_without_matplotlib_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = builtins.__import__

    def no_matplotlib(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.split(".")[0] == "matplotlib":
            raise ModuleNotFoundError(f"No module named {name!r}")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", no_matplotlib)
    with pytest.raises(OutputError, match=r"pip install 'dagmap\[report\]'"):
        draw_traffic(tmp_path / "traffic.png", TrafficFigure([]))
    assert list(tmp_path.iterdir()) == []
