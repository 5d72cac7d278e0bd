"""Transactions made by hand, honest or not, for the tests of ledger, messages and sync."""

from __future__ import annotations

import numpy as np

from dagmap.config import Config, TransactionConfig
from dagmap.identity import Identity
from dagmap.model import quantise_pose
from dagmap.payload import Anchor, Bundle, Payload
from dagmap.transaction import Transaction, parse, seal

CONFIG = Config(transaction=TransactionConfig(proof_of_work_bits=0))


def identity(name: str) -> Identity:
    return Identity.from_seed(name.encode().ljust(32, b"."))


def bundle(base: int, count: int, cycle: int = 0, parents: np.ndarray | None = None) -> Bundle:
    position = (np.arange(3 * count).reshape(count, 3) * 40 + base).astype(np.int32)
    if parents is None:
        parents = np.full((count, 2), -1, np.int64)
    color = np.zeros((count, 3), np.uint8)
    starts, cycles = np.array([0, count], np.int64), np.array([cycle], np.int64)
    return Bundle(base, position, parents, color, starts, cycles, np.zeros(1, np.uint8))


def anchor(cycle: int, x: float = 0.0) -> Anchor:
    pose = np.eye(4)
    pose[0, 3] = x
    return Anchor(cycle, 0, 1_000_000 * cycle, quantise_pose(pose))


class Author:
    """Signs whatever it is told to, keeping count like an honest robot unless told otherwise."""

    def __init__(self, name: str, config: Config = CONFIG) -> None:
        self.identity, self.config = identity(name), config
        self.chain: list[Transaction] = []
        self.features = 0

    def make(
        self,
        *references: Transaction,
        features: int = 3,
        payload: Payload | None = None,
        lamport: int | None = None,
        after: list[Transaction] | None = None,
        keep: bool = True,
    ) -> Transaction:
        chain = self.chain if after is None else after
        before = sum(tx.features for tx in chain)
        if payload is None:
            cycle = len(chain)
            payload = Payload(
                anchors=(anchor(cycle),),
                bundle=bundle(before, features, cycle) if features else None,
            )
        previous = chain[-1] if chain else None
        known = [*references, *([previous] if previous else [])]
        time = 1 + max((tx.lamport for tx in known), default=0) if lamport is None else lamport
        ids = tuple(sorted(tx.id for tx in references))
        data = seal(
            self.identity,
            self.config,
            len(chain),
            previous.id if previous else None,
            time,
            ids,
            payload,
        )
        tx = parse(data, self.config)
        if keep and after is None:
            self.chain.append(tx)
        return tx
