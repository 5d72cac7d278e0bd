"""The figures of docs/fuzzing.md: runs so far, size of the corpora, lines that they reach.

NUMBA_DISABLE_JIT=1 python fuzz/table.py
"""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path

import lines
import targets

RUNS = Path(__file__).resolve().parents[1] / "out" / "fuzz" / "runs.jsonl"


def main() -> None:
    runs: dict[str, list[dict[str, float]]] = defaultdict(list)
    for line in RUNS.read_text().splitlines():
        run = json.loads(line)
        runs[run["target"]].append(run)
    heads = ("target", "executions", "seconds", "peak MB", "files", "bytes", "statements reached")
    print(f"| {' | '.join(heads)} |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    totals = [0.0, 0.0, 0.0, 0.0]
    for name in targets.names():
        executed = sum(run["executions"] for run in runs[name])
        seconds = sum(run["seconds"] for run in runs[name])
        peak = max((run["peak_mb"] for run in runs[name]), default=0)
        sizes = [path.stat().st_size for path in (targets.CORPUS / name).iterdir()]
        total, missed = lines.reached([name])
        reached = f"{total - len(missed)} of {total}" if total else "-"
        cells = f"{executed:,} | {seconds:,.0f} | {peak:.0f} | {len(sizes)} | {sum(sizes):,}"
        print(f"| {name} | {cells} | {reached} |")
        totals = [
            a + b for a, b in zip(totals, (executed, seconds, len(sizes), sum(sizes)), strict=True)
        ]
    cells = f"{totals[0]:,.0f} | {totals[1]:,.0f} | | {totals[2]:.0f} | {totals[3]:,.0f}"
    print(f"| all | {cells} | |")


if __name__ == "__main__":
    main()
