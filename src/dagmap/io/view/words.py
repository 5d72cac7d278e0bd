"""What the panel beside the map says, as HTML. Names come from strangers, so all is escaped."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING

from ...config import FoldConfig
from ...model import State
from .colouring import legend
from .picking import reason, sightings
from .snapshot import Said, Snapshot
from .source import Standing

if TYPE_CHECKING:
    from ...worldmap import WorldMap

_NEWEST = 6  # transactions that are listed
_SEEN = 8  # robots of one node that are listed
_GREEN, _RED, _GREY = "#1d9a3c", "#d7301f", "#8a8a8a"


def standing(title: str, standings: Sequence[Standing], digest: str, remark: str) -> str:
    """The sign of agreement, and every robot's digest."""
    known = [each.agrees for each in standings]
    if not known:
        sign, words = _GREY, "waiting for robots"
    elif all(known):
        sign, words = _GREEN, f"&#10003; all {len(known)} robots agree"
    elif False in known:
        sign, words = _RED, f"&#10007; {known.count(True)} of {len(known)} robots agree"
    else:
        sign, words = _GREY, "not known of all robots"
    rows = [
        (
            _colored(_SIGNS[each.agrees], (_GREEN if each.agrees else _RED)),
            escape(each.robot),
            _code(each.digest[: 18 if each.digest.startswith("heads ") else 12]),
            escape(each.detail),
        )
        for each in standings
    ]
    note = f"<p><b>{escape(remark)}</b></p>" if remark else ""
    return _box(
        f"<div>{escape(title)}</div>"
        f'<div style="font-size:1.15em;font-weight:700;color:{sign}">{words}</div>'
        f"<div>shown: {_code(digest[:16])}</div>{_table(rows)}{note}"
    )


_SIGNS = {True: "&#10003;", False: "&#10007;", None: "?"}


def colours(colouring: str, names: Sequence[str]) -> str:
    """The legend."""
    entries = [
        f'<span style="white-space:nowrap">{_colored("&#9632;", color)} {escape(name)}</span>'
        for name, color in legend(colouring, names)
    ]
    return _box(" &nbsp; ".join(entries)) if entries else ""


def counts(snapshot: Snapshot, shown: int) -> str:
    """How many nodes there are."""
    states = snapshot.world.states
    parts = [f"{int((states == state).sum()):,} {state.name.lower()}" for state in State]
    return _box(f"{len(states):,} nodes: {', '.join(parts)}; {shown:,} points drawn")


def newest(said: Sequence[Said], count: int) -> str:
    """The transactions before the slider, the newest first."""
    rows = [
        (
            f"{count - i:,}",
            escape(each.robot),
            f"#{each.transaction.sequence}",
            f"{each.transaction.features:,} features",
            _seconds(each.stamp),
        )
        for i, each in enumerate(reversed(said[-_NEWEST:]))
    ]
    return _box(_table(rows) if rows else "no transaction yet")


def node(world: WorldMap, number: int, said: Iterable[Said], fold: FoldConfig) -> str:
    """Who saw a node, when, and why it is kept."""
    sequences = {each.transaction.id: each.transaction.sequence for each in said}
    place = ", ".join(f"{value:.3f}" for value in world.positions[number])
    state = State(int(world.states[number])).name.lower()
    found = sightings(world, number)
    rows = []
    for robot, observations in found[:_SEEN]:
        first, last = observations[0], observations[-1]
        numbers = dict.fromkeys(sequences.get(o.transaction) for o in observations)
        named = ", ".join(f"#{n}" for n in list(numbers)[:4] if n is not None)
        more = ", ..." if len(numbers) > 4 else ""
        rows.append(
            (
                escape(robot),
                f"{len(observations)}x",
                _seconds(first.stamp)
                + (f" to {_seconds(last.stamp)}" if last.stamp > first.stamp else ""),
                named + more,
            )
        )
    rest = f"<div>and {len(found) - _SEEN} robots more</div>" if len(found) > _SEEN else ""
    return _box(
        f"<b>node {number:,}</b> at ({place}) m: <b>{state}</b>"
        f"<div>{escape(reason(world, number, fold))}</div>{_table(rows)}{rest}"
    )


def plain(text: str) -> str:
    """A sentence."""
    return _box(escape(text)) if text else ""


def _seconds(stamp: float) -> str:
    return "" if math.isnan(stamp) else f"{stamp:.2f} s"


def _table(rows: Iterable[Sequence[str]]) -> str:
    cells = "".join(
        "<tr>" + "".join(f'<td style="padding:0 .6em .1em 0">{c}</td>' for c in row) + "</tr>"
        for row in rows
    )
    return f'<table style="border-collapse:collapse">{cells}</table>' if cells else ""


def _box(html: str) -> str:
    return f'<div style="font-size:.8rem;line-height:1.45;padding:.1rem .6rem">{html}</div>'


def _code(text: str) -> str:
    return f'<code style="font-size:.95em">{escape(text)}</code>'


def _colored(text: str, color: str) -> str:
    return f'<span style="color:{color}">{text}</span>'
