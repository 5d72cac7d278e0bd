"""What a robot is set up with: the image, the unit, the wheels."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from dagmap.io.settings import load_settings

ROOT = Path(__file__).parents[1]
PACKAGING = ROOT / "packaging"
INSTRUCTIONS = {
    "ARG", "FROM", "WORKDIR", "RUN", "COPY", "ENV", "USER", "VOLUME", "STOPSIGNAL", "HEALTHCHECK",
    "ENTRYPOINT", "CMD",
}  # fmt: skip


def lines() -> list[tuple[str, str]]:
    """(instruction, rest) of the Dockerfile."""
    text = (PACKAGING / "Dockerfile").read_text()
    rows = [line for line in text.splitlines() if line and not line.startswith("#")]
    return [(head, rest) for head, _, rest in (row.partition(" ") for row in rows)]


def test_the_image_runs_the_agent_as_nobody_special() -> None:
    rows = lines()
    assert {head for head, _ in rows} <= INSTRUCTIONS
    last = dict(rows)  # of several the last counts, as in a build
    assert last["FROM"].split()[0].endswith("-slim")
    user = last["USER"].partition(":")[0]
    assert user.isdecimal() and int(user) > 0
    order = [head for head, _ in rows]
    assert order.index("USER") > order.index("COPY") and "RUN" not in order[order.index("USER") :]
    assert last["ENTRYPOINT"] == '["dagmap", "agent"]' and last["STOPSIGNAL"] == "SIGTERM"
    path = next(rest for head, rest in rows if head == "ENV" and rest.startswith("PATH="))
    assert path.startswith("PATH=/opt/dagmap/bin:")


def test_the_image_is_built_from_what_is_there() -> None:
    ignored = (PACKAGING / "Dockerfile.dockerignore").read_text().split()
    for head, rest in lines():
        if head == "COPY" and not rest.startswith("--from"):
            for part in rest.split()[:-1]:
                assert (ROOT / part).exists() and f"!{part}" in ignored, part
        if head == "RUN" and "pip install" in rest:
            words = shlex.split(rest)
            assert "--require-hashes" in words or "--no-deps" in words


def test_the_image_reads_bags() -> None:
    """What it installs, by name, has what bags and their pictures need."""
    sys.path.insert(0, str(PACKAGING))
    try:
        from check_wheels import requirements
    finally:
        sys.path.pop(0)
    file = next(rest for head, rest in lines() if head == "RUN" and "--require-hashes" in rest)
    locked = (ROOT / shlex.split(file)[-1]).read_text()
    names = set(re.findall(r"^([\w.-]+)==", locked, re.M))
    wanted = requirements(["fleet", "rgbd", "ros"], "x86_64")
    assert {re.split(r"[<>=]", each)[0] for each in wanted} <= names
    assert "rosbags" in names and "://" not in locked


def test_the_image_installs_from_a_configured_index_only() -> None:
    for file in PACKAGING.iterdir():
        if file.is_file():
            assert "://" not in file.read_text(), f"{file.name} names an address"


def unit() -> dict[str, dict[str, list[str]]]:
    """The unit's values by section and key."""
    out: dict[str, dict[str, list[str]]] = {}
    section = ""
    for line in (PACKAGING / "dagmap@.service").read_text().splitlines():
        if line.startswith("["):
            section = line.strip("[]")
        elif line and not line.startswith("#"):
            key, _, value = line.partition("=")
            out.setdefault(section, {}).setdefault(key, []).append(value)
    return out


def test_the_unit_starts_again_after_a_failure_only() -> None:
    service = unit()["Service"]
    assert service["Restart"] == ["on-failure"] and service["KillSignal"] == ["SIGTERM"]
    assert service["User"] == ["dagmap"] and service["NoNewPrivileges"] == ["yes"]
    assert service["MemoryDenyWriteExecute"] == ["no"]  # or no kernel could be compiled
    commands = [shlex.split(line) for line in service["ExecStartPre"] + service["ExecStart"]]
    assert all(command[1:3] == ["agent", "/etc/dagmap/%i.toml"] for command in commands)


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd here")
def test_systemd_takes_the_unit(tmp_path: Path) -> None:
    text = (PACKAGING / "dagmap@.service").read_text()
    program = tmp_path / "dagmap"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    file = tmp_path / "dagmap@.service"
    file.write_text(text.replace("/opt/dagmap/bin/dagmap", str(program)))
    environment = {**os.environ, "SYSTEMD_LOG_LEVEL": "info"}
    command = ["systemd-analyze", "verify", "--man=no", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    said = [line for line in done.stderr.splitlines() if "dagmap" in line]
    assert done.returncode == 0 and not said, done.stderr


def test_the_robot_s_file_loads(tmp_path: Path) -> None:
    text = (PACKAGING / "robot.toml").read_text()
    (tmp_path / "robot.toml").write_text(text)
    settings = load_settings(tmp_path / "robot.toml")
    assert settings.config.name == "robot1" and settings.config.network.listen


def test_requirements_of_extras_are_those_of_the_project() -> None:
    sys.path.insert(0, str(PACKAGING))
    try:
        from check_wheels import platforms, requirements
    finally:
        sys.path.pop(0)
    base, every = requirements([], "aarch64"), requirements(["all"], "x86_64")
    assert any(name.startswith("numba") for name in base)
    assert not any("opencv" in name for name in base)
    assert set(base) < set(every) and any("opencv" in name for name in every)
    assert set(every) - set(requirements(["all"], "aarch64")) == {"pye57>=0.4.15"}  # no wheel
    assert not any(re.search(r"dagmap|;", name) for name in every)
    assert "manylinux_2_28_aarch64" in platforms("aarch64")
