"""Fuzz one parser with atheris (libFuzzer for Python).

    python fuzz/run.py TARGET [--runs N | --seconds S] [--seed N]
    python fuzz/run.py all [--runs N]     N in all, shared by speed (default 1,000,000)
    python fuzz/run.py TARGET --merge     move what found new ground into fuzz/corpus, minimised
    python fuzz/run.py TARGET --show FILE run one input, as it was found

New inputs go to out/fuzz/TARGET, findings to out/fuzz/TARGET-crash-*, and one line with the figures
of each run to out/fuzz/runs.jsonl. An input may take 10 s and the process 2 GB.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import subprocess
import sys
import time
import warnings
from importlib import import_module
from pathlib import Path
from random import Random

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "out" / "fuzz"
PURE = "NUMBA_DISABLE_JIT"
LIMITS = (
    "-timeout=10",
    "-rss_limit_mb=2048",
    "-print_final_stats=1",
    "-reload=0",
    "-mutate_depth=1",
)

SHARES = {"message": 500, "ply": 160, "records": 130, "config": 110, "envelope": 40, "npz": 20}
SHARES |= {"store": 12, "tum": 16, "columns": 8, "agent": 4, "closed": 40, "closed_agent": 4}
SHARES |= {"colmap": 60, "orbslam": 60, "scans": 40, "euroc": 20, "rtabmap": 20}
_PURE = ("kernels.codec", "kernels.rangecoder")
_COMPILED = ("wire", "messages", "payload", "transaction", "config", "ledger", "sync", "agent")
_COMPILED += ("io.sources._source", "io.sources._rgbd", "io.sources.npz", "io.sources.tum")
_COMPILED += tuple(
    f"io.sources.{name}"
    for name in ("_cloud", "_pcd", "_poses", "_stereo", "_trajectory", "colmap", "euroc")
)
_COMPILED += ("io.sources.orbslam", "io.sources.rtabmap", "io.sources.scans")
_COMPILED += (
    "io.export",
    "io.ply",
    "io.clouds",
    "io.npy",
    "io.store",
    "io.settings",
    "sim.scenario",
)


def main() -> None:
    options = _options()
    os.environ.update({"PYTHONHASHSEED": "0", "OPENBLAS_NUM_THREADS": "1"})
    if options.child:
        _fuzz(options.target, options.child)
    elif options.show:
        warnings.simplefilter("error")
        print(_target(options.target).run(options.show.read_bytes()))
    elif options.merge:
        _merge(options.target)
    elif options.target == "all":
        _run_all(options)
    else:
        sys.exit(_run(options))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("target")
    parser.add_argument("--runs", type=int, default=1_000_000)
    parser.add_argument("--seconds", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--merge", action="store_true")
    parser.add_argument("--show", type=Path)
    parser.add_argument("--child", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    return parser.parse_args()


def _target(name: str):  # type: ignore[no-untyped-def]
    import targets

    return targets.load(name)


def _run_all(options: argparse.Namespace) -> None:
    """Every target, the slow ones less often."""
    runs, codes = options.runs, []
    for options.target, share in SHARES.items():
        options.runs = max(1, runs * share // sum(SHARES.values()))
        codes.append(_run(options))
    sys.exit(any(codes))


def _run(options: argparse.Namespace) -> int:
    """The fuzzer in a process of its own, since libFuzzer ends the one that it runs in."""
    import targets

    target = targets.load(options.target)
    kept, found = targets.CORPUS / options.target, OUT / options.target
    found.mkdir(parents=True, exist_ok=True)
    until = [f"-max_total_time={options.seconds}"] if options.seconds else [f"-runs={options.runs}"]
    flags = [*LIMITS, *until, f"-seed={options.seed}", f"-max_len={target.max_len}"]
    flags.append(f"-artifact_prefix={OUT}/{options.target}-")
    start = time.monotonic()
    code, text = _child(options.target, [*flags, str(found), str(kept)], target.pure)
    executed = re.search(r"stat::number_of_executed_units:\s*(\d+)", text)
    peak = re.search(r"stat::peak_rss_mb:\s*(\d+)", text)
    figures = {
        "target": options.target,
        "seed": options.seed,
        "executions": int(executed[1]) if executed else 0,
        "seconds": round(time.monotonic() - start, 1),
        "peak_mb": int(peak[1]) if peak else 0,
        "found": code != 0,
    }
    with (OUT / "runs.jsonl").open("a") as log:
        log.write(json.dumps(figures) + "\n")
    print(json.dumps(figures))
    return code


def _child(name: str, arguments: list[str], pure: bool) -> tuple[int, str]:
    """Exit code and output of libFuzzer; shows its last lines where it found something."""
    environment = {**os.environ, **({PURE: "1"} if pure else {})}
    command = [sys.executable, __file__, name, "--child", *arguments]
    log = OUT / f"{name}.log"
    with log.open("w") as file:
        code = subprocess.run(
            command, env=environment, stdout=file, stderr=subprocess.STDOUT, check=False
        ).returncode
    text = log.read_text(errors="replace")
    if code:
        print(text[-4000:], file=sys.stderr)
    return code, text


def _fuzz(name: str, arguments: list[str]) -> None:
    import atheris

    # Edges only: to trace every comparison too costs more than half of the speed.
    with atheris.import_hook.HookManager(
        {"dagmap"}, set(_left_alone()), True, trace_dataflow=False
    ):
        for module in _parsers():
            import_module(f"dagmap.{module}")
    target = _target(name)
    warnings.simplefilter("error")  # a warning is noise on the user's screen

    def mutate(data: bytes, max_size: int, seed: int) -> bytes:
        rng = Random(seed)
        out = target.mutate(
            data, rng, lambda part: atheris.Mutate(part, len(part) + 64) if part else b""
        )
        return out if len(out) <= max_size else data[:max_size]

    again = f"{sys.executable} {__file__} {name} --child"  # a merge starts itself anew, by a shell
    atheris.Setup([again, *arguments], target.run, custom_mutator=mutate)
    atheris.Fuzz()


def _parsers() -> tuple[str, ...]:
    return _PURE if os.environ.get(PURE) else _COMPILED


def _left_alone() -> list[str]:
    """Modules without instrumentation: what parses nothing, and kernels that numba compiles."""
    package = ROOT / "src" / "dagmap"
    files = (path.relative_to(package.parent).with_suffix("") for path in package.rglob("*.py"))
    names = (".".join(path.parts).removesuffix(".__init__") for path in files)
    return sorted(name for name in names if name.removeprefix("dagmap.") not in _parsers())


def _merge(name: str) -> None:
    """Corpus and finds together, the smallest set with the same coverage."""
    import targets

    target, kept = targets.load(name), targets.CORPUS / name
    merged = OUT / f"{name}-merged"
    merged.mkdir(parents=True, exist_ok=True)
    for old in merged.iterdir():
        old.unlink()
    code, _ = _child(
        name, ["-merge=1", *LIMITS, str(merged), str(kept), str(OUT / name)], target.pure
    )
    if code == 0 and any(merged.iterdir()):
        for old in kept.iterdir():
            old.unlink()
        for new in merged.iterdir():
            data = new.read_bytes()
            (kept / hashlib.sha1(data, usedforsecurity=False).hexdigest()).write_bytes(data)
    sys.exit(code)


if __name__ == "__main__":
    main()
