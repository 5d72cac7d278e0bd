"""`dagmap view`: from the command to a map of 10^6 points on the screen, and frames a second.

The map is made here: a building of 60 x 30 m that one robot has walked through. The
browser is the one that the tests use, which draws in software: a graphics card only does better.
The camera turns for ten seconds. `--data FOLDER` keeps the map there for the next time.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dagmap import Agent, Config, Cycle, Identity
from dagmap.config import TransactionConfig
from dagmap.io.export import prepare_out, write_ply
from dagmap.io.store import Store
from dagmap.model import Accepted

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

BY_NAME_ONLY = True
POINTS, OF_A_CYCLE, SECONDS = 1_000_000, 1000, 10.0
SIZE = (60.0, 30.0, 3.0)  # m
_WATCH = """(() => { window.frames_drawn = 0; let points = 0, calls = 0;
  const old = WebGL2RenderingContext.prototype.drawArrays;
  WebGL2RenderingContext.prototype.drawArrays = function (mode, first, count) { calls += 1;
    if (mode === this.POINTS) points += count; return old.call(this, mode, first, count); };
  const step = () => { if (calls) window.frames_drawn += 1;
    if (points > 1000) window.points_at ??= performance.timeOrigin + performance.now();
    points = calls = 0; requestAnimationFrame(step); }; requestAnimationFrame(step); })()"""


def run(data: Path | None = None) -> list[dict[str, Any]]:
    """Seconds to open, to read the ledger, and frames a second. data: where the map is kept."""
    if data is not None:
        return [measure(data if (data / "summary.json").is_file() else make(data))]
    with tempfile.TemporaryDirectory() as folder:
        return [measure(make(Path(folder) / "out"))]


def make(out: Path) -> Path:
    """The folder of a run with some 10^6 nodes."""
    config = Config(transaction=TransactionConfig(proof_of_work_bits=0))
    prepare_out(out, force=False)
    agent = Agent(Identity.from_seed(bytes(31) + b"1"), msgspec.structs.replace(config, name="one"))
    rng = np.random.default_rng(0)
    points = building(rng)
    found: list[tuple[bytes, bytes]] = []
    for i in range(0, len(points), OF_A_CYCLE):
        part = points[i : i + OF_A_CYCLE]
        pose = np.eye(4)
        pose[:3, 3] = part.mean(axis=0) + np.array([0.0, 0.0, 1.0])
        now = i / OF_A_CYCLE
        events = agent.observe(Cycle(now, pose, part - pose[:3, 3]), now) + agent.tick(now)
        found += [(event.id, event.data) for event in events if isinstance(event, Accepted)]
        agent.outbox()
    now = len(points) / OF_A_CYCLE
    while agent.holds_back:
        now += 1.0
        found += [(e.id, e.data) for e in agent.tick(now) if isinstance(e, Accepted)]
    with Store.open(out / "ledgers" / "one.db", config.fleet_id, agent.identity.author) as store:
        store.append_many(found)
    write_ply(out / "map.ply", agent.map)
    summary = {
        "robots": [{"name": "one", "digest": agent.digest().hex()}],
        "parameters": msgspec.to_builtins(config),
    }
    (out / "summary.json").write_text(json.dumps(summary))
    return out


def building(rng: np.random.Generator) -> np.ndarray:
    """(N, 3) m on floors and walls, in the order in which somebody walks past them."""
    points = rng.uniform((0, 0, 0), SIZE, (2 * POINTS, 3))
    kind = rng.integers(0, 4, len(points))
    points[kind == 0, 2] = 0.0
    points[kind == 1, 2] = SIZE[2]
    points[kind == 2, 0] = np.round(points[kind == 2, 0] / 4.0) * 4.0
    points[kind == 3, 1] = np.round(points[kind == 3, 1] / 4.0) * 4.0
    points = points[: int(1.2 * POINTS)]
    return points[np.lexsort((points[:, 1], np.floor(points[:, 0] / 0.5)))]


def measure(out: Path) -> dict[str, Any]:
    from browser import open_browser, wait_for

    with open_browser() as browser:
        browser.call("Page.enable")
        browser.call("Page.addScriptToEvaluateOnNewDocument", source=_WATCH)
        begun = time.time()  # the clock of the browser's `timeOrigin`
        command = [sys.executable, "-c", "from dagmap.cli import main; main()", "view", str(out)]
        view = subprocess.Popen(
            [*command, "--port", "0", "--no-browser"], stdout=subprocess.PIPE, text=True
        )
        try:
            assert view.stdout is not None
            browser.go(view.stdout.readline().strip())
            says = "document.body.innerText"
            opened = wait_for(lambda: browser.run("window.points_at"), "points") / 1000 - begun
            wait_for(lambda: "robots agree" in browser.run(says), "the ledger")
            agreed = time.time() - begun
            nodes = browser.run(says).split(" nodes:")[0].split()[-1]
            time.sleep(3.0)
            return {
                "nodes": int(nodes.replace(",", "")),
                "opens_s": opened,
                "ledger_read_s": agreed,
                "frames_per_s_software": turning(browser),
            }
        finally:
            view.terminate()
            view.wait(30)


def turning(browser: Any) -> float:
    """Frames a second while the camera is dragged about."""
    mouse = {"button": "left", "buttons": 1}
    drag = "Input.dispatchMouseEvent"
    browser.call(drag, type="mousePressed", x=300, y=400, clickCount=1, **mouse)
    browser.run("window.frames_drawn = 0")
    begun, i = time.monotonic(), 0
    while time.monotonic() - begun < SECONDS:
        i += 1
        at = {"x": 300 + 80 * math.sin(i / 10), "y": 400 + 40 * math.cos(i / 10)}
        browser.call(drag, type="mouseMoved", **at, **mouse)
    rate = browser.run("window.frames_drawn") / (time.monotonic() - begun)
    browser.call(drag, type="mouseReleased", x=300, y=400, button="left", clickCount=1)
    return float(rate)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="folder of the map; made where it is missing")
    print(json.dumps(run(parser.parse_args().data), indent=2))
