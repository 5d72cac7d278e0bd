"""What joining and repairing cost on the network, counted where the bytes pass."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from dagmap import Agent, Identity
from dagmap.io.data_folder import load_identity
from dagmap.io.settings import load_settings
from dagmap.io.store import Store
from dagmap.transaction import id_of
from robots import Nursery, Robot, agreed, plain, running, until
from scene import agent as scene_agent

AUTHORS, CYCLES = 4, 60


@pytest.fixture(scope="module")
def ledger(tmp_path_factory: pytest.TempPathFactory, nursery: Nursery) -> list[bytes]:
    """Transactions of four robots that heard each other, each after what it refers to."""
    folder = tmp_path_factory.mktemp("mission")
    config = load_settings(Robot(nursery, folder, "any").write()).config
    fleet: list[Agent] = [scene_agent(f"author{i}", config) for i in range(AUTHORS)]
    walks = [plain(i, count=CYCLES, points=150) for i in range(AUTHORS)]
    for step in range(CYCLES):
        for agent, walk in zip(fleet, walks, strict=True):
            agent.observe(next(walk), float(step))
            for out in agent.outbox():
                for other in fleet:
                    if other is not agent:
                        other.receive(out.data, float(step))
    return [tx.data for tx in fleet[0].ledger]


def fill(robot: Robot, transactions: list[bytes]) -> Identity:
    """Give a robot that has not started yet this ledger."""
    settings = load_settings(robot.write())
    robot.data.mkdir(mode=0o700)
    identity = load_identity(robot.data)
    with Store.open(robot.ledger, settings.config.fleet_id, identity.author) as store:
        store.append_many((id_of(data), data) for data in transactions)
    return identity


def everything(answer: dict[str, Any]) -> float:
    """Bytes of all messages that one robot sent and got.

    Announcements come by the clock, as many more as a machine is slower: two each way are counted,
    by which what is missing is found and agreement is seen.
    """
    tables = [answer["traffic"][way] for way in ("sent", "received")]
    spent = sum(row["bytes"] for table in tables for row in table.values())
    heads = [table["heads"] for table in tables]
    beyond = (row["bytes"] * max(0.0, 1 - 2 / row["messages"]) for row in heads)
    return float(spent - sum(beyond))


def cost(nursery: Nursery, folder: Path, held: list[bytes], all_: list[bytes]) -> float:
    """Bytes over the connection until a robot that holds the one list holds the other."""
    giver, taker = Robot(nursery, folder, "giver"), Robot(nursery, folder, "taker")
    calm = giver.parameters.replace("announce_period = 0.2", "announce_period = 1.0")
    calm = calm.replace("retry_period = 0.5", "retry_period = 10.0")  # a slow machine is no loss
    giver.parameters = taker.parameters = calm
    taker.connect = (giver.port,)
    fill(giver, all_)
    fill(taker, held)
    with running(giver, taker):
        giver.start()
        until(giver.status, "the giver")
        taker.start()
        _, answer = until(lambda: agreed(giver, taker, authors=AUTHORS), "agreement")
        assert answer["transactions"] == len(all_)
    return everything(answer)


class TestBytes:
    def test_a_join_costs_a_tenth_more_than_the_ledger(
        self, nursery: Nursery, tmp_path: Path, ledger: list[bytes]
    ) -> None:
        size = sum(map(len, ledger))
        assert size > 200_000
        spent = cost(nursery, tmp_path, [], ledger)
        assert size < spent <= 1.10 * size

    def test_repair_costs_what_is_missing(
        self, nursery: Nursery, tmp_path: Path, ledger: list[bytes]
    ) -> None:
        for i, missing in enumerate((1, 10, 60)):
            folder = tmp_path / str(i)
            folder.mkdir()
            size = sum(map(len, ledger[-missing:]))
            spent = cost(nursery, folder, ledger[:-missing], ledger)
            assert size < spent <= 1.2 * size + 200 * AUTHORS, (missing, spent, size)
