"""`dagmap status`: what a running agent says of itself, for people or as JSON."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from ..io.settings import load_settings
from ..io.status import ask


def show_status(target: Path, as_json: bool) -> int:
    """Ask the agent of a configuration file, or behind a socket. Raises DagmapError."""
    path = load_settings(target).control if target.suffix == ".toml" else target
    answer = ask(path)
    if as_json:
        sys.stdout.write(json.dumps(answer) + "\n")
        return 0
    console = Console()
    lag, nodes = answer["lag"], answer["map"]
    console.print(f"{answer['name']} ({answer['author']}) in fleet {answer['fleet']}")
    digest = answer["digest"] or "not known yet: the map is being revised, and shown as it was"
    console.print(f"digest {digest}", soft_wrap=True)
    console.print(
        f"map: {nodes['nodes']:,} nodes, {nodes['confirmed']:,} confirmed, "
        f"{nodes['tentative']:,} tentative, {nodes['rejected']:,} rejected"
    )
    console.print(
        f"ledger: {answer['transactions']:,} transactions, {lag['missing']:,} missing; "
        f"{lag['unsent_bytes']:,} bytes wait to be sent; "
        f"{'features wait to go out' if lag['to_issue'] else 'nothing waits to go out'}",
        soft_wrap=True,
    )
    console.print(_overhead(answer["overhead"]), soft_wrap=True)
    for direction, kinds in answer["traffic"].items():
        if direction in ("sent", "received"):
            total = sum(row["bytes"] for row in kinds.values())
            console.print(f"{direction}: {total / 1000:,.0f} kB")
    for other in answer["unplaced"]:
        console.print(f"not placed: {other['name']}, session {other['session']}: {other['why']}")
    console.print(_robots(answer))
    return 0


def _overhead(found: dict[str, Any]) -> str:
    """What DAGmap takes of the SLAM's cycle, and what is held back."""
    if found["cycle_s"] is None:
        return "overhead: no two cycles of the SLAM yet"
    limits = [
        f"{found[key]:,} {what}"
        for key, what in (
            ("features_sent_a_cycle", "features are sent a cycle at most"),
            ("features_inserted_a_cycle", "features are inserted a cycle at most"),
            ("bytes_per_second", "bytes are sent a second at most"),
        )
        if found[key] is not None
    ]
    share = f"{100 * found['load']:.1f} % of a cycle of {found['cycle_s']:.3g} s"
    return "; ".join([f"overhead: {share}", f"N_c {found['n_c']}", *limits])


def _robots(answer: dict[str, Any]) -> Table:
    """A row for every author that the ledger has or the network shows."""
    table = Table()
    for heading in ("robot", "author", "transactions", "in reach", "delay", "heard"):
        table.add_column(heading, no_wrap=heading == "author", overflow="ignore")
    heads, peers = answer["heads"], answer["peers"]
    for author in sorted(heads.keys() | peers.keys()):
        head, peer = heads.get(author), peers.get(author, {})
        delay, heard = peer.get("delay_ms"), peer.get("heard_s_ago")
        length = 0 if head is None else head["length"]
        forked = head is not None and head["forked_at"] is not None
        here = "itself" if author == answer["author"] else "yes" if peer.get("here") else "no"
        table.add_row(
            (head or peer)["name"],
            author,
            f"{length:,}{' (forked)' if forked else ''}",
            here,
            "" if delay is None else f"{delay:.1f} ms",
            "" if heard is None else f"{heard:.1f} s ago",
        )
    return table
