"""`dagmap view`: a run, or a running fleet, in a browser."""

from __future__ import annotations

import sys
import webbrowser
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console

from ..io.view.run import Run
from ..io.view.source import Source
from ..io.view.window import Window, load_viser
from ..model import DagmapError


@dataclass(slots=True)
class ViewCommand:
    """One run of the command."""

    folder: Path | None
    live: str | None
    config: Path | None
    robot: str | None
    host: str
    port: int
    points: int
    browser: bool
    console: Console = field(default_factory=lambda: Console(stderr=True))

    def run(self) -> None:
        """Serve the view until Ctrl-C. Raises DagmapError."""
        load_viser()
        if self.points < 1000:
            raise DagmapError(f"--points {self.points}: at least 1000 are wanted")
        source = self._open()
        try:
            with Window(source, self.host, self.port, self.points) as window:
                sys.stdout.write(f"{window.url}\n")
                sys.stdout.flush()
                self.console.print(f"{source.title}; Ctrl-C ends")
                if self.browser:
                    webbrowser.open(window.url)
                window.run()
        except KeyboardInterrupt:
            self.console.print("closed")
        finally:
            source.close()

    def _open(self) -> Source:
        if (self.folder is None) == (self.live is None):
            raise DagmapError(
                "dagmap view wants the folder of a run, or --live ENDPOINT: one of the two"
            )
        if self.folder is not None:
            if self.config is not None:
                raise DagmapError("--config goes with --live; a run's folder has its parameters")
            return Run(self.folder, self.robot)
        if self.robot is not None:
            raise DagmapError("--robot goes with a run's folder; the live view has its own ledger")
        assert self.live is not None
        from ..io.view.live import LiveFleet  # a folder's view need not wait for the network's code

        return LiveFleet(self.live, self.config)
