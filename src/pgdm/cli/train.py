"""Start or resume a single run, and print its progress and result."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

from pgdm.cli.console.errors import report
from pgdm.cli.console.progress import ProgressView
from pgdm.cli.console.screen import SCREEN, console, notify
from pgdm.cli.console.summary import summary_table
from pgdm.cli.terms import RECORDED_AS, setting_line, term_line, term_table
from pgdm.config.saved import load_config
from pgdm.config.schema import ExperimentCfg, check_device
from pgdm.experiment import RunResult, run_experiment
from pgdm.runs.folder import folder_of
from pgdm.stop import StopRequest


def show(cfg: ExperimentCfg, notes: Sequence[str]) -> None:
    """Print the settings and terms of a run, with notes, and start nothing."""
    print(setting_line(cfg))
    console().print(term_table(cfg))
    print(RECORDED_AS)
    for note in notes:
        print(f"note:   {note}")
    print(f"run:    {cfg.run_dir} (nothing was started)")


def train(cfg: ExperimentCfg, patient: bool = False) -> int:
    """Start or resume a run, and return the exit code.

    Progress goes to stderr, the result to stdout.

    Args:
        cfg: settings of the run.
        patient: whether to ignore stop signals after the first.

    Raises:
        PgdmError: if the run fails.
    """
    view = ProgressView(cfg.task.id, SCREEN)
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
            f"{result.run_dir}; the same command resumes the run, as pgdm resume does",
            file=sys.stderr,
        )
        return stop.exit_code
    _show(cfg, result)
    return 0


def resume_run(
    run: Path,
    total_frames: int | None,
    time_limit_min: float | None,
    uri: str | None,
    offline: bool,
) -> int:
    """Resume a run with the settings in its folder, and return the exit code.

    Args:
        run: the run's folder, or a file in it.
        total_frames: new length; None: as before.
        time_limit_min: new limit, min; None: as before, 0: no limit.
        uri: MLflow store to mirror the run to; None: the one in ``MLFLOW_TRACKING_URI``, else
            the one next to the run. The store named in the folder's settings is not used, since
            somebody else may have made the folder.
        offline: whether missing assets are an error instead of being fetched.

    Raises:
        PgdmError: if the folder holds no run, or the run fails.
    """
    from pgdm.tracking.mlflow import is_own

    cfg = load_config(folder_of(run))
    named = cfg.tracking.uri
    if named and not uri and not is_own(named, Path(cfg.run_dir)):
        notify(
            f"the run's settings name the MLflow store {named}; add --uri {named} to mirror the "
            "run there"
        )
    limit = cfg.time_limit_min if time_limit_min is None else time_limit_min or None
    cfg = dataclasses.replace(
        cfg,
        total_frames=cfg.total_frames if total_frames is None else total_frames,
        time_limit_min=limit,
        resume="must",
        offline=offline or cfg.offline,
        tracking=dataclasses.replace(cfg.tracking, uri=uri),
    )
    cfg.validate()
    check_device(cfg.device)
    return train(cfg)


def _show(cfg: ExperimentCfg, result: RunResult) -> None:
    if result.frames < cfg.total_frames:
        notify(
            f"time_limit_min={cfg.time_limit_min:g} was reached at {result.frames:,} of "
            f"{cfg.total_frames:,} frames; the result is that of the training so far"
        )
    screen = console()
    screen.print(summary_table(cfg, result))
    # Not printed with rich, which would wrap a long path.
    print(f"run:    {result.run_dir}")
    if result.video is not None:
        print(f"video:  {result.video}")
