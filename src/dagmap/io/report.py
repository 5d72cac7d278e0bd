"""One self-contained page about a replay: figures embedded, no scripts; for screen and paper."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from ..model import OutputError
from .export import atomic_write

_CAPTIONS = {  # by the stem of the file
    "maps": (
        "Figure 10 of the paper: (a) all features of the SLAMs, (b) the adjacency graphs and what "
        "was broadcast of them, (c) everything that the transactions hold, (d) the map: kept nodes "
        "in the colour seen, rejected ones in red."
    ),
    "traffic": (
        "Figure 11 of the paper: features on the network each second, log scale. Without DAGmap a "
        "robot would broadcast every feature as soon as its SLAM puts it out."
    ),
}
_COLUMNS = (  # key in summary["robots"], heading
    ("name", "Robot"),
    ("cycles", "Cycles"),
    ("features_observed", "Features observed"),
    ("features_issued", "Features issued"),
    ("transactions", "Transactions"),
)
_COUNTED = ("bytes_sent", "bytes_received", "features_issued", "features_observed")
_HEXADECIMAL = set("0123456789abcdef")
_STATES = (
    ("confirmed", "Confirmed", "seen by enough robots, more hits than misses"),
    ("tentative", "Tentative", "more hits than misses, too few robots so far"),
    ("rejected", "Rejected", "voted out; comes back where it is seen again"),
)
_SHOWN = {  # keys of the summary that have a place of their own on the page
    "converged",
    "digest",
    "robots",
    "map",
    "bytes_per_feature",
    "wall_s",
    "parameters",
    "versions",
}
_CSS = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 68rem; padding: 1.5rem 1.1rem 3rem;
  background: #fff; color: #1a1a1a;
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
h1 { font-size: 1.6rem; margin: 0 0 .3rem; }
h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; border-bottom: 1px solid #ddd; }
.verdict { padding: .7rem 1rem; border-left: 5px solid; margin: 1rem 0; }
.yes { border-color: #1d9a3c; background: #eef8f0; }
.no { border-color: #d7301f; background: #fdf0ee; }
code, pre { font: .82rem/1.45 ui-monospace, "DejaVu Sans Mono", Menlo, Consolas, monospace; }
code { overflow-wrap: anywhere; }
pre { background: #f6f6f6; padding: .8rem 1rem; overflow-x: auto; white-space: pre-wrap; }
.facts { display: grid; grid-template-columns: repeat(auto-fit, minmax(9rem, 1fr)); gap: .7rem;
  margin: 0; }
.facts div { border: 1px solid #ddd; border-radius: 4px; padding: .5rem .8rem; }
.facts dt { color: #595959; font-size: .82rem; }
.facts dd { margin: 0; font-size: 1.25rem; font-weight: 600; font-variant-numeric: tabular-nums; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; }
th, td { padding: .3rem .8rem .3rem 0; text-align: right; border-bottom: 1px solid #e6e6e6;
  font-variant-numeric: tabular-nums; white-space: nowrap; }
th { color: #595959; font-weight: 600; vertical-align: bottom; }
th:first-child, td:first-child, td.text, th.text { text-align: left; }
td.text { white-space: normal; }
figure { margin: 0 0 1.5rem; }
img { max-width: 100%; height: auto; display: block; }
figcaption { color: #595959; font-size: .88rem; margin-top: .4rem; max-width: 52rem; }
td code { overflow-wrap: anywhere; white-space: normal; }
@media screen and (max-width: 40rem) {
  body { padding: 1rem .8rem 2rem; }
  .facts { grid-template-columns: 1fr 1fr; }
  table, tbody, tr, td { display: block; width: 100%; }
  tr { padding: .4rem 0; border-bottom: 1px solid #ddd; }
  tr:first-child { display: none; }
  td, td.text { display: flex; justify-content: space-between; gap: 1rem; text-align: right;
    padding: .1rem 0; border: 0; white-space: normal; }
  td::before { content: attr(data-label); color: #595959; text-align: left; flex: none; }
  td:first-child { font-weight: 600; }
}
@page { margin: 14mm; }
@media print {
  body { max-width: none; padding: 0; font-size: 9.5pt; }
  figure, tr, .facts, .verdict { break-inside: avoid; }
  img { max-height: 22cm; }
  h2 { break-after: avoid; }
  th, td { white-space: normal; }
  .facts div, .verdict { -webkit-print-color-adjust: exact; print-color-adjust: exact; }
}
"""


