"""A fleet of real processes over real sockets: whatever happens to it, it ends with one map."""

from __future__ import annotations

import random
import signal
import time
from pathlib import Path

import pytest

from dagmap import Config
from dagmap.cli.status import show_status
from dagmap.io.transport import load_zenoh
from dagmap.messages import MAX_MESSAGE, Heads, Want, encode
from robots import PARAMETERS, Nursery, Proxy, Robot, agreed, record, record_much, running, until


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("recordings")
    return [record(folder / f"walk{i}.npz", seed=i) for i in range(3)]


def fleet_of(nursery: Nursery, folder: Path, recordings: list[Path]) -> tuple[Robot, ...]:
    """Robots a, b, c, each connected to those before it."""
    robots: list[Robot] = []
    for name, recording in zip("abc", recordings, strict=False):
        ports = tuple(robot.port for robot in robots)
        robots.append(Robot(nursery, folder, name, recording, ports))
    return tuple(robots)


class TestAgreement:
    def test_three_robots_end_with_one_map(
        self, nursery: Nursery, tmp_path: Path, recordings: list[Path]
    ) -> None:
        robots = fleet_of(nursery, tmp_path, recordings)
        with running(*robots):
            for robot in robots:
                robot.start("--speed", 20, "--wait-for", 2, "--until-agreed", 1)
            assert [robot.wait() for robot in robots] == [0, 0, 0], robots[0].log
        digests = {robot.said.split("digest ")[1] for robot in robots}
        assert len(digests) == 1
        assert robots[0].ids() == robots[1].ids() == robots[2].ids()
        agent = robots[0].restored()
        assert agent.digest().hex() == digests.pop().strip()
        assert set(agent.robots) == {"a", "b", "c"} and len(agent.map) > 100

    def test_a_robot_that_was_killed_goes_on(
        self, nursery: Nursery, tmp_path: Path, recordings: list[Path]
    ) -> None:
        a, b = robots = fleet_of(nursery, tmp_path, recordings[:2])
        with running(*robots):
            a.start("--speed", 4)
            b.start("--speed", 4)
            author = until(b.status, "b")["author"]
            until(lambda: (b.status().get("heads", {}).get(author) or {}).get("length", 0) > 2)
            b.kill()
            b.start("--speed", 20)
            until(lambda: b.status().get("cycles") == 8 and agreed(a, b, authors=2), "agreement")
            assert b.answer()["author"] == author
            assert [a.stop(), b.stop()] == [0, 0]
        chain = a.restored().ledger.chain(b.identity().author)
        sessions = {anchor.session for tx in chain.main for anchor in tx.payload.anchors}
        assert chain.cut is None
        assert sessions == {0, 1}  # the SLAM that came back has a frame and ids of its own

    def test_a_late_joiner_copies_the_map(
        self, nursery: Nursery, tmp_path: Path, recordings: list[Path]
    ) -> None:
        a, b, _ = robots = fleet_of(nursery, tmp_path, recordings)
        c = Robot(nursery, tmp_path, "late", None, (b.port,))
        with running(*robots, c):
            a.start("--speed", 20)
            b.start("--speed", 20)
            until(lambda: agreed(a, b, authors=2) and a.answer()["cycles"] == 8, "a and b")
            c.start()
            until(lambda: agreed(a, b, c, authors=2), "the late joiner")
            assert c.answer()["map"] == a.answer()["map"]

    def test_ends_of_a_chain_that_never_meet(
        self, nursery: Nursery, tmp_path: Path, recordings: list[Path]
    ) -> None:
        a = Robot(nursery, tmp_path, "a", recordings[0])
        b = Robot(nursery, tmp_path, "b", recordings[1], (a.port,))
        c = Robot(nursery, tmp_path, "c", recordings[2], (b.port,))
        with running(a, b, c):
            for robot in (a, b, c):
                robot.start("--speed", 20, "--wait-for", 1)
            answers = until(lambda: agreed(a, b, c, authors=3), "agreement")
            here = [
                {who for who, peer in answer["peers"].items() if peer["here"]} for answer in answers
            ]
            names = [answer["author"] for answer in answers]
            assert here == [{names[1]}, {names[0], names[2]}, {names[1]}]

    def test_a_router_relays_between_clients(
        self, nursery: Nursery, tmp_path: Path, recordings: list[Path]
    ) -> None:
        a = Robot(nursery, tmp_path, "a", recordings[0], more='mode = "router"')
        b, c = (
            Robot(nursery, tmp_path, name, recording, (a.port,), more='mode = "client"')
            for name, recording in zip("bc", recordings[1:], strict=True)
        )
        with running(a, b, c):
            for robot in (a, b, c):
                robot.start("--speed", 20, "--wait-for", 2)  # b and c are in each other's reach
            assert until(lambda: agreed(a, b, c, authors=3), "agreement")

    def test_a_partition_heals(
        self, nursery: Nursery, tmp_path: Path, recordings: list[Path]
    ) -> None:
        a = Robot(nursery, tmp_path, "a", recordings[0])
        proxy = Proxy(a.port)
        b = Robot(nursery, tmp_path, "b", recordings[1], (proxy.port,))
        with running(a, b):
            a.start("--speed", 2, "--wait-for", 1)
            b.start("--speed", 2, "--wait-for", 1)
            until(lambda: all(r.status().get("cycles", 0) >= 2 for r in (a, b)), "both to begin")
            proxy.cut()
            until(lambda: all(r.answer()["cycles"] == 8 for r in (a, b)), "both to end")
            until(lambda: not any(r.answer()["lag"]["to_issue"] for r in (a, b)))
            apart = [robot.answer() for robot in (a, b)]
            assert apart[0]["digest"] != apart[1]["digest"]
            proxy.heal()
            together = until(lambda: agreed(a, b, authors=2), "agreement")
            assert together[0]["transactions"] > max(answer["transactions"] for answer in apart)
        proxy.close()

    @pytest.mark.parametrize("heals", [True, False])
    def test_a_stalled_link_does_not_hold_up_the_slam(
        self, nursery: Nursery, tmp_path: Path, heals: bool
    ) -> None:
        a = Robot(nursery, tmp_path, "a", record_much(tmp_path / "long.npz", count=60))
        b = Robot(nursery, tmp_path, "b")
        proxy = Proxy(b.port)
        a.connect = (proxy.port,)
        a.more = f"send_bytes = {1 << 16}"

        def held_up() -> bool:
            now = a.answer()
            return now["lag"]["unsent_bytes"] > 0 or now["traffic"]["dropped"]["sent"] > 0

        with running(a, b):
            b.start()
            until(b.status, "b")
            a.start("--speed", 20, "--wait-for", 1)
            until(lambda: a.answer()["cycles"] > 0, "a to begin")
            proxy.flowing.clear()  # a link that is stuck for ten seconds is closed
            until(held_up, "what a sends to be held up")
            until(lambda: a.answer()["cycles"] == 60, "the SLAM to end nevertheless")
            stalled = a.answer()
            assert b.answer()["transactions"] < stalled["transactions"]
            if heals:
                proxy.flowing.set()
                until(lambda: agreed(a, b, authors=1), "agreement")
                assert b.answer()["transactions"] >= stalled["transactions"]
            assert a.stop() == 0  # also while the link is stuck
        proxy.close()

    def test_stopping_is_graceful_and_a_second_signal_is_immediate(
        self, nursery: Nursery, tmp_path: Path, recordings: list[Path]
    ) -> None:
        (a,) = fleet_of(nursery, tmp_path, recordings[:1])
        with running(a):
            for number in (signal.SIGINT, signal.SIGTERM):
                a.start("--speed", 20)
                until(lambda: a.status().get("transactions", 0) > 0)
                a.signal(number)
                assert a.wait() == 0
                assert not Path(a.socket).exists()
                assert not list(a.data.glob("*-wal"))  # the ledger was closed
            assert a.restored().digest().hex() in a.said


