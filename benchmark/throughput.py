"""Speed of pgdm: stepping, training, start and memory. Prints one table, medians of five.

    python benchmark/throughput.py [--task hammer-use1] [--rounds 5] [--write]

Every round steps the same actions three times: the batch env, and bare ``mujoco.batch.Batch``
doing the very same physics (targets, gravity compensation, restarts) with nothing around it, so
that the machine's drift hits all alike; ratios are medians over the rounds.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from datetime import date
from pathlib import Path

import mujoco
import numpy as np
import torch
from mujoco import batch as mujoco_batch
from rich.console import Console
from rich.table import Table

from pgdm.config.schema import ExperimentCfg
from pgdm.config.store import compose
from pgdm.envs.build import EnvBuilder
from pgdm.experiment import env_builder
from pgdm.library import open_library
from pgdm.rl.callback import Callback, Progress
from pgdm.rl.trainer import Extras, Trainer, TrainerCfg
from pgdm.tracking.provenance import versions

RESULT = Path(__file__).parent / "results" / "throughput.json"
STEPS = 100  # control steps of all simulations in one measurement
ITERATIONS = 5  # of training in one measurement

FIRST_STEP = """
import time; start = time.perf_counter()
from pgdm.make import make_batch
import torch
env = make_batch("{task}", num_envs=64, offline=True)
env.step(torch.zeros(64, env.action_dim))
print(time.perf_counter() - start)
"""


def actions_of(builder: EnvBuilder, num_envs: int) -> list[torch.Tensor]:
    """Return the same random actions around the warm start for every measurement."""
    generator = torch.Generator().manual_seed(0)
    warm = builder.mdp.actions.warm_start.float()
    shape = (num_envs, len(warm))
    return [warm + 0.2 * torch.randn(shape, generator=generator) for _ in range(STEPS)]


def step_env(builder: EnvBuilder, actions: list[torch.Tensor]) -> tuple[float, list[np.ndarray]]:
    """Return steps/s of the batch env, and which rows restarted after each step."""
    env = builder.make(len(actions[0]), 0)
    restarts = []
    start = time.perf_counter()
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        restarts.append((terminated | truncated).nonzero()[:, 0].numpy())
    rate = len(actions) * env.num_envs / (time.perf_counter() - start)
    return rate, restarts


def step_bare(
    builder: EnvBuilder, actions: list[torch.Tensor], restarts: list[np.ndarray]
) -> float:
    """Return steps/s of the same physics without pgdm."""
    num_envs, start_state = len(actions[0]), builder.mdp.start
    batch = mujoco_batch.Batch(builder.scene.model, num_envs, 0, persistent=True)
    ctrl, applied, bias = batch.ctrl, batch.qfrc_applied, batch.bind("qfrc_bias")
    qpos, qvel = batch.qpos, batch.qvel
    stage, n = mujoco.mjtStage.mjSTAGE_VEL, builder.scene.index.num_compensated
    t = torch.zeros(num_envs, dtype=torch.int64)
    targets = [builder.mdp.actions.act(action, t).numpy() for action in actions]

    def restart(ids: np.ndarray) -> None:
        batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        qpos[ids], qvel[ids] = start_state.qpos, start_state.qvel
        batch.forward(ids, stage=stage)

    restart(np.arange(num_envs))
    start = time.perf_counter()
    for target, finished in zip(targets, restarts, strict=True):
        ctrl[:] = target
        applied[:, :n] = bias[:, :n]
        batch.step(nstep=builder.motion.substeps, stage=stage)
        if len(finished):
            restart(finished)
    return len(actions) * num_envs / (time.perf_counter() - start)


class Clock(Callback):
    """Notes when each iteration ends."""

    def __init__(self) -> None:
        self.ends: list[float] = []

    def on_iteration(self, progress: Progress, metrics: dict[str, float]) -> None:
        """Note the time."""
        self.ends.append(time.perf_counter())


def train(builder: EnvBuilder, cfg: ExperimentCfg) -> float:
    """Return environment steps/s of collecting and learning, evaluation and saving aside."""
    threads = len(os.sched_getaffinity(0))
    frames = cfg.num_envs * cfg.algo.steps_per_env
    clock = Clock()
    trainer_cfg = TrainerCfg(cfg.algo, 0, frames * (ITERATIONS + 1), 0, 1e9, "cpu", threads)
    Trainer(builder.make(cfg.num_envs, threads), trainer_cfg, Extras(callbacks=[clock])).run()
    return frames * ITERATIONS / (clock.ends[-1] - clock.ends[0])  # the first one warms up


def first_step_s(task: str) -> float:
    """Return s from a fresh process's import to its first step."""
    code = FIRST_STEP.format(task=task)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return float(done.stdout)


def peak_memory_mib(task: str) -> float:
    """Return the largest resident memory of a short `pgdm-run` with a film."""
    with tempfile.TemporaryDirectory() as folder:
        command = [str(Path(sys.executable).with_name("pgdm-run")), f"task={task}", "--offline"]
        command += [f"run_dir={folder}/run", "total_frames=8192"]
        subprocess.run(command, cwd=folder, capture_output=True, check=True)
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024


def measure(task: str, rounds: int, console: Console) -> dict[str, list[float]]:
    """Return each figure's value in every round."""
    # torch's helper threads spin after each parallel call, on a core that the physics needs.
    torch.set_num_threads(1)
    builder = env_builder(compose([f"task={task}"]), open_library())
    actions = actions_of(builder, 64)
    figures: dict[str, list[float]] = {}

    def note(name: str, value: float) -> None:
        figures.setdefault(name, []).append(value)

    for number in range(rounds):
        with console.status(f"round {number + 1} of {rounds}"):
            rate, restarts = step_env(builder, actions)
            bare = step_bare(builder, actions, restarts)
            note("bare", bare)
            note("make_batch", rate)
            note("make_batch / bare", rate / bare)
            for algo in ("ppo", "ppo_fast"):
                trained = train(builder, compose([f"task={task}", f"algo={algo}"]))
                note(f"training {algo}", trained)
                note(f"training {algo} / bare", trained / bare)
            note("import to first step [s]", first_step_s(task))
            note("peak memory of a run [MiB]", peak_memory_mib(task))
    return figures


def main() -> None:
    """Measure, print, store."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="hammer-use1")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--write", action="store_true", help=f"store the figures in {RESULT.name}")
    options = parser.parse_args()
    console = Console()
    figures = measure(options.task, options.rounds, console)
    table = Table(title=f"{options.task}, N=64, {os.cpu_count()} cores")
    for name in ("figure", "median", "min", "max"):
        table.add_column(name, justify="left" if name == "figure" else "right")
    for name, values in figures.items():
        digits = 2 if "/ bare" in name or "[s]" in name else 0
        row = (statistics.median(values), min(values), max(values))
        table.add_row(name, *(f"{value:,.{digits}f}" for value in row))
    console.print(table)
    if options.write:
        about = {
            "command": "python benchmark/throughput.py --write",
            "date": date.today().isoformat(),
            "machine": f"{os.cpu_count()} cores, {platform.machine()}",
            "task": options.task,
            "versions": versions(),
        }
        RESULT.write_text(json.dumps(about | {"figures": figures}, indent=1) + "\n")


if __name__ == "__main__":
    main()
