"""What `dagmap view` shows, without a browser: levels of detail, colours, clicks, the ledger."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dagmap import Agent, Config, Cycle, Identity, State
from dagmap.cli.view import ViewCommand
from dagmap.config import FoldConfig
from dagmap.io.export import PlyMap
from dagmap.io.view import words
from dagmap.io.view.colouring import COLOURINGS, legend, owners_of, paint
from dagmap.io.view.history import MARKS, History, silent
from dagmap.io.view.live import LiveFleet, standings
from dagmap.io.view.pace import ARRIVAL, PATIENCE, Headstart, Pace
from dagmap.io.view.picking import pick, reason, sightings
from dagmap.io.view.picture import Picture, Stand
from dagmap.io.view.run import Run
from dagmap.io.view.snapshot import edges_near, newest_features, take
from dagmap.io.view.source import Standing
from dagmap.io.view.thinning import Thinning
from dagmap.io.view.window import Window
from dagmap.messages import Head
from dagmap.model import DagmapError
from robots import Nursery, Robot, record, running, until
from runs import replay_of
from scene import QUICK, agent, cycles, pose, secret

HOSTILE = '<img src=x onerror="alert(1)">'


def fleet(*names: str, count: int = 6) -> list[Agent]:
    """Robots that have told each other everything."""
    robots = [agent(name) for name in names]
    for i, robot in enumerate(robots):
        for cycle in cycles(i, count=count):
            robot.observe(cycle, cycle.stamp)
            robot.tick(cycle.stamp)
    for step in range(8):
        for robot in robots:
            robot.tick(100.0 + 4 * step)
            for out in robot.outbox():
                for other in robots:
                    if other is not robot and out.to in (None, other.identity.author):
                        other.receive(out.data, 100.0 + 4 * step)
    assert len({robot.digest() for robot in robots}) == 1
    return robots


@pytest.fixture(scope="module")
def two() -> list[Agent]:
    return fleet("ada", "bob")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return replay_of(tmp_path_factory.mktemp("view"))


def transactions(one: Agent) -> list[bytes]:
    return [each.transaction.data for each in one.consensus.contributions()]


class TestThinning:
    points = np.random.default_rng(1).uniform(-4, 4, (5000, 3))

    @pytest.mark.parametrize("budget", [1, 10, 700, 4999, 5000, 10**6])
    def test_fills_the_budget_and_no_more(self, budget: int) -> None:
        rows = Thinning(self.points).everywhere(budget)
        assert len(rows) == min(budget, 5000) == len(set(rows.tolist()))

    def test_few_points_are_all_over_the_map(self) -> None:
        rows = Thinning(self.points).everywhere(300)
        octants = (self.points[rows] > 0) @ [1, 2, 4]
        assert np.bincount(octants, minlength=8).min() > 15

    def test_everything_that_is_near_where_there_is_room(self) -> None:
        centre = np.array([1.0, -1.0, 2.0])
        rows = Thinning(self.points).near(centre, 1.5, 5000)
        near = np.linalg.norm(self.points - centre, axis=1) <= 1.5
        assert near.sum() > 50 and set(rows) == set(np.flatnonzero(near))
        assert set(Thinning(self.points).near(centre, 1.5, 20)) < set(rows)

    def test_a_map_of_many_kilometres_is_thinned_alike(self) -> None:
        far = Thinning(5000.0 * self.points)
        octants = (self.points[far.everywhere(300)] > 0) @ [1, 2, 4]
        assert np.bincount(octants, minlength=8).min() > 15
        assert len(far.everywhere(4999)) == 4999

    def test_equal_points_and_none(self) -> None:
        assert len(Thinning(np.ones((9, 3))).everywhere(9)) == 9
        nothing = Thinning(np.zeros((0, 3)))
        assert len(nothing.everywhere(5)) == len(nothing.near(np.zeros(3), 1.0, 5)) == 0


_FIRST = """
import sys
from pathlib import Path
from dagmap.cli.view import ViewCommand
from dagmap.io.view.run import Run
from dagmap.io.view.window import Window
with Window(Run(Path(sys.argv[1])), "127.0.0.1", 0) as window:
    window.show_first()
    print(window.controls.counts.content, "numba" in sys.modules)
