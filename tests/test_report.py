from __future__ import annotations

import base64
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from dagmap.io.report import write_report
from dagmap.model import OutputError

VOID = {"meta", "img", "br"}


class Page(HTMLParser):
    """Checks that tags are balanced; collects them and the text."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.text += data + "|"


def summary(**changes: Any) -> dict[str, Any]:
    robots = [
        {
            "name": name,
            "digest": "5a" * 32,
            "cycles": 42,
            "features_observed": 14293,
            "features_issued": 9876,
            "transactions": 41,
            "bytes_sent": 71234,
            "bytes_received": 140000,
        }
        for name in ("ada", "bob")
    ]
    return {
        "converged": True,
        "digest": "5a" * 32,
        "robots": robots,
        "map": {"nodes": 4000, "confirmed": 1000, "tentative": 2500, "rejected": 500},
        "bytes_per_feature": 7.2345,
        "wall_s": 4.93,
        **changes,
    }


def report(tmp_path: Path, summary_: dict[str, Any], **arguments: Any) -> Page:
    figures = []
    for name in ("maps", "traffic"):
        figures.append(tmp_path / f"{name}.png")
        figures[-1].write_bytes(b"\x89PNG" + name.encode())
    arguments = {"parameters": "v_th = 8", "versions": {"dagmap": "0.1.0"}, **arguments}
    write_report(tmp_path / "report.html", summary_, figures, **arguments)
    return Page((tmp_path / "report.html").read_text("utf-8"))


def test_everything_stands_on_the_page(tmp_path: Path) -> None:
    page = report(tmp_path, summary())
    for words in (
        *("All 2 robots hold the same map.", "5a" * 32, "ada", "bob", "14,293", "9,876"),
        *("71,234", "140,000", "1,000", "2,500", "62.5 %", "3,500", "7.23", "4.93 s"),
        *("v_th = 8", "dagmap", "0.1.0"),
    ):
        assert words in page.text, words


def test_the_page_is_self_contained(tmp_path: Path) -> None:
    page = report(tmp_path, summary())
    sources = [attrs["src"] for tag, attrs in page.tags if tag == "img"]
    data = [base64.b64decode(re.sub("^data:image/png;base64,", "", s or "")) for s in sources]
    assert data == [b"\x89PNGmaps", b"\x89PNGtraffic"]
    assert all(attrs.get("alt") for tag, attrs in page.tags if tag == "img")
    assert not {"script", "link", "iframe"} & {tag for tag, _ in page.tags}
    assert "://" not in (tmp_path / "report.html").read_text("utf-8")


def test_robots_that_disagree_are_not_called_converged(tmp_path: Path) -> None:
    changed = summary(converged=False)
    changed["robots"][1]["digest"] = "77" * 32
    page = report(tmp_path, changed)
    assert "The robots do not hold the same map: 2 robots, 2 digests." in page.text
    assert "hold the same map.|" not in page.text


def test_whatever_else_was_measured_is_listed(tmp_path: Path) -> None:
    more = {"loss": 0.1, "late": {"robot": "cleo", "undone": 12}, "left": ["ada", "bob"]}
    told = {"versions": {"numpy": "told elsewhere"}, "parameters": {"v_th": "told elsewhere"}}
    page = report(tmp_path, summary(**more, **told, nothing=None, nobody=[]))
    assert "loss|0.1|" in page.text
    assert "late.robot|cleo|" in page.text
    assert "late.undone|12|" in page.text
    assert "left|ada, bob|" in page.text
    assert not {"nothing", "nobody", "told elsewhere"} & set(page.text.split("|"))


def test_names_cannot_put_markup_on_the_page(tmp_path: Path) -> None:
    changed = summary()
    changed["robots"][0]["name"] = "<script>alert(1)</script>"
    changed["<b>"] = "<i>&"
    page = report(tmp_path, changed, parameters="</pre><b>", versions={"<u>": "</td>"})
    assert not {"script", "b", "i", "u"} & {tag for tag, _ in page.tags}
    assert "<script>alert(1)</script>" in page.text


def test_a_summary_of_nothing_is_a_page_all_the_same(tmp_path: Path) -> None:
    page = report(tmp_path, summary(robots=[], map={}, bytes_per_feature=None))
    assert "Bytes per feature|\N{EN DASH}|" in re.sub(r"\|\s*\|", "|", page.text)


def test_a_figure_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"maps\.png: .*cannot be read"):
        write_report(tmp_path / "report.html", summary(), [tmp_path / "maps.png"], "", {})
    assert list(tmp_path.iterdir()) == []
