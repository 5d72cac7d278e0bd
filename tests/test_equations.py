"""Section 5.1: Equations (2) to (5), and what is learnt of the costs."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dagmap import Config, GraphConfig
from dagmap.config import OverheadConfig
from dagmap.equations import Fit, Model, Size, Work, t_broadcast, t_insertion, t_merge
from dagmap.overhead import Controller


def test_the_equations_are_those_of_the_paper() -> None:
    size = Size(n_u=4096, n_c=2)
    assert t_insertion(size, 1e-9) == pytest.approx(4096 / 12 * 1e-9)  # Eq. (3)
    assert t_broadcast(size, 1e-9) == pytest.approx(4096e-9)  # Eq. (4)
    assert t_merge(size, 1.0) == pytest.approx(4096 + 2**2 * 12)  # Eq. (5) as printed
    assert t_merge(size, 1.0, as_printed=False) == pytest.approx(4096 + 2 ** (2 * 12))
    wide = Size(n_u=4096, n_c=8)
    assert t_broadcast(wide, 1.0) == pytest.approx(2 ** (math.log(4096) / math.log(8)))
    assert t_insertion(wide, 1.0) > t_insertion(size, 1.0)
    assert t_broadcast(wide, 1.0) < t_broadcast(size, 1.0)


def test_a_graph_of_nothing_has_a_cost_too() -> None:
    for size in (Size(0, 1), Size(1, 2)):
        assert all(math.isfinite(f(size, 1.0)) for f in (t_insertion, t_broadcast, t_merge))


def stories(count: int) -> list[Work]:
    rng = np.random.default_rng(2)
    return [Work(*rng.integers(50, 1000, 3).tolist(), *rng.integers(1, 9, 2)) for _ in range(count)]


def test_costs_per_feature_are_found_whatever_the_size_of_the_map() -> None:
    model, true = Model(), np.array([4e-6, 9e-6, 2e-6])
    for i, work in enumerate(stories(60)):
        seconds = float(np.dot(true, (work.inserted, work.sent, work.merged)))
        model.add(work, Size(1000 * (i + 1), 2), seconds)
    assert model.costs == pytest.approx(true, rel=0.02)
    work = Work(500, 500, 1000)
    assert model.own(work) == pytest.approx(float(np.dot(true, (500, 500, 1000))), rel=0.02)


@pytest.mark.parametrize("as_printed", [True, False])
def test_a_robot_that_costs_what_the_paper_says_is_understood(as_printed: bool) -> None:
    model, l_dist, l_search = Model(as_printed), 3e-9, 8e-9
    for i, work in enumerate(stories(60)):
        size = Size(1000 + 50 * i, 2)
        seconds = work.inserted * t_insertion(size, l_dist)  # Eq. (2)
        seconds += work.bundles * t_broadcast(size, l_search)
        seconds += work.merges * t_merge(size, l_dist, as_printed)
        model.add(work, size, seconds)
    assert model.l_dist == pytest.approx(l_dist, rel=0.02)
    if as_printed:  # else 2^(2 log n) hides everything beside it
        assert model.l_search == pytest.approx(l_search, rel=0.2)
    assert model.paper(stories(1)[0], Size(4000, 2)) > 0


def test_a_fit_follows_a_change_and_never_goes_below_nothing() -> None:
    fit = Fit((1.0, 1.0))
    for _ in range(100):
        fit.add((1.0, 0.0), 5.0)
    assert fit.coefficients == pytest.approx([5.0, 1.0], rel=1e-2)  # what was not seen stays
    for _ in range(200):
        fit.add((1.0, 0.0), 2.0)
    assert fit.coefficients[0] == pytest.approx(2.0, rel=1e-2)
    for _ in range(200):
        fit.add((2.0, 1.0), 1.0)
        fit.add((1.0, 1.0), 2.0)
    assert (fit.coefficients >= 0).all()


def test_work_is_the_difference_of_two_counts() -> None:
    assert Work(5, 4, 3, 2, 1).since(Work(1, 1, 1, 1, 1)) == Work(4, 3, 2, 1, 0)


def test_fewer_are_sent_again_before_fewer_are_inserted() -> None:
    """Though N_c is at its most, and so was never given back: what was cut once may be cut anew."""
    graph = GraphConfig(n_c=4, n_c_max=4)
    controller = Controller(Config(graph=graph, overhead=OverheadConfig(cycle_share=0.5)))
    now = 0.0

    def cycle(seconds: float, sent: int) -> None:
        nonlocal now
        controller.took(seconds)
        controller.work.inserted += 1000
        controller.work.sent += sent
        now += 1.0
        controller.cycle(now, 1000, 0, 0)

    for _ in range(2):
        cycle(0.8, 1000)
        assert controller.n_f is None  # a single one may be a hiccup
        cycle(0.8, 1000)
        cycle(0.8, 1000)
        assert controller.n_f is not None and controller.features is None
        for _ in range(60):
            cycle(0.01, 100)
        assert controller.n_f is None and controller.features is None
