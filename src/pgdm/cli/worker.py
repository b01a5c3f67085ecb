"""``python -m pgdm.cli.worker``: one attempt at one job of a sweep, as a process of its own."""

from __future__ import annotations

import ctypes
import dataclasses
import os
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pgdm.cli.errors import FAILED, check_environment, guarded
from pgdm.errors import SweepError

if TYPE_CHECKING:
    from pgdm.config.schema import ExperimentCfg

_PR_SET_PDEATHSIG = 1  # Linux, sys/prctl.h
_HANDOVER_S = 60.0
"""How long an earlier process of the same job may take to save and end."""


def main(argv: Sequence[str] | None = None) -> int:
    """Work on a job, and return the exit code of its run.

    Args:
        argv: folder of the sweep, key of the job, number of the attempt, threads for a job that
            does not say how many, and Slurm's name of the job that this is, if it is one.
    """
    folder, key, number, threads, *slurm = sys.argv[1:] if argv is None else argv
    slurm_id = slurm[0] if slurm else None
    place = Path(folder), key, int(number), int(threads)
    return guarded(lambda: _work(*place, slurm_id), debug=False)


def _work(folder: Path, key: str, number: int, threads: int, slurm_id: str | None) -> int:
    if slurm_id is None:
        # If the sweep's process is killed, this one saves and stops: nobody would see how it ends.
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    from pgdm.cli.run import set_up_logging
    from pgdm.sweep.ledger import Ledger
    from pgdm.sweep.processes import Process

    check_environment()
    set_up_logging(debug=False)
    if not Ledger(folder).register(key, number, Process.of(os.getpid()), slurm_id):
        print("error: this attempt was given up before it began", file=sys.stderr)
        return FAILED
    from pgdm.cli.train import train
    from pgdm.sweep.plan import read_plan

    job = next((job for job in read_plan(folder).jobs if job.key == key), None)
    if job is None:
        raise SweepError(f"the plan of {folder} has no job {key}; start the sweep's command again")
    threads = job.cfg.num_threads or threads
    cfg = dataclasses.replace(job.cfg, num_threads=threads, resume="auto")
    return train(cfg) if slurm_id is None else _train_in_slurm(cfg, slurm_id)


def _train_in_slurm(cfg: ExperimentCfg, slurm_id: str) -> int:
    """Do a run, and have Slurm start it again if it must make room but has come further."""
    from pgdm.cli.train import train
    from pgdm.stop import STOPPED
    from pgdm.sweep.queue import requeue
    from pgdm.sweep.state import stand
    from pgdm.tracking.run_folder import RunFolder

    folder = Path(cfg.run_dir)
    limit = time.monotonic() + _HANDOVER_S
    while RunFolder(folder).busy and time.monotonic() < limit:  # of a node that was given up
        time.sleep(1.0)
    before = stand(folder, cfg.total_frames).frames or 0
    code = train(cfg, patient=True)
    if code in STOPPED and (stand(folder, cfg.total_frames).frames or 0) > before:
        try:
            requeue(slurm_id)
        except SweepError as error:  # not allowed here: the sweep's own process does it
            print(f"not queued again: {error}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
