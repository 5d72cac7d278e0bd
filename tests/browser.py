"""A headless browser for tests: started, steered over its DevTools protocol, ended.

It draws in software, so it needs neither a screen nor a graphics card.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NoReturn
from urllib.request import ProxyHandler, build_opener

import pytest
from websockets.sync.client import ClientConnection, connect

PATIENCE = 120.0  # s: a test fails after it, none waits for it
_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_FLAGS = (
    "--headless=new",
    "--no-sandbox",  # a test may run as root
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-extensions",
    "--disable-sync",
    "--disable-background-timer-throttling",
    "--disable-renderer-backgrounding",
    "--no-first-run",
    "--no-default-browser-check",
    "--no-proxy-server",
    "--mute-audio",
    "--remote-debugging-port=0",
)


def without(reason: str) -> NoReturn:
    """No browser: a test is skipped and says why; where one was promised, it fails."""
    if os.environ.get("DAGMAP_BROWSER") == "required":
        pytest.fail(f"{reason}, and DAGMAP_BROWSER=required says that there is one")
    pytest.skip(reason)


def find_browser() -> str | None:
    """Where the browser is; None where there is none."""
    return next((path for name in _NAMES if (path := shutil.which(name))), None)


class Browser:
    """One page. Every call waits for its answer, `PATIENCE` at most."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection, self._number = connection, 0
        self._events: set[str] = set()  # that came while something else was waited for

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """One command of the DevTools protocol and its result."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": params}
        self._connection.send(json.dumps(message))
        deadline = time.monotonic() + PATIENCE
        while (answer := self._next(deadline)).get("id") != self._number:
            pass
        assert "error" not in answer, (method, answer["error"])
        return answer["result"]  # type: ignore[no-any-return]

    def _next(self, deadline: float) -> dict[str, Any]:
        message = json.loads(self._connection.recv(deadline - time.monotonic()))
        self._events.add(message.get("method", ""))
        return message  # type: ignore[no-any-return]

    def run(self, script: str) -> Any:
        """What a JavaScript expression gives; a promise is waited for."""
        result = self.call(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def go(self, url: str) -> None:
        """Load a page, and wait until it is there."""
        self.call("Page.enable")
        self._events.clear()
        self.call("Page.navigate", url=url)
        deadline = time.monotonic() + PATIENCE
        while "Page.loadEventFired" not in self._events:
            self._next(deadline)

    def click(self, x: float, y: float) -> None:
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def screenshot(self) -> bytes:
        """PNG of what the page shows now."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def frames_per_second(self, seconds: float) -> float:
        """How often the page was drawn within so many seconds."""
        return float(
            self.run(
                "new Promise(done => { let n = 0; const begin = performance.now();"
                " const step = now => { n += 1; const took = performance.now() - begin;"
                f" if (took > {1000 * seconds}) done(1000 * n / took);"
                " else requestAnimationFrame(step); }; requestAnimationFrame(step); })"
            )
        )


@contextmanager
def open_browser(width: int = 1000, height: int = 700) -> Iterator[Browser]:
    """A browser with an empty page; see `without` for where none is, or none that draws."""
    path = find_browser()
    if path is None:
        without(f"no browser is installed (one of {', '.join(_NAMES)})")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            [path, *_FLAGS, f"--window-size={width},{height}", f"--user-data-dir={profile}",
             "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # its children end with it
        )  # fmt: skip
        try:
            port = _port(Path(profile), process)
            with connect(_page(port), max_size=None, compression=None, proxy=None) as connection:
                browser = Browser(connection)
                if not browser.run("!!document.createElement('canvas').getContext('webgl2')"):
                    without(f"{path} cannot draw in three dimensions here")
                yield browser
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait(PATIENCE)


def _port(profile: Path, process: subprocess.Popen[bytes]) -> int:
    """The port that the browser has chosen and written down."""

    def look() -> int | None:
        if process.poll() is not None:
            without(f"the browser does not start here: it ended with {process.returncode}")
        file = profile / "DevToolsActivePort"
        lines = file.read_text().splitlines() if file.exists() else []
        return int(lines[0]) if len(lines) > 1 else None

    return int(wait_for(look, "the browser to start"))


def _page(port: int) -> str:
    def look() -> str | None:
        opener = build_opener(ProxyHandler({}))  # this machine is reached without one
        with opener.open(f"http://127.0.0.1:{port}/json/list", timeout=PATIENCE) as answer:
            pages = [page for page in json.load(answer) if page["type"] == "page"]
        return pages[0]["webSocketDebuggerUrl"] if pages else None

    return str(wait_for(look, "the browser's page"))


def wait_for(condition: Callable[[], Any], what: str) -> Any:
    """What the condition gives, once it is true."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        if value := condition():
            return value
        time.sleep(0.1)
    raise AssertionError(f"waited {PATIENCE:.0f} s for {what}")