"""


def test_a_first_picture_does_not_wait_for_compiled_kernels(run: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _FIRST, str(run)], capture_output=True, text=True, check=True
    )
    assert "nodes:" in done.stdout and done.stdout.rstrip().endswith("False")


class TestColours:
    world = PlyMap(
        np.zeros((4, 3)),
        np.array([[10, 20, 30]] * 4, np.uint8),
        np.array([0, 1, 2, 1], np.uint8),
        np.array([3, 1, 1, 0]),
        np.array([0, 1, 3, 0]),
        np.array([2, 1, 1, 1]),
    )

    def test_states_have_the_colours_of_the_legend(self) -> None:
        painted = paint(self.world, "state", np.zeros(4, np.int64), 1)
        named = [f"#{bytes(row).hex()}" for row in painted[:3]]
        assert named == [color for _, color in legend("state", [])]

    def test_ratios_go_from_no_hit_to_no_miss(self) -> None:
        painted = paint(self.world, "hit ratio", np.zeros(4, np.int64), 1)
        ends = [color for _, color in legend("hit ratio", [])]
        assert f"#{bytes(painted[0]).hex()}" == ends[2]
        assert f"#{bytes(painted[1]).hex()}" == ends[1]
        assert f"#{bytes(painted[3]).hex()}" == ends[0]

    def test_what_one_robot_saw_has_its_colour(self, two: list[Agent]) -> None:
        world = two[0].map
        owners = owners_of(world, ["ada", "bob"])
        assert {-1, 0, 1} == set(owners.tolist())
        for node in range(0, len(world), 17):
            robots = {seen.robot for seen in world.provenance(node)}
            expected = -1 if len(robots) > 1 else ["ada", "bob"].index(*robots)
            assert owners[node] == expected
        painted = paint(world, "robot", owners, 2)
        colors = dict(legend("robot", ["ada", "bob"]))
        assert f"#{bytes(painted[owners == 1][0]).hex()}" == colors["bob"]
        assert f"#{bytes(painted[owners == -1][0]).hex()}" == colors["several robots"]

    @pytest.mark.parametrize("colouring", COLOURINGS)
    def test_a_map_without_its_ledger_and_an_empty_one(self, colouring: str) -> None:
        assert (owners_of(self.world, ["ada"]) == [-1, -2, -2, -2]).all()
        assert paint(self.world, colouring, owners_of(self.world, []), 0).shape == (4, 3)
        nothing = Agent(Identity.from_seed(secret("x")), QUICK).map
        assert paint(nothing, colouring, owners_of(nothing, []), 0).shape == (0, 3)


class TestClicks:
    def test_the_point_under_the_ray_and_none_beside_it(self) -> None:
        points = np.array([[5.0, 0, 0], [5.0, 1.0, 0], [-5.0, 0, 0]])
        assert pick(points, np.zeros(3), np.array([2.0, 0.01, 0])) == 0
        assert pick(points, np.zeros(3), np.array([5.0, 0.98, 0])) == 1
        assert pick(points, np.zeros(3), np.array([5.0, 0.5, 0])) is None
        assert pick(points[:0], np.zeros(3), np.array([1.0, 0, 0])) is None

    def test_what_is_in_front_hides_what_is_behind(self) -> None:
        points = np.array([[9.0, 0, 0], [3.0, 0.02, 0]])
        assert pick(points, np.zeros(3), np.array([1.0, 0, 0])) == 1

    def test_says_who_saw_it_when_and_why_it_is_kept(self, two: list[Agent]) -> None:
        snapshot = take(two[0])
        world = two[0].map
        fold = FoldConfig()
        for state, said in (
            (State.CONFIRMED, "kept: "),
            (State.TENTATIVE, "kept for now: "),
            (State.REJECTED, "not kept: "),
        ):
            for node in np.flatnonzero(world.states == state)[:3].tolist():
                assert reason(world, node, fold).startswith(said)
                html = words.node(world, node, snapshot.said, fold)
                assert state.name.lower() in html
                for robot, observations in sightings(world, node):
                    assert robot in html and f"{observations[0].stamp:.2f} s" in html
        node = int(np.flatnonzero(world.states == State.CONFIRMED)[0])
        assert "seen by 2 robots (2 are enough)" in reason(world, node, fold)

    def test_names_from_strangers_are_no_markup(self) -> None:
        one = agent(HOSTILE)
        for cycle in cycles(3):
            one.observe(cycle, cycle.stamp)
        snapshot = take(one)
        assert isinstance(snapshot.world, type(one.map)) and len(one.map)
        pages = [
            words.node(one.map, 0, snapshot.said, FoldConfig()),
            words.newest(snapshot.said, 9),
            words.colours("robot", snapshot.names),
            words.standing(HOSTILE, [Standing(HOSTILE, HOSTILE, True, HOSTILE)], "", HOSTILE),
            words.plain(HOSTILE),
        ]
        assert all("&lt;img" in page and "<img" not in page for page in pages)


class TestPicture:
    def test_shows_the_states_that_are_wanted(self, two: list[Agent]) -> None:
        snapshot = take(two[0])
        world = two[0].map
        everything = Picture(snapshot, tuple(State), ["ada", "bob"])
        confirmed = Picture(snapshot, (State.CONFIRMED,), ["ada", "bob"])
        assert len(everything) == len(world) and len(confirmed) == world.count(State.CONFIRMED) > 0
        assert confirmed.colors("state").shape == confirmed.positions.shape
        assert len(set(map(tuple, confirmed.colors("state").tolist()))) == 1
        eye = world.positions.mean(axis=0) + np.array([50.0, 0.0, 0.0])
        for row in range(3):
            node = confirmed.pick(eye, confirmed.positions[row] - eye)
            assert node is not None and world.states[node] == State.CONFIRMED

    def test_the_camera_stands_above_and_sees_all(self, two: list[Agent]) -> None:
        stand = Stand(take(two[0]))
        assert (stand.position - stand.look_at) @ stand.up > 0
        assert np.linalg.norm(stand.position - stand.look_at) > stand.size / 2
        Stand(take(agent("nobody")))  # and of an empty map

    def test_paths_are_where_the_robots_were(self, two: list[Agent]) -> None:
        paths = {path.robot: path.poses for path in take(two[0]).paths}
        for name, (newest, _) in two[0].robots.items():
            assert np.allclose(paths[name][-1], newest) and len(paths[name]) == 6


class TestEdges:
    def test_all_edges_of_the_bundles_and_those_of_a_region(self) -> None:
        config = Config(transaction=QUICK.transaction, graph=QUICK.graph)
        one = Agent(Identity.from_seed(secret("ada")), config)
        rng = np.random.default_rng(5)
        for i in range(4):
            one.observe(Cycle(float(i), pose(), rng.uniform([2, -1, 0], [2.2, 1, 1], (60, 3))), i)
        said = take(one).said
        ends, robots = edges_near(said, config, np.zeros(3), 1e3, 10**6)
        wanted = set()
        xyz = np.concatenate([each.xyz for each in said])
        for each in said:
            for i, row in enumerate(each.parents(config).tolist()):
                for parent in (p for p in row if p >= 0):
                    wanted.add((tuple(each.xyz[i]), tuple(xyz[parent])))
        found = {tuple(tuple(p) for p in np.rint(1000 * e).astype(int)) for e in ends}
        assert found == {tuple(tuple(map(int, p)) for p in e) for e in wanted}
        assert len(found) > 100 and set(robots) == {one.identity.author.hex()}
        centre = np.array([2.1, 0.0, 0.5])
        some, _ = edges_near(said, config, centre, 0.3, 10**6)
        assert 0 < len(some) < len(ends)
        assert (np.linalg.norm(some[:, 0] - centre, axis=1) <= 0.3).all()
        assert len(edges_near(said, config, np.zeros(3), 1e3, 7)[0]) == 7


class TestHistory:
    def test_every_prefix_is_what_a_robot_with_it_holds(self, two: list[Agent]) -> None:
        everything = transactions(two[0])
        history = History(QUICK, Identity.from_seed(secret("view")), everything)
        rng = np.random.default_rng(2)
        for count in [len(everything), 0, *rng.integers(0, len(everything), 12).tolist()]:
            fresh = Agent(Identity.from_seed(secret("other")), QUICK)
            for data in everything[:count]:
                fresh.take(data)
            assert history.agent_at(count).digest() == fresh.digest()
        assert history.agent_at(10**9).digest() == two[0].digest()

    def test_says_how_far_it_is_and_keeps_few_marks(self, two: list[Agent]) -> None:
        history = History(QUICK, Identity.from_seed(secret("view")), transactions(two[0]))
        shares: list[float] = []
        history.agent_at(len(history), shares.append)
        assert shares == sorted(shares) and shares[-1] == 1.0
        assert 0 < len(history._marks) <= MARKS

    def test_a_late_transaction_in_between_is_there_afterwards(self, two: list[Agent]) -> None:
        everything = transactions(two[0])
        history = History(QUICK, Identity.from_seed(secret("view")))
        without = [data for i, data in enumerate(everything) if i != len(everything) - 2]
        history.follow(without[:-1])
        history.agent_at(len(history))
        history.follow(everything)
        assert history.agent_at(len(everything)).digest() == two[0].digest()


class TestPace:
    def test_a_browser_proves_that_it_is_fast_and_may_fail(self) -> None:
        pace = Pace()
        assert pace.slow  # nothing is known
        for chance in range(4):
            for i in range(30):
                pace.moved(100.0 * chance + 0.02 * i)
            assert pace.slow == (chance >= 2)  # twice slow: for good
            for i in range(4):
                pace.moved(100.0 * chance + 10 + 0.5 * i)
            assert pace.slow

    def test_a_slow_frame_is_no_rest(self) -> None:
        pace = Pace()
        for i in range(3):
            pace.moved(1.0 * i)
        assert not pace.rests(4.9, 0.3) and pace.rests(5.0, 0.3)

    def test_nor_is_the_first_one_of_a_browser_that_nobody_knows(self) -> None:
        pace = Pace()
        pace.moved(0.0)
        assert not pace.rests(1.1, 0.3) and pace.rests(1.3, 0.3)
        for i in range(30):
            pace.moved(2.0 + 0.02 * i)
        assert pace.rests(2.58 + 0.31, 0.3)  # it is known to be fast

    def test_one_fast_frame_among_slow_ones_is_no_rest_either(self) -> None:
        pace = Pace()
        for now in (0.0, 1.0, 2.0, 2.01):
            pace.moved(now)
        assert not pace.rests(4.0, 0.3) and pace.rests(4.2, 0.3)

    def test_pauses_are_no_slowness(self) -> None:
        pace = Pace()
        assert pace.rests(0.0, 1.0)
        for i in range(30):
            pace.moved(0.02 * i)
        for i in range(20):
            pace.moved(10.0 * i + 10)
        assert not pace.slow
        assert pace.rests(201.5, 1.0) and not pace.rests(200.5, 1.0)


class TestHeadstart:
    def test_without_a_picture_the_ledger_comes_first(self) -> None:
        headstart = Headstart()
        assert headstart.is_over(0.0)
        headstart.came(0.0)
        assert headstart.is_over(0.0)

    def test_the_first_browser_gets_its_picture_first(self) -> None:
        headstart = Headstart()
        headstart.shown(10.0)
        assert not headstart.is_over(10.0 + ARRIVAL)
        headstart.came(14.0)
        headstart.came(15.0)  # who comes later does not delay it
        assert not headstart.is_over(13.9 + ARRIVAL) and headstart.is_over(14.0 + ARRIVAL)

    def test_a_browser_that_is_there_before_the_picture(self) -> None:
        headstart = Headstart()
        headstart.came(1.0)
        headstart.shown(10.0)
        assert not headstart.is_over(9.9 + ARRIVAL) and headstart.is_over(10.0 + ARRIVAL)

    def test_nobody_comes(self) -> None:
        headstart = Headstart()
        headstart.shown(10.0)
        assert not headstart.is_over(9.9 + PATIENCE) and headstart.is_over(10.0 + PATIENCE)


class TestRun:
    def test_the_map_comes_first_and_the_ledger_agrees(self, run: Path) -> None:
        summary = json.loads((run / "summary.json").read_text())
        opened = Run(run)
        first = opened.first()
        latest = opened.latest(silent)
        assert first is not None and len(first.world.positions) == len(latest.world.positions)
        assert latest.digest == summary["digest"]
        assert [each.agrees for each in opened.standings()] == [True, True]
        assert latest.names == ["blue", "red"] and opened.remark() == ""
        total = summary["robots"][0]["transactions"] + summary["robots"][1]["transactions"]
        assert opened.count == total
        half = opened.at(total // 2, silent)
        assert len(half.said) == total // 2 and half.digest != latest.digest
        assert opened.at(total, silent) is latest
        assert len(newest_features(latest.said, 1)) == latest.said[-1].transaction.features

    def test_a_ledger_with_less_is_told_from_its_summary(self, tmp_path: Path) -> None:
        import sqlite3

        folder = replay_of(tmp_path)
        database = sqlite3.connect(folder / "ledgers" / "red.db", isolation_level=None)
        database.execute("DELETE FROM transactions WHERE position > 3")
        database.close()
        opened = Run(folder, "blue")
        opened.latest(silent)
        lacking = {each.robot: each for each in opened.standings()}
        assert lacking["blue"].agrees and lacking["red"].agrees is False
        assert "lacks" in lacking["red"].detail

    def test_wrong_folders_are_named(self, run: Path, tmp_path: Path) -> None:
        with pytest.raises(DagmapError, match="no such folder; name the --out of a replay"):
            Run(tmp_path / "missing")
        with pytest.raises(DagmapError, match="not the folder of a run"):
            Run(tmp_path)
        with pytest.raises(DagmapError, match="--robot nobody: not in .* robots are red, blue"):
            Run(run, "nobody")
        summary = tmp_path / "summary.json"
        for text, words_ in (
            ("{", "not what a replay writes"),
            ('{"robots": [], "parameters": {}}', "without robots"),
            ('{"robots": [{"name": "../x", "digest": ""}], "parameters": {}}', "cannot be"),
            ('{"robots": [{"name": "x", "digest": ""}], "parameters": {"k": 1}}', "parameters"),
            ('{"robots": [{"name": "x", "digest": ""}], "parameters": {}}', "no ledger is here"),
        ):
            summary.write_text(text)
            with pytest.raises(DagmapError, match=words_):
                Run(tmp_path)

    def test_the_ledger_of_another_fleet(self, tmp_path: Path) -> None:
        folder = replay_of(tmp_path)
        summary = json.loads((folder / "summary.json").read_text())
        summary["parameters"]["fleet"] = "strangers"
        (folder / "summary.json").write_text(json.dumps(summary))
        with pytest.raises(DagmapError, match=r"red\.db: the ledger of another fleet"):
            Run(folder)


class TestCommand:
    def command(self, **changes: Any) -> ViewCommand:
        arguments: dict[str, Any] = {
            "folder": None, "live": None, "config": None, "robot": None, "host": "127.0.0.1",
            "port": 0, "points": 400_000, "browser": False,
        }  # fmt: skip
        return ViewCommand(**{**arguments, **changes})

    def test_what_does_not_go_together(self, tmp_path: Path) -> None:
        for changes, said in (
            ({}, "one of the two"),
            ({"folder": tmp_path, "live": "tcp/127.0.0.1:1"}, "one of the two"),
            ({"folder": tmp_path, "config": tmp_path}, "--config goes with --live"),
            ({"live": "tcp/127.0.0.1:1", "robot": "x"}, "--robot goes with"),
            ({"folder": tmp_path, "points": 3}, "--points 3"),
            (
                {"live": "foo"},
                r"^--live foo: an endpoint such as \"tcp/192.168.1.7:7447\" is wanted",
            ),
            ({"live": "tcp/foo"}, "^--live tcp/foo: an endpoint such as"),
        ):
            with pytest.raises(DagmapError, match=said):
                self.command(**changes).run()

    def test_the_extra_is_named(self, run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "viser", None)
        with pytest.raises(DagmapError, match=r"pip install 'dagmap\[view\]'"):
            self.command(folder=run).run()

    def test_a_port_that_is_in_use_is_not_silently_another(self, run: Path) -> None:
        pytest.importorskip("viser", reason="the extra view is not installed")
        with socket.create_server(("127.0.0.1", 0)) as taken:
            port = taken.getsockname()[1]
            with pytest.raises(DagmapError, match=f"--port {port} on 127.0.0.1: cannot be used"):
                Window(Run(run), "127.0.0.1", port)


class TestLive:
    def test_heads_that_are_equal_agree(self, two: list[Agent]) -> None:
        ada, bob = two
        me = {
            author: Head(author, chain.end, chain.main[-1].id[:8])
            for author, chain in ada.ledger.chains.items()
        }
        less = me | {ada.identity.author: me[ada.identity.author]._replace(length=2)}
        other = me | {ada.identity.author: me[ada.identity.author]._replace(tip=bytes(8))}
        ahead = me | {bytes(8): Head(bytes(8), 3, bytes(8))}
        announced = {bob.identity.author: me, b"1": less, b"2": other, b"3": ahead}
        found = {each.robot: each for each in standings(ada, announced, "d1")}
        assert found["bob"] == Standing("bob", "d1", True, "the same transactions")
        assert found["31"].agrees is False and found["31"].detail.endswith(" behind")
        assert (found["32"].agrees, found["32"].detail) == (False, "another branch")
        assert (found["33"].agrees, found["33"].detail) == (False, "3 ahead")
        shown = [found[name].digest for name in ("31", "32", "33")]  # each by its own heads
        assert len(set(shown)) == 3 and all(digest.startswith("heads ") for digest in shown)
        again = standings(ada, {b"4": dict(reversed(less.items()))}, "d1")
        assert again[0].digest == found["31"].digest
        html = words.standing("a fleet", list(found.values()), "d1", "")
        assert all(digest[:18] in html for digest in shown)

    def test_follows_a_running_robot(self, nursery: Nursery, tmp_path: Path) -> None:
        robot = Robot(nursery, tmp_path, "ada", record(tmp_path / "walk.npz", seed=1))
        with running(robot):
            robot.start("--speed", 20)
            with LiveFleet(f"tcp/127.0.0.1:{robot.port}", robot.write()) as live:
                assert live.first() is None

                def agrees() -> bool:
                    snapshot = live.latest(silent)
                    status = robot.status()
                    standing = [each.agrees for each in live.standings()]
                    done = status.get("cycles") == 8 and not status["lag"]["to_issue"]
                    return done and snapshot.digest == status["digest"] and standing == [True]

                until(agrees, "the view to hold what the robot holds")
                assert live.latest(silent).names == ["ada"] and live.remark() == ""
                assert live.latest(silent) is live.latest(silent)  # nothing is new
                held = live.count
                assert live.at(held // 2, silent).digest != live.latest(silent).digest
                assert robot.status()["transactions"] == held > 4
                assert len(robot.status()["heads"]) == 1  # the view has said nothing

    def test_other_parameters_are_told_plainly(self, nursery: Nursery, tmp_path: Path) -> None:
        robot = Robot(nursery, tmp_path, "ada", record(tmp_path / "walk.npz", seed=1))
        with running(robot):
            robot.start("--speed", 20)
            until(robot.status, "the robot")
            other = tmp_path / "other.toml"
            other.write_text(robot.write().read_text() + "[fold]\ndelta = 0.2\n")
            with LiveFleet(f"tcp/127.0.0.1:{robot.port}", other) as live:

                def told() -> bool:
                    live.latest(silent)
                    return "other fleet-wide parameters" in live.remark()

                assert until(told, "the remark")

    def test_an_endpoint_that_is_none(self) -> None:
        with pytest.raises(DagmapError, match="an endpoint such as"):
            LiveFleet("nonsense")

    def test_a_robot_of_a_closed_fleet_is_not_doubled(self, tmp_path: Path) -> None:
        file = tmp_path / "robot.toml"
        file.write_text(f'fleet_key = "{"ab" * 32}"\n[store]\npath = "ledger.db"\n')
        (tmp_path / "ledger.db").touch()
        with pytest.raises(DagmapError, match="enroll the view too"):
            LiveFleet("tcp/127.0.0.1:1", file)
