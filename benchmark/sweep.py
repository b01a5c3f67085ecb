"""Measure the overhead of a sweep: planning, ledger, MLflow, and `pgdm sweep status` on 150 jobs.

    python benchmark/sweep.py [--task hammer-use1] [--write]

The plan is that of the study validate_tcdm50, timed as a whole process. The sweep whose status is
queried is synthetic, with two attempts at each job and full-size records. Values are medians of
five. Shares are shares of processor time: the driver's of one core, MLflow's of a run of a few
iterations on one thread, where the thread that talks to MLflow is timed separately.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import io
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from datetime import date
from itertools import pairwise
from pathlib import Path
from typing import Any

from pgdm.cli import main as pgdm
from pgdm.config.compose import compose
from pgdm.experiment import run_experiment
from pgdm.rl.callback import Callback, Progress
from pgdm.runs.log import RunLog
from pgdm.runs.provenance import versions
from pgdm.sweep.ledger import Ending, Ledger
from pgdm.sweep.plan import Job, Plan, job_key, write_plan
from pgdm.sweep.processes import Process
from pgdm.sweep.status import PARENT, rows
from pgdm.tracking.live import MlflowTracker

RESULT = Path(__file__).parent / "results" / "sweep.json"
JOBS, ROUNDS = 150, 5
ITERATIONS = 6
FRAMES = 1_000_000  # of the run over which MLflow's one-time cost is spread
LINES = 300  # records at the end of a running job's log; more than are ever read
METRICS = {f"eval_{kind}/metric_{i}": 0.123456789 for kind in ("sampled", "it") for i in range(30)}


def synthetic(folder: Path, running: int) -> None:
    """Write a synthetic sweep of ``JOBS`` jobs, the last ones running in this process."""
    cfg, me = compose(["task=hammer-use1"]), Process.of(os.getpid())
    jobs = []
    for seed in range(JOBS):
        mine = dataclasses.replace(cfg, seed=seed, run_dir=str(folder / "runs" / f"s{seed}"))
        jobs.append(Job(job_key(mine), f"task=hammer-use1 seed={seed}", (f"seed={seed}",), mine))
    write_plan(plan := Plan("made-up", folder, tuple(jobs), "none"))
    ledger = Ledger(folder)
    ledger.add(plan)
    ledger.set_fact(PARENT, [me.host, me.pid, me.born])
    for place, job in enumerate(jobs):
        first = ledger.begin(job.key, me)
        ledger.end(job.key, first, Ending("interrupted", 143, 1000, METRICS, "stopped"))
        number = ledger.begin(job.key, me)
        if place < JOBS - running:
            ledger.end(job.key, number, Ending("finished", 0, cfg.total_frames, METRICS, None))
            ledger.set_states({job.key: "finished"})
            continue
        run_dir = Path(job.cfg.run_dir)
        run_dir.mkdir(parents=True)
        log = RunLog(run_dir / "metrics.jsonl")
        for i in range(LINES):
            log.append(METRICS, frames=4096 * i, iteration=i, time_s=2.0 * i, kind="train")


def median_s(
    work: Callable[[], object], times: int = 1, clock: Callable[[], float] = time.perf_counter
) -> float:
    """Return the median time of one call, s."""
    found = []
    for _ in range(ROUNDS):
        start = clock()
        for _ in range(times):
            work()
        found.append((clock() - start) / times)
    return statistics.median(found)


def ledger_costs(folder: Path) -> dict[str, float]:
    """Measure the ledger of a synthetic sweep with two running jobs."""
    ledger, me = Ledger(folder), Process.of(os.getpid())
    key = next(iter(ledger.states()))

    def attempt() -> None:
        number = ledger.begin(key, me)
        ledger.register(key, number, me)
        ledger.end(key, number, Ending("finished", 0, 1, METRICS, None))

    look_s = median_s(ledger.states, 20, time.process_time)
    show_s = median_s(lambda: rows(ledger), 5, time.process_time)
    return {
        "attempt_ms": 1000 * median_s(attempt, 5),
        # The driver reads the states five times a second and shows them every two seconds.
        "driver_share_of_a_core": 5 * look_s + show_s / 2,
    }


def status_s(folder: Path) -> float:
    """Measure ``pgdm sweep status``, without its imports."""

    def status() -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            assert pgdm.main(["sweep", "status", str(folder)]) == 0

    return median_s(status)


def planning_s() -> float:
    """Measure a dry run of a study's 150 jobs, including the start-up of Python and Hydra."""
    program = Path(sys.executable).with_name("pgdm-run")

    def plan() -> None:
        command = [str(program), "+sweep=validate_tcdm50", "--dry-run"]
        printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        assert f"{JOBS} (" in printed, printed

    return median_s(plan)


