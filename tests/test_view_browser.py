"""`dagmap view` in a real browser: are the points on the screen?"""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra view is not installed")

from browser import Browser, open_browser, wait_for
from dagmap.io.view.colouring import legend
from dagmap.io.view.run import Run
from dagmap.io.view.window import Window
from dagmap.model import State
from runs import NAMES, replay_of

LEFT = 0.6  # of the width: the panel covers the rest
TOP = 160  # pixels that a notice may cover: that the browser draws in software
ENOUGH = 100  # pixels of one colour


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return replay_of(tmp_path_factory.mktemp("view"))


@contextmanager
def shown(folder: Path) -> Iterator[tuple[Window, Browser]]:
    """The view of a run, and a browser that looks at it."""
    with Window(Run(folder), "127.0.0.1", 0) as window:
        drawing = threading.Thread(target=window.run)
        drawing.start()
        try:
            with open_browser() as browser:
                browser.go(window.url)
                yield window, browser
        finally:
            window.stop()
            drawing.join()


def pixels(browser: Browser, color: str) -> np.ndarray:
    """(N, 2) x and y of the pixels beside the panel that have nearly this colour."""
    from matplotlib.image import imread

    picture = np.asarray(imread(io.BytesIO(browser.screenshot())))[..., :3] * 255
    picture = picture[TOP:, : int(LEFT * picture.shape[1])]
    wanted = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)])
    rows, columns = np.nonzero((np.abs(picture - wanted) < 30).all(axis=-1))
    return np.column_stack([columns, rows + TOP])


def test_the_points_are_on_the_screen(run: Path) -> None:
    states, robots = dict(legend("state", NAMES)), dict(legend("robot", sorted(NAMES)))
    amber = states["tentative"]
    with shown(run) as (window, browser):
        controls = window.controls
        wait_for(lambda: len(pixels(browser, amber)) > ENOUGH, "points in the state's colour")
        wait_for(lambda: "all 2 robots agree" in controls.standing.content, "the sign of agreement")
        says = "document.body.innerText"
        wait_for(lambda: "all 2 robots agree" in browser.run(says), "the sign in the browser")

        # A point that is clicked tells its story.
        def told() -> bool:
            x, y = pixels(browser, amber)[ENOUGH // 2].tolist()
            browser.click(x, y)
            time.sleep(0.5)
            return "kept" in controls.node.content

        wait_for(told, "the story of the point")
        assert any(name in controls.node.content for name in NAMES)
        # By robot: other colours, the old one is gone.
        controls.paths.value = False
        controls.colouring.value = "robot"
        for color in robots.values():
            wait_for(lambda color=color: len(pixels(browser, color)) > 5, f"points in {color}")
        wait_for(lambda: len(pixels(browser, amber)) < 5, "the old colour to go")
        # Without any state the scene is empty: what was seen were the points.
        for state in State:
            controls.states[state].value = False
        wait_for(
            lambda: sum(len(pixels(browser, color)) for color in robots.values()) < 5,
            "the points to go",
        )


def test_the_ledger_runs_in_the_browser(run: Path) -> None:
    with shown(run) as (window, browser):
        controls = window.controls
        wait_for(lambda: controls.slider.max > 10, "the ledger")
        count = int(controls.slider.max)
        whole = wait_for(lambda: controls.counts.content, "the count of nodes")
        controls.latest.value = False
        controls.slider.value = 3
        wait_for(lambda: controls.counts.content != whole, "fewer nodes")
        wait_for(lambda: "#0" in controls.newest.content, "the first transactions")
        controls.edges.value = True
        controls.radius.value = 5.0
        controls.play.value = True
        wait_for(lambda: controls.latest.value, "the end of the ledger")
        wait_for(lambda: controls.counts.content == whole, "all nodes again")
        assert int(controls.slider.value) == count
        assert browser.frames_per_second(0.5) > 0


def test_a_browser_that_was_promised_may_not_be_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.setenv("DAGMAP_BROWSER", "required")
    with pytest.raises(pytest.fail.Exception, match="no browser is installed"), open_browser():
        pass
    monkeypatch.delenv("DAGMAP_BROWSER")
    with pytest.raises(pytest.skip.Exception, match="no browser is installed"), open_browser():
        pass
