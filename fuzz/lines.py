"""Which lines of the parsers the corpus does not reach.

    NUMBA_DISABLE_JIT=1 python fuzz/lines.py [TARGET ...]

Lines are statements of functions, found in the source; those of the functions that a target leaves
out (encoders) are not counted. Exits with 1 where one of the rest is not reached.
"""

from __future__ import annotations

import ast
import json
import sys
from collections import defaultdict
from collections.abc import Iterator
from fnmatch import fnmatch
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Any

import targets

UNREACHABLE = Path(__file__).with_name("unreachable.json")
Span = tuple[int, int]  # first and last line of a statement's own code


def statements(path: Path, left_out: tuple[str, ...]) -> Iterator[tuple[str, Span]]:
    """(function, lines) of every statement in the functions of a module."""
    yield from _inside(ast.parse(path.read_text()), "", left_out)


def _inside(node: ast.AST, name: str, left_out: tuple[str, ...]) -> Iterator[tuple[str, Span]]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, (ast.FunctionDef, ast.ClassDef)):
            inner = f"{name}.{child.name}" if name else child.name
            if not _left_out(inner, left_out):
                yield from _inside(child, inner, left_out)
            continue
        in_function = name and not isinstance(node, ast.ClassDef)
        if in_function and isinstance(child, ast.stmt) and _runs(child):
            yield name, _span(child)
        yield from _inside(child, name, left_out)


def _left_out(name: str, patterns: tuple[str, ...]) -> bool:
    """Patterns that begin with "!" name what alone is counted."""
    kept = [pattern[1:] for pattern in patterns if pattern.startswith("!")]
    if kept:
        return not any(fnmatch(name, pattern) for pattern in kept)
    return any(fnmatch(name, pattern) for pattern in patterns)


def _runs(statement: ast.stmt) -> bool:
    """Whether a statement has code of its own: not docstrings, `try`, bare types."""
    if isinstance(statement, ast.Expr):
        return not isinstance(statement.value, ast.Constant)
    if isinstance(statement, ast.AnnAssign):
        return statement.value is not None
    if isinstance(statement, ast.While):
        return not isinstance(statement.test, ast.Constant)
    return not isinstance(statement, (ast.Try, ast.Pass, ast.Global, ast.Nonlocal))


def _span(statement: ast.stmt) -> Span:
    """All its lines; of a statement with a body, those before the body."""
    body = getattr(statement, "body", None)
    last = statement.end_lineno or statement.lineno
    return statement.lineno, max(statement.lineno, body[0].lineno - 1) if body else last


class Tracer:
    """Lines of some files that run while it is on."""

    def __init__(self, files: set[str]) -> None:
        self.lines: dict[str, set[int]] = defaultdict(set)
        self._files = files

    def __enter__(self) -> Tracer:
        sys.settrace(self._call)
        return self

    def __exit__(self, *_: object) -> None:
        sys.settrace(None)

    def _call(self, frame: FrameType, event: str, argument: object) -> Any:
        return self._line if frame.f_code.co_filename in self._files else None

    def _line(self, frame: FrameType, event: str, argument: object) -> Any:
        self.lines[frame.f_code.co_filename].add(frame.f_lineno)
        return self._line


def reached(names: list[str]) -> tuple[int, list[str]]:
    """Statements of these targets' parsers, and what of them the corpora do not reach."""
    parsers: dict[str, tuple[str, ...]] = {}
    every = {name: targets.load(name) for name in names}
    loaded = {name: target for name, target in every.items() if target.parsers}
    for target in loaded.values():
        parsers |= target.parsers
    files = {name: Path(str(import_module(name).__file__)) for name in parsers}
    tracer = Tracer({str(path) for path in files.values()})
    for name, target in loaded.items():
        for data in targets.corpus(name):
            with tracer:  # anew each time: Python drops a tracer in which its stack ran out
                target.run(data)
    total, missed = 0, []
    for name, path in files.items():
        for function, (first, last) in statements(path, parsers[name]):
            total += 1
            if not tracer.lines[str(path)] & set(range(first, last + 1)):
                text = path.read_text().splitlines()[first - 1].strip()
                missed.append(f"{name}.{function}: {text}")
    return total, missed


def unreachable() -> dict[str, str]:
    """Statements that no input of a parser reaches, and why."""
    return dict(json.loads(UNREACHABLE.read_text())) if UNREACHABLE.exists() else {}


def main() -> None:
    total, missed = reached(sys.argv[1:] or targets.names())
    known = unreachable()
    print(f"{total - len(missed)} of {total} statements reached")
    print("\n".join(f"{'known' if line in known else 'MISSED'}: {line}" for line in missed))
    sys.exit(any(line not in known for line in missed))


if __name__ == "__main__":
    main()
