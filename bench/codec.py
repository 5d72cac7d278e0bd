"""Bytes a feature and speed of the bundle codec, on the office and on a seeded surface.

A bundle here is all features of one cycle, in Morton order, with the parents that the adjacency
DAG of the robot gives them. Sizes of columns are differences: parents alone, then with positions,
then with colours. Rates are the best of some repetitions, wrappers included.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from dagmap import AdjacencyDag, Config
from dagmap.io.sources import open_source
from dagmap.kernels.codec import decode_features, encode_features, morton_order
from dagmap.quantising import quantise_cycle
from scenes import FRAME, surface

OFFICE = Path(__file__).parents[1] / "examples" / "office"
ROUNDS = 7

Bundle = dict[str, Any]


def run() -> list[dict[str, Any]]:
    """One row a scene: sizes in bytes a feature, rates in features a second."""
    office = [bundle for robot in sorted(OFFICE.glob("robot*")) for bundle in office_bundles(robot)]
    points = surface(100_000)
    walls = list(bundles(np.split(points, range(FRAME, len(points), FRAME))))
    return [measure("office", office), measure("surface", walls)]


def office_bundles(folder: Path) -> Iterator[Bundle]:
    """The frames of one robot, in the camera frame; the graph sees them in the SLAM frame."""
    frames, world, colors = [], [], []
    for cycle in open_source(folder):
        points = quantise_cycle(cycle).points
        pose = np.asarray(cycle.pose)
        placed = points @ pose[:3, :3].T + pose[:3, 3] * 1000.0
        frames.append(points)
        world.append(np.floor(placed + 0.5).astype(np.int32))
        colors.append(np.asarray(cycle.colors))
    return bundles(frames, world, colors)


def bundles(
    frames: list[Any], world: list[Any] | None = None, colors: Any = None
) -> Iterator[Bundle]:
    """Columns of one bundle a frame."""
    graph = AdjacencyDag(Config().graph)
    base = 0
    for i, points in enumerate(frames):
        order = morton_order(points)
        ids = graph.insert((points if world is None else world[i])[order])
        n = len(points)
        yield {
            "position": points[order],
            "parents": graph.parents(ids),
            "base": base,
            "starts": np.array([0, n]),
            "color": np.zeros((n, 3), np.uint8) if colors is None else colors[i][order],
            "colored": np.array([colors is not None], np.uint8),
        }
        base += n


def measure(scene: str, columns: list[Bundle]) -> dict[str, Any]:
    """Sizes and rates of one scene."""
    count = sum(len(bundle["position"]) for bundle in columns)
    codes = [encode_features(**bundle) for bundle in columns]
    for bundle, code in zip(columns, codes, strict=True):
        assert decode(code, bundle)[4]
    plain = [bundle | {"colored": np.zeros(1, np.uint8)} for bundle in columns]
    bare = [bundle | {"position": bundle["position"] * 0} for bundle in plain]
    total, parents, placed = (
        sum(len(encode_features(**bundle)) for bundle in kind) / count
        for kind in (columns, bare, plain)
    )
    points = np.concatenate([bundle["position"] for bundle in columns])
    tree = count / best(lambda: cKDTree(points))
    encoding = count / best(lambda: [encode_features(**bundle) for bundle in columns])
    decoding = count / best(lambda: list(map(decode, codes, columns)))
    ordering = count / best(lambda: [morton_order(bundle["position"]) for bundle in columns])
    return {
        "scene": scene,
        "features": count,
        "features_a_bundle": count / len(columns),
        "bytes_a_feature": total,
        "parents_bytes": parents,
        "position_bytes": placed - parents,
        "color_bytes": total - placed,
        "encode_a_second": encoding,
        "decode_a_second": decoding,
        "order_a_second": ordering,
        "encode_to_ckdtree": encoding / tree,
        "decode_to_ckdtree": decoding / tree,
    }


def decode(code: Any, bundle: Bundle) -> tuple[Any, ...]:
    n, slots = bundle["parents"].shape
    return decode_features(code, n, slots, bundle["base"], bundle["starts"], bundle["colored"])


def best(work: Callable[[], Any]) -> float:
    """Seconds of the fastest of some rounds."""
    times = []
    for _ in range(ROUNDS):
        started = time.perf_counter()
        work()
        times.append(time.perf_counter() - started)
    return min(times)
