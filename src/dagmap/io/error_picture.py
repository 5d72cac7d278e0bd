"""A map coloured by its distance to a reference, as a PNG file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..model import Floats
from .panels import (
    draw_points,
    frame,
    limits_of,
    open_figure,
    page_size,
    put_title,
    save,
    scale_bar,
)
from .projection import choose_view

WORST = 0.10  # m: this far off and further has the last colour


def draw_error(path: Path, points: Floats, distance: Floats) -> None:
    """Draw points (N, 3) m in the colours of their distances (N,) m. Raises OutputError."""
    view = choose_view(points, np.zeros((0, 4, 4)))
    limits = limits_of(view.project(points), np.zeros((0, 2)))
    with open_figure(page_size(limits, 1, 1), 1, 1) as (figure, axes):
        from matplotlib import colormaps
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize

        scale = ScalarMappable(Normalize(0.0, 100 * WORST), colormaps["turbo"])
        draw_points(axes[0], view, points, scale.to_rgba(100 * distance)[:, :3])
        detail = f"{len(points):,} points, mean {1000 * float(distance.mean()):.1f} mm"
        put_title(axes[0], "a", "Distance to the reference", detail)
        frame(axes[0], limits)
        scale_bar(axes[0], limits)
        figure.colorbar(scale, ax=axes[0], shrink=0.7, label="cm", extend="max")
        save(path, figure)
