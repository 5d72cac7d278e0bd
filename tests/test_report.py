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
    told = {"versions": {"numpy": "told elsewhere"}}
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


def rows(page: Page, table: str) -> list[list[str]]:
    """The cells of the table under a heading of the page."""
    text = page.text.split(f"|{table}|")[1]
    cells = [cell.strip() for cell in text.split("|") if cell.strip()]
    columns = cells.index("ada")
    return [cells[i : i + columns] for i in range(0, 4 * columns, columns)]


def test_agreement_names_who_holds_another_map(tmp_path: Path) -> None:
    changed = summary()
    changed["robots"][1]["digest"] = "77" * 32
    table = rows(report(tmp_path, changed), "Agreement")
    assert table[:3] == [
        ["Robot", "The same map", "Digest"],
        ["ada", "yes", "5a" * 32],
        ["bob", "NO", "77" * 32],
    ]


def test_traffic_of_each_robot_and_of_all(tmp_path: Path) -> None:
    changed = summary()
    changed["robots"][1] |= {"bytes_sent": 1000, "features_issued": 500, "features_observed": 707}
    table = rows(report(tmp_path, changed), "Traffic of the robots")
    assert table == [
        ["Robot", "Bytes sent", "Bytes received", "Bytes per feature", "Features sent"],
        ["ada", "71,234", "140,000", "7.21", "69.1 %"],
        ["bob", "1,000", "140,000", "2", "70.7 %"],
        ["All", "72,234", "280,000", "6.96", "69.2 %"],
    ]


def test_parameters_are_a_table_where_the_summary_has_them(tmp_path: Path) -> None:
    told = {"fleet": "office", "graph": {"v_th": 8, "n_p": 2}, "path": None, "pose": [1.0, 0.5]}
    page = report(tmp_path, summary(parameters=told))
    for row in ("fleet|office|", "graph.v_th|8|", "graph.n_p|2|", "pose|1.0, 0.5|"):
        assert row in page.text
    assert "v_th = 8" not in page.text


def test_every_section_is_there_for_a_phone_and_for_paper(tmp_path: Path) -> None:
    page = report(tmp_path, summary())
    headings = re.findall("<h2>(.*?)</h2>", (tmp_path / "report.html").read_text("utf-8"))
    assert headings == [
        *("Maps", "Traffic", "Robots", "Map", "Traffic of the robots", "Agreement"),
        *("Parameters", "Versions"),
    ]
    cells = [attrs for tag, attrs in page.tags if tag == "td"]
    assert cells and all(attrs.get("data-label") for attrs in cells)  # a narrow screen shows them
    viewport = {attrs.get("name"): attrs.get("content") for tag, attrs in page.tags}
    assert viewport["viewport"] == "width=device-width, initial-scale=1"
    css = (tmp_path / "report.html").read_text("utf-8").split("</style>")[0]
    assert "@media print" in css and "@media screen and (max-width" in css
    assert not re.search(r"url\(|@import", css)


def test_names_cannot_leave_an_attribute(tmp_path: Path) -> None:
    changed = summary()
    changed["robots"][0]["name"] = '"><script>alert(1)</script>'
    changed['x" onclick="alert(1)'] = 1
    page = report(tmp_path, changed)
    assert "script" not in {tag for tag, _ in page.tags}
    assert all("onclick" not in attrs for _, attrs in page.tags)
