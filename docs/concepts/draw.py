"""The figures of docs/concepts.md, the graph in them a real one: `python docs/concepts/draw.py`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dagmap import AdjacencyDag, GraphConfig

HERE = Path(__file__).parent
INK, GREY, GREEN, BLUE, RED, ORANGE = "#222", "#999", "#2a9d5c", "#2a6f97", "#c1121f", "#e07a1f"
PITCH = 250  # mm
SCALE = 0.32  # pixels a mm


class Svg:
    """Shapes one after the other."""

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        self._parts = [f'<rect width="{width}" height="{height}" fill="#fff"/>']

    def line(
        self, a: tuple[float, float], b: tuple[float, float], color: str = INK, dash: str = "",
        arrow: bool = False, width: float = 1.5,
    ) -> None:  # fmt: skip
        more = f' stroke-dasharray="{dash}"' if dash else ""
        more += f' marker-end="url(#{color[1:]})"' if arrow else ""
        self._parts.append(
            f'<line x1="{a[0]:.1f}" y1="{a[1]:.1f}" x2="{b[0]:.1f}" y2="{b[1]:.1f}" '
            f'stroke="{color}" stroke-width="{width}"{more}/>'
        )

    def dot(
        self, at: tuple[float, float], r: float, fill: str = "#fff", color: str = INK,
        width: float = 1.5, dash: str = "",
    ) -> None:  # fmt: skip
        more = f' stroke-dasharray="{dash}"' if dash else ""
        self._parts.append(
            f'<circle cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="{r}" fill="{fill}" stroke="{color}" '
            f'stroke-width="{width}"{more}/>'
        )

    def box(
        self, at: tuple[float, float], size: tuple[float, float], fill: str, color: str = INK,
        dash: str = "",
    ) -> None:  # fmt: skip
        x, y = at[0] - size[0] / 2, at[1] - size[1] / 2
        more = f' stroke-dasharray="{dash}"' if dash else ""
        self._parts.append(
            f'<rect x="{x:.1f}" y="{y:.1f}" width="{size[0]:.1f}" height="{size[1]:.1f}" rx="2" '
            f'fill="{fill}" stroke="{color}"{more}/>'
        )

    def text(
        self, at: tuple[float, float], text: str, color: str = INK, size: int = 13,
        anchor: str = "middle", bold: bool = False,
    ) -> None:  # fmt: skip
        weight = ' font-weight="bold"' if bold else ""
        self._parts.append(
            f'<text x="{at[0]:.1f}" y="{at[1]:.1f}" fill="{color}" font-size="{size}" '
            f'text-anchor="{anchor}"{weight}>{text}</text>'
        )

    def save(self, name: str, title: str) -> None:
        heads = "".join(
            f'<marker id="{c[1:]}" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" '
            f'markerHeight="7" orient="auto"><path d="M0,0 L8,4 L0,8 z" fill="{c}"/></marker>'
            for c in (INK, GREY, GREEN, BLUE, RED, ORANGE)
        )
        body = "\n".join(self._parts)
        (HERE / name).write_text(
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width} {self.height}" '
            f'width="{self.width}" font-family="sans-serif"><title>{title}</title>'
            f"<defs>{heads}</defs>\n{body}\n</svg>\n"
        )


def graph() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions (N, 2) mm, parents (N, 2) and validity of features along an edge of a table."""
    rng = np.random.default_rng(11)
    along = np.linspace(200, 1900, 15)
    height = 330 + 190 * np.sin(along / 420)
    points = np.column_stack([along, height + rng.normal(0, 55, 15), np.zeros(15)])
    points = points[rng.permutation(15)].astype(np.int32)  # as a SLAM finds them
    dag = AdjacencyDag(
        GraphConfig(n_p=2, n_c=2, n_c_max=4, v_th=3, reference_pitch=0.25, max_parent_distance=0.6)
    )
    ids = dag.insert(points)
    return points[ids, :2].astype(np.float64), dag.parents(ids), dag.validity(ids)


def at(point: np.ndarray) -> tuple[float, float]:
    return float(point[0] * SCALE + 20), float(point[1] * SCALE + 20)


def edge(svg: Svg, a: np.ndarray, b: np.ndarray, color: str, dash: str = "", r: float = 12) -> None:
    """An arrow from a child to its parent that ends at the circle."""
    p, q = np.array(at(a)), np.array(at(b))
    way = (q - p) / max(float(np.linalg.norm(q - p)), 1e-9)
    svg.line(tuple(p + 12 * way), tuple(q - r * way), color, dash, arrow=True)


def adjacency() -> None:
    """Features hold on to their two nearest terminals."""
    points, parents, validity = graph()
    svg = Svg(680, 300)
    for x in range(0, 2001, PITCH):
        for y in range(0, 751, PITCH):
            svg.box(at(np.array([x, y])), (7, 7), "#cfe8d8", GREEN)
    for i, row in enumerate(parents):
        for parent in row:
            if parent >= 0:
                edge(svg, points[i], points[parent], BLUE)
        if (row < 0).any():
            edge(svg, points[i], PITCH * np.round(points[i] / PITCH), GREEN, "4 3", 6)
    for i, v in enumerate(validity):
        strong = v > 3
        svg.dot(at(points[i]), 12, "#d7e9f4" if strong else "#fff", BLUE, 3 if strong else 1.5)
        x, y = at(points[i])
        svg.text((x, y + 4.5), str(v))
    svg.text((20, 290), "green: lattice nodes, validity 1; circles: features with their validity v;"
             " bold: v above V_th = 3", GREY, 12, "start")  # fmt: skip
    svg.save("adjacency.svg", "The adjacency DAG of one robot")


