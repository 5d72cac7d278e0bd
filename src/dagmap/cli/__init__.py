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


_Camera = Annotated[Path | None, typer.Option(help="camera.json to use, not the folder's own.")]
_MaxFeatures = Annotated[int, typer.Option(help="Points a frame gives at most.")]
_MaxDepth = Annotated[float | None, typer.Option(help="Points beyond are dropped, m.")]
_Topic = Annotated[
    list[str] | None, typer.Option(help="Of a bag: a topic to use; may be repeated.")
]
_Frame = Annotated[str | None, typer.Option(help="Of a bag with tf: the frame that stands still.")]
_SameFrame = Annotated[bool, typer.Option(help="Poses are the sensor's, whatever frames say.")]
_Poses = Annotated[Path | None, typer.Option(help="File of poses, TUM or KITTI (clouds, EuRoC).")]
_BodyPoses = Annotated[
    bool,
    typer.Option("--body-poses", help="Poses of a SLAM are the body's (IMU), not the camera's."),
]
_Voxel = Annotated[float, typer.Option(help="Of a cloud one point a voxel is kept, m.")]
_KeepGoing = Annotated[bool, typer.Option(help="Leave out what cannot be read.")]


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
        list[Path],
        typer.Argument(help="One per robot: a bag, a folder, a cycle stream; see docs/formats.md."),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the results; it must be empty.")],
    config: Annotated[Path | None, typer.Option(help="TOML file of parameters.")] = None,
    loss: Annotated[float, typer.Option(help="Share of messages that the network loses.")] = 0.0,
    late: Annotated[
        list[str] | None,
        typer.Option(help="A robot that joins at the end and copies the map; may be repeated."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the simulated network.")] = 0,
    max_features: _MaxFeatures = 1000,
    max_depth: _MaxDepth = None,
    topic: _Topic = None,
    frame: _Frame = None,
    same_frame: _SameFrame = False,
    poses: _Poses = None,
    body_poses: _BodyPoses = False,
    voxel: _Voxel = 0.1,
    keep_going: _KeepGoing = False,
    camera: _Camera = None,
    unknown_frames: Annotated[
        bool,
        typer.Option(
            "--unknown-frames", help="Every robot starts at its own identity and finds the others."
        ),
    ] = False,
    force: Annotated[bool, typer.Option(help="Replace the results in a non-empty --out.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print summary.json, no table.")] = False,
) -> None:
    """Play recordings through one agent each and write the map on which they agree."""
    from ..io.sources import Options
    from .replay import Replay

    options = Options(
        camera, max_features, max_depth, tuple(topic or ()), frame, same_frame, poses, voxel,
        keep_going, body_poses,
    )  # fmt: skip
    replay = Replay(
        recordings, out, config, loss, late or [], seed, options, unknown_frames, force, json
    )
    raise typer.Exit(replay.run())


@app.command()
def inspect(
    recording: Annotated[Path, typer.Argument(help="A recording of any kind that is read.")],
    camera: _Camera = None,
    topic: _Topic = None,
    frame: _Frame = None,
    same_frame: _SameFrame = False,
    poses: _Poses = None,
    body_poses: _BodyPoses = False,
    keep_going: _KeepGoing = False,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """List what a recording holds, and say what of it would be used."""
    from ..io.sources import Options
    from .inspect import show_source

    options = Options(
        camera, topics=tuple(topic or ()), frame=frame, same_frame=same_frame, poses=poses,
        keep_going=keep_going, body_poses=body_poses,
    )  # fmt: skip
    raise typer.Exit(show_source(recording, options, json))


@app.command()
def tune(
    recordings: Annotated[
        list[Path], typer.Argument(help="One per robot; those of one fleet share a frame.")
    ],
    out: Annotated[
        Path | None, typer.Option(help="TOML file to write; default: the terminal.")
    ] = None,
    camera: _Camera = None,
    max_features: _MaxFeatures = 1000,
    max_depth: _MaxDepth = None,
    topic: _Topic = None,
    frame: _Frame = None,
    same_frame: _SameFrame = False,
    poses: _Poses = None,
    body_poses: _BodyPoses = False,
    voxel: _Voxel = 0.1,
    keep_going: _KeepGoing = False,
    force: Annotated[bool, typer.Option(help="Replace the file.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Propose parameters from what recordings show of resolution and noise, without truth."""
    from ..io.sources import Options
    from .tune import Tune

    options = Options(
        camera, max_features, max_depth, tuple(topic or ()), frame, same_frame, poses, voxel,
        keep_going, body_poses,
    )  # fmt: skip
    Tune(recordings, out, options, force, json).run()


@app.command()
def agent(
    config: Annotated[Path, typer.Argument(help="TOML file of this robot, see docs/fleet.md.")],
    speed: Annotated[float, typer.Option(help="Play the recording so many times as fast.")] = 1.0,
    wait_for: Annotated[
        int, typer.Option(help="Begin the recording when so many other robots are in reach.")
    ] = 0,
    until_agreed: Annotated[
        float | None,
        typer.Option(
            help="End once the recording is over and there was no news for so many seconds; "
            "default: go on and serve."
        ),
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Check the file, compile the kernels, and end.")
    ] = False,
    log: Annotated[str, typer.Option(help="debug, info, warning or error.")] = "info",
    json: Annotated[bool, typer.Option("--json", help="At the end, print the status.")] = False,
) -> None:
    """Run one robot: its SLAM or a recording in, the fleet's map kept on disk and shared."""
    from .agent import AgentCommand, level_named

    level = level_named(log)
    raise typer.Exit(AgentCommand(config, speed, wait_for, until_agreed, check, level, json).run())


@app.command()
def status(
    target: Annotated[Path, typer.Argument(help="The agent's TOML file, or its status socket.")],
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Ask a running agent for its digest, heads, peers, lag and traffic."""
    from .status import show_status

    raise typer.Exit(show_status(target, json))


@app.command()
def view(
    folder: Annotated[
        Path | None, typer.Argument(help="The --out of a replay.", show_default=False)
    ] = None,
    live: Annotated[
        str | None, typer.Option(help="Endpoint of a running fleet, as tcp/192.168.1.7:7447.")
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(help="With --live: TOML file with the fleet's name and parameters."),
    ] = None,
    robot: Annotated[
        str | None, typer.Option(help="Whose ledger of a run is shown; default: the first one's.")
    ] = None,
    host: Annotated[
        str, typer.Option(help="Address to serve at; 0.0.0.0 lets others look on.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to serve at; 0: any that is free.")] = 8080,
    points: Annotated[int, typer.Option(help="Points that are drawn at most.")] = 400_000,
    browser: Annotated[bool, typer.Option(help="Open a browser.")] = True,
) -> None:
    """Look at a run or at a running fleet in a browser: the map, the robots, the ledger."""
    from .view import ViewCommand

    ViewCommand(folder, live, config, robot, host, port, points, browser).run()


@app.command()
def evaluate(
    map: Annotated[Path, typer.Argument(help="The map: PLY or NPZ.")],  # noqa: A002
    reference: Annotated[Path, typer.Option(help="What is true: PLY or NPZ, in the same frame.")],
    recall_reference: Annotated[
        Path | None, typer.Option(help="What the map should hold; default: the reference.")
    ] = None,
    states: Annotated[
        str, typer.Option(help="Which nodes count, where the map tells: names with commas.")
    ] = "confirmed,tentative",
    picture: Annotated[
        Path | None, typer.Option(help="PNG of the map, coloured by its error.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Measure a map against a reference: accuracy, completeness, F-scores, entropy and more."""
    from .evaluate import Evaluate

    Evaluate(map, reference, recall_reference, states, picture, json).run()


@app.command()
def export(
    source: Annotated[
        Path,
        typer.Argument(help="A replay's folder, a ledger.db, an agent's TOML file, or a map.ply."),
    ],
    out: Annotated[
        Path,
        typer.Option(help="Its suffix names the format: ply pcd las laz e57 npz mcap yaml bt."),
    ],
    config: Annotated[
        Path | None, typer.Option(help="TOML file under which the ledger was written.")
    ] = None,
    state: Annotated[
        str, typer.Option(help="Which nodes: names with commas.")
    ] = "confirmed,tentative",
    robot: Annotated[
        list[str] | None, typer.Option(help="Only what this robot saw; may be repeated.")
    ] = None,
    box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(help="Lower corner, upper corner: x y z x y z, m.", metavar="X Y Z X Y Z"),
    ] = None,
    since: Annotated[float | None, typer.Option(help="Only what was seen from then on, s.")] = None,
    until: Annotated[float | None, typer.Option(help="Only what was seen up to then, s.")] = None,
    resolution: Annotated[float, typer.Option(help="m a cell, of yaml and bt.")] = 0.05,
    height: Annotated[
        tuple[float, float], typer.Option(help="The slice of a yaml grid, m along --up.")
    ] = (0.1, 2.0),
    up: Annotated[str, typer.Option(help="The axis that points up: z, -y, ...; for yaml.")] = "z",
    free: Annotated[
        bool, typer.Option(help="In yaml and bt: what rays passed through is free.")
    ] = True,
    force: Annotated[bool, typer.Option(help="Replace the file.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Write the map, or a part of it, in a format that other programs open."""
    from ..io.writers import WriteOptions
    from .export import Export

    wanted = (tuple(robot or ()), box, since, until)
    options = WriteOptions(resolution, height, up, free)
    Export(source, out, config, state, wanted, options, force, json).run()


@app.command()
def simulate(
    scenarios: Annotated[list[Path], typer.Argument(help="TOML file of a scenario.")],
    seed: Annotated[int, typer.Option(min=0, help="What all chance is drawn from.")] = 0,
    seeds: Annotated[
        int | None,
        typer.Option(
            min=1, help="Sweep: so many seeds, with invariants checked after every event."
        ),
    ] = None,
    timeline: Annotated[
        Path | None, typer.Option(help="Write every event to this file; - for the terminal.")
    ] = None,
    jobs: Annotated[int, typer.Option(min=0, help="Processes of a sweep; 0: one a core.")] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Run a whole fleet in one process, with faults and liars. The same seed gives the same run."""
    from .simulate import Simulate

    raise typer.Exit(Simulate(scenarios, seed, seeds, timeline, jobs, json).run())


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
