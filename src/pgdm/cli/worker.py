"""``python -m pgdm.cli.worker``: the process of one attempt at a job of a sweep."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pgdm.cli.console.errors import guarded

if TYPE_CHECKING:
    from pgdm.config.schema import ExperimentCfg

COMMAND = (sys.executable, "-m", "pgdm.cli.worker")
"""The command that starts a worker; the arguments of ``main`` are appended."""


def main(argv: Sequence[str] | None = None) -> int:
    """Work on a job, and return the exit code of its run.

    Args:
        argv: folder of the sweep, key of the job, number of the attempt, number of threads (used if
            the job's settings fix none) and, under Slurm, the ID of the Slurm job.
    """
    folder, key, number, threads, *slurm = sys.argv[1:] if argv is None else argv
    slurm_id = slurm[0] if slurm else None
    return guarded(lambda: _work(Path(folder), key, int(number), int(threads), slurm_id), False)


def _work(folder: Path, key: str, number: int, threads: int, slurm_id: str | None) -> int:
    from pgdm.sweep.attempt import attempt, stop_with_parent

    if slurm_id is None:
        stop_with_parent()
    from pgdm.cli.console.logging_setup import set_up_logging

    set_up_logging(debug=False)
    return attempt(folder, key, number, threads, slurm_id, _train)


def _train(cfg: ExperimentCfg, patient: bool) -> int:
    from pgdm.cli.train import train

    return train(cfg, patient)


if __name__ == "__main__":
    sys.exit(main())