def write_report(
    path: Path,
    summary: Mapping[str, Any],
    figures: Sequence[Path],
    parameters: str,
    versions: Mapping[str, str],
) -> None:
    """Write `report.html`. Raises OutputError, also where a figure cannot be read.

    summary: what `summary.json` holds; entries beyond the documented ones are listed as they are.
    figures: PNG files in the order in which they are shown.
    parameters: the configuration as text. versions: of whatever took part, by name.
    """
    page = "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>DAGmap report</title>\n<style>{_CSS}</style>\n</head>\n<body>",
            "<h1>DAGmap report</h1>",
            _verdict(summary),
            _facts(summary),
            *(_figure(figure) for figure in figures),
            f"<h2>Robots</h2>\n{_robots(summary)}",
            f"<h2>Map</h2>\n{_states(summary.get('map', {}))}",
            f"<h2>Traffic of the robots</h2>\n{_bytes(summary)}",
            f"<h2>Agreement</h2>\n{_agreement(summary)}",
            _further(summary),
            f"<h2>Parameters</h2>\n{_parameters(summary, parameters)}",
            f"<h2>Versions</h2>\n{_table(('Of', 'Version'), versions.items())}",
            "</body>\n</html>\n",
        ]
    )
    with atomic_write(path) as file:
        file.write(page.encode())


def _verdict(summary: Mapping[str, Any]) -> str:
    robots = summary.get("robots", [])
    if summary.get("converged"):
        words = f"All {len(robots)} robots hold the same map."
        digest = escape(str(summary.get("digest", "")))
        return (
            f'<p class="verdict yes"><strong>{words}</strong><br>Digest <code>{digest}</code></p>'
        )
    digests = len({robot.get("digest") for robot in robots})
    words = f"The robots do not hold the same map: {len(robots)} robots, {digests} digests."
    return f'<p class="verdict no"><strong>{words}</strong></p>'


def _facts(summary: Mapping[str, Any]) -> str:
    robots, nodes = summary.get("robots", []), summary.get("map", {})
    facts = [
        ("Features observed", _number(sum(r.get("features_observed", 0) for r in robots))),
        ("Features issued", _number(sum(r.get("features_issued", 0) for r in robots))),
        ("Nodes in the map", _number(nodes.get("confirmed", 0) + nodes.get("tentative", 0))),
        ("Rejected nodes", _number(nodes.get("rejected", 0))),
        ("Bytes per feature", _number(summary.get("bytes_per_feature"))),
        ("Time", f"{_number(summary.get('wall_s'))} s"),
    ]
    cells = "\n".join(f"<div><dt>{name}</dt><dd>{value}</dd></div>" for name, value in facts)
    return f'<dl class="facts">\n{cells}\n</dl>'


def _figure(path: Path) -> str:
    try:
        data = base64.b64encode(path.read_bytes()).decode()
    except OSError as error:
        raise OutputError(
            f"{path}: a figure for the report cannot be read ({error.strerror}); draw it first"
        ) from error
    caption = escape(_CAPTIONS.get(path.stem, path.stem))
    return (
        f'<h2>{escape(path.stem.capitalize())}</h2>\n<figure><img alt="{caption}" '
        f'src="data:image/png;base64,{data}">\n<figcaption>{caption}</figcaption></figure>'
    )


def _robots(summary: Mapping[str, Any]) -> str:
    rows = [[robot.get(key) for key, _ in _COLUMNS] for robot in summary.get("robots", [])]
    return _table([heading for _, heading in _COLUMNS], rows)


