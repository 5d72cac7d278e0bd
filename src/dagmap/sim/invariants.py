"""What must hold after every event of every run. `Violation` says what did not."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from ..agent import Agent
from ..consensus import Consensus
from ..graph import AdjacencyDag
from ..identity import signature_holds
from ..model import AuthorId, Bools, Int64s, Issued, MapChanged, State, TransactionId
from ..transaction import Transaction, signed_part
from .fleet import Fleet
from .robot import Happening, Observed, Robot
from .truth import transactions_anew

# What a robot may hold at most, stated here once more and not taken from the code that is checked.
_PEERS = 256  # other robots
_HEADS = 1800  # of one of them
_ASKED = 3600  # chains that were asked about
_SENT = 64  # announcements that may be echoed
_STORM = 4000  # events of one robot in a simulated second: beyond, they never end
_EVERY = 200  # events of a robot between two folds from scratch
_CHANGES = 8  # of a robot's map, between two looks at its witnesses
_MOST = np.iinfo(np.int64).max


class Violation(Exception):
    """A promise was broken: which one, by which robot, when."""

    def __init__(self, name: str, robot: str, at: float, detail: object) -> None:
        super().__init__(f"{name}: {robot} at {at:.3f} s: {detail}")
        self.name = name


@dataclass(slots=True)
class _Looked:
    """What of one robot's process was found good already."""

    agent: Agent
    events: int = 0
    changes: int = 0  # of the map
    held: int = 0  # transactions
    n_c: int = 0  # the largest so far
    chains: dict[AuthorId, int] = field(default_factory=dict)


