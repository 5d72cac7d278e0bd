"""Agents of one process judge the same bytes alike, so the judgement is made once."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import fields
from operator import attrgetter
from typing import Generic, TypeVar

from .. import messages, transaction
from ..config import Config
from ..messages import Parsers
from ..transaction import Transaction
from ..wire import Refusal

T = TypeVar("T")
_fields = attrgetter(*(field.name for field in fields(Transaction)))
_KEPT = 1 << 15  # results; what is older is simply judged again


class _Memo(Generic[T]):
    """A pure function of bytes that remembers results and refusals. One fleet's config only."""

    def __init__(self, judge: Callable[[bytes, Config], T]) -> None:
        self._judge = judge
        self._known: OrderedDict[bytes, T | Refusal] = OrderedDict()

    def __call__(self, data: bytes, config: Config) -> T:
        found = self._known.get(data)
        if found is None:
            try:
                found = self._judge(data, config)
            except Refusal as refusal:
                found = refusal
            self._known[data] = found
            if len(self._known) > _KEPT:
                self._known.popitem(last=False)
        if isinstance(found, Refusal):
            raise found.with_traceback(None)
        return found


class _Shared(Transaction):
    """A transaction in the hands of several agents."""

    __slots__ = ()

    def drop_columns(self) -> None:
        """The others may not have placed its features yet; one copy serves all of them."""


def _parse_shared(data: bytes, config: Config) -> Transaction:
    return _Shared(*_fields(transaction.parse_worked(data, config)))


class SharedParsers:
    """Parsers for the agents of one fleet: each message and transaction is parsed once."""

    def __init__(self) -> None:
        self.parsers = Parsers(
            _Memo(messages.parse), _Memo(transaction.worked), _Memo(_parse_shared)
        )