class TestStrangers:
    def test_garbage_on_the_wire(
        self, nursery: Nursery, tmp_path: Path, recordings: list[Path]
    ) -> None:
        a, b = robots = fleet_of(nursery, tmp_path, recordings[:2])
        zenoh, rng = load_zenoh(), random.Random(5)
        fleet = Config(fleet="test").fleet_id.hex()
        with running(*robots):
            for robot in robots:
                robot.start("--speed", 4, "--wait-for", 1)
            author = until(a.status, "a")["author"]
            with stranger(zenoh, a.port, fleet) as session:
                junk = [rng.randbytes(rng.randrange(1, 2000)) for _ in range(100)]
                junk += [b"", b"DM", bytes(MAX_MESSAGE), bytes(1 << 20)]
                junk += list(mutants(rng, a))
                for data in junk:
                    for key in ("all", f"to/{author}", f"to/{author}/deeper", "all/x"):
                        session.put(f"dagmap/{fleet}/{key}", data)
                session.delete(f"dagmap/{fleet}/all")
                session.liveliness().declare_token(f"dagmap/{fleet}/here/not-an-author")
                answers = until(
                    lambda: b.status().get("cycles") == 8 and agreed(a, b, authors=2), "agreement"
                )
            refused = answers[0]["refused"]
            assert refused["truncated"] > 0 and refused["checksum does not match"] > 100
            assert [a.stop(), b.stop()] == [0, 0]
        lines = [line for line in a.log.splitlines() if "event=refused" in line]
        assert 0 < len(lines) < 20  # whoever sends junk does not fill the disk with lines

    def test_another_fleet_is_neither_heard_nor_told(
        self, nursery: Nursery, tmp_path: Path, recordings: list[Path]
    ) -> None:
        a = Robot(nursery, tmp_path, "a", recordings[0])
        other = Robot(nursery, tmp_path, "other", recordings[1], (a.port,), fleet="pirates")
        with running(a, other):
            a.start("--speed", 20)
            other.start("--speed", 20)
            until(lambda: a.status().get("cycles") == 8 and other.status().get("cycles") == 8)
            time.sleep(0.5)  # two announcements
            for robot in (a, other):
                answer = robot.status()
                assert len(answer["heads"]) == 1 and answer["peers"] == {}
                assert answer["traffic"]["received"] == {}

    def test_other_parameters_are_told_so_plainly(
        self, nursery: Nursery, tmp_path: Path, recordings: list[Path]
    ) -> None:
        a = Robot(nursery, tmp_path, "a", recordings[0])
        other = Robot(nursery, tmp_path, "other", recordings[1], (a.port,))
        other.parameters = PARAMETERS + "[fold]\ndelta = 0.07\n"
        with running(a, other):
            a.start("--speed", 20)
            other.start("--speed", 20)
            until(lambda: "make [fold], [transaction]" in a.log + other.log)
            until(lambda: "make [fold], [transaction]" in other.log and "make [fold]" in a.log)
            assert len(a.answer()["heads"]) == len(other.answer()["heads"]) == 1


