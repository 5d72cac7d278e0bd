"""`load_config`: TOML that a person wrote. What loads has ids and can start a robot."""

from __future__ import annotations

import json
from collections.abc import Iterable
from random import Random

import msgspec

from dagmap import Agent
from dagmap.config import Config, load_config
from dagmap.model import DagmapError
from grammar import Flip
from targets import Target
from targets._files import workplace, write
from targets._wire import ROBOTS

_FILE = workplace() / "robot.toml"
_VALUES = (
    "0",
    "1",
    "-1",
    "8",
    "9",
    "255",
    "1e300",
    "-0.0",
    "nan",
    "inf",
    "true",
    '""',
    '"x"',
    "[]",
    "{}",
    "0x" + "f" * 64,
    "0x" + "f" * 5000,
    "9" * 400,
    "9" * 5000,
    "1979-05-27",
    '"\\u0000"',
    '"\\U0001F600"',
    "[" * 60 + "]" * 60,
    "[" * 3000,
    "[[1.0,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]",
    "'paper'",
    "4611686018427387905",
)
_GROUPS = {
    name: list(msgspec.to_builtins(value) if isinstance(value, msgspec.Struct) else ())
    for name, value in ((n, getattr(Config(), n)) for n in Config.__struct_fields__)
}


def run(data: bytes) -> bool:
    write(_FILE, data)
    try:
        config = load_config(_FILE)
    except DagmapError as error:
        assert "\n" not in str(error), "an error is one line"
        return False
    assert len(config.fleet_id) == len(config.parameters_id) == 8
    assert config.graph.pitch_mm > 0 and config.fold.cell_mm > 0 and config.fold.delta_mm > 0
    assert config.fold.max_ray_mm >= 0
    Agent(ROBOTS[0], config)
    return True


def mutate(data: bytes, rng: Random, flip: Flip) -> bytes:
    """A line gets another value or goes; a line with a known name comes; or bytes change."""
    if rng.random() < 0.3:
        return flip(data)
    lines = data.split(b"\n")
    i = rng.randrange(len(lines))
    key, equals, _ = lines[i].partition(b"=")
    value = rng.choice(_VALUES).encode()
    way = rng.randrange(4)
    if way == 0 and equals:
        lines[i] = key + b"= " + value
    elif way == 1:
        del lines[i]
    elif way == 2 and equals:
        lines[i] = flip(lines[i])
    else:
        group = rng.choice(sorted(_GROUPS))
        name = rng.choice(_GROUPS[group] or [""])
        lines.insert(i, f"{group}{'.' if name else ''}{name} = ".encode() + value)
    return b"\n".join(lines)


def seeds() -> Iterable[bytes]:
    yield _written(Config(name="robot"))
    yield b"[graph]\nn_p = 3\nn_c = 2\n"
    yield b"[issuance]\nfeatures_per_second = 100.0\n"
    yield b"start_pose = [[1,0,0,0],[0,1,0,0],[0,0,2,0],[0,0,0,1]]\n"
    yield b"no key\n"
    yield b"\xff"
    yield b"fleet = 5\n"


def _written(config: Config) -> bytes:
    """Every parameter of a configuration as TOML, whose values are like those of JSON."""
    tree, lines = msgspec.to_builtins(config), []
    for name, value in tree.items():
        rows = value if isinstance(value, dict) else {"": value}
        for key, leaf in rows.items():
            if leaf is not None:
                lines.append(f"{name}{'.' if key else ''}{key} = {json.dumps(leaf)}\n")
    return "".join(lines).encode()


PARSERS = {"dagmap.config": ()}
TARGET = Target(
    run, mutate, seeds, PARSERS, max_len=16_384, generated=(b"", b"name = " + b"9" * 5000)
)
