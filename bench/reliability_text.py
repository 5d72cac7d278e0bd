"""How docs/reliability.md says what bench/reliability.py has measured: text, tables and plots.

The page is a function of the figures in reliability.json alone, and a test compares the two.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

PAGE = Path("reliability.md")
WANTED = {"hundred": 300, "busy": 20_000}  # s of wall time at most; messages/s at least

BOUND = """\
It holds for enrolled keys (a closed fleet, `dagmap keys`): in open mode one liar can make as
many keys as it likes, and no bound holds. Let m robots lie, together and in any way, and let
`witnesses` = w, `hit_say` = `miss_say` = 1.

1. **One map.** Whatever the m do, all honest robots that can reach each other end with one
   digest, for every m. What is accepted follows from the transactions alone, and a fork is cut
   at the same number everywhere.
2. **Nothing invented is confirmed while m < w.** A node is `confirmed` only with w different
   authors, and only its own key can speak for an author. With m = w liars that say the same it
   is confirmed: the tests show it.
3. **A place stays while more honest robots saw it than speak against it, liars included, if an
   honest robot saw it first.** Each author counts at most once for and once against a node, and it
   is rejected only where those against are at least as many. So a node that began with an honest
   observation, that h honest robots saw and a honest ones speak against, survives m liars where
   h > a + m; with nobody honest against it, m + 1 witnesses are enough (m at least 1). One liar
   more can reject it, where nothing around it speaks for it: the tests show that too, with the
   evidence of the neighbourhood switched off (`doubt` = 1000); with it, dense surfaces stay
   although they are outvoted.

The third is a promise about nodes, and *first* is first in canonical order, which a liar can be by
dating back or by being there early. From where a node was seen first it is judged what lies before
it: a liar that reports true points from a false pose (the `outsider`) makes honest robots' walls
speak against a place that all of them saw. It can also plant seeds of its own within delta of a
place, so that the observations of honest robots are shared out among several nodes (the
`splitter`): then h counts for each of those. For such *usurped* places there is no bound, and with
`doubt` = 1000 some are lost to one liar (the tests show it); by default what lies around them
speaks for them, and the table has what liars gain: next to nothing, but not nothing."""


TEXT = """\
# Does it hold under faults and liars?

One command measures all figures here and writes this page: `make reliability`. They are of seeds,
so everybody gets the same (times excepted). Its parts can be measured one by one: the
[last table](#how-each-part-was-made) says of which code each is, and how long it took.
[simulator.md](simulator.md) says how the simulator works, and how to write a scenario.

## In short

| what | figure |
|---|---|
| seeds swept | {sweep} |
| largest run | {hundred} |
| after a partition of {hour_for} | {hour} |
| messages a second, small transactions, one core | {busy} |
| fuzz executions | {fuzz} |

The sweep checks after every event that the graph is as Section 4.1 wants it, chains are unbroken,
dated and signed, memory is bounded and nothing was forgotten; now and then, that the fold is that
of the set from scratch and nothing is confirmed without witnesses; and at the end, that all
honest robots have one digest. Scenarios: {scenarios}, {seeds_each} seeds each (`make sweep`).

## Loss

{fleet} robots work for {mission:.0f} s, each looks at {points} points a second.
Then they have time to agree: from when the last transaction was issued until the last robot holds
everything, in announcement periods ({period:g} s), over {runs} seeds. *Ideal* is a flood without
loss over the same links, each hop one mean delay. In *all hear all* a transaction comes at once
or by repair; in *a chain* each robot stands in one room of a row and hears the next ones, so that
news travels by announcement, question and answer. *Bytes* are all copies sent, lost or not, over
one copy of each transaction for everybody but its author (median).

{loss}

![Time to agreement by loss](agreement.png)

## Divergence

{fleet} robots, {trouble_loss:.0%} loss, two partitions (the second one-way: the robot sends but
does not hear) and three crashes. The line is the largest share of all transactions that one robot
lacks.

![Divergence over time](divergence.png)

## Liars

{fleet} robots in one room, of which 0 to 4 lie: *forger* invents a wall, *eraser* shoots rays
through what is there, *splitter* surrounds points with copies, *wrong-frame* is half a metre and
ten degrees off, *outsider* says that it stands 4.5 m further back, *early-outsider* dates back
too. Sums over {liar_runs} seeds. *Lost*: points of honest robots that are in the map
without the liars' transactions and rejected with them. *Proven lost*: of the nodes that so many
liars' misses cannot outvote, and that an honest robot saw first, those rejected: must be 0.
*Usurped lost*: the same of those that a liar saw first. *Confirmed*: nodes that no honest robot
saw, confirmed (in brackets: those far from every real surface): must be 0 while there are fewer
liars than `witnesses`.

{liars}

## The bound

{bound}

## How each part was made

*Code* is a hash over the sources and the scenarios: parts with the same are of the same code. Where
wall time is longer than processor time over the processes, other work ran beside it.

{made}
"""


def write(figures: dict[str, Any], folder: Path) -> None:
    """Write the page, its plots and the figures themselves into the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / PAGE.with_suffix(".json")).write_text(json.dumps(figures, indent=1) + "\n")
    (folder / PAGE).write_text(text(figures))
    _save(_divergence(figures["parts"]["divergence"]["figures"]), folder / "divergence.png")
    _save(_agreement(figures["parts"]["loss"]["figures"]), folder / "agreement.png")


