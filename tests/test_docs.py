"""The documentation: links lead somewhere, code runs, commands exist, errors are explained."""

from __future__ import annotations

import ast
import re
import shlex
import subprocess
import sys
import unicodedata
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
import typer.main

import dagmap
from dagmap import model
from dagmap.cli import app
from dagmap.config import load_config
from dagmap.io.settings import load_settings
from dagmap.model import DagmapError, Reason
from dagmap.sim.scenario import load_scenario

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(
    [*ROOT.glob("*.md"), *DOCS.rglob("*.md"), *(ROOT / "examples").rglob("*.md")],
    key=str,
)
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.M | re.S)
_LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")


def prose(page: Path) -> str:
    """Without code."""
    return re.sub(r"`[^`\n]+`", "", _FENCE.sub("", page.read_text()))


def anchors(page: Path) -> set[str]:
    """What headings are called in links, as the site and as code hosts make it."""
    found = set()
    for line in _FENCE.sub("", page.read_text()).splitlines():
        if match := re.match(r"#{1,6} (.*)", line):
            text = unicodedata.normalize("NFKD", match[1].replace("`", "")).strip().lower()
            found.add(re.sub(r"[^\w -]", "", text).replace(" ", "-"))
    return found


def blocks(*kinds: str) -> Iterator[tuple[str, str]]:
    """(where, text) of the code blocks of some languages."""
    for name, page in zip(NAMES, PAGES, strict=True):
        for i, (kind, text) in enumerate(_FENCE.findall(page.read_text())):
            if kind in kinds:
                yield f"{name}-{i}", text


def parametrised(*kinds: str) -> pytest.MarkDecorator:
    found = list(blocks(*kinds))
    return pytest.mark.parametrize("text", [t for _, t in found], ids=[name for name, _ in found])


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_lead_somewhere(page: Path) -> None:
    for target in _LINK.findall(prose(page)):
        if "://" in target:
            continue
        file, _, anchor = target.partition("#")
        there = (page.parent / file).resolve() if file else page
        assert there.exists(), f"{target}: no such file"
        if anchor:
            assert anchor in anchors(there), f"{target}: no such heading"


@parametrised("python")
def test_python_runs(text: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", text],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


@parametrised("toml")
def test_toml_loads(text: str, tmp_path: Path) -> None:
    file = tmp_path / "robot1.toml"
    file.write_text(text)
    tables = set(msgspec.toml.decode(text))
    if tables & {"store", "network", "source", "ros"}:
        if "store" not in tables:  # a part of a robot's file
            file.write_text(text + '\n[store]\npath = "ledger.db"\n')
        assert load_settings(file).config.store.path
    elif tables & {"scene", "robots", "link"}:
        assert load_scenario(file).robots
    else:
        assert load_config(file).fold


def commands() -> Iterator[tuple[str, list[str]]]:
    """(where, words) of every `dagmap ...` in blocks that are no other language."""
    for where, text in blocks("", "sh", "bash", "console", "text"):
        for line in text.replace("\\\n", " ").splitlines():
            match = re.match(r"\s*(?:[$#] )?(?:\S*bin/)?dagmap ((?:[a-z-]).*)", line)
            if match and not match[1].startswith("-"):
                yield where, shlex.split(match[1], comments=True)


def test_commands_exist_with_their_options() -> None:
    root = typer.main.get_command(app)
    count = 0
    for where, (name, *words) in commands():
        command = root
        for word in (name, *words):
            inner = getattr(command, "commands", None)
            if inner is None:
                break
            assert word in inner, f"{where}: no command {word!r}"
            command = inner[word]
        known = {option for one in command.params for option in (*one.opts, *one.secondary_opts)}
        for word in words:
            if re.match(r"--\w", word):
                assert word.partition("=")[0] in known, f"{where}: {name} has no {word}"
        count += 1
    assert count > 40


def test_every_option_that_a_page_names_exists() -> None:
    """Also in the text: `--option` in backticks. Some pages are of other programs, too."""
    root = typer.main.get_command(app)
    known = {"--help", "--version"}
    stack = [root]
    while stack:
        command = stack.pop()
        known |= {option for one in command.params for option in (*one.opts, *one.secondary_opts)}
        stack += getattr(command, "commands", {}).values()
    others = {"--runs", "--seconds", "--scenes"}  # of programs in bench
    for page in PAGES:
        if page.name in ("fuzzing.md", "quality.md", "install.md", "experiments.md"):
            continue
        named = set(re.findall(r"`(--[a-z][\w-]+)", page.read_text()))
        assert named <= known | others, f"{page.name}: {named - known - others}"


# --- Troubleshooting

TROUBLE = (DOCS / "troubleshooting.md").read_text()


def test_every_reason_is_explained() -> None:
    for reason in Reason:
        assert f"| `{reason.name}` | {reason.value} |" in TROUBLE, reason


def test_every_kind_of_error_is_explained() -> None:
    kinds = [
        name
        for name, value in vars(model).items()
        if isinstance(value, type) and issubclass(value, DagmapError)
    ]
    assert len(kinds) > 5
    for name in kinds:
        assert f"### {name}\n" in TROUBLE, name


def test_every_event_of_the_log_is_explained() -> None:
    page = (DOCS / "fleet.md").read_text()
    found = set()
    for file in (ROOT / "src" / "dagmap").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "attr", "") in ("write", "seldom"):
                words = [a.value for a in node.args[:2] if isinstance(a, ast.Constant)]
                if len(words) == 2 and words[0] in ("warning", "error"):
                    found.add(words[1])
    assert len(found) > 4
    for event in found:
        assert f"`{event}`" in page, event


def said() -> str:
    """All strings in the code, formatted parts left out, one a line."""
    parts = []
    for file in (ROOT / "src" / "dagmap").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                parts.append(node.value)
    return "\n".join(parts)


def test_what_the_page_quotes_is_what_the_code_says() -> None:
    errors = TROUBLE[TROUBLE.index("## Errors by kind") : TROUBLE.index("## Lines of the log")]
    quoted = re.findall(r"^\| `([^`]+)` \|", errors, re.M)
    everything = said()
    assert len(quoted) > 15
    for words in quoted:
        assert words in everything, f"no error says {words!r}"


def test_every_public_name_is_in_the_reference() -> None:
    page = (DOCS / "api.md").read_text()
    for name in dagmap.__all__:
        assert re.search(rf"^::: dagmap\.[\w.]*\b{name}$", page, re.M), name


# --- The site


def test_the_site_builds_without_a_warning_and_fetches_nothing(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings")
    pytest.importorskip("material")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT, capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > 15
    for page in pages:
        text = page.read_text()
        fetched = re.findall(r'<(?:script|img|iframe)[^>]+src="(https?:)?//', text)
        fetched += re.findall(r'<link[^>]+rel="(?:stylesheet|preconnect)"[^>]+href="https?:', text)
        assert not fetched, page.name
    api = (tmp_path / "site" / "api.html").read_text()
    assert "observe" in api and "strictly increasing within a session" in api
    assert "observations within it are twins" in api  # a comment in the code


def test_every_page_is_in_the_navigation() -> None:
    nav = (ROOT / "mkdocs.yml").read_text().partition("\nnav:")[2]
    for page in DOCS.glob("*.md"):
        assert f": {page.name}\n" in nav, page.name
