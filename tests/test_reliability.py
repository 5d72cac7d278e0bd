"""bench/reliability.py: what was measured is kept with how it was made."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]


def module(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "bench" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


def test_a_part_is_measured_once_for_each_question_and_each_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keeping, file, done = module("keeping"), tmp_path / "new" / "part.json", []

    def part() -> list[int]:
        done.append(len(done))
        return done

    first = keeping.kept(file, {"seeds": 5}, part)
    assert first["figures"] == [0] and first["asked"]["seeds"] == 5
    assert first["made"]["cores"] >= 1 and len(first["made"]["spent"]) == 2
    assert keeping.kept(file, {"seeds": 5}, part) == first
    assert keeping.kept(file, {"seeds": 6}, part)["figures"] == [0, 1]
    monkeypatch.setattr(keeping, "_code", lambda: "another")
    again = keeping.kept(file, {"seeds": 6}, part)
    assert again["figures"] == [0, 1, 2] and again["asked"]["code"] == "another"


def test_a_part_may_say_itself_what_it_took(tmp_path: Path) -> None:
    held = module("keeping").kept(tmp_path / "a.json", {}, lambda: {"spent": [3.0, 2.0], "x": 1})
    assert held["made"]["spent"] == [3.0, 2.0] and held["figures"] == {"x": 1}


PAGE = ROOT / "docs" / "reliability.md"


def test_the_page_is_written_from_its_figures_alone() -> None:
    """Nobody edits a figure, or the words around it: they are in bench/reliability_text.py."""
    figures = json.loads(PAGE.with_suffix(".json").read_text())
    remedy = "python bench/reliability.py text"
    assert module("reliability_text").text(figures) == PAGE.read_text(), remedy


def test_the_page_has_the_executions_of_the_page_about_fuzzing() -> None:
    figures = json.loads(PAGE.with_suffix(".json").read_text())
    fuzzing = (ROOT / "docs" / "fuzzing.md").read_text()
    assert f"In all {figures['fuzz_executions']:,} coverage-guided" in fuzzing
