"""``pgdm deploy``: commands and their options; each runs in the module of the same name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from pgdm.cli.console.screen import loading
from pgdm.cli.options import Offline, Video, existing, known_run
from pgdm.errors import ConfigError

app = typer.Typer(help="Play a trained policy on a Franka Panda arm.", no_args_is_help=True)

_File = Annotated[
    Path, typer.Argument(metavar="FILE", help="A playback: .npz or .csv.", callback=existing)
]


def _numbers(count: int, what: str) -> Callable[[typer.CallbackParam, str | None], str | None]:
    def check(param: typer.CallbackParam, text: str | None) -> str | None:
        if text is not None:
            try:
                fits = len([float(word) for word in text.split()]) == count
            except ValueError:
                fits = False
            if not fits:
                raise ConfigError(f"--{param.name} '{text}': give {count} numbers, {what}")
        return text

    return check


def _floats(text: str | None) -> tuple[float, ...] | None:
    return None if text is None else tuple(float(word) for word in text.split())


@app.command("export")
def export_playback(
    run: Annotated[
        Path,
        typer.Argument(
            metavar="RUN", help="Folder of a run, or one of its checkpoints.", callback=known_run
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="File to write: .npz or .csv.")],
    episodes: Annotated[
        int,
        typer.Option(
            min=1,
            help="Episodes of which the best is exported; only one is run unless the task is "
            "randomised or --sampled is given.",
        ),
    ] = 16,
    sampled: Annotated[
        bool, typer.Option("--sampled", help="Sample actions instead of using the mean action.")
    ] = False,
    best: Annotated[
        bool,
        typer.Option(
            "--best", help="Use the run's checkpoint of highest success, if any, not its last."
        ),
    ] = False,
    base: Annotated[
        str,
        typer.Option(
            help="Motion of the hand's base: as simulated (reached), or its targets (commanded).",
            metavar="KIND",
        ),
    ] = "reached",
    speed: Annotated[float, typer.Option(help="Fraction of the simulation's speed.")] = 1.0,
    smooth: Annotated[
        float,
        typer.Option(help="Standard deviation of the Gaussian smoothing, s of simulated time."),
    ] = 0.04,
    hold: Annotated[float, typer.Option(min=0, help="How long to hold the last command, s.")] = 1.0,
    rate: Annotated[
        float,
        typer.Option(min=10, max=1000, help="Samples per second, rounded to 1000/n, n whole."),
    ] = 100.0,
    arm: Annotated[
        str | None,
        typer.Option(
            metavar="'X Y TURN'",
            help="Arm's base in the world: x and y in m, turn (yaw) in degrees; hands other than "
            "adroit and dmanus have no default.",
            callback=_numbers(3, "x y turn"),
        ),
    ] = None,
    table_height: Annotated[
        float, typer.Option(metavar="M", help="Table top above the arm's base, m.")
    ] = 0.0,
    mount: Annotated[
        str | None,
        typer.Option(
            metavar="'X Y Z R P Y'",
            help="Hand's mount body in the flange's frame: x, y, z in m, then roll, pitch, yaw in "
            "degrees; hands other than adroit and dmanus have no default.",
            callback=_numbers(6, "x y z roll pitch yaw"),
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Write the file even if the arm cannot play it.")
    ] = False,
    seed: Annotated[
        int | None,
        typer.Option(
            min=0, help="Seed of action noise and task randomisation; by default the run's."
        ),
    ] = None,
    offline: Offline = False,
) -> None:
    """Convert an episode of a trained policy into commands for arm and hand.

    The six base joints of the hand become the seven joints of a Franka Panda.
    """
    from pgdm.deploy.names import check_base, check_suffix

    check_suffix(out)
    check_base(base)
    with loading():
        from pgdm.cli.deploy.export import ExportRequest, Place, run_export
        from pgdm.deploy.convert import ConvertCfg

    cfg = ConvertCfg(base, smooth, hold, rate, speed)
    place = Place(_floats(arm), table_height, _floats(mount))
    request = ExportRequest(run, out, episodes, sampled, best, force, seed, offline)
    raise typer.Exit(run_export(request, cfg, place))


@app.command("check")
def check_playback(file: _File) -> None:
    """Check that a playback file is well-formed and respects the arm's limits."""
    with loading():
        from pgdm.cli.deploy.check import run_check

    raise typer.Exit(run_check(file))


@app.command("simulate")
def simulate_playback(
    file: _File,
    boxes: Annotated[
        int,
        typer.Option(
            min=1, help="Random objects to try; without effect unless the task is randomised."
        ),
    ] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random objects.")] = 0,
    video: Video = None,
    offline: Offline = False,
) -> None:
    """Play a file open-loop on arm and hand in simulation, and print how many objects are held.

    Arm and hand follow the commands with joint controllers; the policy corrects nothing. An object
    is held if it ends more than 2 cm above its start, and rises at least half as far as in the
    exported episode.
    """
    with loading():
        from pgdm.cli.deploy.simulate import SimulateRequest, run_simulate

    raise typer.Exit(run_simulate(SimulateRequest(file, boxes, seed, video, offline)))


@app.command("study")
def study_playbacks(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder of runs.", callback=existing)
    ],
    task: Annotated[str, typer.Option(help="Task whose runs are played.")] = "dmanus-sim2real",
    speed: Annotated[float, typer.Option(help="Fraction of the simulation's speed.")] = 0.6,
    boxes: Annotated[
        int,
        typer.Option(
            min=1, help="Random objects for each run; without effect unless the task is randomised."
        ),
    ] = 100,
    offline: Offline = False,
) -> None:
    """Export and simulate all runs of a task, in place of the paper's real-world experiment.

    A playback that the arm can play is written to its run's folder as playback.npz; the results of
    all runs are written to playbacks.json in DIR.
    """
    with loading():
        from pgdm.cli.deploy.study import run_study

    raise typer.Exit(run_study(folder, task, speed, boxes, offline))


@app.command("play")
def play_playback(
    file: _File,
    robot: Annotated[
        str | None, typer.Option(metavar="HOST", help="Address of the arm's control unit.")
    ] = None,
    move: Annotated[
        bool, typer.Option("--move", help="Really move the arm; without it this is a dry run.")
    ] = False,
    no_realtime: Annotated[
        bool, typer.Option("--no-realtime", help="Allow a kernel that is not real-time.")
    ] = False,
) -> None:
    """Play a file on a Franka arm. Without --move nothing moves.

    The arm first moves slowly to the start. Ctrl-C brings it to rest at any time. The hand is not
    moved.
    """
    if move and robot is None:
        raise ConfigError("--move needs --robot HOST")
    with loading():
        from pgdm.cli.deploy.play import run_play

    raise typer.Exit(run_play(file, robot, move, not no_realtime))
