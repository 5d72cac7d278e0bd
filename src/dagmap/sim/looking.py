"""What a robot's SLAM makes of what its sensor sees: points with ids, right and wrong ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from ..model import Bools, Floats, Int64s
from .sensor import Sensor, SensorConfig, displace

PERSON = -1  # the number of the surface of people
MEMORY = 3  # cycles in which a point may be seen again after its first
_BATCH, _POINTS = 16, 4096  # cycles that are looked at together at most, and their points

Ids: TypeAlias = npt.NDArray[np.uint64]
Pose: TypeAlias = tuple[float, float, float, float]  # x, y, z in m, yaw in rad
Cast: TypeAlias = Callable[[Floats, Floats, Sequence[float]], tuple[Floats, Int64s]]


class View(NamedTuple):
    """Points, a row each; in between also (N cycles, R rays)."""

    local: Floats  # (..., 3) m in the sensor frame, as measured
    true: Floats  # (..., 3) m in the fleet frame, where they are
    ids: Ids
    outliers: Bools
    surface: Int64s

    @property
    def bad(self) -> Bools:
        """Which points a map should not hold."""
        return np.asarray(self.outliers | (self.surface == PERSON))


class _Known(NamedTuple):
    """New points of N cycles, R in each, which may be seen again."""

    true: Floats  # (N, R, 3)
    ids: Ids  # (N, R)
    good: Bools  # (N, R)


class Looking:
    """Looks some cycles ahead, which costs little more than a single one.

    cast: depths (m, inf: none) and surfaces (N, R) of rays (N, R, 3) from places (N, 3) at N times
    (s). place: the true pose at a time. What a cycle sees does not depend on how many are asked
    for.
    """

    def __init__(
        self,
        config: SensorConfig,
        cast: Cast,
        place: Callable[[float], Pose],
        rng: np.random.Generator,
    ) -> None:
        self._config, self._cast, self._place, self._rng = config, cast, place, rng
        self._sensor = Sensor(config)
        self._again = int(config.tracked * config.points)  # rays to known points
        self._new = config.points - self._again
        self.batch = max(1, min(_BATCH, _POINTS // config.points))  # cycles at a time
        self._cycles = 0
        self._before: Floats | None = None  # (4,) the last pose
        shape = (MEMORY, self._new)
        self._known = _Known(
            np.zeros((*shape, 3)), np.zeros(shape, np.uint64), np.zeros(shape, np.bool_)
        )

    def views(self, times: Sequence[float]) -> list[View]:
        """The next cycles: `batch` of them, or fewer if they are the last."""
        count, rng = len(times), self._rng
        u, v = rng.uniform(-1.0, 1.0, (2, self.batch, self._new))[:, :count]
        noise = rng.standard_normal((self.batch, self._config.points))[:count]
        chance = rng.random((2, self.batch, self._new))[:, :count]
        poses = np.array([self._place(t) for t in times])
        baseline = self._baseline(times, poses)
        factor, outliers = displace(chance, self._config.outliers)
        rays = self._sensor.rays(u, v)
        measured, true, surface, kept = self._shoot(
            rays, noise[:, : self._new], baseline, poses, times
        )
        first = self._cycles * self._new
        self._cycles += count
        numbers = np.arange(first, first + count * self._new, dtype=np.uint64)
        ids = numbers.reshape(surface.shape)
        view = View(measured * factor[..., None], true, ids, outliers, surface)
        self._remember(_Known(true, ids, kept & ~view.bad))
        if self._again:
            old, old_kept = self._seen_again(noise[:, self._new :], baseline, poses, times)
            view = View(*(np.concatenate(pair, axis=1) for pair in _pairs(old, view)))
            kept = np.concatenate([old_kept, kept], axis=1)
        ends = np.cumsum(kept.sum(axis=1)).tolist()
        columns = (_split(column[kept], ends) for column in view)
        return [View(*rows) for rows in zip(*columns, strict=True)]

    def _shoot(
        self, rays: Floats, noise: Floats, baseline: Floats, poses: Floats, times: Sequence[float]
    ) -> tuple[Floats, Floats, Int64s, Bools]:
        """Points as measured (N, R, 3), where they are, their surfaces, which there are."""
        world = turned(rays, poses[:, 3])
        depth, surface = self._cast(poses[:, :3], world, times)
        hit = np.isfinite(depth)
        depth = np.where(hit, depth, 1.0)
        measured, kept = self._sensor.measure(rays, depth, noise, baseline)
        true = poses[:, None, :3] + world * depth[..., None]
        return rays * measured[..., None], true, surface, hit & kept

    def _seen_again(
        self, noise: Floats, baseline: Floats, poses: Floats, times: Sequence[float]
    ) -> tuple[View, Bools]:
        """Points of the last cycles that are in view, and nothing stands before them."""
        count = len(times)
        cycles = np.arange(count)[:, None] + np.arange(MEMORY)  # rows of what is known
        true, ids, good = (
            np.swapaxes(column[cycles], 1, 2).reshape(count, -1, *column.shape[2:])
            for column in self._known
        )
        local = turned(true - poses[:, None, :3], -poses[:, 3])
        view = good & self._sensor.in_view(local)
        pick = np.argsort(~view, axis=1, kind="stable")[:, : self._again]
        row = np.arange(count)[:, None]
        local, true, ids, view = local[row, pick], true[row, pick], ids[row, pick], view[row, pick]
        local = np.where(view[..., None], local, (1.0, 0.0, 0.0))
        length = np.sqrt((local * local).sum(axis=2))
        measured, there, surface, kept = self._shoot(
            local / length[..., None], noise, baseline, poses, times
        )
        kept &= view & (np.abs(there - true).max(axis=2) < 1e-6)
        return View(measured, true, ids, np.zeros_like(kept), surface), kept

    def _remember(self, fresh: _Known) -> None:
        """Known are the cycles of this batch, and the `MEMORY` ones before each of them."""
        pairs = _pairs(self._known, fresh)
        self._known = _Known(*(np.concatenate([old[-MEMORY:], new]) for old, new in pairs))

    def _baseline(self, times: Sequence[float], poses: Floats) -> Floats:
        """(N,) m by which the robot has moved since the last cycle (before the first: will)."""
        if self._before is None:
            self._before = np.array(self._place(times[0] + self._config.period))
        steps = np.diff(np.concatenate([self._before[None], poses]), axis=0)[:, :3]
        self._before = poses[-1]
        return np.asarray(np.sqrt((steps * steps).sum(axis=1)))


def _split(column: npt.NDArray[Any], ends: list[int]) -> list[Any]:
    return [column[low:high] for low, high in zip([0, *ends[:-1]], ends, strict=True)]


def _pairs(one: tuple[Any, ...], two: tuple[Any, ...]) -> Iterator[tuple[Any, Any]]:
    """The columns of two tables."""
    return zip(one, two, strict=True)


def turned(vectors: Floats, yaws: Floats) -> Floats:
    """(N, R, 3) vectors, turned about z by (N,) angles in rad."""
    c, s = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([c * x - s * y, s * x + c * y, vectors[..., 2]], axis=-1)
