"""One attempt at a job of a sweep, as run by the worker process."""

from __future__ import annotations

import ctypes
import dataclasses
import logging
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from pgdm.errors import SweepError
from pgdm.runs.folder import RunFolder
from pgdm.stop import STOPPED
from pgdm.sweep.ledger import Ledger
from pgdm.sweep.processes import Process
from pgdm.sweep.queue import requeue
from pgdm.sweep.status import run_ending

if TYPE_CHECKING:  # the schema loads the simulator and torch
    from pgdm.config.schema import ExperimentCfg

_PR_SET_PDEATHSIG = 1  # Linux, sys/prctl.h
_HANDOVER_S = 60.0
"""How long an earlier process of the same job may take to save and exit."""

_log = logging.getLogger(__name__)

Train = Callable[["ExperimentCfg", bool], int]
"""Trains with the given settings, and returns the exit code. The flag is True if stop signals after
the first are to be ignored."""


def stop_with_parent() -> None:
    """Have Linux stop this process with SIGTERM, so that it saves, when its parent dies."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def attempt(
    folder: Path, key: str, number: int, threads: int, slurm_id: str | None, train: Train
) -> int:
    """Train the run of a job, and return its exit code.

    Args:
        folder: folder of the sweep.
        key: key of the job.
        number: number of the attempt.
        threads: number of threads if the job's settings leave ``num_threads`` at 0.
        slurm_id: ID of the Slurm job in which this process runs; None outside Slurm.
        train: trains with the given settings.

    Raises:
        PgdmError: if the ledger has closed the attempt before it began, the sweep's files cannot
            be used, or the run fails.
    """
    if not Ledger(folder).register(key, number, Process.of(os.getpid()), slurm_id):
        raise SweepError("this attempt was given up before it began: the ledger has it as ended")
    from pgdm.sweep.plan import read_job

    job = read_job(folder, key)
    threads = job.cfg.num_threads or threads
    cfg = dataclasses.replace(job.cfg, num_threads=threads, resume="auto")
    return train(cfg, False) if slurm_id is None else _train_in_slurm(cfg, slurm_id, train)


def _train_in_slurm(cfg: ExperimentCfg, slurm_id: str, train: Train) -> int:
    """Train; if Slurm stops the run after some progress, have Slurm requeue the job."""
    folder = Path(cfg.run_dir)
    limit = time.monotonic() + _HANDOVER_S
    while RunFolder(folder).busy and time.monotonic() < limit:  # an earlier process is saving
        time.sleep(1.0)
    before = run_ending(folder, cfg.total_frames).frames or 0
    code = train(cfg, True)
    if code in STOPPED and (run_ending(folder, cfg.total_frames).frames or 0) > before:
        try:
            requeue(slurm_id)
        except SweepError as error:  # where users may not requeue, the driver starts a new attempt
            _log.warning("cannot requeue this job: %s", error)
    return code
