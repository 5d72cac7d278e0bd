"""Does everything that DAGmap needs install from wheels, without a compiler?

    python packaging/check_wheels.py                      the base on AArch64, Python 3.10 to 3.13
    python packaging/check_wheels.py --extra all --machine x86_64
    python packaging/check_wheels.py --extra fleet --python 3.11 --list

Nothing is installed. The index is the one that pip is configured for. pip judges the conditions of
requirements by the interpreter that runs it, so of DAGmap's own only those of the
machine count here.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import msgspec

PROJECT = Path(__file__).parents[1] / "pyproject.toml"
PYTHONS = ("3.10", "3.11", "3.12", "3.13")
GLIBC = 35  # of 2.35, Ubuntu 22.04: what wheels may ask for at most


def requirements(extras: list[str], machine: str) -> list[str]:
    """The base and these extras, less what is not meant for a machine."""
    project = msgspec.toml.decode(PROJECT.read_bytes())["project"]
    table: dict[str, list[str]] = project["optional-dependencies"]
    found, waiting = [], [*project["dependencies"], *(r for e in extras for r in table[e])]
    while waiting:
        one, _, condition = (part.strip() for part in waiting.pop(0).partition(";"))
        if condition == f"platform_machine != '{machine}'":
            continue
        own = re.fullmatch(r"dagmap\[([\w,]+)\]", one)
        waiting += [r for e in own[1].split(",") for r in table[e]] if own else []
        found += [] if own or one in found else [one]
    return found


def platforms(machine: str) -> list[str]:
    """Tags of wheels that a robot with glibc 2.35 takes."""
    return [
        f"manylinux2014_{machine}",
        *(f"manylinux_2_{n}_{machine}" for n in range(5, GLIBC + 1)),
    ]


def resolve(names: list[str], python: str, machine: str) -> list[str]:
    """The wheels that pip would install. Raises RuntimeError with what pip says."""
    with tempfile.TemporaryDirectory() as target:
        command = [sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--report", "-"]
        command += ["--ignore-installed", "--only-binary=:all:", "--target", target]
        command += ["--implementation", "cp", "--python-version", python]
        command += [part for tag in platforms(machine) for part in ("--platform", tag)]
        done = subprocess.run([*command, *names], capture_output=True, text=True, check=False)
    if done.returncode:
        errors = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
        raise RuntimeError("; ".join(errors) or done.stderr[-500:])
    wheels = [
        part["download_info"]["url"].rpartition("/")[2]
        for part in json.loads(done.stdout)["install"]
    ]
    return sorted(wheels)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--extra", action="append", default=[])
    parser.add_argument("--python", action="append", choices=PYTHONS)
    parser.add_argument("--machine", action="append", choices=("aarch64", "x86_64"))
    parser.add_argument("--list", action="store_true", help="name the wheels")
    options = parser.parse_args()
    lacking = 0
    for machine in options.machine or ["aarch64"]:
        names = requirements(options.extra, machine)
        for python in options.python or PYTHONS:
            try:
                wheels = resolve(names, python, machine)
            except RuntimeError as error:
                lacking += 1
                print(f"{machine}, Python {python}: NOT from wheels alone: {error}")
                continue
            print(f"{machine}, Python {python}: {len(wheels)} wheels, no compiler")
            print("".join(f"  {wheel}\n" for wheel in wheels) if options.list else "", end="")
    sys.exit(lacking > 0)


if __name__ == "__main__":
    main()