def text(figures: dict[str, Any]) -> str:
    """The page."""
    parts = {name: part["figures"] for name, part in figures["parts"].items()}
    sweep, hour = parts["sweep"], parts["hour"]
    return TEXT.format(
        sweep=_sweep(sweep),
        hundred=_hundred(parts["hundred"], figures["settings"]["fold_period"]),
        hour_for=f"{hour['mission_s']:,.0f} s",
        hour=_hour(hour),
        busy=_busy(parts["busy"]),
        fuzz=_fuzz(figures["fuzz_executions"]),
        scenarios=", ".join(sweep["scenarios"]),
        seeds_each=f"{sweep['seeds_each']:,}",
        runs=figures["parts"]["loss"]["asked"]["runs"],
        loss=_loss(parts["loss"]),
        liars=_liars(parts["liars"]),
        liar_runs=parts["liars"][0]["runs"],
        bound=BOUND,
        made=_made(figures["parts"]),
        **figures["settings"],
    )


def _made(parts: dict[str, Any]) -> str:
    columns = ["part", "asked for", "dagmap", "code", "on", "processor time", "wall time"]
    table = _table(columns, (_made_row(name, part) for name, part in parts.items()))
    machines: dict[str, list[str]] = {}
    for name, part in parts.items():
        machines.setdefault(_machine(part["made"]), []).append(name)
    of = [f"{', '.join(names)} with {machine}" for machine, names in machines.items()]
    return f"{table}\n\n{'; '.join(of) if len(of) > 1 else f'All with {next(iter(machines))}'}."


def _made_row(name: str, part: dict[str, Any]) -> list[str]:
    made, asked = part["made"], part["asked"]
    options = [f"--{key} {asked[key]}" for key in asked if key != "code" and asked[key] is not None]
    told = f"`{' '.join(options)}`" if options else "-"
    spent = [_duration(seconds) for seconds in made["spent"]]
    return [name, told, made["dagmap"], asked["code"], made["date"], *spent]


def _machine(made: dict[str, Any]) -> str:
    tools = ", ".join(f"{tool} {made[tool.lower()]}" for tool in ("Python", "numpy", "numba"))
    return f"{tools}, on {made['machine']} with {made['cores']} cores"


def _duration(seconds: float) -> str:
    return f"{seconds:,.0f} s" if seconds < 300 else f"{seconds / 60:,.0f} min"


def _sweep(sweep: dict[str, Any]) -> str:
    if sweep["failure"] is not None:
        return f"**BROKEN**: {sweep['failure']}"
    return f"{sweep['runs']:,} runs without a violation"


def _hundred(run: dict[str, Any], fold_period: float) -> str:
    over = run["bytes_carried"] / max(1, run["bytes_minimum"])
    missed = "**" if run["wall_s"] > WANTED["hundred"] else ""
    return (
        f"{run['robots']} robots, {run['mission_s']:,.0f} s: {_agreement_of(run)} of the last of "
        f"{run['transactions']:,} transactions; {run['messages']:,} messages "
        f"({run['messages_per_s']:,.0f} a second), {over:.1f} times the least bytes; maps are "
        f"folded every {fold_period:g} s. Wall time "
        f"{missed}{run['wall_s']:,.0f} s{missed}, processor time {run['processor_s']:,.0f} s "
        f"(wanted: {WANTED['hundred']} s at most)"
    )


def _hour(run: dict[str, Any]) -> str:
    return (
        f"{_agreement_of(run)} of its end; until then {run['apart_most']:.0%} of "
        f"{run['transactions']:,} transactions were unknown to some"
    )


