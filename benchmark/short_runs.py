"""Short trainings behind a stored result: ordinary runs, so that stopped ones go on."""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pgdm.tracking.run_folder import CONFIG, RESULT, RunFolder, read_json
from pgdm.tracking.run_log import FILE_NAME, RunLog, metrics_of

AT_A_TIME = 2
TRAIN_POINTS = 40
TRAINED = ("train/return", "train/success", "train/lifted")


@dataclass(frozen=True)
class Job:
    """One run."""

    task: str
    setting: str
    overrides: tuple[str, ...]
    seed: int | None = None
    """Where there are several."""

    @property
    def name(self) -> str:
        """Name of its folder and of its stored result."""
        name = f"{self.task}-{self.setting}"
        return name if self.seed is None else f"{name}-s{self.seed}"


def train(folder: Path, job: Job) -> int:
    """Train one run to its end, or go on with it; return the exit code."""
    command = [str(Path(sys.executable).with_name("pgdm-run")), f"task={job.task}", *job.overrides]
    command += [f"run_dir={folder / job.name}", "num_threads=1", "tracking=none"]
    command += [] if job.seed is None else [f"seed={job.seed}"]
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / f"{job.name}.log", "a") as log:
        return subprocess.run(command, stdout=log, stderr=log).returncode


def train_all(folder: Path, jobs: Sequence[Job]) -> None:
    """Train all that is missing, a few at a time, one thread each.

    Raises:
        SystemExit: if one failed, after all have had their turn.
    """
    with ThreadPoolExecutor(AT_A_TIME) as pool:
        codes = list(pool.map(lambda job: train(folder, job), jobs))
    failed = [job.name for job, code in zip(jobs, codes, strict=True) if code]
    if failed:
        raise SystemExit(f"failed: {', '.join(failed)}; see the logs in {folder}")


def finished(run: Path) -> dict[str, Any] | None:
    """Return the result of a run without its film, or None if it has not finished."""
    result = read_json(run / "result.json")
    if result.get("status") != "finished":
        return None
    return {key: value for key, value in result.items() if key != "video"}


def curves(run: Path, kind: str, names: Sequence[str]) -> dict[str, list[float | None]]:
    """Return metrics of a run over its records of a kind, rounded, beside their ``frames``.

    Args:
        run: its folder.
        kind: ``train`` or ``eval``.
        names: metrics; None, which JSON has and NaN is not, where one was not recorded.
    """
    lines = [line for line in RunLog(run / "metrics.jsonl").read() if line["kind"] == kind]
    found: dict[str, list[float | None]] = {
        "frames": [int(line["frames"]) for line in lines],
        "minutes": [round(float(line["time_s"]) / 60, 2) for line in lines],
    }
    for name in names:
        values = [float(line.get(name, math.nan)) for line in lines]
        found[name] = [None if math.isnan(v) else round(v, 5) for v in values]
    return found


def store(found: RunFolder, target: Path, results: Path) -> None:
    """Keep what a report needs of a run, its training curve thinned, in a folder of results."""
    target.mkdir(parents=True, exist_ok=True)
    where = f"run_dir: {target.relative_to(results)}"  # not a path of the machine it ran on
    config = (found.path / CONFIG).read_text(encoding="utf-8")
    config = re.sub(r"^run_dir: .*$", where, config, flags=re.MULTILINE)
    (target / CONFIG).write_text(config, encoding="utf-8")
    (target / RESULT).write_text(json.dumps({**found.result, "video": None}, indent=1) + "\n")
    (target / FILE_NAME).unlink(missing_ok=True)
    log = RunLog(target / FILE_NAME)
    for record in found.log.thinned(TRAIN_POINTS):
        metrics, kind = metrics_of(record), str(record["kind"])
        log.append(
            {k: v for k, v in metrics.items() if kind == "eval" or k in TRAINED},
            frames=int(record["frames"]),
            iteration=int(record["iteration"]),
            time_s=float(record["time_s"]),
            kind=kind,
        )
