"""`dagmap bench`: runs the files of `bench/`, each a module with `run() -> list of rows`.

One that takes minutes says `BY_NAME_ONLY = True`.
"""

from __future__ import annotations

import importlib.util
import json
import platform
import sys
from itertools import groupby
from pathlib import Path
from types import ModuleType
from typing import Any

from rich.console import Console
from rich.table import Table

from ..model import DagmapError
from .kernels import warm_up


def run_benchmarks(folder: Path, names: list[str], as_json: bool) -> int:
    """Run the named ones; without names all that take seconds. Raises DagmapError for others."""
    progress = Console(stderr=True)
    found = {path.stem: path for path in sorted(folder.glob("*.py"))}
    if not found:
        raise DagmapError(
            f"{folder}: no benchmarks here; they are in the folder bench of a checkout, name it "
            "with --dir"
        )
    unknown = [name for name in names if name not in found]
    if unknown:
        raise DagmapError(f"no benchmark called {unknown[0]}; there are: {', '.join(found)}")
    results: dict[str, Any] = {"machine": platform.platform(), "python": platform.python_version()}
    sys.path.insert(0, str(folder))
    warm_up(progress)
    for name in names or found:
        module = _load(found[name])
        if not hasattr(module, "run") or (not names and hasattr(module, "BY_NAME_ONLY")):
            continue
        progress.print(f"running {name}")
        results[name] = module.run()
        if not as_json:
            _show(name, results[name])
    if as_json:
        sys.stdout.write(json.dumps(results, indent=2) + "\n")
    return 0


def _load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


def _show(name: str, rows: list[dict[str, Any]]) -> None:
    """A table for those rows after each other that say the same things."""
    for columns, alike in groupby(rows, key=tuple):
        table = Table(title=name)
        for column in columns:
            table.add_column(column.replace("_", " "), overflow="fold")
        for row in alike:
            table.add_row(*(_cell(row[column]) for column in columns))
        Console().print(table)


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    if value is None:
        return ""
    return f"{value:,}" if isinstance(value, int) else str(value)
