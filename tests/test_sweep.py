"""Sweeps: nothing breaks over many seeds, and each planted bug is found and cut down."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from dagmap import fold, graph, ledger, transaction
from dagmap.consensus import Consensus
from dagmap.contribution import Author
from dagmap.kernels import lattice
from dagmap.ledger import Ledger
from dagmap.model import Int32s
from dagmap.sim.scenario import Scenario, load_scenario
from dagmap.sim.sweep import Failure, attempt, minimised, sweep, timeline_of

FOLDER = Path(__file__).parents[1] / "scenarios"
NAMES = ["wifi", "crashes", "partitions", "reach", "liars", "loops"]


def scenario(name: str) -> Scenario:
    return load_scenario(FOLDER / f"{name}.toml")


@pytest.mark.parametrize("name", NAMES)
def test_no_promise_is_broken(name: str) -> None:
    """A slice of `make sweep`."""
    failure = sweep([scenario(name)], range(9000, 9006))
    assert failure is None, failure


# Planted bugs: each is switched on alone, and the sweep must find it.

Plant = Callable[[pytest.MonkeyPatch], None]


def arrival_order(patch: pytest.MonkeyPatch) -> None:
    """The fold takes transactions as they come."""
    add = Consensus.add

    def in_order_of_arrival(self: Consensus, tx: transaction.Transaction) -> None:
        add(self, tx)
        self._order.remove(tx.key)
        self._order.append(tx.key)
        self._mark = None

    patch.setattr(Consensus, "add", in_order_of_arrival)


def lost_retraction(patch: pytest.MonkeyPatch) -> None:
    """A withdrawn point stays in the map."""
    patch.setattr(Author, "retract", lambda self, numbers: [])


def unchecked_lamport(patch: pytest.MonkeyPatch) -> None:
    """A transaction may claim any Lamport time."""
    judge = Ledger._judge

    def lenient(self: Ledger, tx: transaction.Transaction) -> object:
        refusal = judge(self, tx)
        lie = refusal is not None and refusal.reason is ledger.Reason.LAMPORT
        return None if lie else refusal

    patch.setattr(Ledger, "_judge", lenient)


def one_child_too_many(patch: pytest.MonkeyPatch) -> None:
    """Nodes leave the terminals one child too late."""
    make = graph.AdjacencyDag.__init__

    def off_by_one(self: graph.AdjacencyDag, config: graph.GraphConfig, salt: int = 0) -> None:
        make(self, config, salt)
        self._numbers[lattice.N_C] += 1

    patch.setattr(graph.AdjacencyDag, "__init__", off_by_one)
    # who steers N_c sets it to what it is anyway, and would mend the bug
    kept = property(graph.AdjacencyDag.n_c.fget, lambda self, value: None)
    patch.setattr(graph.AdjacencyDag, "n_c", kept)


def unchecked_signature(patch: pytest.MonkeyPatch) -> None:
    """Whoever signs, the transaction is taken for the named author's."""
    patch.setattr(transaction, "signature_holds", lambda key, signature, message: True)


def one_witness_too_many(patch: pytest.MonkeyPatch) -> None:
    """Every node counts one robot more than saw it."""
    verdict = fold.verdict_of

    def generous(hits: Int32s, misses: Int32s, witnesses: Int32s, wanted: int) -> fold.Verdict:
        return verdict(hits, misses, witnesses + 1, wanted)

    patch.setattr(fold, "verdict_of", generous)


def endless_waiting_room(patch: pytest.MonkeyPatch) -> None:
    """The waiting room has another limit than the one that is configured."""
    wait = Ledger._wait

    def patient(self: Ledger, tx: transaction.Transaction, missing: tuple[bytes, ...]) -> None:
        config = self.config
        more = msgspec.structs.replace(config.ledger, waiting_transactions=1 << 20)
        self.config = msgspec.structs.replace(config, ledger=more)
        wait(self, tx, missing)
        self.config = config

    patch.setattr(Ledger, "_wait", patient)


def forgetful_waiting_room(patch: pytest.MonkeyPatch) -> None:
    """The bytes of what has left the waiting room go on counting."""
    leave = Ledger._leave

    def careless(self: Ledger, id_: bytes) -> transaction.Transaction:
        tx = leave(self, id_)
        self._waiting_size += len(tx.data)
        return tx

    patch.setattr(Ledger, "_leave", careless)


BUGS: dict[str, tuple[Plant, Callable[[], Scenario], str]] = {
    "arrival order": (arrival_order, lambda: scenario("wifi"), "the fold is not that of the set"),
    "lost retraction": (lost_retraction, lambda: scenario("loops"), "a retraction was lost"),
    "Lamport time": (unchecked_lamport, lambda: scenario("liars"), "a Lamport time is false"),
    "N_c": (one_child_too_many, lambda: scenario("wifi"), "E is wrong"),
    "signature": (unchecked_signature, lambda: scenario("liars"), "a signature is false"),
    "witness": (one_witness_too_many, lambda: scenario("wifi"), "witnesses are miscounted"),
    "endless room": (endless_waiting_room, lambda: scenario("liars"), "memory"),
    "forgetful room": (forgetful_waiting_room, lambda: scenario("wifi"), "memory"),
}


@pytest.mark.parametrize("bug", BUGS)
def test_a_planted_bug_is_found(bug: str, monkeypatch: pytest.MonkeyPatch) -> None:
    plant, make, promise = BUGS[bug]
    plant(monkeypatch)
    failure = sweep([make()], range(2000))
    assert failure is not None and failure.name == promise
    monkeypatch.undo()
    assert attempt(failure.scenario, failure.seed) is None, "the bug, not the scenario"


def test_a_failure_is_cut_down(monkeypatch: pytest.MonkeyPatch) -> None:
    one_child_too_many(monkeypatch)
    failure = sweep([scenario("wifi")], range(50))
    assert failure is not None
    small = minimised(failure)
    assert small.name == failure.name and small.timeline < failure.timeline
    assert small.scenario.robots <= 2 and small.scenario.seconds < failure.scenario.seconds
    again = attempt(small.scenario, small.seed)
    assert again == small, "it stands for itself"
    assert len(timeline_of(small.scenario, small.seed)) == small.timeline


def test_the_first_failure_does_not_depend_on_the_number_of_processes() -> None:
    hopeless = msgspec.structs.replace(scenario("wifi"), patience=0.001, seconds=2.0)
    first, second = (sweep([hopeless], range(4), jobs) for jobs in (1, 2))
    assert isinstance(first, Failure) and first == second
    assert first.name == "no agreement" and np.isfinite(first.at)
