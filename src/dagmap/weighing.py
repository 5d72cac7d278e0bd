"""Section 4.3, preset `default`: what speaks for a node against what speaks against it.

Logarithms are in sixteenths of a bit and whole, so that every machine weighs alike. How the weights
were found, and what was tried beside them: docs/quality.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .kernels.matching import AUTHOR, MOMENTS, NEXT, SEEN
from .model import Bools, Int32s, Int64s

SIXTEENTHS = 16
MOST_DOUBT = 36  # bits; what was found with the truth at hand, for a sensor that sees densely
_PRIOR = 16  # votes that must speak against that
_DENIED = 5  # votes of a node that its author's rays deny; one that they do not has one, against
# 256 * 2^(k / 16), rounded up, k from 1 to 15: where the fraction of a logarithm steps.
_STEPS = np.array(
    [268, 280, 292, 305, 318, 332, 347, 363, 379, 395, 413, 431, 450, 470, 491], np.int64
)
_SUPPORT, _DISTANCE, _PASSED, _HIDDEN, _RECORD = 6, 6, 1, 2, 2
_HALF = 1 << 20
_STRIDES = np.array([1 << 42, 1 << 21, 1], np.int64)
_CUBE = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3)
_PER_SHARE = 200  # the record counts in half percents
_BRIEF = 3  # moments: what was seen in fewer around a place speaks of what comes and goes
_LASTING = MOMENTS  # moments: what was seen in as many around it is not gone
_CROSSED = 62  # sixteenths of bits, 15 in all: see `crossed`
_TOGETHER = 4  # nodes of one moment that are crossed, in the cubes about a node


class Evidence(NamedTuple):
    """Of N nodes; each author's part in support, passed and hidden is bounded."""

    hits: Int32s  # (N,) see `fold.Verdict`
    witnesses: Int32s
    against: Int32s  # (N,) authors whose evidence speaks against the node, each at most miss_say
    distance: Int32s  # (N,) mm from the sensor that saw it first
    passed: Int32s  # (N,) transactions with rays through its cell
    ended: Int32s  # (N,) transactions with points in its cell
    hidden: Int32s  # (N,) ends that lie between that sensor and the node
    support: Int32s  # (N,) observations around the node, its own among them
    moments: Int32s  # (N,) in how many cycles those were made at least
    denied: Bools  # (E,) of an author in a node: more of its own rays pass there than end


def log2_16(values: npt.NDArray[np.integer]) -> Int64s:
    """Sixteen times the binary logarithm of numbers from 1 to 2^52, of their first nine bits."""
    numbers = np.asarray(values, np.int64)
    whole = np.frexp(numbers.astype(np.float64))[1].astype(np.int64) - 1  # exact below 2^53
    head = np.where(whole >= 8, numbers >> np.maximum(whole - 8, 0), numbers << (8 - whole).clip(0))
    return np.asarray(SIXTEENTHS * whole + np.searchsorted(_STEPS, head, side="right"), np.int64)


def lonely(found: Evidence) -> Bools:
    """(N,) whether nothing was seen around a node but itself, once, and something contradicts."""
    return np.asarray((found.support <= 1) & (found.against > 0))


