"""What is learned of each robot's sensor: how much must lie around a node that is real."""

from __future__ import annotations

import numpy as np

from dagmap import weighing
from dagmap.kernels.matching import AUTHOR, NEXT
from dagmap.model import Bools, Int32s, Int64s
from dagmap.weighing import MOST_DOUBT, SIXTEENTHS

DENSE, SPARSE, NEW = 0, 1, 2  # authors
Said = tuple[int, bool]  # an author that has seen a node, and whether its own rays deny it


def learned(balance: list[int], said: list[tuple[Said, ...]], authors: int = 3) -> Int64s:
    """The doubt of nodes with these balances, in bits: a little above the given ones."""
    first, entries, denied = witnessed(said)
    columns = {name: np.zeros(len(said), np.int32) for name in weighing.Evidence._fields}
    found = weighing.Evidence(**{**columns, "denied": denied})
    above = np.array(balance) * SIXTEENTHS + 1
    return weighing.doubts(found, above, first, entries, authors) // SIXTEENTHS


def witnessed(said: list[tuple[Said, ...]]) -> tuple[Int32s, Int32s, Bools]:
    """First entries of nodes, entries as a fold holds them, and which are denied."""
    first, entries, denied = [], [], []
    for mine in said:
        at = -1
        for author, no in mine:
            entries.append([0] * 5)
            entries[-1][AUTHOR], entries[-1][NEXT] = author, at
            denied.append(no)
            at = len(entries) - 1
        first.append(at)
    return np.array(first, np.int32), np.array(entries, np.int32), np.array(denied, np.bool_)


def test_each_robot_is_doubted_as_far_as_its_own_rays_deny_it() -> None:
    """Of the dense one's nodes those below 30 bits, of the sparse one's below 12."""
    bits = [*range(45)] * 20
    said: list[tuple[Said, ...]] = [((DENSE, b < 30),) for b in bits]
    said += [((SPARSE, b < 12),) for b in bits]
    said += [((DENSE, False), (SPARSE, False)), ((NEW, False),), ((NEW, True),)]
    doubt = learned([*bits, *bits, 20, 20, 40], said)
    assert set(doubt[: len(bits)]) == {30} and set(doubt[len(bits) : 2 * len(bits)]) == {12}
    assert doubt[-3] == 12, "of two witnesses the one doubted less counts"
    assert list(doubt[-2:]) == [MOST_DOUBT] * 2, "of who has said little nothing is known"


def test_nobody_is_doubted_more_or_less_by_what_others_say() -> None:
    """However many nodes a liar has, whether its rays deny them, and also where it repeats."""
    bits = [*range(10, 40)] * 20
    mine = [((DENSE, b < 30),) for b in bits]
    alone = learned(bits, mine, 1)
    crowd = [((SPARSE, n % 3 == 0),) for n in range(20 * len(bits))]
    beside = learned(bits * 21, [*mine, *crowd], 2)
    assert np.array_equal(alone, beside[: len(bits)]) and set(alone) == {30}
    repeated = [(*said, (SPARSE, True)) for said in mine]
    assert set(learned(bits, repeated, 2)) == {30}, "it is doubted itself, the other as before"
