"""The map after any number of transactions: the ledger folded up to there, in canonical order.

Forward costs what is new. Backward starts at the last mark before, a folded state that was kept
when the fold came by; so a slider can be dragged both ways.
"""

from __future__ import annotations

from collections.abc import Sequence

from ...agent import Agent
from ...config import Config
from ...identity import Identity
from ...transaction import id_of
from .source import Progress

MARKS = 16  # folded states that are kept, evenly over the ledger
MOST_BYTES = 512 << 20  # of them all
_STEP = 64  # transactions that are folded between two words on the progress


def silent(share: float) -> None:
    """No word on the progress."""


class History:
    """transactions: bytes, in canonical order, of those that count. identity: of the looker-on."""

    def __init__(
        self, config: Config, identity: Identity, transactions: Sequence[bytes] = ()
    ) -> None:
        self._config, self._identity = config, identity
        self._transactions = list(transactions)
        self._agent, self._position = Agent(identity, config), 0
        self._marks: dict[int, bytes] = {}

    def __len__(self) -> int:
        return len(self._transactions)

    def follow(self, transactions: Sequence[bytes]) -> None:
        """The ledger as it is now. What came in between others makes later marks worthless."""
        pairs = zip(self._transactions, transactions, strict=False)
        same = next((i for i, (a, b) in enumerate(pairs) if a is not b and a != b), None)
        if same is None:
            same = min(len(self._transactions), len(transactions))
        self._transactions = list(transactions)
        self._marks = {at: mark for at, mark in self._marks.items() if at <= same}
        if self._position > same:
            self._restart(0)

    def agent_at(self, count: int, progress: Progress = silent) -> Agent:
        """A participant that holds the first `count` transactions, folded."""
        count = max(0, min(count, len(self)))
        if count < self._position:
            self._restart(count)
        begin = self._position
        while self._position < count:
            end = min(count, self._position + _STEP, self._next_mark())
            for data in self._transactions[self._position : end]:
                self._agent.take(data)
            self._position = end
            self._agent.consensus.advance()
            self._mark()
            progress((end - begin) / (count - begin))
        return self._agent

    @property
    def _spacing(self) -> int:
        return max(1, -(-len(self) // MARKS))

    def _next_mark(self) -> int:
        return (self._position // self._spacing + 1) * self._spacing

    def _mark(self) -> None:
        """Keep the state here, where a mark is due and there is room."""
        held = sum(map(len, self._marks.values()))
        room = held + self._agent.consensus.nbytes <= MOST_BYTES
        due = self._position % self._spacing == 0 and self._position not in self._marks
        if due and room and len(self._marks) < 2 * MARKS:
            self._marks[self._position] = self._agent.checkpoint(self._ids(self._position))

    def _restart(self, count: int) -> None:
        """Go back to the last mark that is not after `count`."""
        at = max((at for at in self._marks if at <= count), default=0)
        self._agent = Agent.restore(
            self._identity, self._config, self._transactions[:at], checkpoint=self._marks.get(at)
        )
        self._position = at

    def _ids(self, count: int) -> list[bytes]:
        return [id_of(data) for data in self._transactions[:count]]
