"""What is learned of each robot's sensor: how much must lie around a node that is real."""

from __future__ import annotations

import numpy as np

from dagmap import weighing
from dagmap.kernels.matching import AUTHOR, NEXT
from dagmap.weighing import MOST_DOUBT, SIXTEENTHS

DENSE, SPARSE, NEW = 0, 1, 2  # authors


def evidence(passed: list[int], ended: list[int]) -> weighing.Evidence:
    n = len(passed)
    columns = {name: np.zeros(n, np.int32) for name in weighing.Evidence._fields}
    columns |= {"passed": np.array(passed, np.int32), "ended": np.array(ended, np.int32)}
    return weighing.Evidence(**columns)


def witnessed(*authors: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """First entries and entries of nodes with these witnesses, as a fold holds them."""
    first, entries = [], []
    for mine in authors:
        at = -1
        for author in mine:
            entries.append([0] * 5)
            entries[-1][AUTHOR], entries[-1][NEXT] = author, at
            at = len(entries) - 1
        first.append(at)
    return np.array(first, np.int32), np.array(entries, np.int32)


def test_each_robot_is_doubted_as_far_as_rays_contradict_it() -> None:
    """Of the dense one's nodes those below 30 bits were passed, of the sparse one's below 12."""
    bits = [*range(45)] * 20
    shared = (DENSE, SPARSE)
    authors = [(DENSE,)] * len(bits) + [(SPARSE,)] * len(bits) + [shared, (NEW,), (NEW,)]
    balance = np.array([*bits, *bits, 20, 20, 40]) * SIXTEENTHS + 1
    passed = [3 * (b < 30) for b in bits] + [3 * (b < 12) for b in bits] + [0, 0, 0]
    found = evidence(passed, [1] * len(passed))
    doubt = weighing.doubts(found, balance, *witnessed(*authors), 3) // SIXTEENTHS
    assert set(doubt[: len(bits)]) == {30} and set(doubt[len(bits) : 2 * len(bits)]) == {12}
    assert doubt[-3] == 12, "of two witnesses the one doubted less counts"
    assert list(doubt[-2:]) == [MOST_DOUBT] * 2, "of who has said little nothing is known"


def test_nobody_gains_credit_by_what_others_say() -> None:
    """However many nodes a liar has that nothing contradicts, another's are judged as before."""
    bits = [*range(10, 40)] * 10
    passed = [3 * (b < 30) for b in bits]
    alone = weighing.doubts(
        evidence(passed, [1] * len(bits)),
        np.array(bits) * SIXTEENTHS + 1,
        *witnessed(*[(DENSE,)] * len(bits)),
        1,
    )
    crowd = 20 * len(bits)
    beside = weighing.doubts(
        evidence(passed + [0] * crowd, [1] * (len(bits) + crowd)),
        np.array(bits * 21) * SIXTEENTHS + 1,
        *witnessed(*[(DENSE,)] * len(bits), *[(SPARSE,)] * crowd),
        2,
    )
    assert np.array_equal(alone, beside[: len(bits)]) and set(beside[len(bits) :]) == {0}
