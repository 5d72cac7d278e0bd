"""All experiments, as many at a time as there are cores: `make figures`. `--out DIR`, `--jobs N`.

Each is a process of its own, so that one that fails does not take the others with it.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from rich.console import Console

import common
from dagmap.cli.kernels import warm_up

# What takes longest first.
ALL = (
    "figure_11",
    "sensors",
    "completion",
    "section_5",
    "figure_10",
    "feature_poor",
    "agreement",
    "figure_07",
)
HERE = Path(__file__).parent


def one(name: str, out: Path) -> tuple[str, int, str, float]:
    """Its name, exit code, what it said, and the seconds it took."""
    started = time.perf_counter()
    command = [sys.executable, str(HERE / f"{name}.py"), "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return name, done.returncode, done.stdout + done.stderr, time.perf_counter() - started


def main() -> int:
    parser = common.Parser(description=__doc__)
    parser.add_argument(
        "--out", type=common.folder, default=str(common.OUT), help="folder for JSON and PNG"
    )
    jobs = common.between(int, 1, 1000)
    parser.add_argument(
        "--jobs", type=jobs, default=os.cpu_count() or 1, help="processes at a time"
    )
    options = parser.parse_args()
    started = time.perf_counter()
    warm_up(Console(stderr=True))  # once, for all of them
    failed = []
    with ThreadPoolExecutor(options.jobs) as pool:
        for done in as_completed([pool.submit(one, name, options.out) for name in ALL]):
            name, code, said, seconds = done.result()
            print(said.rstrip(), f"({name}: {seconds:.0f} s)", sep="\n", flush=True)
            failed += [name] if code else []
    took, processor = time.perf_counter() - started, os.times()
    spent = processor.user + processor.system + processor.children_user + processor.children_system
    print(f"{options.out}: {len(ALL)} experiments in {took:.0f} s, {spent:.0f} s of processor")
    if failed:
        print(f"FAILED: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