class Invariants:
    """Call it after every event with the robot that it concerned, and `at_the_end` once.

    `saw` is told of everything that happens (a fleet's `on_event`).
    changes: of a robot's map, between two looks at who witnessed it; 1: every one is looked at.
    """

    def __init__(self, changes: int = _CHANGES) -> None:
        self.fleet: Fleet | None = None
        self._changes = changes
        self._looked: dict[str, _Looked] = {}
        self._grown: set[str] = set()  # robots whose graph may have changed
        self._folded: set[str] = set()  # robots whose map has changed
        self._signed: set[TransactionId] = set()
        self._robot = ""
        self._second = 0  # of simulated time
        self._busy: Counter[str] = Counter()  # events in it

    def saw(self, robot: Robot, happening: Happening) -> None:
        if isinstance(happening, Observed | Issued):
            self._grown.add(robot.name)
        elif isinstance(happening, MapChanged):
            self._folded.add(robot.name)

    def __call__(self, robot: Robot) -> None:
        self._robot = robot.name
        self._storm()
        if not robot.honest:
            return
        looked = self._looked.get(robot.name)
        if looked is None or looked.agent is not robot.agent:  # it was restarted
            self._nothing_lost(robot)
            looked = self._looked[robot.name] = _Looked(robot.agent)
        looked.events += 1
        self._bounds(robot.agent)
        self._ledger(robot.agent, looked)
        n_c = robot.agent.steering.controller.n_c  # what the graph is told to keep to
        looked.n_c = max(looked.n_c, n_c)
        self._require(n_c <= robot.agent.config.graph.n_c_max, "N_c is too large", n_c)
        if robot.name in self._grown:
            self._grown.discard(robot.name)
            self._graph(robot.agent.observing.graph, n_c, looked.n_c)
        if looked.events % _EVERY == 0:
            self._fold(robot.agent)
        if robot.name in self._folded and robot.agent.settled:  # to look folds on, else
            self._folded.discard(robot.name)
            looked.changes += 1
            if looked.changes % self._changes == 0:
                self._witnesses(robot.agent)

    def at_the_end(self, honest: list[Robot]) -> None:
        """The fleet had its time to agree."""
        digests = {}
        for robot in honest:
            self._robot = robot.name
            digests[robot.name] = robot.agent.digest()
            self._withdrawn(robot, honest)
            chain = honest[0].agent.ledger.chain(robot.author)
            self._require(
                {tx.id for tx in chain.main} == robot.own,
                "a transaction was forgotten",
                f"{honest[0].name} does not hold what {robot.name} issued",
            )
            self._require(chain.cut is None, "an honest robot was cut", robot.name)
        self._fold(honest[0].agent)
        self._require(
            len(set(digests.values())) == 1,
            "the maps differ",
            ", ".join(f"{name} {digest.hex()[:8]}" for name, digest in digests.items()),
        )

    def _require(self, holds: bool, name: str, detail: object) -> None:
        if not holds:
            now = self.fleet.now if self.fleet is not None else 0.0
            raise Violation(name, self._robot, now, detail)

    def _storm(self) -> None:
        """Messages may cause messages, but not more and more of them: the run would never end."""
        second = int(self.fleet.now) if self.fleet is not None else 0
        if second != self._second:
            self._second = second
            self._busy.clear()
        self._busy[self._robot] += 1
        count = self._busy[self._robot]
        self._require(count <= _STORM, "a storm", f"{count} events within a second")

    def _nothing_lost(self, robot: Robot) -> None:
        """What was stored and told of is there after a restart, and the own chain goes on."""
        held = {tx.id for tx in robot.agent.ledger}
        told = self._told_of(robot)
        self._require(told <= held, "a restart lost what others hold", f"{len(told - held)} lost")

    def _told_of(self, robot: Robot) -> set[TransactionId]:
        """Transactions of a robot that others hold."""
        others = self.fleet.robots.values() if self.fleet is not None else ()
        return {
            tx.id
            for other in others
            if other is not robot and other.up
            for tx in other.agent.ledger.chain(robot.author).main
        } & robot.own

    def _bounds(self, agent: Agent) -> None:
        """Nothing that others can fill grows without end."""
        limits, sizes = agent.config.ledger, agent.ledger.sizes()
        self._require(sizes.waiting <= limits.waiting_transactions, "memory", sizes)
        self._require(sizes.waiting_bytes <= limits.waiting_bytes, "memory", sizes)
        left = sizes.waiting_bytes or sizes.waited_for
        self._require(bool(sizes.waiting) or not left, "memory", sizes)
        ids = limits.waiting_transactions * (agent.config.transaction.max_references + 1)
        most_of = {"peers": _PEERS, "_asked": _ASKED, "_sent_at": _SENT, "_asked_ids": ids}
        for name, most in most_of.items():
            size = len(getattr(agent.sync, name))
            self._require(size <= most, "memory", f"{name}: {size}, at most {most}")
        heads = max((len(peer.heads) for peer in agent.sync.peers.values()), default=0)
        self._require(heads <= _HEADS, "memory", f"heads of a peer: {heads}")

    def _ledger(self, agent: Agent, looked: _Looked) -> None:
        """Chains are unbroken, dated as they must be, and signed; nothing leaves."""
        ledger = agent.ledger
        self._require(len(ledger) >= looked.held, "a transaction was forgotten", len(ledger))
        looked.held = len(ledger)
        for author, chain in ledger.chains.items():
            first = looked.chains.get(author, 0)
            self._require(len(chain.main) >= first, "a transaction was forgotten", author.hex())
            for i in range(first, len(chain.main)):
                self._transaction(agent, chain.main, i, author)
            looked.chains[author] = len(chain.main)

    def _transaction(self, agent: Agent, main: list[Transaction], i: int, author: AuthorId) -> None:
        tx = main[i]
        previous = main[i - 1].id if i else None
        unbroken = tx.author == author and tx.sequence == i and tx.previous == previous
        self._require(unbroken, "a chain is broken", tx)
        known = [agent.ledger.find(id_) for id_ in tx.refers_to]
        dates = [other.lamport for other in known if other is not None]
        self._require(len(dates) == len(known), "a reference is unknown", tx)
        self._require(tx.lamport == 1 + max(dates, default=0), "a Lamport time is false", tx)
        if tx.id not in self._signed:
            signature, signed = tx.data[-64:], signed_part(tx.data, agent.config)
            holds = signature_holds(tx.data[1:33], signature, signed)
            self._require(holds, "a signature is false", tx)
            self._signed.add(tx.id)

    def _graph(self, graph: AdjacencyDag, n_c: int, largest: int) -> None:
        """Acyclic, at most N_c children, E as it must be, validity the sum of the parents'.

        n_c: now; largest: that it ever was, since what was inserted under it stays.
        """
        parents, taken = graph.parents(), graph.parents_taken()
        ids, here = np.arange(len(graph)), graph.alive() | graph.issued()
        self._each(np.all(parents < ids[:, None], axis=1), "the graph has a cycle")
        counted = np.bincount(parents[parents >= 0], minlength=len(graph))
        children = graph.children_count()
        self._each((counted == children) | ~here, "children are miscounted")
        self._each(children <= largest, "too many children")
        found, wanted = graph.terminals(), np.flatnonzero(graph.alive() & (counted < n_c))
        if not np.array_equal(found, wanted):
            self._require(False, "E is wrong", f"of {np.setxor1d(found, wanted)[:5].tolist()}")
        sums = self._validity(graph, parents, taken)
        self._each((graph.validity() == sums) | ~here, "validity")

    def _each(self, good: Bools, name: str) -> None:
        """It must hold of every feature; else the first that breaks it is named."""
        if not good.all():
            self._require(False, name, f"feature {int(good.argmin())} of {len(good)}")

    @staticmethod
    def _validity(graph: AdjacencyDag, parents: Int64s, taken: Int64s) -> Int64s:
        """Eq. (1) from the parents' values, saturating."""
        values = graph.validity()
        of_features = np.where(parents >= 0, values[parents], 0).astype(object).sum(axis=1)
        lattice = taken - (parents >= 0).sum(axis=1)
        sums = np.minimum(of_features + lattice, _MOST)
        return np.asarray(np.where(taken == 0, 1, sums), np.int64)

    def _fold(self, agent: Agent) -> None:
        """The fold is that of the set from scratch."""
        scratch = Consensus(agent.config)
        for tx in transactions_anew(agent):
            scratch.add(tx)
        alike = agent.digest() == scratch.digest()
        held = f"of {len(agent.ledger)} transactions"
        self._require(alike, "the fold is not that of the set", held)
        self._witnesses(agent)

    def _witnesses(self, agent: Agent) -> None:
        """Nothing is confirmed without witnesses, counted here from what each author observed."""
        world = agent.map
        seen = np.zeros(len(world), np.int64)
        for _, author in sorted(agent.consensus.authors.items()):
            nodes = agent.consensus.folded.feature_nodes(world.origin, author.index)
            seen[np.unique(nodes[nodes >= 0])] += 1
        self._require(np.array_equal(world.witnesses, seen), "witnesses are miscounted", world)
        few = seen < agent.config.fold.witnesses
        self._require(
            not bool((few & (world.states == State.CONFIRMED)).any()),
            "confirmed without witnesses",
            world,
        )

    def _withdrawn(self, robot: Robot, honest: list[Robot]) -> None:
        """What a robot's SLAM has withdrawn is in nobody's map."""
        if not len(robot.withdrawn):
            return
        for other in honest:
            fold = other.agent.consensus
            nodes = fold.folded.feature_nodes(
                other.agent.map.origin, fold.author(robot.author).index
            )
            numbers = np.array(sorted(robot.withdrawn), np.int64)
            alive = nodes[numbers[numbers < len(nodes)]] >= 0
            self._require(
                not bool(alive.any()),
                "a retraction was lost",
                f"{other.name} holds {int(alive.sum())} points that {robot.name} withdrew",
            )
