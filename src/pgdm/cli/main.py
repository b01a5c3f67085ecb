"""``pgdm``: all commands except starting a training run."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import typer

from pgdm.cli import assets, dashboard, runs, sweep, zoo
from pgdm.cli.author import commands as author
from pgdm.cli.console.errors import USAGE, guarded, report
from pgdm.cli.console.screen import loading
from pgdm.cli.deploy import commands as deploy
from pgdm.cli.options import (
    EXPORTS,
    Best,
    Hand,
    Offline,
    Policy,
    Run,
    Start,
    Task,
    Video,
    ZipSettings,
    ZipStatistics,
    ZipTask,
    check_image,
    known_runs,
    one_of,
)
from pgdm.cli.pregrasp import commands as pregrasp
from pgdm.errors import ConfigError

# click's ClickException, or the copy of it that newer versions of typer contain.
_WRONG_USAGE: type[Exception] = typer.BadParameter.mro()[2]

app = typer.Typer(
    name="pgdm",
    help="Pre-Grasp informed Dexterous Manipulation. To train: pgdm-run --help.",
    no_args_is_help=True,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
)
app.add_typer(assets.app, name="assets")
app.add_typer(pregrasp.app, name="pregrasp")
app.add_typer(author.app, name="author")
app.add_typer(deploy.app, name="deploy")
app.add_typer(runs.app, name="runs")
app.add_typer(sweep.app, name="sweep")
app.add_typer(zoo.app, name="zoo")
app.command("dashboard")(dashboard.dashboard)


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pgdm`` and return its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    arguments = [argument for argument in arguments if argument != "--debug"]
    return guarded(lambda: _main(arguments, debug), debug)


def _main(arguments: list[str], debug: bool) -> int:
    from pgdm.cli.console.logging_setup import set_up_logging

    set_up_logging(debug)
    command = typer.main.get_command(app)
    try:
        code = command.main(arguments, prog_name="pgdm", standalone_mode=False)
    except _WRONG_USAGE as error:
        return _report_usage(error, debug)
    except typer.Abort:
        raise KeyboardInterrupt from None
    return code if isinstance(code, int) else 0


def _report_usage(error: Exception, debug: bool) -> int:
    text = getattr(error, "format_message", error.__str__)()
    if type(error).__name__ == "NoArgsIsHelpError":
        print(text)  # the help
        return USAGE
    context = getattr(error, "ctx", None)
    command = context.command_path if context is not None else "pgdm"
    return report(ConfigError(f"{text.rstrip('.')}; see {command} --help"), debug)


def _print_version(asked: bool) -> None:
    if asked:
        print(f"pgdm {version('pgdm')}")
        raise typer.Exit


@app.callback()
def _options(
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of an error, and log more.")
    ] = False,
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version.", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    del debug, version  # handled in main and in _print_version


@app.command("eval")
def evaluate(
    policy: Policy,
    episodes: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of sampled episodes, and of deterministic episodes if the task is "
            "randomised (else 1); by default as in the run.",
        ),
    ] = None,
    video: Annotated[
        bool, typer.Option("--video", help="Also make a video of one deterministic episode.")
    ] = False,
    deterministic: Annotated[
        bool, typer.Option("--deterministic", help="Evaluate only the mean action, without noise.")
    ] = False,
    best: Best = False,
    seed: Annotated[
        int | None,
        typer.Option(
            min=0, help="Seed of action noise and task randomisation; by default the run's."
        ),
    ] = None,
    task: ZipTask = None,
    settings: ZipSettings = None,
    vecnormalize: ZipStatistics = None,
    offline: Offline = False,
) -> None:
    """Evaluate a trained policy.

    If results are stored with the policy, as in the zoo, and --episodes, --seed and --deterministic
    are not given, the exit code is 1 unless the stored numbers are reproduced bit-identically. The
    video is written to the run's folder, or to the current folder if the policy is not a run's.
    """
    with loading():
        from pgdm.cli.evaluate import EvalRequest, evaluate_policy
        from pgdm.cli.policies import PolicyRequest

    which = PolicyRequest(policy, best, task, tuple(settings or ()), vecnormalize)
    request = EvalRequest(which, episodes, video, deterministic, seed, offline)
    raise typer.Exit(evaluate_policy(request))


@app.command("export")
def export_policy(
    policy: Policy,
    form: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="FORMAT",
            help="torchscript, onnx, safetensors, or minari (a dataset of the policy's episodes).",
            callback=one_of("--format", lambda: EXPORTS),
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="File to write [TASK plus the format's ending]; minari: the folder of datasets "
            "[datasets].",
        ),
    ] = None,
    scene: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Also write the scene, for plain MuJoCo, to this new or empty folder.",
        ),
    ] = None,
    episodes: Annotated[
        int | None, typer.Option(min=1, help="Only minari: number of episodes [25].")
    ] = None,
    deterministic: Annotated[
        bool, typer.Option("--deterministic", help="Only minari: use the mean action, no noise.")
    ] = False,
    seed: Annotated[
        int | None,
        typer.Option(min=0, help="Only minari: seed of noise and task randomisation [the run's]."),
    ] = None,
    best: Best = False,
    task: ZipTask = None,
    settings: ZipSettings = None,
    vecnormalize: ZipStatistics = None,
    offline: Offline = False,
) -> None:
    """Write a policy for use without pgdm, or episodes of it as a dataset."""
    if form != "minari" and (episodes is not None or deterministic or seed is not None):
        raise ConfigError("--episodes, --deterministic and --seed are for --format minari")
    with loading():
        from pgdm.cli.export import ExportRequest, export
        from pgdm.cli.policies import PolicyRequest

    which = PolicyRequest(policy, best, task, tuple(settings or ()), vecnormalize)
    request = ExportRequest(which, form, out, scene, episodes or 25, deterministic, seed, offline)
    raise typer.Exit(export(request))


@app.command()
def resume(
    run: Run,
    total_frames: Annotated[
        int | None,
        typer.Option(metavar="N", help="New total length, frames; it may only grow [unchanged]."),
    ] = None,
    time_limit_min: Annotated[
        float | None,
        typer.Option(
            min=0,
            metavar="MIN",
            help="Time limit over all attempts, minutes; 0: no limit [unchanged].",
        ),
    ] = None,
    uri: Annotated[
        str | None,
        typer.Option(
            help="MLflow store to mirror to, such as http://host:5000 [MLFLOW_TRACKING_URI, else "
            "mlflow.db in the folder of runs]."
        ),
    ] = None,
    offline: Offline = False,
) -> None:
    """Resume a stopped run with the settings in its folder."""
    with loading():
        from pgdm.cli.train import resume_run

    raise typer.Exit(resume_run(run, total_frames, time_limit_min, uri, offline))


@app.command()
def compare(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN...", help="Folders of two or more runs.", callback=known_runs),
    ],
    image: Annotated[Path, typer.Option(help="PNG for the curves.", callback=check_image)] = Path(
        "comparison.png"
    ),
) -> None:
    """Compare runs: settings that differ, results, curves."""
    with loading():
        from pgdm.cli.compare import compare_runs

    compare_runs(runs, image)


@app.command()
def doctor() -> None:
    """Check this machine: versions, memory, disk, GPU, rendering, library, MLflow, Slurm."""
    with loading():
        from pgdm.cli.doctor import diagnose

    raise typer.Exit(diagnose())


@app.command()
def view(
    task: Task,
    video: Video = None,
    pregrasp: Start = None,
    hand: Hand = None,
    expert: Annotated[
        bool,
        typer.Option(
            "--expert", help="Play the expert's hand motion, on Adroit; spheres mark contacts."
        ),
    ] = False,
    reach: Annotated[
        bool,
        typer.Option("--reach", help="Play the reach from the reset pose to the pre-grasp."),
    ] = False,
    wrist: Annotated[
        bool, typer.Option("--wrist", help="Play the wrist plan: the hand alone, no object.")
    ] = False,
    ablations: Annotated[
        bool, typer.Option("--ablations", help="Show the start under each ablation, no motion.")
    ] = False,
    image: Annotated[
        Path | None,
        typer.Option(help="PNG for the pictures of --ablations.", callback=check_image),
    ] = None,
    offline: Offline = False,
) -> None:
    """Show a task's motion, reach, wrist plan or expert hand.

    By default the object moves along its exemplar motion, with the hand at its pre-grasp.
    """
    if (ablations or image is not None) and (video is not None or expert or not ablations):
        raise ConfigError(
            "--ablations and --image FILE go together, without --video, --reach, --wrist and "
            "--expert"
        )
    if reach + wrist + ablations + expert > 1:
        raise ConfigError("--reach, --wrist, --ablations and --expert exclude each other")
    if expert and (pregrasp is not None or hand is not None):
        raise ConfigError(
            "--expert shows the expert's hand motion: leave --pregrasp and --hand out"
        )
    with loading():
        from pgdm.cli.ablations import view_ablations
        from pgdm.cli.view import View, view_expert, view_reach, view_task, view_wrist

    what = View(task, hand, video, pregrasp or "planned", offline)
    if ablations:
        view_ablations(what, image)
        return
    play = view_wrist if wrist else view_reach if reach else view_expert if expert else view_task
    play(what)


@app.command("report")
def write_report(
    places: Annotated[
        list[str],
        typer.Argument(metavar="DIR...", help="Folders of runs, or names of MLflow experiments."),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder to write to [report/ in the first DIR, or in runs/ if the first DIR is an "
            "MLflow experiment].",
            metavar="FOLDER",
        ),
    ] = None,
    uri: Annotated[
        str | None,
        typer.Option(
            help="MLflow store of the experiments [MLFLOW_TRACKING_URI, else runs/mlflow.db]."
        ),
    ] = None,
) -> None:
    """Compare runs with the paper on one page.

    Its tables and plots are also written as files.
    """
    from pgdm.cli.report import make_report

    make_report(places, out, uri)


@app.command()
def tasks(
    tcdm30: Annotated[
        bool, typer.Option("--tcdm30", help="List only the 30 tasks of the paper's comparisons.")
    ] = False,
) -> None:
    """List the tasks."""
    from pgdm.cli.tasks import print_tasks

    print_tasks(tcdm30)
