"""The start of the commands: an interrupt while modules load shows no traceback."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

# Stands in for a person who presses Ctrl-C just when a module begins to be loaded.
INTERRUPTED = """
import os, signal, sys

class Impatient:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)

signal.signal(signal.SIGINT, {handler})
sys.meta_path.insert(0, Impatient())
sys.argv = ["dagmap", "agent", "robot.toml"]
from dagmap.command import main
main()
"""


def interrupted(module: str, handler: str = "signal.default_int_handler") -> tuple[int, str]:
    """How the process ended, and what it said."""
    code = INTERRUPTED.format(module=module, handler=handler)
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120
    )
    return done.returncode, done.stdout + done.stderr


@pytest.mark.parametrize("module", ["dagmap.cli", "typer", "numpy", "dagmap.model"])
def test_before_the_command_is_loaded(module: str) -> None:
    assert interrupted(module) == (-signal.SIGINT, "")


def test_while_the_agent_is_loaded() -> None:
    assert interrupted("dagmap.io.ros.bridge") == (130, "")


def test_where_interrupts_are_ignored() -> None:
    code, said = interrupted("typer", "signal.SIG_IGN")
    assert code == 2 and "robot.toml" in said


def test_as_a_module() -> None:
    command = [sys.executable, "-m", "dagmap", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0 and done.stdout.startswith("dagmap ")
