"""Entry points of the commands: what holds while their modules are still being loaded."""

from __future__ import annotations

import signal
from importlib import import_module


def main() -> None:
    """`dagmap`."""
    _run("cli", "main")


def ros1() -> None:
    """`dagmap-ros1`."""
    _run("cli.ros", "ros1")


def ros2() -> None:
    """`dagmap-ros2`."""
    _run("cli.ros", "ros2")


def _run(module: str, name: str) -> None:
    """Until there is somebody to catch it, an interrupt ends the process as it ends any other one:
    without a traceback, by the signal itself. Where it is ignored, it stays so."""
    heeded = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if heeded:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    command = getattr(import_module(f"dagmap.{module}"), name)
    if heeded:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    command()
