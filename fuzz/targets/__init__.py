"""What is fuzzed: one module per parser, found by being here, with a constant `TARGET`.

A target's `run` takes any bytes. It returns whether they were taken (True) or refused with a typed
error (False); whatever else it raises is a finding.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from random import Random

from grammar import Flip

CORPUS = Path(__file__).parents[1] / "corpus"
FOUND = Path(__file__).parents[1] / "found"  # what once was no typed refusal, by target


@dataclass(frozen=True)
class Target:
    """run: the parser at work. mutate: a change that keeps the rest of the format in order.

    seeds: inputs that the real encoders wrote. parsers: modules, each with the names of functions
    that its lines are counted without (encoders; what only a broken installation reaches).
    """

    run: Callable[[bytes], bool]
    mutate: Callable[[bytes, Random, Flip], bytes]
    seeds: Callable[[], Iterable[bytes]]
    parsers: dict[str, tuple[str, ...]]
    max_len: int = 4096
    generated: tuple[bytes, ...] = ()  # inputs of the corpus that are too large to be kept as files
    pure: bool = False  # kernels as plain Python, so that they are instrumented too


def names() -> list[str]:
    """All targets, by name."""
    found = (module.name for module in pkgutil.iter_modules(__path__))
    return sorted(name for name in found if not name.startswith("_"))


def load(name: str) -> Target:
    """A target by its name."""
    target = import_module(f"{__name__}.{name}").TARGET
    assert isinstance(target, Target)
    return target


def corpus(name: str) -> list[bytes]:
    """The kept inputs of a target, in order of their names, and the generated ones."""
    files = sorted((CORPUS / name).iterdir())
    return [*(path.read_bytes() for path in files), *load(name).generated]
