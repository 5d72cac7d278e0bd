"""`load_config`, `load_settings`, `load_scenario`: TOML that a person wrote.

What loads has ids and can start a robot, has paths, or can be drawn and written again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from random import Random

import msgspec

from dagmap import Agent
from dagmap.config import Config, load_config
from dagmap.io.settings import AgentConfig, StoreConfig, load_settings
from dagmap.model import DagmapError
from dagmap.sim.scenario import Chaos, Crash, Liars, Partition, Scenario, load_scenario
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
    "[1, 2]",
    "[0.5, inf]",
    "[inf, inf]",
    "[nan, 1]",
    '"~x/y"',
    '"a\\u0000b"',
    '":٣"',
    '"a:' + "9" * 5000 + '"',
    '["tcp/[::]:0"]',
    '["tls/a:1", "x"]',
    '"router"',
    '"client"',
    "'" + "0f" * 32 + "'",
    '[{kind = "any", count = 2}]',
    '[{kind = "any", count = -1}, {kind = "forger", count = 1}]',
    '[{robot = "r00", at = 1, down = inf}]',
    '[{start = 1, end = inf, robots = ["r00"]}]',
    "[0, 1]",
)
_FULL = (Config(), AgentConfig(store=StoreConfig(path="x")), Scenario())
_GROUPS = {
    name: list(msgspec.to_builtins(value) if isinstance(value, msgspec.Struct) else ())
    for config in _FULL
    for name, value in ((n, getattr(config, n)) for n in config.__struct_fields__)
} | {"source": ["path", "max_features", "camera"], "network.tls": ["ca", "certificate", "key"]}


_WRONG = (
    b"robots = 0\n",
    b"link.loss = 2.0\n",
    b"sensor.kind = 'lidar'\nsensor.field = [0.0, 9.0]\n",
    b"partitions = [{start = 2, end = 1, robots = []}]\n",
    b"crashes = [{robot = 'r00', at = -1}]\n",
    b"liars = [{kind = 'liar'}]\n",
    b"liars = [{kind = 'forger', count = 1}]\n",
    b"chaos.crashes = 1\nchaos.down = [inf, inf]\n",
    b"chaos.crashes = 9999999999\n",
    b'store.path = "~nobody-at-all/x"\n',
    b'store.path = "a\\u0000b"\n',
    b"store.path = 'a'\n[ros]\n[source]\npath = 'a'\n",
    b"store.path = 'a'\nros.cloud = 'a b'\nros.zenoh.connect = ['x']\n",
    b"store.path = 'a'\nros.zenoh = {namespace = 'a', listen = []}\n",
    b"store.path = 'a'\nros = {map_data = '/m', map_graph = 'g', zenoh = {domain = 1}}\n",
)


def run(data: bytes) -> bool:
    write(_FILE, data)
    return sum([_taken(read) for read in (_robot, _process, _mission)]) > 0


def _taken(read: Callable[[], None]) -> bool:
    try:
        read()
    except DagmapError as error:
        assert "\n" not in str(error), "an error is one line"
        return False
    return True


def _robot() -> None:
    config = load_config(_FILE)
    assert len(config.fleet_id) == len(config.parameters_id) == 8
    assert config.graph.pitch_mm > 0 and config.fold.cell_mm > 0 and config.fold.delta_mm > 0
    assert config.fold.max_ray_mm >= 0 and config.placing.tolerance_mm > 0
    assert config.fold.support_mm >= 2 * config.fold.delta_mm
    Agent(ROBOTS[0], config)


def _process() -> None:
    settings = load_settings(_FILE)
    config = settings.config
    assert config.closed or config.name
    for path in (settings.ledger, settings.keys, settings.control):
        path.name.encode()
        assert "\0" not in str(path)
    if config.metrics.address is not None:
        assert 0 <= config.metrics.address[1] < 1 << 16


def _mission() -> None:
    scenario = load_scenario(_FILE)
    assert len(scenario.names) == scenario.robots
    assert len(scenario.drawn(1).crashes) >= len(scenario.crashes)
    scenario.clock(0, 1)
    _FILE.write_bytes(scenario.toml())
    assert load_scenario(_FILE) == scenario, "a scenario that is written is another"


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
    yield b'fleet_key = "' + b"0f" * 32 + b'"\n'
    yield _written(AgentConfig(name="robot", store=StoreConfig(path="data/robot.db")))
    yield (
        b'name = "r"\nstore.path = "~/r.db"\nsource.path = "walk"\ncontrol.path = "status"\n'
        b'metrics.listen = "[::1]:9464"\n[network]\nmode = "router"\nlisten = ["tls/[::]:7447"]\n'
        b'tls = {ca = "ca.pem", certificate = "a.pem", key = "a.key"}\n'
    )
    yield b'name = "' + b"x" * 70 + b'"\nstore.path = "a"\n'
    yield b'store.path = "a"\nmetrics.listen = "9464"\nnetwork.mode = "client"\n'
    yield _written(Scenario())
    yield b"store.path = 'a'\n"
    yield b"store.path = 'a'\nnetwork.receive_bytes_per_second_per_robot = 65536\n"
    yield from _WRONG
    yield b"[clocks]\n[scene]\nrooms = [1, 1]\n[sensor]\n[motion]\n[link]\n"
    yield Scenario(
        chaos=Chaos(crashes=2, partitions=2),
        robots=5,
        liars=(Liars(kind="any", count=2),),
        late=(1.0,),
        crashes=(Crash(robot="r00", at=1.0, moment="unsent"),),
        partitions=(Partition(start=1.0, end=2.0, robots=("r01",), direction="in"),),
    ).toml()


def _written(config: Config) -> bytes:
    """Every parameter of a configuration as TOML, whose values are like those of JSON."""
    tree, lines = msgspec.to_builtins(config), []
    for name, value in tree.items():
        rows = value if isinstance(value, dict) else {"": value}
        for key, leaf in rows.items():
            if leaf is not None:
                lines.append(f"{name}{'.' if key else ''}{key} = {json.dumps(leaf)}\n")
    return "".join(lines).encode()


PARSERS = {
    "dagmap.config": (),
    "dagmap.io.settings": ("SourceConfig.options",),
    "dagmap.io.ros.config": (),
    "dagmap.sim.scenario": (),
    "dagmap.sim.building": ("!SceneConfig*",),
    "dagmap.sim.sensor": ("!SensorConfig*",),
    "dagmap.sim.walk": ("!MotionConfig*",),
    "dagmap.sim.network": ("!Link", "!Link.*", "!Partition", "!Partition.__post_init__"),
    "dagmap.sim.fleet": ("!Crash", "!Crash.*"),
}
TARGET = Target(
    run, mutate, seeds, PARSERS, max_len=16_384, generated=(b"", b"name = " + b"9" * 5000)
)
