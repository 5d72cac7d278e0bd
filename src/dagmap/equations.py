"""Section 5.1: the paper's model of the overhead, Equations (2) to (5), beside DAGmap's own.

Both are fitted to what was measured while running. They predict; what is decided from them decides
nothing that others depend on, so floating point will do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .model import Floats


@dataclass(slots=True)
class Work:
    """What was done: features, and transactions."""

    inserted: int = 0
    sent: int = 0
    merged: int = 0  # of other robots
    bundles: int = 0  # own transactions
    merges: int = 0  # transactions of others

    def since(self, before: Work) -> Work:
        """What was done after `before`."""
        return Work(
            self.inserted - before.inserted,
            self.sent - before.sent,
            self.merged - before.merged,
            self.bundles - before.bundles,
            self.merges - before.merges,
        )


class Size(NamedTuple):
    """What the paper's costs depend on."""

    n_u: int  # n(U)
    n_c: int  # N_c

    @property
    def levels(self) -> float:
        """log_Nc n(U)."""
        return math.log(max(self.n_u, 2)) / math.log(max(self.n_c, 2))


def t_insertion(size: Size, l_dist: float) -> float:
    """Eq. (3): s to insert a feature."""
    return size.n_u / size.levels * l_dist


def t_broadcast(size: Size, l_search: float) -> float:
    """Eq. (4): s to broadcast a transaction."""
    return math.pow(2.0, size.levels) * l_search


def t_merge(size: Size, l_dist: float, as_printed: bool = True) -> float:
    """Eq. (5): s to merge a transaction. Printed is 2^2 log n; meant, it seems, 2^(2 log n)."""
    ascendants = 4.0 * size.levels if as_printed else math.pow(2.0, 2.0 * size.levels)
    return (size.n_u + ascendants) * l_dist


class Fit:
    """Least squares as the observations come, older ones counting less and less."""

    def __init__(self, prior: Sequence[float], forget: float = 0.95) -> None:
        """prior: what the coefficients are taken for, weakly, before anything was measured."""
        self._prior, self._forget = np.array(prior, np.float64), forget
        self._weight = np.diag(1e-4 / self._prior**2)
        self._a = np.zeros((len(prior), len(prior)))
        self._b = np.zeros(len(prior))

    def add(self, row: Sequence[float], value: float) -> None:
        """An observation: the sum of coefficients times `row` was `value`."""
        a = np.array(row, np.float64) / max(value, 1e-9)  # errors are shares of what is measured
        self._a = self._forget * self._a + np.outer(a, a)
        self._b = self._forget * self._b + a

    @property
    def coefficients(self) -> Floats:
        """(k,) never below 0: nothing takes less than no time."""
        scale = self._prior  # the columns differ by orders of magnitude
        a = (self._a + self._weight) * np.outer(scale, scale)
        found = np.linalg.lstsq(a, (self._b + self._weight @ self._prior) * scale, rcond=None)[0]
        return np.asarray(np.maximum(found * scale, 0.0))


class Model:
    """S of a cycle, as the paper has it and as this implementation has it: see the module."""

    def __init__(self, as_printed: bool = True) -> None:
        """as_printed: which reading of Eq. (5)."""
        self._as_printed = as_printed
        self._paper = Fit((1e-9, 1e-9))
        self._own = Fit((5e-6, 5e-6, 5e-6))

    def add(self, work: Work, size: Size, seconds: float) -> None:
        """A cycle took so long."""
        self._paper.add(self._terms(work, size), seconds)
        self._own.add((work.inserted, work.sent, work.merged), seconds)

    @property
    def l_dist(self) -> float:
        """s for a distance of the paper's model, were it right."""
        return float(self._paper.coefficients[0])

    @property
    def l_search(self) -> float:
        """s for a step of the graph search of the paper's model, were it right."""
        return float(self._paper.coefficients[1])

    @property
    def costs(self) -> Floats:
        """(3,) s a feature that is inserted, sent, merged, whatever the size of the map."""
        return self._own.coefficients

    def paper(self, work: Work, size: Size) -> float:
        """S by Equations (2) to (5), s."""
        return float(np.dot(self._terms(work, size), self._paper.coefficients))

    def own(self, work: Work) -> float:
        """S by costs per feature, s."""
        return float(np.dot((work.inserted, work.sent, work.merged), self.costs))

    def _terms(self, work: Work, size: Size) -> tuple[float, float]:
        """Eq. (2), as multiples of l_dist and l_search. N_G N_tx is the transactions merged."""
        distances = work.inserted * t_insertion(size, 1.0)
        distances += work.merges * t_merge(size, 1.0, self._as_printed)
        return distances, work.bundles * t_broadcast(size, 1.0)
