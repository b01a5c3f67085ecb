"""Small sweeps, as planned by the command line."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from pathlib import Path
from typing import IO

from command_line import TINY
from pgdm.config.compose import compose
from pgdm.sweep.plan import Job, LocalCfg, Plan, SlurmCfg, SweepCfg, job_key

SWEEP = SweepCfg(name=None, dir=None, max_attempts=2, detach=False, dry_run=False, most_jobs=10_000)
LOCAL = LocalCfg(name="local", max_jobs=2, cores_per_job=1, memory_per_job_gb=1.0)
SLURM = SlurmCfg(
    name="slurm",
    partition=None,
    account=None,
    qos=None,
    constraint=None,
    time_min=60,
    cores_per_job=1,
    memory_per_job_gb=1.0,
    gpus_per_job=0,
    gres=None,
    array_parallelism=3,
    signal_delay_s=100,
    poll_s=1.0,
    setup=[],
    additional_parameters=[],
)


def plan(folder: Path, jobs: int = 3, *overrides: str) -> Plan:
    """Return a sweep over seeds; a later override of the same key wins."""
    settings = dict(text.split("=", 1) for text in (*TINY, "offline=true", *overrides))
    found = []
    for seed in range(jobs):
        mine = [f"{key}={value}" for key, value in settings.items()] + [f"seed={seed}"]
        cfg = compose([*mine, f"run_dir={folder / 'runs' / f's{seed}'}"])
        found.append(Job(job_key(cfg), f"seed={seed}", tuple(mine), cfg))
    return Plan(folder.name, folder, tuple(found), "pgdm-run -m seed=0,1,2")


def broken(whole: Plan, number: int) -> Plan:
    """Return the plan with one job that always fails: its assets do not exist."""
    job = whole.jobs[number]
    task = dataclasses.replace(job.cfg.task, motion="no-such-motion")
    cfg = dataclasses.replace(job.cfg, task=task)
    jobs = list(whole.jobs)
    jobs[number] = dataclasses.replace(job, cfg=cfg, key=job_key(cfg))
    return dataclasses.replace(whole, jobs=tuple(jobs))


PROGRAM = """
import sys
from pathlib import Path
from typing import IO
from pgdm.cli.sweep import FRONT
from pgdm.sweep.launch import run_sweep
from pgdm.sweep.plan import read_plan
import sweep_plans
plan = read_plan(Path(sys.argv[1]))
launcher = getattr(sweep_plans, sys.argv[2])
sys.exit(run_sweep(plan, sweep_plans.SWEEP, launcher, FRONT))
"""


def start(
    folder: Path, output: IO[str] | None = None, launcher: str = "LOCAL"
) -> subprocess.Popen[str]:
    """Start a planned sweep as a process of its own.

    Args:
        folder: of the sweep.
        output: file for its output; None: pipes.
        launcher: name of one of those above.
    """
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(folder), launcher],
        env=env,
        stdout=output or subprocess.PIPE,
        stderr=output or subprocess.PIPE,
        text=True,
    )