def _bytes(summary: Mapping[str, Any]) -> str:
    """What every robot sent and got, a message to everybody counted once, and their sum."""
    rows, sums = [], dict.fromkeys(_COUNTED, 0)
    for robot in summary.get("robots", []):
        counts = {key: robot.get(key) or 0 for key in _COUNTED}
        sums = {key: sums[key] + count for key, count in counts.items()}
        rows.append(_traffic_row(robot.get("name"), counts))
    headings = ("Robot", "Bytes sent", "Bytes received", "Bytes per feature", "Features sent")
    return _table(headings, [*rows, _traffic_row("All", sums)])


def _traffic_row(name: Any, counts: Mapping[str, int]) -> tuple[Any, ...]:
    sent, received, issued, observed = (counts[key] for key in _COUNTED)
    share = f"{100 * issued / observed:.1f} %" if observed else None
    return name, sent, received, sent / issued if issued else None, share


def _agreement(summary: Mapping[str, Any]) -> str:
    """Whose digest is that of the run."""
    rows = []
    for robot in summary.get("robots", []):
        same = robot.get("digest") == summary.get("digest")
        rows.append((robot.get("name"), "yes" if same else "NO", str(robot.get("digest") or "")))
    return _table(("Robot", "The same map", "Digest"), rows)


def _parameters(summary: Mapping[str, Any], text: str) -> str:
    """A row each, where the summary has them; else as the text that was given."""
    told = summary.get("parameters")
    if not isinstance(told, Mapping):
        return f"<pre>{escape(text.strip())}</pre>"
    return _table(("Parameter", "Value"), _flat("parameters.", told, len("parameters.")))


def _states(nodes: Mapping[str, Any]) -> str:
    total = max(nodes.get("nodes", 0), 1)
    rows = [
        (name, nodes.get(key, 0), f"{100 * nodes.get(key, 0) / total:.1f} %", meaning)
        for key, name, meaning in _STATES
    ]
    return _table(
        ("State", "Nodes", "Share", "Meaning"), [*rows, ("All", nodes.get("nodes"), "", "")]
    )


def _further(summary: Mapping[str, Any]) -> str:
    """Whatever else was measured."""
    rows = [(key, value) for key, value in _flat("", summary) if value is not None]
    return f"<h2>Further figures</h2>\n{_table(('What', 'Value'), rows)}" if rows else ""


def _flat(prefix: str, entries: Mapping[str, Any], cut: int = 0) -> Iterable[tuple[str, Any]]:
    """Every value with the names that lead to it, less the first `cut` letters of these."""
    for key, value in entries.items():
        if not prefix and key in _SHOWN:
            continue
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from _flat(f"{name}.", value, cut)
        elif isinstance(value, (list, tuple)):
            yield name[cut:], ", ".join(map(str, value)) or None
        else:
            yield name[cut:], value


def _table(headings: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Words and the first column are set to the left, numbers to the right."""
    cells = [list(row) for row in rows]
    text = [i == 0 or any(_is_words(row[i]) for row in cells) for i in range(len(headings))]
    head = "".join(_cell("th", name, left) for name, left in zip(headings, text, strict=True))
    body = "\n".join(
        "<tr>"
        + "".join(
            _cell("td", v, left, label) for v, left, label in zip(row, text, headings, strict=True)
        )
        + "</tr>"
        for row in cells
    )
    return f'<div class="wide"><table>\n<tr>{head}</tr>\n{body}\n</table></div>'


def _is_words(value: Any) -> bool:
    return isinstance(value, str) and any(letter.isalpha() for letter in value)


def _cell(tag: str, value: Any, left: bool, label: str = "") -> str:
    """label: the heading, which a narrow screen shows beside the value."""
    style = ' class="text"' if left else ""
    named = f' data-label="{escape(label)}"' if label else ""
    text = escape(value if isinstance(value, str) else _number(value))
    if isinstance(value, str) and len(value) == 64 and set(value) <= _HEXADECIMAL:
        text = f"<code>{text}</code>"
    return f"<{tag}{style}{named}>{text}</{tag}>"


def _number(value: Any) -> str:
    """Whole numbers with separators, others to three digits, a dash for what was not measured."""
    if value is None:
        return "\N{EN DASH}"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return str(value)
