"""`dagmap keys`: make a fleet, enroll robots, revoke them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..model import KeysError

if TYPE_CHECKING:
    from ..io.keys import Fleet, Robot

app = typer.Typer(
    help="Keys of a closed fleet: make it, enroll robots, revoke them.", no_args_is_help=True
)

_Fleet = Annotated[Path, typer.Option("--fleet", help="The fleet's folder.")]
_Name = Annotated[str, typer.Argument(help="The robot's name.")]
_Days = Annotated[int, typer.Option(help="Days for which its TLS certificate is valid.")]
_Addresses = Annotated[
    list[str] | None,
    typer.Option(
        "--address",
        help="IP address or host name for its TLS certificate, beside the name; may be repeated.",
    ),
]
_Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


@app.command("init-fleet")
def init_fleet(
    folder: Annotated[Path, typer.Argument(help="Folder to make.")],
    name: Annotated[str, typer.Option(help="Name of the fleet.")],
    as_json: _Json = False,
) -> None:
    """Make a fleet: its key, its certificate authority, its list of robots."""
    from ..io.keys import create_fleet

    fleet = create_fleet(folder, name)
    lines = [
        f"{folder} is the fleet {name!r}, fleet_key {fleet.config.fleet_key}",
        f"keep {folder / 'fleet.key'} in one place, off the robots: who has it, is the fleet",
        f"next: dagmap keys enroll NAME --fleet {folder} --out NAME",
    ]
    _say(lines, _fleet_facts(fleet), as_json)


@app.command()
def enroll(
    name: _Name,
    fleet: _Fleet,
    out: Annotated[Path, typer.Option(help="Folder to make; it goes onto the robot.")],
    days: _Days = 365,
    address: _Addresses = None,
    as_json: _Json = False,
) -> None:
    """Make a robot's key, and the fleet's certificate for it. No other robot needs to be told."""
    from ..io.keys import open_fleet, open_robot

    open_fleet(fleet).enroll(name, out, days, address or ())
    robot = open_robot(out)
    lines = [
        f"{out} is the robot {name!r}, author {robot.identity.author.hex()}",
        f"TLS until {robot.tls_until:%Y-%m-%d}; move the folder onto the robot, keep no copy",
    ]
    _say(lines, _robot_facts(robot), as_json)


@app.command()
def renew(
    name: _Name,
    fleet: _Fleet,
    out: Annotated[Path, typer.Option(help="File to write; it replaces the robot's tls.pem.")],
    days: _Days = 365,
    address: _Addresses = None,
) -> None:
    """Make a robot's TLS certificate anew, before or after it has expired."""
    from ..io.keys import open_fleet

    until = open_fleet(fleet).renew(name, out, days, address or ())
    typer.echo(f"{out}: TLS of {name} until {until:%Y-%m-%d}; put it onto the robot as tls.pem")


@app.command()
def revoke(
    name: Annotated[str, typer.Argument(help="The robot's name, or its author id.")],
    last: Annotated[
        int, typer.Option(help="Its last transaction number that still counts; -1: none does.")
    ],
    fleet: _Fleet,
    as_json: _Json = False,
) -> None:
    """Sign that a robot counts no further. Give the file to any robot: it spreads by itself."""
    from ..io.keys import open_fleet

    home = open_fleet(fleet)
    path, author = home.revoke(name, last), home.identity.author.hex()
    before = int(path.stem)
    done = f"{path}: {name} counts up to number {last}; give this file to any robot of the fleet"
    first = (
        f"{fleet} held {before} revocations before. First see that `dagmap status` of a robot "
        f"shows no more transactions of the fleet key ({author}): where it does, {fleet} is an "
        f"old copy; then put back the newest, and remove {path}: it would end the fleet key's say "
        "for good"
    )
    facts = {"file": str(path), "name": name, "last": last, "number": before, "author": author}
    _say([done, first], facts, as_json)


@app.command()
def show(
    folder: Annotated[Path, typer.Argument(help="The folder of a fleet or of a robot.")],
    as_json: _Json = False,
) -> None:
    """Check a folder and show what it holds, private keys excepted."""
    from ..io.keys import open_fleet, open_robot

    if (folder / "fleet.key").exists():
        facts = _fleet_facts(open_fleet(folder))
    elif (folder / "robot.key").exists():
        facts = _robot_facts(open_robot(folder))
    else:
        raise KeysError(f"{folder}: neither fleet.key nor robot.key is here; name such a folder")
    lists = {key: value for key, value in facts.items() if isinstance(value, list)}
    lines = [f"{key:10} {value}" for key, value in facts.items() if key not in lists]
    for key, rows in lists.items():
        lines += [f"{key:10} {len(rows)}"]
        lines += ["  " + "  ".join(str(value) for value in row.values()) for row in rows]
    _say(lines, facts, as_json)


def _fleet_facts(fleet: Fleet) -> dict[str, Any]:
    robots = fleet.robots().values()
    names = {robot.author: robot.name for robot in robots}
    gone = [(tx.sequence, word) for tx in fleet.revocations() for word in tx.payload.revocations]
    return {
        "fleet": fleet.config.fleet,
        "fleet_key": fleet.config.fleet_key,
        "fleet_id": fleet.config.fleet_id.hex(),
        "author": fleet.identity.author.hex(),
        "robots": [{"author": robot.author.hex(), "name": robot.name} for robot in robots],
        "revoked": [
            {
                "number": number,
                "author": word.author.hex(),
                "last": word.count - 1,
                "name": names.get(word.author, ""),
            }
            for number, word in gone
        ],
    }


def _robot_facts(robot: Robot) -> dict[str, Any]:
    return {
        "robot": robot.name,
        "author": robot.identity.author.hex(),
        "public_key": robot.identity.public_key.hex(),
        "fleet": robot.config.fleet,
        "fleet_key": robot.config.fleet_key,
        "fleet_id": robot.config.fleet_id.hex(),
        "tls_until": robot.tls_until.isoformat(),
    }


def _say(lines: list[str], facts: dict[str, Any], as_json: bool) -> None:
    typer.echo(json.dumps(facts, indent=2) if as_json else "\n".join(lines))
