"""The file of one robot: what it may say, and what is said where it is wrong."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from dagmap import ConfigError
from dagmap.io.settings import Settings, is_endpoint, load_settings
from dagmap.io.transport import session_config

EXAMPLES = Path(__file__).parents[1] / "examples" / "fleet"
STORE = '[store]\npath = "data/ledger.db"\n'


def load(folder: Path, text: str) -> Settings:
    path = folder / "robot7.toml"
    path.write_text(text)
    return load_settings(path)


class TestFile:
    def test_the_least(self, tmp_path: Path) -> None:
        settings = load(tmp_path, STORE)
        assert settings.config.name == "robot7"
        assert settings.ledger == tmp_path / "data" / "ledger.db"
        assert settings.control == tmp_path / "data" / "status.sock"
        assert settings.config.source is None and settings.config.metrics.address is None

    def test_the_keys_of_config_stand_beside_the_tables(self, tmp_path: Path) -> None:
        text = 'name = "scout"\nfleet = "f"\n[graph]\nv_th = 9\n' + STORE
        config = load(tmp_path, text).config
        assert (config.name, config.fleet, config.graph.v_th) == ("scout", "f", 9)

    @pytest.mark.parametrize("name", ["robot1", "robot2", "robot3"])
    def test_the_examples(self, name: str) -> None:
        settings = load_settings(EXAMPLES / f"{name}.toml")
        assert settings.config.name == name and settings.config.source is not None
        assert settings.at(settings.config.source.path).is_dir()
        root = EXAMPLES.parents[1]
        assert settings.ledger == root / "out" / "fleet" / name / "ledger.db"

    def test_the_documented_tables(self, tmp_path: Path) -> None:
        """The file in docs/fleet.md can be loaded, and shows every key of every table."""
        text = (EXAMPLES.parents[1] / "docs" / "fleet.md").read_text()
        block = re.search(r"```toml\n(.*?)```", text, re.S)
        assert block is not None
        config = load(tmp_path, block[1]).config
        tables = (config.source, config.network, config.network.tls, config.store, config.metrics)
        for table in (*tables, config.control):
            assert table is not None
            for key in table.__struct_fields__:
                assert re.search(rf"^(\[network\.)?{key}\b", block[1], re.M), key

    def test_the_documented_limits(self, tmp_path: Path) -> None:
        """The table of limits in docs/fleet.md names every bound, and its default."""
        text = (EXAMPLES.parents[1] / "docs" / "fleet.md").read_text()
        limits = text.partition("## Limits")[2].partition("\n## ")[0]
        rows = dict(re.findall(r"^\| `([a-z_.]+)` \| (\d+) \| .{20,} \|$", limits, re.M))
        config = load(tmp_path, STORE).config
        for name, value in rows.items():
            table, _, key = name.partition(".")
            assert int(value) == getattr(getattr(config, table), key), name
        bounds = [f"ledger.{key}" for key in config.ledger.__struct_fields__]
        network = config.network.__struct_fields__
        bounds += [f"network.{key}" for key in network if re.search("bytes|messages|_remem", key)]
        spread = config.sync.__struct_fields__
        bounds += [f"sync.{key}" for key in spread if not key.endswith("period")]
        assert set(bounds) <= rows.keys() and len(bounds) == 19


class TestMistakes:
    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("", r"there is no table \[store\]; add one with path ="),
            ("[store]\n", "missing required field `path` - at `$.store`"),
            (STORE + "[network]\nlisen = []", "unknown field `lisen` - at `$.network`"),
            (STORE + '[network]\nlisten = ["7447"]', "listen = .*, but endpoints such as"),
            (STORE + '[network]\nmode = "router"', "NetworkConfig: listen = .* a router wants"),
            (STORE + '[network]\nmode = "mesh"', "'mesh'"),
            (
                STORE + '[network]\nmode = "client"\nscouting = false',
                "NetworkConfig: mode = 'client', but a client wants a router",
            ),
            (STORE + "[network]\nsend_bytes = 1", "send_bytes = 1, but 65536 to"),
            (
                STORE + "[network]\nreceive_messages_per_second = 1",
                "receive_messages_per_second = 1, but 10 to",
            ),
            (
                STORE + "[network]\nreceive_bytes_per_second_per_robot = 70000",
                "receive_bytes_per_second_per_robot = 70000, but a question counts",
            ),
            (
                STORE + '[network]\nconnect = ["tcp/x:1"]\n'
                '[network.tls]\nca = "a"\ncertificate = "b"\nkey = "c"',
                "connect = .* every endpoint begins with tls/",
            ),
            (
                STORE + '[metrics]\nlisten = "9464"',
                "MetricsConfig: listen = '9464', but an address",
            ),
            ("store = 3", "Expected `object`, got `int` - at `$.store`"),
        ],
    )
    def test_each_names_the_file_the_key_and_what_is_wanted(
        self, tmp_path: Path, text: str, message: str
    ) -> None:
        with pytest.raises(ConfigError, match=message.replace("$", r"\$")) as error:
            load(tmp_path, text)
        assert str(error.value).startswith(f"{tmp_path}/robot7.toml: ")


@pytest.mark.parametrize(
    ("text", "good"),
    [
        ("tcp/192.168.1.7:7447", True),
        ("tls/[::]:0", True),
        ("tcp/robot1.local:7447#iface=wlan0", True),
        ("unixsock-stream//tmp/robot", True),
        ("7447", False),
        ("tcp/", False),
        ("tcp/robot1", False),
        ("tcp/7447", False),
        ("tcp/robot1:", False),
        ("udp/robot1:70000", False),
    ],
)
def test_an_endpoint_has_a_protocol_an_address_and_a_port(text: str, good: bool) -> None:
    assert is_endpoint(text) == good


class TestSession:
    def test_with_tls_no_other_door_is_open(self, tmp_path: Path) -> None:
        tls = '[network.tls]\nca = "ca.pem"\ncertificate = "r.pem"\nkey = "r.key"\n'
        settings = load(tmp_path, STORE + tls)
        config = session_config(settings.config.network, settings.folder)
        assert config["transport/link/protocols"] == ["tls"]
        assert config["transport/link/tls/enable_mtls"] is True
        assert config["listen/endpoints"] == ("tls/[::]:0",)
        assert config["transport/link/tls/root_ca_certificate"] == str(tmp_path / "ca.pem")

    def test_shared_memory_is_off_and_robots_try_again_for_ever(self, tmp_path: Path) -> None:
        settings = load(tmp_path, STORE + '[network]\nconnect = ["tcp/1.2.3.4:5"]\n')
        config = session_config(settings.config.network, settings.folder)
        assert config["transport/shared_memory/enabled"] is False
        assert config["connect/timeout_ms"] == -1
        assert config["connect/endpoints"] == ("tcp/1.2.3.4:5",)
