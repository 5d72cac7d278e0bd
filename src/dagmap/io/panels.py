"""What all figures share: the page, its style, and points, lines, titles and legends on a panel.

matplotlib is the extra `report`, imported only when something is drawn.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..model import Floats, OutputError
from .export import atomic_write
from .projection import View

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, FAINT = "#1a1a1a", "#6b6b6b"
# The paper's green, red and blue first, then colours that are told apart beside them.
_ROBOTS = ("#1d9a3c", "#d7301f", "#2166d1", "#e08214", "#12a5a5", "#8c564b", "#c51b8a", "#7a7a12")
_BRIGHTEST = 0.74  # luminance of the palest point, so that white walls show on white paper
_MAX_BYTES = 1_900_000
_STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 8.0,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": "#c8c8c8",
    "axes.linewidth": 0.6,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "legend.frameon": False,
    "legend.fontsize": 7.5,
}


def draw_points(
    axis: Axes, view: View, points: Floats, colors: npt.NDArray[Any], scale: float = 1.0
) -> None:
    """Points (N, 3) metres in colours (N, 3) from 0 to 1, near ones on top, small where many."""
    order = view.far_to_near(points)
    size = scale * float(np.clip(2.2e4 / max(len(points), 1), 0.4, 4.0))  # square points
    x, y = view.project(points)[order].T
    axis.scatter(x, y, s=size, c=colors[order], linewidths=0)


def draw_lines(axis: Axes, segments: Floats, colors: Floats) -> None:
    """Thin lines between the ends (E, 2, 2) on the page, in colours (E, 3) from 0 to 1."""
    from matplotlib.collections import LineCollection

    axis.add_collection(LineCollection(list(segments), colors=colors, linewidths=0.25, alpha=0.5))


def put_title(axis: Axes, letter: str, title: str, detail: str) -> None:
    """What the panel shows on the left, a count on the right."""
    axis.set_title(f"({letter})  {title}", loc="left", fontsize=10.0, fontweight="bold", pad=6)
    axis.set_title(detail, loc="right", fontsize=7.5, color=FAINT, pad=6)


def put_legend(axis: Axes, entries: Sequence[tuple[str, str]], below: float = -0.01) -> None:
    """Name the colours of (name, colour) under a panel; of many, the first and the last."""
    from matplotlib.lines import Line2D

    shown = list(entries) if len(entries) <= 10 else [*entries[:8], *entries[-2:]]
    handles = [Line2D([], [], marker="o", markersize=4, linestyle="", color=c) for _, c in shown]
    axis.legend(
        handles,
        [plain(name) for name, _ in shown],
        loc="upper center",
        bbox_to_anchor=(0.5, below),
        ncols=min(len(shown), 5),
        handletextpad=0.1,
        columnspacing=1.4,
        borderaxespad=0.2,
    )


def plain(text: str) -> str:
    """A robot's name as it is: no mathematics between dollars."""
    return text.replace("$", r"\$")


def frame(axis: Axes, limits: Floats) -> None:
    """Show what lies within `limits_of`, true to scale, without numbers along the edges."""
    axis.set_xlim(*limits[:, 0])
    axis.set_ylim(*limits[:, 1])
    axis.set_aspect("equal")
    axis.set_xticks([])
    axis.set_yticks([])


def scale_bar(axis: Axes, limits: Floats) -> None:
    """A bar of 1, 2 or 5 times a power of ten metres, about a sixth of the width."""
    width, height = limits[1] - limits[0]
    power = 10.0 ** np.floor(np.log10(width / 5))
    length = max(step * power for step in (1, 2, 5) if step * power <= width / 5)
    x, y = limits[0] + (0.03 * width, 0.035 * height)
    axis.plot([x, x + length], [y, y], color=INK, linewidth=1.6, solid_capstyle="butt")
    axis.annotate(
        f"{length:g} m", (x + length / 2, y), (0, 2.5), textcoords="offset points", ha="center"
    )


def limits_of(flat: Floats, tracks: Floats) -> Floats:
    """(2, 2) corners of what is shown: the middle 99 % of points, all tracks, and a margin."""
    if not len(flat):
        return np.array([[-1.0, -1.0], [1.0, 1.0]])
    low, high = np.percentile(flat, (0.5, 99.5), axis=0)
    if len(tracks):
        low, high = np.minimum(low, tracks.min(axis=0)), np.maximum(high, tracks.max(axis=0))
    margin = np.maximum(0.04 * (high - low), 0.3)
    return np.stack([low - margin, high + margin])


def page_size(limits: Floats, rows: int, columns: int) -> tuple[float, float]:
    """Inches of a page whose panels have the shape of the map, within reason."""
    width, height = limits[1] - limits[0]
    panel = 5.6 * float(np.clip(height / width, 0.4, 1.4))
    return 5.6 * columns + 0.5, (panel + 0.65) * rows


def visible(colors: npt.NDArray[Any]) -> Floats:
    """(N, 3) uint8 to colours in 0..1, the palest darkened."""
    bright = np.asarray(colors, np.float64) / 255.0
    luminance = bright @ np.array([0.299, 0.587, 0.114])
    dimmed = np.minimum(1.0, _BRIGHTEST / np.maximum(luminance, 1e-6))
    return np.asarray(bright * dimmed[:, None], np.float64)


def rgb(colors: Sequence[str]) -> Floats:
    """(N, 3) from 0 to 1 of "#rrggbb"."""
    return np.array([[int(c[i : i + 2], 16) / 255 for i in (1, 3, 5)] for c in colors])


def robot_colors(count: int) -> list[str]:
    """One colour a robot; after eight of them they come again."""
    return [_ROBOTS[i % len(_ROBOTS)] for i in range(count)]


def joined(arrays: Sequence[Floats]) -> Floats:
    """All points (N, 3) of several robots, of none too."""
    return np.concatenate([np.zeros((0, 3)), *arrays])


@contextmanager
def open_figure(
    size: tuple[float, float], rows: int, columns: int
) -> Iterator[tuple[Figure, list[Axes]]]:
    """A page of panels in our style, whatever the user's matplotlibrc says; no window."""
    try:
        from matplotlib import style
        from matplotlib.figure import Figure
    except ImportError as error:
        raise OutputError(
            f"figures need matplotlib ({error}); install it: pip install 'dagmap[report]'"
        ) from None
    with style.context(["default", _STYLE]):
        figure = Figure(figsize=size, layout="constrained")
        yield figure, list(figure.subplots(rows, columns, squeeze=False).flat)


def save(path: Path, figure: Figure) -> None:
    """As PNG, at fewer dots per inch where the file would be more than a report can bear."""
    for dpi in (220, 170, 130):
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": "DAGmap"})
        if buffer.tell() <= _MAX_BYTES:
            break
    with atomic_write(path) as file:
        file.write(buffer.getvalue())
