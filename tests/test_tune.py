"""`dagmap tune`: noise and resolution are found, and what is proposed makes better maps."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from typer.testing import CliRunner

from dagmap import Config, Cycle
from dagmap.cli import app
from dagmap.cli.tune import snippet
from dagmap.config import load_config
from dagmap.io.sources import open_source, save_cycles
from dagmap.metrics import nearest, thin
from dagmap.model import DagmapError
from dagmap.sim.fleet import Fleet
from dagmap.sim.scene import MotionConfig, Scene, SceneConfig
from dagmap.sim.sensor import SensorConfig
from dagmap.tuning import Measured, Points, gather, measure, proposal, propose

OFFICE = Path(__file__).parents[1] / "examples" / "office"
STILL = MotionConfig(drift=0.0, drift_yaw=0.0, loop_closures=False)
Recordings = dict[str, list[Cycle]]


def walk(
    sensor: SensorConfig, named: bool, seconds: float = 40.0, robots: int = 2, room: float = 5.0
) -> tuple[Scene, Recordings]:
    """Robots in two rooms whose SLAM does not drift, with or without names of points."""
    scene = Scene(SceneConfig(rooms=(1, 2), room=room), sensor, STILL, robots, 1)
    recordings = {f"r{i}": list(scene.robot(i).cycles(seconds)) for i in range(robots)}
    if not named:
        recordings = {n: [replace(c, ids=None) for c in cs] for n, cs in recordings.items()}
    return scene, recordings


def looked_at(recordings: Recordings) -> tuple[Points, Measured]:
    points, period = gather(recordings)
    return points, measure(points, period)


@pytest.mark.parametrize("noise", [0.005, 0.02, 0.06])
@pytest.mark.parametrize("named", [True, False], ids=["ids", "planes"])
def test_noise_along_the_ray_is_found(noise: float, named: bool) -> None:
    found = looked_at(walk(SensorConfig(points=300, noise=noise, outliers=0.1), named)[1])[1]
    assert found.noise.method == ("repeated ids" if named else "planes")
    assert found.noise.along == pytest.approx(
        noise, rel=0.1 if named else 0.4
    )  # planes: corners too
    assert found.noise.across is not None and found.noise.across < 0.7 * noise
    assert abs(found.noise.power) < 0.4


@pytest.mark.parametrize("named", [True, False], ids=["ids", "planes"])
def test_noise_that_grows_with_the_square_of_the_depth(named: bool) -> None:
    sensor = SensorConfig(kind="stereo", points=300, pixel=0.1, outliers=0.05)
    found = looked_at(walk(sensor, named)[1])[1]
    assert 1.4 < found.noise.power < 2.4
    for reach, sigma in found.noise.at:  # off the axis of the camera a depth is less than a range
        wanted = reach**2 * sensor.pixel / (sensor.focal * sensor.baseline)
        assert 0.5 * wanted < sigma < 1.3 * wanted


def test_resolution_of_a_grid() -> None:
    """A wall of points 4 cm apart, seen from five places with 5 mm noise in all directions."""
    rng, cycles = np.random.default_rng(2), []
    wall = np.stack(np.meshgrid([3.0], np.arange(-1, 1, 0.04), np.arange(-1, 1, 0.04)), -1)
    for i in range(5):
        pose = np.eye(4)
        pose[:3, 3] = 0.0, 0.3 * i - 0.6, 0.0
        seen = wall.reshape(-1, 3) + rng.normal(0, 0.005, (wall.size // 3, 3)) - pose[:3, 3]
        cycles.append(Cycle(0.5 * i, pose, seen))
    found = looked_at({"one": cycles})[1]
    assert (found.robots, found.cycles, found.period) == (1, 5, 0.5)
    assert found.per_cycle == 2500 and found.overlap == 1.0
    assert found.in_scan == pytest.approx(0.036, abs=0.006)
    assert found.between < 0.01
    assert found.noise.along == pytest.approx(0.005, rel=0.3)
    assert found.between_robots is None


def test_loop_closures_are_followed() -> None:
    """Poses that a later cycle corrects do not count as noise."""
    cycles = walk(SensorConfig(points=300, noise=0.01), False)[1]["r0"]
    off = [np.array(c.pose) + 0.0 for c in cycles]
    for i, pose in enumerate(off):
        pose[:3, 3] += 0.02 * i
    bent = [replace(c, pose=p) for c, p in zip(cycles, off, strict=True)]
    right = ([c.stamp for c in cycles], np.array([c.pose for c in cycles]))
    closed = [*bent[:-1], replace(bent[-1], moved=right)]
    straight = looked_at({"r0": cycles})[1].noise.along
    assert looked_at({"r0": bent})[1].noise.along > 2 * straight
    assert looked_at({"r0": closed})[1].noise.along == pytest.approx(straight, rel=0.1)


SENSORS = {
    "rgbd": SensorConfig(points=150, noise=0.01, outliers=0.1),
    "stereo": SensorConfig(kind="stereo", points=150, pixel=0.25, outliers=0.1),
    "mono": SensorConfig(kind="mono", points=40, outliers=0.1),
}


def f_score(scene: Scene, recordings: Recordings, config: Config) -> float:
    """Of the fleet's map at 10 cm."""
    fleet = Fleet(config)
    for _ in fleet.run(recordings):
        pass
    world = next(iter(fleet.robots.values())).agent.map
    cloud = thin(world.positions[world.kept])
    seen = [scene.robot(i).seen().reference for i in range(len(recordings))]
    places = thin(np.concatenate(seen))
    precision = float((scene.distance(cloud) <= 0.1).mean())
    recall = float((nearest(places, cloud) <= 0.1).mean())
    return 2 * precision * recall / (precision + recall)


