"""OctoMap's binary tree (.bt): cells with a node are occupied, cells that rays passed are free."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...model import Int64s, OutputError, Uint8s
from ..export import atomic_write
from ..exported import MapTable
from ._writer import WriteOptions, along_rays

SUFFIXES = (".bt",)
ABOUT = "OctoMap, binary tree"
_DEPTH = 16  # of every OctoMap
_HALF = 1 << (_DEPTH - 1)
# Of a child, in two bits: the bit that is written first is the lower one.
_FREE, _OCCUPIED, _INNER = 0b01, 0b10, 0b11


def write(path: Path, table: MapTable, options: WriteOptions) -> None:
    edge = options.resolution
    occupied = _codes(path, table.positions, edge)
    free = occupied[:0]
    if options.free:
        passed = [_codes(path, places, edge) for places in along_rays(*table.rays(), edge / 2)]
        free = np.setdiff1d(np.unique(np.concatenate([free, *passed])), occupied)
    count, body = _tree(occupied, free)
    head = [
        "# Octomap OcTree binary file",
        "# (feel free to add / change comments, but leave the first line as it is!)",
        "# DAGmap: metres in the fleet frame",
        "id OcTree",
        f"size {count}",
        f"res {edge:.9g}",
        "data\n",
    ]
    with atomic_write(path) as file:
        file.write("\n".join(head).encode())
        file.write(body)


def _codes(path: Path, points: np.ndarray, edge: float) -> Int64s:
    """The cells of points (N, 3) m, each once, ascending: bits of z y x, the root's first."""
    keys = np.floor(points / edge).astype(np.int64) + _HALF
    if ((keys < 0) | (keys >= 2 * _HALF)).any():
        raise OutputError(
            f"{path}: an OctoMap reaches {_HALF * edge:g} m from its origin, and the map further; "
            "a coarser --resolution or a smaller --box is wanted"
        )
    code = np.zeros(len(keys), np.int64)
    for bit in range(_DEPTH):
        for axis in range(3):
            code |= (keys[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.unique(code)


def _tree(occupied: Int64s, free: Int64s) -> tuple[int, bytes]:
    """The number of nodes, and the inner ones in depth-first order, two bytes each."""
    codes = np.concatenate([occupied, free])
    kinds = np.repeat(np.array([_OCCUPIED, _FREE], np.int64), [len(occupied), len(free)])
    order = np.argsort(codes, kind="stable")
    codes, kinds = codes[order], kinds[order]
    total, firsts, depths, bits = len(codes), [], [], []
    for depth in range(_DEPTH - 1, -1, -1):  # parents of what the level below holds
        parents, row = np.unique(codes >> 3, return_inverse=True)
        said = np.zeros(len(parents), np.int64)
        np.bitwise_or.at(said, row, kinds << 2 * (codes & 7))
        firsts.append(parents << 3 * (_DEPTH - depth))
        depths.append(np.full(len(parents), depth))
        bits.append(said)
        codes, kinds = parents, np.full(len(parents), _INNER, np.int64)
        total += len(parents)
    first, depth_of, said = (np.concatenate(parts) for parts in (firsts, depths, bits))
    order = np.lexsort((depth_of, first))  # a parent before its children, those in their order
    body: Uint8s = said[order].astype("<u2").view(np.uint8)
    return total, body.tobytes()
