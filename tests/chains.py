"""Transactions made by hand, honest or not, for the tests of ledger, messages and sync."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np

from dagmap.config import Config, TransactionConfig
from dagmap.identity import Identity
from dagmap.model import quantise_pose
from dagmap.payload import Anchor, Bundle, Payload, Revocation
from dagmap.transaction import Transaction, parse, seal

CONFIG = Config(transaction=TransactionConfig(proof_of_work_bits=0))
FLEET_KEY = "the fleet's own key"


def identity(name: str) -> Identity:
    return Identity.from_seed(name.encode().ljust(32, b"."))


def closed(config: Config = CONFIG, key: str = FLEET_KEY) -> Config:
    """The same parameters in a fleet that is closed by this key."""
    return msgspec.structs.replace(config, fleet_key=identity(key).public_key.hex())


def enrolled(name: str, config: Config, key: str = FLEET_KEY) -> Identity:
    """A robot that holds a certificate of the fleet key."""
    public_key = identity(name).public_key
    certificate = identity(key).certify(config.fleet_id, public_key, name)
    return Identity.from_seed(name.encode().ljust(32, b"."), certificate)


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
        certified = config.closed and name != FLEET_KEY
        self.identity = enrolled(name, config) if certified else identity(name)
        self.config = config
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
        if not chain:
            payload = replace(payload, certificate=self.identity.certificate)
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

    def revoke(self, count: int, *authors: Author, **more: object) -> Transaction:
        """As the fleet key: of these authors the first `count` transactions count."""
        gone = tuple(Revocation(author.identity.author, count) for author in authors)
        return self.make(payload=Payload(revocations=gone), **more)  # type: ignore[arg-type]