def records(found: Evidence, first: Int32s, entries: Int32s, authors: int) -> Int64s:
    """(N,) what the word of the most reliable of a node's witnesses is discounted by.

    That is the share of its observations that are `lonely`, in sixteenths of bits, 0 for a clean
    record. first, entries: see `kernels.matching.Nodes`.
    """
    observed, discredited = np.zeros(authors, np.int64), np.zeros(authors, np.int64)
    np.add.at(observed, entries[:, AUTHOR], entries[:, SEEN])
    np.add.at(discredited, entries[first[lonely(found)], AUTHOR], 1)
    record = log2_16(_PER_SHARE * discredited // np.maximum(observed, 1) + 1)
    return _least(record, first, entries)


def doubts(
    found: Evidence, balance: Int64s, first: Int32s, entries: Int32s, authors: int
) -> Int64s:
    """(N,) what the balance of each node must exceed, sixteenths of bits: it is learned.

    How much lies around a real node depends on how densely its sensor sees. Where most of what is
    in the balance so low is real, its author has hardly ever looked through it. So an author is
    doubted up to the bits below which its own rays have denied more than a sixth of its nodes, by
    the most; up to `MOST_DOUBT` unless `_PRIOR` votes and more say otherwise. Nobody else's rays
    count, or they could make a robot doubted. Of a node's witnesses the one doubted least counts.
    """
    rung = ((balance - 1) // SIXTEENTHS).clip(0, MOST_DOUBT)
    sums = np.zeros((authors, MOST_DOUBT + 2), np.int64)  # from the second column on, by rungs
    for rows, at in _witnesses(first, entries):
        says = np.where(found.denied[at], _DENIED, -1)
        np.add.at(sums, (entries[at, AUTHOR], rung[rows] + 1), says)
    gain = np.cumsum(sums[:, :-1], axis=1)
    gain[:, MOST_DOUBT] += _PRIOR
    best = np.argmax(gain, axis=1)  # the first of equals
    return _least(SIXTEENTHS * best, first, entries)


def _least(of_author: Int64s, first: Int32s, entries: Int32s) -> Int64s:
    """(N,) the least of a value (A,) of authors among each node's witnesses."""
    best = np.full(len(first), np.iinfo(np.int64).max)
    for rows, at in _witnesses(first, entries):
        best[rows] = np.minimum(best[rows], of_author[entries[at, AUTHOR]])
    return best


def _witnesses(first: Int32s, entries: Int32s) -> Iterator[tuple[npt.NDArray[np.intp], Int32s]]:
    """Nodes and an entry of each: first the newest witnesses, then those before them."""
    rows, at = np.arange(len(first)), first
    while len(rows):
        yield rows, at
        at = entries[at, NEXT]
        rows, at = rows[at >= 0], at[at >= 0]


def blocks(seed: Int32s, edge: int) -> Int64s:
    """(N,) number of the cube of `edge` mm in which each seed (N, 3) lies, to be told apart from
    those of its neighbours; beyond 2^20 cubes from the origin all are one."""
    place = np.clip(seed.astype(np.int64) // edge, 2 - _HALF, _HALF - 2) + _HALF
    return np.asarray(place @ _STRIDES)


def crossed(found: Evidence, place: Int64s) -> Bools:
    """(N,) whether a node was there briefly, where rays cross what was there briefly.

    In the 27 cubes about it (`blocks`), with only brief nodes: 15 rays or more have passed their
    cells, times the squared share that their cells have of all ends; four times as many where it
    was seen in two moments. One ray that grazes an edge does not do that, nor do many where most of
    what is seen lasts; where somebody has walked by, everything says so.
    """
    cubes, at = np.unique(place, return_inverse=True)
    brief = found.moments < _BRIEF
    columns = (brief * found.passed, brief * found.ended, found.ended)
    sums = _about(cubes, np.stack([np.bincount(at, column, len(cubes)) for column in columns]))
    passed, share, ended = log2_16(np.maximum(sums, 1))[:, at]
    balance = passed + 2 * (share - ended) - 2 * log2_16(np.maximum(found.moments, 1))
    return np.asarray(brief & (balance >= _CROSSED))


def gone(found: Evidence, place: Int64s, moment: Int64s) -> Bools:
    """(N,) whether a node left together with what was seen beside it.

    Of the nodes in the 27 cubes about it that were seen last in the same moment, half or more are
    `crossed`, and four at least. So what no ray came through, as feet, goes with the rest;
    and what was seen beside it in other moments, three or more, stays.
    moment: (N,) a number for the author and cycle that saw each node last.
    """
    marked = crossed(found, place)
    moments, when, count = np.unique(moment[marked], return_inverse=True, return_counts=True)
    out = np.zeros(len(place), np.bool_)
    asked = np.flatnonzero(np.isin(moment, moments[count >= _TOGETHER]))
    if len(asked) == 0:
        return out
    when = np.searchsorted(moments, moment[asked])
    cubes, at = np.unique(place[asked], return_inverse=True)
    groups, group = np.unique(when * len(cubes) + at, return_inverse=True)
    counts = np.stack([np.bincount(group, marked[asked]), np.bincount(group)])
    with_them, of_all = _about(cubes, counts, groups)[:, group]
    left = (with_them >= _TOGETHER) & (2 * with_them >= of_all)
    out[asked] = left & (found.moments[asked] < _LASTING)
    return out


def _about(cubes: Int64s, values: npt.NDArray[np.generic], groups: Int64s | None = None) -> Int64s:
    """Sums of whole values (k, N) over the 27 cubes about each cube; or about each group, where a
    group is a part of a cube: cubes times its kind, plus the place of its cube in `cubes`
    (ascending). Values may be floats, as `bincount` adds them up: below 2^53 that is exact."""
    whole = values.astype(np.int64)
    out = np.zeros_like(whole)
    kind, at = np.divmod(np.arange(len(cubes)) if groups is None else groups, len(cubes))
    for shift in (_CUBE @ _STRIDES).tolist():
        beside = np.searchsorted(cubes, cubes + shift).clip(max=len(cubes) - 1)
        there = np.flatnonzero((cubes[beside] == cubes + shift)[at])
        other = beside[at[there]]
        if groups is not None:
            wanted = kind[there] * len(cubes) + other
            other = np.searchsorted(groups, wanted).clip(max=len(groups) - 1)
            same = groups[other] == wanted
            there, other = there[same], other[same]
        out[:, there] += whole[:, other]
    return out


def balances(found: Evidence, record: Int64s, delta_mm: int) -> Int64s:
    """(N,) what speaks for each node, sixteenths of bits. record: that of its most reliable
    witness.

    A node is dense around itself where it is real, the denser the nearer its sensor was; it is not
    where rays pass, and nothing lies before it.
    """
    spread = log2_16(np.maximum(found.distance, 1)) - log2_16(np.array(delta_mm))
    balance = _SUPPORT * log2_16(np.maximum(found.support, 1)) + _DISTANCE * spread
    balance -= _PASSED * log2_16(1 + found.passed) + _HIDDEN * log2_16(1 + found.hidden)
    return balance - _RECORD * record


def misses(found: Evidence, record: Int64s, doubted: Bools, gone: Bools) -> Int32s:
    """(N,) what counts against each node.

    Only where it is doubted, or `gone`, do the authors who speak against it count; where nobody
    does, its witness's record does, or that it is gone.
    """
    counted = np.where((found.against == 0) & ((record > 0) | gone), 1, found.against)
    return np.asarray(np.where(doubted | gone, counted, 0), np.int32)
