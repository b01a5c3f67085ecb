"""Train, store and report the short runs of the benchmarks; each is an ordinary `pgdm-run`."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pgdm.runs.files import CONFIG, LOG, RESULT, read_json, write_json
from pgdm.runs.folder import RunFolder
from pgdm.runs.log import RunLog, metrics_of

AT_A_TIME = 2
TRAIN_POINTS = 40
TRAINED = ("train/return", "train/shaping", "train/success", "train/lifted")


@dataclass(frozen=True)
class Job:
    """One run."""

    task: str
    setting: str
    overrides: tuple[str, ...]
    seed: int | None = None
    """None if the setting has a single seed."""

    @property
    def name(self) -> str:
        """Name of the run's folder and of its stored result."""
        name = f"{self.task}-{self.setting}"
        return name if self.seed is None else f"{name}-s{self.seed}"


def program(name: str) -> str:
    """Return the path of one of pgdm's commands."""
    return str(Path(sys.executable).with_name(name))


def train(folder: Path, job: Job) -> int:
    """Train one run to its end, or resume it; return the exit code."""
    command = [program("pgdm-run"), f"task={job.task}", *job.overrides]
    command += [f"run_dir={folder / job.name}", "num_threads=1", "tracking=none"]
    command += [] if job.seed is None else [f"seed={job.seed}"]
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / f"{job.name}.log", "a") as log:
        return subprocess.run(command, stdout=log, stderr=log).returncode


def train_all(folder: Path, jobs: Sequence[Job]) -> None:
    """Train jobs, a few at a time, one thread each.

    Raises:
        SystemExit: if a job failed, after all have run.
    """
    with ThreadPoolExecutor(AT_A_TIME) as pool:
        codes = list(pool.map(lambda job: train(folder, job), jobs))
    failed = [job.name for job, code in zip(jobs, codes, strict=True) if code]
    if failed:
        raise SystemExit(f"failed: {', '.join(failed)}; see the logs in {folder}")


def finished(run: Path) -> dict[str, Any] | None:
    """Return the result of a run without its video, or None if it has not finished."""
    result = read_json(run / RESULT)
    if result.get("status") != "finished":
        return None
    return {key: value for key, value in result.items() if key != "video"}


def curves(run: Path, kind: str, names: Sequence[str]) -> dict[str, list[float | None]]:
    """Return metrics of a run at each record of a kind, rounded, with ``frames`` and ``minutes``.

    Args:
        run: folder of the run.
        kind: ``train`` or ``eval``.
        names: metrics. A value that was not recorded is None, since NaN is not valid JSON.
    """
    lines = [line for line in RunLog(run / LOG).read() if line["kind"] == kind]
    found: dict[str, list[float | None]] = {
        "frames": [int(line["frames"]) for line in lines],
        "minutes": [round(float(line["time_s"]) / 60, 2) for line in lines],
    }
    for name in names:
        values = [float(line.get(name, math.nan)) for line in lines]
        found[name] = [None if math.isnan(v) else round(v, 5) for v in values]
    return found


def store(found: RunFolder, target: Path, results: Path) -> None:
    """Copy the files of a run that a report needs, with a thinned training curve, to ``target``."""
    target.mkdir(parents=True, exist_ok=True)
    where = f"run_dir: {target.relative_to(results)}"  # replaces a path on this machine
    config = (found.path / CONFIG).read_text(encoding="utf-8")
    config = re.sub(r"^run_dir: .*$", where, config, flags=re.MULTILINE)
    (target / CONFIG).write_text(config, encoding="utf-8")
    write_json(target / RESULT, {**found.result, "video": None})
    (target / LOG).unlink(missing_ok=True)
    log = RunLog(target / LOG)
    for record in found.log.thinned(TRAIN_POINTS):
        metrics, kind = metrics_of(record), str(record["kind"])
        log.append(
            {k: v for k, v in metrics.items() if kind == "eval" or k in TRAINED},
            frames=int(record["frames"]),
            iteration=int(record["iteration"]),
            time_s=float(record["time_s"]),
            kind=kind,
        )


def report(results: Path) -> int:
    """Report on the runs that are stored in a folder of results; return the exit code."""
    # From that folder: the page names the folders it was given.
    command = [program("pgdm"), "report", "runs", "--out", "report"]
    return subprocess.run(command, cwd=results).returncode