def bundle() -> None:
    """What goes out with a core, and what does not."""
    points, parents, validity = graph()
    core = int(np.argmax(validity))
    ascendants, waiting = [], [core]
    while waiting:
        node = waiting.pop(0)
        ascendants += [node] if node not in ascendants else []
        waiting += [int(p) for p in parents[node] if p >= 0]
    ascendants.sort(key=lambda i: float(np.linalg.norm(points[i] - points[core])))
    sent, issued = ascendants[: (2 * len(ascendants) + 2) // 3], set(ascendants[-2:])
    svg = Svg(680, 300)
    for i, row in enumerate(parents):
        for parent in row:
            if parent >= 0:
                used = i in sent
                edge(
                    svg,
                    points[i],
                    points[parent],
                    ORANGE if used else "#999",
                    "" if used else "4 3",
                )
    for i in range(len(points)):
        place = at(points[i])
        fill = (
            ORANGE if i == core else "#fbe3cf" if i in sent else "#ddd" if i in issued else "#fff"
        )
        svg.dot(place, 12, fill, ORANGE if i in sent else GREY, 2)
        svg.text((place[0], place[1] + 4.5), "n" if i == core else "", bold=True)
    svg.text(
        (20, 290), "orange: the core n and the ascendants that go with it; grey: issued before, "
        "named by (transaction, index); white: waits", GREY, 12, "start",
    )  # fmt: skip
    svg.save("bundle.svg", "A bundle: the core and its ascendants")


def votes() -> None:
    """A hit and a miss."""
    svg = Svg(680, 260)
    for left, title in ((0, "a hit"), (340, "a miss")):
        svg.text((left + 170, 24), title, size=16, bold=True)
        svg.line((left + 60, 70), (left + 300, 70), GREY, width=4)
        svg.text((left + 308, 66), "wall", GREY, 12, "end")
        for x, color, name in ((110, BLUE, "red"), (230, ORANGE, "green")):
            svg.box((left + x, 215), (34, 20), color, color)
            svg.text((left + x, 245), f"robot {name}", color, 12)
    svg.dot((170, 70), 20, "none", GREEN, 1.5, "4 3")
    svg.text((170, 108), "delta", GREEN, 12)
    svg.line((110, 204), (165, 76), BLUE, arrow=True)
    svg.line((230, 204), (178, 78), ORANGE, arrow=True)
    svg.dot((166, 70), 4, BLUE, BLUE)
    svg.dot((177, 71), 4, ORANGE, ORANGE)
    svg.box((510, 140), (40, 40), "#fdeaea", RED, "4 3")
    svg.dot((510, 140), 4, BLUE, BLUE)
    svg.line((450, 204), (505, 146), BLUE, arrow=True)
    svg.line((570, 204), (462, 76), ORANGE, arrow=True)
    svg.dot((461, 71), 4, ORANGE, ORANGE)
    svg.text((560, 128), "cell that the", RED, 12, "start")
    svg.text((560, 143), "ray has crossed", RED, 12, "start")
    svg.save("votes.svg", "What speaks for a node and what against it")


def sync() -> None:
    """Announcements, questions and answers between three robots, and a late one."""
    svg = Svg(680, 400)
    names = (("red", 90, BLUE), ("green", 290, ORANGE), ("blue, late", 520, GREEN))
    for name, x, color in names:
        svg.text((x, 24), f"robot {name}", color, 14, bold=True)
        svg.line((x, 34 if x < 500 else 200), (x, 385), color)
    red, green, blue = 90, 290, 520
    for y, a, b, text in (
        (60, red, green, "transactions 7, 8"),
        (150, green, red, "heads: red 8"),
        (180, red, green, "heads: red 9"),
        (210, green, red, "want: red 9"),
        (240, red, green, "transaction 9"),
        (285, green, blue, "heads: red 9, green 4"),
        (315, blue, green, "want: red 0 to 9, green 0 to 4"),
        (345, green, blue, "transactions, in chunks"),
    ):
        color = BLUE if "trans" in text else INK
        svg.line((a, y), (b + (-4 if b > a else 4), y), color, arrow=True)
        svg.text(((a + b) / 2, y - 6), text, color, 12)
    svg.line((red, 105), (205, 105), RED, "4 3")
    svg.text((190, 99), "transaction 9", RED, 12)
    svg.text((214, 111), "x", RED, 18, bold=True)
    svg.text((232, 109), "lost", RED, 12, "start")
    for x in (red, green, blue):
        svg.box((x, 382), (92, 22), "#fff", GREY)
        svg.text((x, 386), "digest a24343...", GREY, 11)
    svg.save("sync.svg", "How robots come to hold the same transactions")


if __name__ == "__main__":
    for figure in (adjacency, bundle, votes, sync):
        figure()
