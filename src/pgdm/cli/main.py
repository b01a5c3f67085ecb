"""``pgdm``: everything besides training."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import typer

from pgdm.cli import assets, author, dashboard, pregrasp, runs, sweep
from pgdm.cli.errors import USAGE, check_environment, guarded, report
from pgdm.errors import ConfigError

# click's ClickException, which typer brings as a copy of its own in newer versions.
_WRONG_USAGE: type[Exception] = typer.BadParameter.mro()[2]

app = typer.Typer(
    name="pgdm",
    help="Pre-Grasp informed Dexterous Manipulation. To train: pgdm-run --help.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
app.add_typer(assets.app, name="assets")
app.add_typer(pregrasp.app, name="pregrasp")
app.add_typer(author.app, name="author")
app.add_typer(runs.app, name="runs")
app.add_typer(sweep.app, name="sweep")
app.command("dashboard")(dashboard.dashboard)


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``pgdm`` and return its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    arguments = [argument for argument in arguments if argument != "--debug"]
    return guarded(lambda: _main(arguments, debug), debug)


def _main(arguments: list[str], debug: bool) -> int:
    from pgdm.cli.run import set_up_logging

    check_environment()
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
    form = getattr(error, "format_message", error.__str__)
    if type(error).__name__ == "NoArgsIsHelpError":
        print(form())  # the help
        return USAGE
    text = form()
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
    del debug, version  # read before, and by its callback


@app.command("eval")
def evaluate(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="A run's folder, or a checkpoint file inside one.")
    ],
    episodes: Annotated[
        int | None, typer.Option(min=1, help="Episodes; by default as many as in the run.")
    ] = None,
    video: Annotated[bool, typer.Option("--video", help="Film the policy too.")] = False,
    deterministic: Annotated[
        bool, typer.Option("--deterministic", help="Only the mean action, without noise.")
    ] = False,
    best: Annotated[
        bool, typer.Option("--best", help="Of a run: its best checkpoint, not its last.")
    ] = False,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Of the noise; by default the run's.")
    ] = None,
    offline: Annotated[bool, typer.Option("--offline", help="Never use the network.")] = False,
) -> None:
    """Measure a trained policy."""
    from pgdm.cli.evaluate import EvalRequest, evaluate_policy

    request = EvalRequest(run, episodes, video, deterministic, best, seed, offline)
    raise typer.Exit(evaluate_policy(request))


@app.command()
def view(
    task: Annotated[
        str, typer.Argument(metavar="TASK", help="Such as hammer-use1; pgdm tasks lists them.")
    ],
    video: Annotated[
        Path | None, typer.Option(help="Write an MP4 to this file instead of opening a window.")
    ] = None,
    pregrasp: Annotated[
        str | None, typer.Option(help="Start that shows the hand, as in pgdm-run [planned].")
    ] = None,
    hand: Annotated[
        str | None, typer.Option(help="Another hand than the task's: adroit, dhand or dmanus.")
    ] = None,
    expert: Annotated[
        bool,
        typer.Option("--expert", help="Move the hand as a person's moved; spheres show contacts."),
    ] = False,
    reach: Annotated[
        bool, typer.Option("--reach", help="Play the plan that brings the hand to its pre-grasp.")
    ] = False,
    wrist: Annotated[
        bool, typer.Option("--wrist", help="Play the planned wrist: the hand alone, no object.")
    ] = False,
    ablations: Annotated[
        bool, typer.Option("--ablations", help="Show the start under each ablation instead.")
    ] = False,
    image: Annotated[
        Path | None, typer.Option(help="With --ablations: write the pictures to this PNG.")
    ] = None,
    offline: Annotated[bool, typer.Option("--offline", help="Never use the network.")] = False,
) -> None:
    """Replay a task's exemplar motion with the hand at its pre-grasp, or as a person moved it."""
    from pgdm.cli.ablations import view_ablations
    from pgdm.cli.view import view_expert, view_reach, view_task, view_wrist

    if (ablations or image is not None) and (video is not None or expert or not ablations):
        raise ConfigError(
            "--ablations and --image FILE go together, without --video, --reach and --expert"
        )
    if reach + wrist + ablations + expert > 1:
        raise ConfigError("--reach, --wrist, --ablations and --expert exclude each other")
    if expert and (pregrasp is not None or hand is not None):
        raise ConfigError("--expert shows the hand as it moved: leave --pregrasp and --hand out")
    start = pregrasp or "planned"
    if ablations:
        return view_ablations(task, hand, image, start, offline)
    if wrist:
        return view_wrist(task, hand, video, start, offline)
    if reach:
        return view_reach(task, hand, video, start, offline)
    if expert:
        return view_expert(task, video, offline)
    return view_task(task, hand, video, start, offline)


@app.command("report")
def write_report(
    places: Annotated[
        list[str],
        typer.Argument(metavar="DIR...", help="Folders of runs, or an MLflow experiment's name."),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder to write into [DIR/report].", metavar="FOLDER")
    ] = None,
    uri: Annotated[
        str | None, typer.Option(help="MLflow store with the experiment [runs/mlflow.db].")
    ] = None,
) -> None:
    """Set runs beside the paper: one page, tables and pictures."""
    from pgdm.cli.report import make_report

    make_report(places, out, uri)


@app.command()
def tasks(
    tcdm30: Annotated[
        bool, typer.Option("--tcdm30", help="Only the 30 tasks of the paper's comparisons.")
    ] = False,
) -> None:
    """List the tasks."""
    from pgdm.cli.tasks import print_tasks

    print_tasks(tcdm30)