def _agreement_of(run: dict[str, Any]) -> str:
    if not run["agreed"]:
        return "**no agreement** in time"
    took, periods = run["agreement_s"], run["agreement_periods"]
    return f"one digest, all known to all within {took:.1f} s ({periods:.1f} announcement periods)"


def _busy(run: dict[str, Any]) -> str:
    rate = run["messages"] / run["processor_s"]
    missed = "**" if rate < WANTED["busy"] else ""
    return (
        f"{missed}{rate:,.0f}{missed} of processor time, {run['messages_per_s']:,.0f} of wall time "
        f"({run['robots']} robots; wanted: {WANTED['busy']:,})"
    )


def _fuzz(executions: int | None) -> str:
    return "not recorded" if executions is None else f"{executions:,} ([fuzzing.md](fuzzing.md))"


def _table(columns: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    columns = list(columns)
    lines = [columns, ["---"] * len(columns), *map(list, rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _loss(rows: list[dict[str, Any]]) -> str:
    columns = ["topology", "loss", "p50", "p99", "ideal", "bytes over the least", "runs"]
    return _table(columns, map(_loss_row, rows))


def _loss_row(row: dict[str, Any]) -> list[str]:
    def number(name: str) -> str:
        return "-" if row[name] is None else f"{row[name]:.3g}"

    runs = f"{row['runs']}"
    if row["apart"]:
        runs += f" (in {row['apart']} more a robot stood apart)"
    if row["never"]:
        runs += f", **{row['never']} did not agree**"
    names = [number(name) for name in ("p50", "p99", "ideal", "bytes_over_minimum")]
    return [row["topology"], f"{row['loss']:.0%}", *names, runs]


def _liars(rows: list[dict[str, Any]]) -> str:
    columns = ["liars", "how many", "lost of honest points", "proven lost", "usurped lost"]
    columns += [f"confirmed, `witnesses` = {row}" for row in (2, 3)]
    by = {(row["witnesses"], row["kind"], row["liars"]): row for row in rows}
    return _table(
        columns,
        (
            [
                kind,
                str(liars),
                f"{by[2, kind, liars]['honest_lost']:,} of {by[2, kind, liars]['honest_points']:,}",
                *(
                    f"{by[2, kind, liars][f'{which}_lost']:,} of "
                    f"{by[2, kind, liars][f'{which}_nodes']:,}"
                    for which in ("proven", "usurped")
                ),
                *(_confirmed(by[witnesses, kind, liars]) for witnesses in (2, 3)),
            ]
            for _, kind, liars in (key for key in by if key[0] == 2)
        ),
    )


def _confirmed(row: dict[str, Any]) -> str:
    return f"{row['liars_confirmed']:,} of {row['liars_only']:,} ({row['false_confirmed']:,})"


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=80, metadata={"Software": None})


def _divergence(run: dict[str, Any]) -> Figure:
    figure = Figure(figsize=(8, 3), layout="constrained")
    axes = figure.subplots()
    axes.plot(*zip(*run["divergence"], strict=True), color="tab:blue")
    for i, cut in enumerate(run["partitions"]):
        label = "partition" if i == 0 else None
        axes.axvspan(cut["start"], cut["end"], color="tab:orange", alpha=0.25, label=label)
    for i, crash in enumerate(run["crashes"]):
        label = "a robot is down" if i == 0 else None
        back = crash["at"] + crash["down"]
        axes.axvspan(crash["at"], back, ymax=0.06, color="tab:red", label=label)
    axes.set(xlabel="time, s", ylabel="largest share lacking", ylim=(0, None))
    axes.legend(loc="upper right")
    return figure


def _agreement(rows: list[dict[str, Any]]) -> Figure:
    figure = Figure(figsize=(8, 3), layout="constrained")
    axes = figure.subplots()
    for color, topology in zip(("tab:blue", "tab:orange"), _topologies(rows), strict=False):
        of = [row for row in rows if row["topology"] == topology and row["p50"] is not None]
        loss = [100 * row["loss"] for row in of]
        for name, style in (("p99", "--"), ("p50", "-"), ("ideal", ":")):
            label = f"{topology}, {name}"
            axes.plot(loss, [row[name] for row in of], style, color=color, label=label, marker=".")
    axes.set(xlabel="loss, %", ylabel="announcement periods", yscale="log")
    axes.legend(fontsize="small", ncols=2)
    return figure


def _topologies(rows: list[dict[str, Any]]) -> list[str]:
    return list(dict.fromkeys(row["topology"] for row in rows))
