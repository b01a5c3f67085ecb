"""``python -m pgdm.cli.worker``: one attempt at one job of a sweep, as a process of its own."""

from __future__ import annotations

import ctypes
import dataclasses
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from pgdm.cli.errors import FAILED, check_environment, guarded
from pgdm.errors import SweepError

_PR_SET_PDEATHSIG = 1  # Linux, sys/prctl.h


def main(argv: Sequence[str] | None = None) -> int:
    """Work on a job, and return the exit code of its run.

    Args:
        argv: folder of the sweep, key of the job, number of the attempt, and threads for a job
            that does not say how many.
    """
    folder, key, number, threads = sys.argv[1:] if argv is None else argv
    return guarded(lambda: _work(Path(folder), key, int(number), int(threads)), debug=False)


def _work(folder: Path, key: str, number: int, threads: int) -> int:
    # If the sweep's own process is killed, this one saves and stops: nobody would see how it ends.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    from pgdm.cli.run import set_up_logging
    from pgdm.sweep.ledger import Ledger
    from pgdm.sweep.processes import Process

    check_environment()
    set_up_logging(debug=False)
    if not Ledger(folder).register(key, number, Process.of(os.getpid())):
        print("error: this attempt was given up before it began", file=sys.stderr)
        return FAILED
    from pgdm.cli.train import train
    from pgdm.sweep.plan import read_plan

    job = next((job for job in read_plan(folder).jobs if job.key == key), None)
    if job is None:
        raise SweepError(f"the plan of {folder} has no job {key}; start the sweep's command again")
    threads = job.cfg.num_threads or threads
    return train(dataclasses.replace(job.cfg, num_threads=threads, resume="auto"))


if __name__ == "__main__":
    sys.exit(main())