@contextlib.contextmanager
def timed_mlflow(spent: dict[str, float]) -> Iterator[None]:
    """Add up the processor time of the methods that talk to MLflow, s."""
    originals = {name: getattr(MlflowTracker, name) for name in ("_flush", "_connected", "_end")}

    def timed(name: str) -> Callable[..., Any]:
        def method(self: MlflowTracker, *arguments: Any) -> Any:
            start = time.thread_time()
            try:
                return originals[name](self, *arguments)
            finally:
                spent[name] = spent.get(name, 0.0) + time.thread_time() - start

        return method

    for name in originals:
        setattr(MlflowTracker, name, timed(name))
    try:
        yield
    finally:
        for name, method in originals.items():
            setattr(MlflowTracker, name, method)


class Clock(Callback):
    """Notes the processor time after each iteration."""

    def __init__(self) -> None:
        self.ticks: list[float] = []

    def on_iteration(self, progress: Progress, metrics: dict[str, float]) -> None:
        """Note it."""
        self.ticks.append(time.process_time())


def mlflow_costs(task: str, folder: Path) -> dict[str, float]:
    """Train for a few iterations, mirrored to MLflow, and return what that costs."""
    steps = 64 * 64
    cfg = compose(
        [
            f"task={task}",
            "algo=ppo_fast",
            "action=residual",
            "num_envs=64",
            "num_threads=1",
            f"total_frames={ITERATIONS * steps}",
            "eval.episodes=1",
            "eval.interval_frames=0",
            "eval.video=false",
            f"run_dir={folder / 'run'}",
        ]
    )
    spent: dict[str, float] = {}
    clock = Clock()
    with timed_mlflow(spent):
        run_experiment(cfg, [clock], notify=lambda text: None)
    iteration_s = statistics.median(b - a for a, b in pairwise(clock.ticks))
    once_s = spent["_connected"] + spent["_end"]  # import, connect, copy files
    each_s = (spent["_flush"] - spent["_connected"]) / ITERATIONS
    return {
        "iteration_cpu_s": iteration_s,
        "mlflow_cpu_s_per_iteration": each_s,
        "mlflow_cpu_s_once": once_s,
        "mlflow_share": each_s / iteration_s + once_s / (FRAMES / steps * iteration_s),
    }


def main() -> None:
    """Measure, print, and store the values if wanted."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="hammer-use1")
    parser.add_argument("--write", action="store_true", help=f"store the values in {RESULT.name}")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        root = Path(place)
        synthetic(root / "two", 2)
        synthetic(root / "all", JOBS)
        values = {
            "planning_150_s": planning_s(),
            "status_of_150_s": status_s(root / "two"),
            "status_of_150_running_s": status_s(root / "all"),
            **ledger_costs(root / "two"),
            **mlflow_costs(options.task, root),
        }
    values["ledger_and_mlflow_share"] = values["mlflow_share"] + values[
        "driver_share_of_a_core"
    ] / len(os.sched_getaffinity(0))
    for name, value in values.items():
        print(f"{name:<28}{value:.4g}")
    if options.write:
        whole = {
            "command": f"python benchmark/sweep.py --task {options.task} --write",
            "date": date.today().isoformat(),
            "machine": {"cores": len(os.sched_getaffinity(0)), "processor": platform.machine()},
            "versions": versions(),
            "figures": {name: float(f"{value:.4g}") for name, value in values.items()},
        }
        RESULT.parent.mkdir(exist_ok=True)
        RESULT.write_text(json.dumps(whole, indent=1) + "\n")


if __name__ == "__main__":
    main()
