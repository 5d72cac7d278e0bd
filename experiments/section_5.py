"""Section 5: what a cycle costs against n(U), N_c and N_G, measured and by Equations (2) to (5).

Both readings of Eq. (5): 2^2 log n as printed, and 2^(2 log n). The models are fitted to the cycles
up to n(U) = 10^4, two and three children, two and four robots, and predict the rest; n(U) is
measured to `--most` and predicted to 10^7 (`--most 10000000`: five minutes and 3 GB).
"""

from __future__ import annotations

from pathlib import Path

import common
import overhead
from common import Row
from dagmap.io.panels import open_figure, save

NAME = "section_5"
PAPER = (
    "t_insertion grows as n(U) / log n(U), t_broadcast and t_merge as n(U) (Eq. 3 to 5), linearly "
    "in N_G (Eq. 2); with a higher N_c the complexity reduces to O(2^(log_Nc N))"
)
FURTHEST = 10_000_000
MODELS = {"own_ms": "a cost per feature", "paper_printed_ms": "printed", "paper_meant_ms": "meant"}


def run(out: Path, most: int = 1_000_000) -> Row:
    beyond = [size for size in (10**5, 10**6, FURTHEST) if size > 1.1 * most]
    found = overhead.measure(most, beyond)
    growth = {key: growths(key, rows) for key, rows in found.items()}
    draw(out / f"{NAME}.png", found)
    measured = [sentence(key, row) for key, row in growth.items()]
    return common.written(
        out, NAME, PAPER, measured, features_a_cycle=overhead.FEATURES, growth=growth, **found
    )


def growths(key: str, rows: list[Row]) -> Row:
    """From the first to the last row that was measured: by how much each grows."""
    seen = [row for row in rows if row["measured_ms"] is not None]
    first, last = seen[0], seen[-1]
    row: Row = {"from": first[key], "to": last[key]}
    for column in ("measured_ms", *MODELS):
        row[column] = last[column] / max(first[column], 1e-9)
    return row


def sentence(key: str, row: Row) -> str:
    name = {"n_u": "n(U)", "n_c": "N_c", "n_g": "N_G"}[key]
    predicted = ", ".join(f"{text} {row[column]:,.2f}" for column, text in MODELS.items())
    return (
        f"from {name} = {row['from']:,} to {row['to']:,} the measured S of a cycle changes by a "
        f"factor of {row['measured_ms']:.2f}; by the models: {predicted}"
    )


def draw(path: Path, found: dict[str, list[Row]]) -> None:
    with open_figure((11.0, 3.6), 1, 3) as (figure, axes):
        for axis, (key, rows) in zip(axes, found.items(), strict=True):
            overhead.draw_costs(axis, key, rows)
        axes[0].axvspan(0, overhead.LEARNT, color="#eeeeee", zorder=0)
        axes[0].legend(title="grey: fitted there", title_fontsize=7)
        save(path, figure)


if __name__ == "__main__":
    common.main(run, ("most", int, 1_000_000, 3_000, 10_000_000, "n(U) up to which it is measured"))
