"""The command line. Each command lives in a module of its own and is imported when it is run."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from .. import __version__
from .keys import app as keys

app = typer.Typer(
    help="One map for a fleet of robots, the same on every robot, without a central station.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
app.add_typer(keys, name="keys")


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"dagmap {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """One map for a fleet of robots, the same on every robot, without a central station."""


@app.command()
def replay(
    recordings: Annotated[
        list[Path], typer.Argument(help="One per robot: a TUM RGB-D folder or a cycle stream .npz.")
    ],
    out: Annotated[Path, typer.Option(help="Folder for the results; it must be empty.")],
    config: Annotated[Path | None, typer.Option(help="TOML file of parameters.")] = None,
    loss: Annotated[float, typer.Option(help="Share of messages that the network loses.")] = 0.0,
    late: Annotated[
        list[str] | None,
        typer.Option(help="A robot that joins at the end and copies the map; may be repeated."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the simulated network.")] = 0,
    max_features: Annotated[int, typer.Option(help="ORB features a frame at most.")] = 1000,
    camera: Annotated[
        Path | None, typer.Option(help="camera.json to use instead of the folder's own.")
    ] = None,
    force: Annotated[bool, typer.Option(help="Replace the results in a non-empty --out.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print summary.json, no table.")] = False,
) -> None:
    """Play recordings through one agent each and write the map on which they agree."""
    from .replay import Replay

    raise typer.Exit(
        Replay(
            recordings, out, config, loss, late or [], seed, max_features, camera, force, json
        ).run()
    )


@app.command()
def bench(
    names: Annotated[
        list[str] | None, typer.Argument(help="Which ones, by file name; default: all.")
    ] = None,
    folder: Annotated[Path, typer.Option("--dir", help="Folder of the benchmarks.")] = Path(
        "bench"
    ),
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Measure this machine: rates, memory and bytes, beside peers measured in the same run."""
    from .bench import run_benchmarks

    raise typer.Exit(run_benchmarks(folder, names or [], json))


def main() -> None:
    """Entry point of `dagmap`. A user's mistake gets one line and exit code 2, no traceback."""
    from ..model import DagmapError

    try:
        app()
    except DagmapError as error:
        typer.echo(f"dagmap: {error}", err=True)
        sys.exit(2)
    except KeyboardInterrupt:
        typer.echo("dagmap: interrupted", err=True)
        sys.exit(130)
