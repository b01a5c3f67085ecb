"""``python -m pgdm.cli.worker``: one attempt at one job of a sweep, as a process of its own."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pgdm.cli.console.errors import guarded

if TYPE_CHECKING:
    from pgdm.config.schema import ExperimentCfg

COMMAND = (sys.executable, "-m", "pgdm.cli.worker")
"""How it is started; the arguments of ``main`` follow."""


def main(argv: Sequence[str] | None = None) -> int:
    """Work on a job, and return the exit code of its run.

    Args:
        argv: folder of the sweep, key of the job, number of the attempt, threads for a job that
            does not set them itself, and Slurm's ID of the job that this is, if it is one.
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
