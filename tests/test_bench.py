"""`dagmap bench`, from the command line, and what it says of section 5."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

BENCH = Path(__file__).parents[1] / "bench"
START = "from dagmap.command import main; main()"


def bench(folder: Path, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", START, "bench", *words],
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
        env={**os.environ, **environment},
    )


def test_bench_overhead_measures_and_predicts(tmp_path: Path) -> None:
    done = bench(tmp_path, "overhead", "--dir", str(BENCH), "--json", DAGMAP_BENCH_MOST="2000")
    assert done.returncode == 0, done.stderr
    rows: list[dict[str, Any]] = json.loads(done.stdout)["overhead"]
    sizes = [row for row in rows if row.get("against") == "n_u"]
    assert [row["n_u"] for row in sizes] == [1000, 2000, 10**6, 3 * 10**6, 10**7]
    assert [row["measured_ms"] is None for row in sizes] == [False] * 2 + [True] * 3
    assert all(row["own_ms"] > 0 and row["paper_printed_ms"] > 0 for row in sizes)
    for cost in ("insert_us", "send_us", "merge_us", "l_dist_ns"):  # told apart
        assert all(row[cost] > 0 for row in rows if "learnt_from" in row)
    assert [row["learnt_from"] for row in rows if "learnt_from" in row] == ["n_u", "n_c", "n_g"]
    steering = [row for row in rows if row.get("name") == "steering"]
    assert [row["peers"] for row in steering] == [0, 3, 30]
    assert all(row["ms_a_cycle"] > 0 for row in steering)
    files = rows[-1]["written"].split(", ")
    assert str(Path("out/overhead/overhead.json")) in files
    assert all((tmp_path / name).stat().st_size > 0 for name in files)


def test_bench_refuses_what_it_does_not_know(tmp_path: Path) -> None:
    done = bench(tmp_path, "nonsense", "--dir", str(BENCH))
    assert done.returncode == 2 and "no benchmark called nonsense" in done.stderr
    done = bench(tmp_path, "overhead", "--dir", str(BENCH), DAGMAP_BENCH_MOST="few")
    assert done.returncode == 2 and "DAGMAP_BENCH_MOST = 'few'" in done.stderr


def test_every_benchmark_fits_the_sources_that_are_here() -> None:
    """Those of the bench folder that nothing else runs would notice too late what has moved."""
    names = sorted(path.stem for path in BENCH.glob("*.py"))
    assert len(names) > 20
    code = f"import sys; sys.path.insert(0, {str(BENCH)!r})\nimport {', '.join(names)}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
