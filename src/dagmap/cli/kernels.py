"""Compiling the kernels is slow once; this does it up front and says so."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from rich.console import Console


def warm_up(console: Console) -> float:
    """Run every kernel that an agent uses once. Returns the seconds it took."""
    from ..agent import Agent
    from ..config import Config, TransactionConfig
    from ..identity import Identity
    from ..model import Cycle

    started = time.perf_counter()
    if not _compiled_before():
        console.print("compiling the kernels: once after an installation, about ten seconds")
    agent = Agent(
        Identity.from_seed(bytes(32)), Config(transaction=TransactionConfig(proof_of_work_bits=0))
    )
    points = np.zeros((12, 3))
    colors = np.zeros((12, 3), np.uint8)
    agent.observe(Cycle(0.0, np.eye(4), points, colors=colors), 0.0)
    agent.observe(Cycle(1.0, np.eye(4), points, ids=np.arange(12), colors=colors), 1.0)
    agent.observe(Cycle(2.0, np.eye(4), points[:0], removed=[3]), 4.0)
    agent.digest()
    return time.perf_counter() - started


def _compiled_before() -> bool:
    """Whether an earlier process left compiled kernels on disk."""
    from ..kernels.jit import KERNELS

    caches = [k._cache for k in KERNELS if hasattr(k, "_cache")]  # none without a compiler
    paths = {str(path) for cache in caches if (path := getattr(cache, "cache_path", None))}
    return all(any(Path(path).glob("*.nbi")) for path in paths)