class TestStatus:
    def test_people_see_who_is_where(
        self,
        nursery: Nursery,
        tmp_path: Path,
        recordings: list[Path],
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        a, b = robots = fleet_of(nursery, tmp_path, recordings[:2])
        with running(*robots):
            for robot in robots:
                robot.start("--speed", 20)
            until(lambda: all(robot.status().get("cycles") == 8 for robot in robots))
            answers = until(lambda: agreed(a, b, authors=2), "agreement")
            until(lambda: a.answer()["peers"][answers[1]["author"]]["delay_ms"] is not None)
            show_status(a.file, as_json=False)
            show_status(Path(a.socket), as_json=True)
        shown = capsys.readouterr().out
        assert answers[0]["digest"] in shown and "itself" in shown and " ms " in shown
        assert "% of a cycle of " in shown and "N_c 2" in shown
        assert '"name": "b"' in shown


def stranger(zenoh: object, port: int, fleet: str):  # type: ignore[no-untyped-def]
    """A Zenoh session of somebody who knows the port and the key space."""
    config = zenoh.Config()  # type: ignore[attr-defined]
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{port}"]')
    return zenoh.open(config)  # type: ignore[attr-defined]


def mutants(rng: random.Random, robot: Robot):  # type: ignore[no-untyped-def]
    """Messages of the fleet with some bytes changed, and true ones that make no sense."""
    from dagmap.io.settings import load_settings

    config = load_settings(robot.file).config
    huge = encode(Want(((bytes(8), 0, 1 << 40),), (bytes(32),) * 1000), config, b"stranger")
    heads = encode(Heads(1 << 40, (), ()), config, b"stranger")
    yield from (huge, heads)
    for _ in range(200):
        data = bytearray(rng.choice((huge, heads)))
        for _ in range(rng.randrange(1, 4)):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        yield bytes(data)
