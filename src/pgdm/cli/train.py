"""One run, as a person watches it."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from rich.console import Console

from pgdm.cli.errors import report
from pgdm.cli.progress import ProgressView
from pgdm.cli.summary import summary_table
from pgdm.cli.terms import RECORDED_AS, setting_line, term_line, term_table
from pgdm.config.schema import ExperimentCfg
from pgdm.experiment import RunResult, run_experiment
from pgdm.stop import StopRequest

_PROGRESS = Console(stderr=True)


def notify(text: str) -> None:
    """Tell what takes time, or differs from what was asked."""
    _PROGRESS.print(text, markup=False, highlight=False, soft_wrap=True)


def show(cfg: ExperimentCfg, notes: Sequence[str]) -> None:
    """Print what a run would be made of and what is to be said of it, and start nothing."""
    print(setting_line(cfg))
    Console().print(term_table(cfg))
    print(RECORDED_AS)
    for note in notes:
        print(f"note:   {note}")
    print(f"run:    {cfg.run_dir} (nothing was started)")


def train(cfg: ExperimentCfg, patient: bool = False) -> int:
    """Do a run, or go on with it, and return the exit code.

    Progress goes to stderr, the result to stdout.

    Args:
        cfg: the run.
        patient: whether a second signal leaves it to save in peace.

    Raises:
        PgdmError: if the run fails.
    """
    view = ProgressView(cfg.task.id, _PROGRESS)
    notify(setting_line(cfg))
    notify(term_line(cfg))
    with StopRequest(patient) as stop:
        try:
            result = run_experiment(cfg, (view,), stop, notify)
        except KeyboardInterrupt as error:
            report(error, debug=False)
            return stop.exit_code
    if result.status == "interrupted":
        print(
            f"stopped and saved at {result.frames:,} of {cfg.total_frames:,} frames in "
            f"{result.run_dir}; the same command goes on",
            file=sys.stderr,
        )
        return stop.exit_code
    _show(cfg, result)
    return 0


def _show(cfg: ExperimentCfg, result: RunResult) -> None:
    if result.frames < cfg.total_frames:
        notify(
            f"time_limit_min={cfg.time_limit_min:g} was reached at {result.frames:,} of "
            f"{cfg.total_frames:,} frames; this is what was learned by then"
        )
    console = Console()
    console.print(summary_table(cfg, result))
    # Not through rich: a path must stay whole on its line.
    print(f"run:    {result.run_dir}")
    if result.video is not None:
        print(f"video:  {result.video}")
