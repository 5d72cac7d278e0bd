"""Parts of a long measurement: each is kept with how it was made, so that it can go on later."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import time
from collections.abc import Callable
from datetime import datetime, timezone
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]


def kept(path: Path, asked: dict[str, Any], part: Callable[[], Any]) -> dict[str, Any]:
    """What a part gave and how it was made: from the file, if that was asked for the same of the
    same code; else measured, and put there."""
    asked = asked | {"code": _code()}
    if path.exists():
        held: dict[str, Any] = json.loads(path.read_text())
        if held["asked"] == asked:
            return held
    began = _spent()
    figures = part()
    spent = [now - then for now, then in zip(_spent(), began, strict=True)]
    if isinstance(figures, dict):
        spent = figures.pop("spent", spent)
    made = {
        "dagmap": version("dagmap"),
        "date": datetime.now(timezone.utc).date().isoformat(),
        "python": platform.python_version(),
        **{package: version(package) for package in ("numpy", "numba")},
        "machine": f"{platform.system()} {platform.machine()}",
        "cores": os.cpu_count(),
        "spent": spent,
    }
    held = {"asked": asked, "made": made, "figures": figures}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(held))
    return json.loads(path.read_text())  # as it will be read


def _spent() -> tuple[float, float]:
    """Processor time of this process and of those it waited for, and wall time, s."""
    return sum(os.times()[:4]), time.monotonic()


@cache
def _code() -> str:
    """Eight digits that change with the code, the scenarios and what is measured of them."""
    paths = [*(ROOT / "src" / "dagmap").rglob("*.py"), *(ROOT / "scenarios").glob("*.toml")]
    digest = hashlib.blake2b(digest_size=4)
    for path in sorted([*paths, ROOT / "bench" / "reliability.py"]):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(ROOT).as_posix()} {len(content)}\n".encode() + content)
    return digest.hexdigest()
