"""What a run is made of, as a TOML file says it. Chance is drawn from the seed, here and once."""

from __future__ import annotations

import math
import random
from collections import Counter
from pathlib import Path
from typing import Literal

import msgspec

from ..config import Config, read_toml
from ..model import ConfigError
from .building import SceneConfig
from .fleet import Crash
from .liars import LIARS
from .network import Link, Partition
from .robot import Clock, Costs
from .sensor import SensorConfig
from .walk import MotionConfig

MAX_CHAOS = 10_000  # faults of a kind that a seed draws


class _Part(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    def _require(self, holds: bool, name: str, wanted: str) -> None:
        if not holds:
            value = getattr(self, name)
            where = type(self).__name__.lower()
            raise ConfigError(f"scenario: {where}.{name} = {value!r}, but {wanted} is wanted")


class Clocks(_Part, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How wrong the robots' clocks are at most, either way."""

    offset: float = 0.0  # s
    drift: float = 0.0  # s per s, below 0.5

    def __post_init__(self) -> None:
        self._require(0 <= self.offset < math.inf, "offset", "a time of at least 0")
        self._require(0 <= self.drift < 0.5, "drift", "0 up to 0.5 s/s")


class Chaos(_Part, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Faults at times and on robots that the seed draws."""

    crashes: int = 0
    down: tuple[float, float] = (0.5, 5.0)  # s that a robot stays away
    partitions: int = 0
    apart: tuple[float, float] = (2.0, 10.0)  # s that a partition lasts

    def __post_init__(self) -> None:
        for name in ("crashes", "partitions"):
            self._require(0 <= getattr(self, name) <= MAX_CHAOS, name, f"0 to {MAX_CHAOS}")
        for name in ("down", "apart"):
            low, high = getattr(self, name)
            self._require(0 <= low <= high < math.inf, name, "two times, the shorter first,")


class Liars(_Part, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """So many robots that lie in one way; "any": in a way that the seed draws for each."""

    kind: str
    count: int = 1

    def __post_init__(self) -> None:
        known = [*sorted(LIARS), "any"]
        self._require(self.kind in known, "kind", f"one of {', '.join(known)}")
        self._require(self.count >= 0, "count", "at least 0")


class Scenario(_Part, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A mission: robots in a scene, a network between them, and what goes wrong.

    robots: all of them, the liars included (they are the last). Either they walk through a
    synthetic scene, or `recordings` (one a robot, files) are what they see; then `reference` may
    be a file of the points that are truly there.
    seconds: of mission; patience: seconds that the fleet gets afterwards to agree.
    """

    name: str = "scenario"
    robots: int = 3
    seconds: float = 60.0
    patience: float = 120.0
    tick: float = 0.1  # s between the ticks of an agent
    late: tuple[float, ...] = ()  # s at which the last honest robots join; the others at 0
    config: Config = Config()
    scene: SceneConfig = SceneConfig()
    sensor: SensorConfig = SensorConfig()
    motion: MotionConfig = MotionConfig()
    recordings: tuple[str, ...] = ()
    reference: str | None = None
    link: Link = Link()
    clocks: Clocks = Clocks()
    costs: Costs = Costs()
    chaos: Chaos = Chaos()
    liars: tuple[Liars, ...] = ()
    partitions: tuple[Partition, ...] = ()
    crashes: tuple[Crash, ...] = ()

    def __post_init__(self) -> None:
        self._require(1 <= self.robots <= 1000, "robots", "1 to 1000")
        for name in ("seconds", "patience"):
            self._require(0 < getattr(self, name) < math.inf, name, "a time above 0")
        self._require(0.001 <= self.tick <= 60, "tick", "0.001 to 60 s")
        honest = self.robots - self.lying
        self._require(honest >= 1, "liars", f"fewer than the {self.robots} robots")
        self._require(len(self.late) < honest, "late", "at least one honest robot on time")
        on_time = all(0 <= at <= self.seconds for at in self.late)
        self._require(on_time, "late", f"times from 0 to the {self.seconds} s of the mission")
        self._require(
            not self.recordings or len(self.recordings) == self.robots,
            "recordings",
            f"one for each of the {self.robots} robots",
        )
        needed = self.reference is None or bool(self.recordings)
        self._require(needed, "reference", "recordings beside it (a scene is its own truth)")
        placed = not self.recordings or self.link.reach is None
        self._require(placed, "recordings", "a link without reach, for want of true positions,")
        known = set(self.names)
        for crash in self.crashes:
            self._require(crash.robot in known, "crashes", f"robots out of {sorted(known)}")
        for partition in self.partitions:
            names = set(partition.robots)
            self._require(names <= known, "partitions", f"robots out of {sorted(known)}")

    @property
    def lying(self) -> int:
        return sum(liars.count for liars in self.liars)

    @property
    def names(self) -> list[str]:
        """r00, r01, ... for honest robots, then forger00, ... for liars."""
        names, numbers = [f"r{i:02d}" for i in range(self.robots - self.lying)], Counter[str]()
        for group in self.liars:
            for _ in range(group.count):
                names.append(f"{group.kind}{numbers[group.kind]:02d}")
                numbers[group.kind] += 1
        return names

    def drawn(self, seed: int) -> Scenario:
        """The same scenario with the faults and the liars that the seed draws listed."""
        chance, chaos = random.Random(f"chaos {seed}"), self.chaos
        liars = [liar for group in self.liars for liar in _drawn_liars(group, chance)]
        honest = self.names[: self.robots - self.lying]
        crashes, partitions = list(self.crashes), list(self.partitions)
        names = msgspec.structs.replace(self, liars=tuple(liars)).names
        for _ in range(chaos.crashes):
            at = round(chance.uniform(0, self.seconds), 3)
            down = round(chance.uniform(*chaos.down), 3)
            moment: Literal["between", "unsynced", "unsent"]
            moment = chance.choice(["between", "unsynced", "unsent"])
            crashes.append(Crash(robot=chance.choice(honest), at=at, down=down, moment=moment))
        for _ in range(chaos.partitions):
            start = round(chance.uniform(0, self.seconds), 3)
            end = round(start + chance.uniform(*chaos.apart), 3)
            side = tuple(sorted(chance.sample(names, chance.randint(1, self.robots))))
            way: Literal["both", "in", "out"] = chance.choice(["both", "both", "in", "out"])
            partitions.append(Partition(start=start, end=end, robots=side, direction=way))
        return msgspec.structs.replace(
            self,
            chaos=Chaos(),
            crashes=tuple(crashes),
            partitions=tuple(partitions),
            liars=tuple(liars),
        )

    def clock(self, index: int, seed: int) -> Clock:
        """The clock of a robot."""
        chance, worst = random.Random(f"clock {seed} {index}"), self.clocks
        return Clock(
            offset=chance.uniform(-worst.offset, worst.offset),
            drift=chance.uniform(-worst.drift, worst.drift),
        )

    def toml(self) -> bytes:
        """The scenario as a file: only what differs from the defaults, the name always."""
        return msgspec.toml.encode({"name": self.name, **_differing(self, Scenario())})


def _drawn_liars(group: Liars, chance: random.Random) -> list[Liars]:
    if group.kind != "any":
        return [group]
    drawn = Counter(chance.choice(sorted(LIARS)) for _ in range(group.count))
    return [Liars(kind=kind, count=count) for kind, count in sorted(drawn.items())]


def load_scenario(path: Path) -> Scenario:
    """Read a TOML file. Raises ConfigError that names the file, the key and what is wanted."""
    return read_toml(path, Scenario)


def _differing(value: msgspec.Struct, default: msgspec.Struct) -> dict[str, object]:
    out: dict[str, object] = {}
    for name in value.__struct_fields__:
        mine, usual = getattr(value, name), getattr(default, name)
        if mine == usual:
            continue
        if isinstance(mine, msgspec.Struct) and type(mine) is type(usual):
            out[name] = _differing(mine, usual)
        elif mine is not None:
            out[name] = msgspec.to_builtins(mine)
    return out
