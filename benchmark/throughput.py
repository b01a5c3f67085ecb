"""Speed of pgdm: stepping, training, start and memory. Prints one table, medians of five.

    python benchmark/throughput.py [--task hammer-use1] [--rounds 5] [--write]

Beside everything runs bare ``mujoco.batch.Batch`` doing the very same physics (targets, gravity
compensation, restarts) with nothing around it: step by step beside the batch env, and after each
iteration of a training, so that the machine's drift hits both alike.
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
from dataclasses import dataclass
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
STEPS = 64  # control steps of all simulations in one measurement
CURRENT = mujoco.mjtStage.mjSTAGE_VEL
ITERATIONS = 3  # of training in one measurement

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


class Bare:
    """The physics of the batch env without pgdm: targets, gravity compensation, restarts."""

    def __init__(self, builder: EnvBuilder, num_envs: int) -> None:
        self._batch = mujoco_batch.Batch(builder.scene.model, num_envs, 0, persistent=True)
        self._start, self._substeps = builder.mdp.start, builder.motion.substeps
        self._n = builder.scene.index.num_compensated
        self._ctrl, self._applied = self._batch.ctrl, self._batch.qfrc_applied
        self._bias = self._batch.bind("qfrc_bias")
        self._qpos, self._qvel = self._batch.qpos, self._batch.qvel
        self._restart(np.arange(num_envs))

    def _restart(self, ids: np.ndarray) -> None:
        self._batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._qpos[ids], self._qvel[ids] = self._start.qpos, self._start.qvel
        self._batch.forward(ids, stage=CURRENT)

    def step(self, target: np.ndarray, finished: np.ndarray) -> None:
        """Take one control step, then restart the rows that the env restarted."""
        self._ctrl[:] = target
        self._applied[:, : self._n] = self._bias[:, : self._n]
        self._batch.step(nstep=self._substeps, stage=CURRENT)
        if len(finished):
            self._restart(finished)


@dataclass
class Script:
    """What was done in one measurement, to be done again."""

    targets: list[np.ndarray]
    finished: list[np.ndarray]

    def play(self, bare: Bare) -> float:
        """Do it again; return s."""
        start = time.perf_counter()
        for target, finished in zip(self.targets, self.finished, strict=True):
            bare.step(target, finished)
        return time.perf_counter() - start


def step_side_by_side(
    builder: EnvBuilder, actions: list[torch.Tensor]
) -> tuple[float, float, Script]:
    """Step env and bare physics in turn, one control step each; return s of both, and what."""
    num_envs = len(actions[0])
    env, bare = builder.make(num_envs), Bare(builder, num_envs)
    t = torch.zeros(num_envs, dtype=torch.int64)
    script, in_env, in_bare = Script([], []), 0.0, 0.0
    for action in actions:
        target = builder.mdp.actions.act(action, t).numpy()
        start = time.perf_counter()
        _, _, terminated, truncated, _ = env.step(action)
        middle = time.perf_counter()
        finished = (terminated | truncated).nonzero()[:, 0].numpy()
        between = time.perf_counter()
        bare.step(target, finished)
        in_env += middle - start
        in_bare += time.perf_counter() - between
        script.targets.append(target)
        script.finished.append(finished)
    return in_env, in_bare, script


class Clock(Callback):
    """Takes the time of each iteration, and plays the bare physics after each."""

    def __init__(self, builder: EnvBuilder, script: Script) -> None:
        self._builder, self._script = builder, script
        self.training_s: list[float] = []
        self.bare_s: list[float] = []
        self._since = 0.0

    def on_start(self, trainer: Trainer) -> None:
        """Begin."""
        self._since = time.perf_counter()

    def on_iteration(self, progress: Progress, metrics: dict[str, float]) -> None:
        """Note the iteration's time, and that of the bare physics."""
        self.training_s.append(time.perf_counter() - self._since)
        bare = Bare(self._builder, len(self._script.targets[0]))
        self.bare_s.append(self._script.play(bare))
        self._since = time.perf_counter()


def train(builder: EnvBuilder, cfg: ExperimentCfg, script: Script) -> tuple[float, float]:
    """Return steps/s of collecting and learning, and of the bare physics in between.

    Evaluation and saving are left out; the first iteration warms up.
    """
    threads = len(os.sched_getaffinity(0))
    frames = cfg.num_envs * cfg.algo.steps_per_env
    clock = Clock(builder, script)
    trainer_cfg = TrainerCfg(cfg.algo, 0, frames * (ITERATIONS + 1), 0, 1e9, "cpu", threads)
    Trainer(builder.make(cfg.num_envs, threads), trainer_cfg, Extras(callbacks=[clock])).run()
    played = len(script.targets) * len(script.targets[0])
    trained_s, bare_s = sum(clock.training_s[1:]), sum(clock.bare_s[1:])
    return frames * ITERATIONS / trained_s, played * ITERATIONS / bare_s


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
            in_env, in_bare, script = step_side_by_side(builder, actions)
            frames = len(actions) * len(actions[0])
            note("bare", frames / in_bare)
            note("make_batch", frames / in_env)
            note("make_batch / bare", in_bare / in_env)
            for algo in ("ppo", "ppo_fast"):
                cfg = compose([f"task={task}", f"algo={algo}"])
                trained, bare = train(builder, cfg, script)
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