@pytest.mark.parametrize("sensor", SENSORS)
def test_what_is_proposed_serves_where_points_are_few(sensor: str) -> None:
    scene, recordings = walk(SENSORS[sensor], named=True)
    config = proposal(propose(*looked_at(recordings)))
    found, usual = (f_score(scene, recordings, c) for c in (config, Config()))
    assert found > 0.8 and found > usual - 0.1


def test_the_office_gets_about_what_was_found_for_it_with_the_truth_at_hand() -> None:
    recordings = {f"robot{i}": open_source(OFFICE / f"robot{i}") for i in (1, 2, 3)}
    points, period = gather(recordings)
    found, usual = measure(points, period), Config()
    assert found.cycles == 125 and found.points == 71_463
    assert 0.005 < found.noise.along < 0.015
    config = proposal(propose(points, found))
    assert 0.02 <= config.fold.delta <= 0.04 and 0.05 <= config.fold.cell <= 0.15
    assert config.fold.doubt is None and config.graph.v_th == usual.graph.v_th
    assert 0.02 <= config.graph.reference_pitch <= 0.1
    assert 3.0 <= config.fold.max_ray <= 6.0


def test_long_cycles_are_named() -> None:
    _, recordings = walk(SensorConfig(points=200, period=5.0), True, seconds=200.0)
    proposed = {item.field: item.value for item in propose(*looked_at(recordings))}
    assert proposed["issuance.cycle_period"] == 5.0


def run(*arguments: object) -> tuple[int, str]:
    """Exit code and what is on the terminal; a DagmapError is its text, as `main` prints it."""
    done = CliRunner().invoke(app, ["tune", *map(str, arguments)])
    if isinstance(done.exception, DagmapError):
        return 2, str(done.exception)
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done.exit_code, done.output


def saved(folder: Path, recordings: Recordings) -> list[Path]:
    for name, cycles in recordings.items():
        save_cycles(folder / f"{name}.npz", cycles)
    return [folder / f"{name}.npz" for name in recordings]


def test_command(tmp_path: Path) -> None:
    recordings = walk(SENSORS["rgbd"], named=True)[1]
    files, out = saved(tmp_path, recordings), tmp_path / "tuned.toml"
    code, said = run(*files, "--json")
    answer = json.loads(said)
    assert code == 0 and answer["measured"]["noise"]["along"] == pytest.approx(0.01, rel=0.1)
    assert all(item["why"] for item in answer["proposed"])
    assert run(*files, "--out", out) == (0, run(*files, "--out", out, "--force")[1])
    assert out.read_text() == answer["toml"]
    config = load_config(out)
    for item in answer["proposed"]:
        group, name = item["field"].split(".")
        assert getattr(getattr(config, group), name) == item["value"]
    code, said = run(*files)
    assert code == 0 and answer["toml"] in said and "noise along the ray, by repeated ids" in said
    code, said = run(*files, "--out", out)
    assert code == 2 and "exists already" in said


def one(cycles: list[Cycle]) -> Recordings:
    return {"alone": cycles}


def scan(at: float, stamp: float, count: int = 200) -> Cycle:
    """Points of a wall; 100 m from place to place."""
    pose = np.eye(4)
    pose[0, 3] = 100.0 * at
    points = np.random.default_rng(int(stamp)).uniform([2, -1, -1], [2.01, 1, 1], (count, 3))
    return Cycle(stamp, pose, points)


@pytest.mark.parametrize(
    ("recordings", "wanted"),
    [
        (one([]), "alone: no cycles in it; there is nothing to tune by"),
        (one([scan(0, 0.0, 0), scan(0, 1.0, 0)]), "alone: no points in any cycle"),
        (one([scan(0, 0.0)]), "alone: a single cycle; noise shows between two"),
        (one([scan(0, 0.0), scan(1, 1.0), scan(2, 2.0)]), "do not overlap enough.*0% of the"),
        (one([scan(0, 0.0, 1), scan(0, 1.0, 1)]), "no cycle has two points"),
    ],
    ids=["empty", "no points", "one cycle", "no overlap", "one point"],
)
def test_what_tells_nothing_is_refused_in_one_line(recordings: Recordings, wanted: str) -> None:
    with pytest.raises(DagmapError, match=wanted) as refused:
        looked_at(recordings)
    assert "\n" not in str(refused.value)


def test_command_refuses_in_one_line(tmp_path: Path) -> None:
    (path,) = saved(tmp_path, one([scan(0, 0.0)]))
    code, said = run(path)
    assert code == 2 and "single cycle" in said and "Traceback" not in said
    code, said = run(path, path)
    assert code == 2 and "one name" in said
    code, said = run(tmp_path / "none.npz")
    assert code == 2 and "no such file" in said


def test_a_snippet_holds_only_what_differs_and_why() -> None:
    recordings = walk(SENSORS["rgbd"], named=True, seconds=20.0)[1]
    proposed = propose(*looked_at(recordings))
    text = snippet(proposed, "robot1,\nrobot2")
    assert text.startswith("# dagmap tune: from robot1, robot2\n")
    assert msgspec.toml.decode(text, type=Config) == proposal(proposed)
    values = [line for line in text.splitlines() if " = " in line and not line.startswith("#")]
    assert len(values) == len(proposed) and all("  # " in line for line in values)
