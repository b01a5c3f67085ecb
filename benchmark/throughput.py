"""Measure stepping, training, start-up and memory of pgdm; print medians of five rounds.

    python benchmark/throughput.py [--task hammer-use1] [--rounds 5] [--write] [--methods-only]
    python benchmark/throughput.py --against OTHER_CHECKOUT [--task hammer-use1] [--rounds 5]

The baseline is bare ``mujoco.batch.Batch`` doing exactly the same steps (targets, gravity
compensation, restarts, from the same states) and nothing else. It alternates with the batch env
step by step; in training, it repeats the steps of each iteration right after the iteration. So
drift of the machine's speed affects both alike.

With ``--against``, this checkout and another one, such as the code before a change, are measured in
turn, each round in a new process. This file measures both, so it only uses what they share.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path

import mujoco
import numpy as np
import torch
from method_cost import measure_methods
from mujoco import batch as mujoco_batch
from rich.console import Console
from rich.table import Table

import pgdm
from pgdm.config.compose import compose
from pgdm.config.schema import ExperimentCfg
from pgdm.envs.batch_env import BatchEnv
from pgdm.envs.build import EnvBuilder
from pgdm.experiment import env_builder
from pgdm.library import open_library
from pgdm.rl.callback import Callback, Progress
from pgdm.rl.trainer import Extras, Trainer, TrainerCfg
from pgdm.runs.provenance import versions
from pgdm.sim.batch import Array

HERE = Path(__file__).resolve().parents[1]
sys.path.append(str(HERE / "tests"))
from toy_envs import FreeEnv  # noqa: E402

RESULT = Path(__file__).parent / "results" / "throughput.json"
NUM_ENVS = 64  # simulations of the batch env; in training their number follows from the settings
STEPS = 64  # control steps of all simulations in one measurement
CURRENT = mujoco.mjtStage.mjSTAGE_VEL
ITERATIONS = 3  # iterations of training in one measurement

FIRST_STEP = """
import time; start = time.perf_counter()
from pgdm.make import make_batch
import torch
env = make_batch("{task}", num_envs=64, offline=True)
env.step(torch.zeros(64, env.action_dim))
print(time.perf_counter() - start)
"""


@dataclass
class Script:
    """What the simulations of an env did: states at the start, targets and restarts by step."""

    states: np.ndarray
    targets: list[np.ndarray] = field(default_factory=list)
    restarted: list[np.ndarray] = field(default_factory=list)


class Recorder:
    """Records what an env does with its simulations."""

    def __init__(self, env: BatchEnv) -> None:
        self._sim, self._step, self._reset = env.sim, env.sim.step, env.sim.reset
        self.script = Script(np.array(env.sim.rows))
        # Intercept the env's calls; the two list entries per step take a few microseconds.
        env.sim.step, env.sim.reset = self._on_step, self._on_reset

    def start(self) -> None:
        """Begin a new script."""
        self.script = Script(np.array(self._sim.rows))

    def _on_step(self, ctrl: Array) -> Array:
        self.script.targets.append(np.array(ctrl))
        self.script.restarted.append(np.zeros(0, np.int64))
        return self._step(ctrl)

    def _on_reset(self, ids: Array, qpos: np.ndarray, qvel: np.ndarray) -> None:
        if self.script.restarted:  # the states already include the reset before the first step
            self.script.restarted[-1] = np.array(ids)
        self._reset(ids, qpos, qvel)


class Bare:
    """The physics of the batch env without pgdm: targets, gravity compensation, restarts."""

    def __init__(self, builder: EnvBuilder, states: np.ndarray) -> None:
        self._batch = mujoco_batch.Batch(builder.scene.model, len(states), 0, persistent=True)
        self._start, self._substeps = builder.mdp.start, builder.motion.substeps
        self._n = builder.scene.index.num_compensated
        self._ctrl, self._applied = self._batch.ctrl, self._batch.qfrc_applied
        self._bias = self._batch.bind("qfrc_bias")
        self._qpos, self._qvel = self._batch.qpos, self._batch.qvel
        self._batch.state[:] = states
        self._batch.forward(stage=CURRENT)

    def step(self, target: np.ndarray, restarted: np.ndarray) -> None:
        """Take one control step, then restart the rows that the env restarted."""
        self._ctrl[:] = target
        self._applied[:, : self._n] = self._bias[:, : self._n]
        self._batch.step(nstep=self._substeps, stage=CURRENT)
        if len(restarted):
            self._batch.reset(restarted, stage=mujoco.mjtStage.mjSTAGE_NONE)
            self._qpos[restarted], self._qvel[restarted] = self._start.qpos, self._start.qvel
            self._batch.forward(restarted, stage=CURRENT)

    @property
    def states(self) -> np.ndarray:
        """All simulations' states, (N, nstate)."""
        return self._batch.state


def play(script: Script, builder: EnvBuilder) -> tuple[float, np.ndarray]:
    """Repeat a script with the bare physics; return its time, s, and final states (N, nstate)."""
    bare = Bare(builder, script.states)
    start = time.perf_counter()
    for target, restarted in zip(script.targets, script.restarted, strict=True):
        bare.step(target, restarted)
    return time.perf_counter() - start, bare.states


def step_side_by_side(builder: EnvBuilder, num_envs: int) -> tuple[float, float]:
    """Step env and bare physics in turn, one control step each; return the time of each, s."""
    generator = torch.Generator().manual_seed(0)
    env = builder.make(num_envs)
    recorder, bare = Recorder(env), Bare(builder, np.array(env.sim.rows))
    in_env = in_bare = 0.0
    for _ in range(STEPS):
        noise = torch.randn((num_envs, env.action_dim), generator=generator)
        action = env.warm_start() + 0.2 * noise
        start = time.perf_counter()
        env.step(action)
        middle = time.perf_counter()
        bare.step(recorder.script.targets[-1], recorder.script.restarted[-1])
        in_env += middle - start
        in_bare += time.perf_counter() - middle
    if not np.array_equal(env.sim.rows, bare.states):
        raise SystemExit("env and bare physics did not do the same")
    return in_env, in_bare


class Clock(Callback):
    """Times each iteration, and then its steps with the bare physics."""

    def __init__(self, builder: EnvBuilder, env: BatchEnv) -> None:
        self._builder, self._env, self._recorder = builder, env, Recorder(env)
        self.training_s: list[float] = []
        self.bare_s: list[float] = []
        self._since = 0.0

    def on_start(self, trainer: Trainer) -> None:
        """Begin."""
        self._begin()

    def on_iteration(self, progress: Progress, metrics: dict[str, float]) -> None:
        """Record the time of the iteration and of the bare physics."""
        self.training_s.append(time.perf_counter() - self._since)
        seconds, states = play(self._recorder.script, self._builder)
        if not np.array_equal(states, self._env.sim.rows):
            raise SystemExit("training and bare physics did not do the same")
        self.bare_s.append(seconds)
        self._begin()

    def _begin(self) -> None:
        self._recorder.start()
        self._since = time.perf_counter()


def train(builder: EnvBuilder, cfg: ExperimentCfg, overlap: bool = True) -> tuple[float, float]:
    """Return steps/s of collecting and learning, and of the bare physics doing the same steps.

    Evaluation and saving are left out; the first iteration is a warm-up. Without ``overlap``,
    physics and the updates of soft actor-critic alternate, so that each has all cores.
    """
    threads = len(os.sched_getaffinity(0))
    frames = cfg.num_envs * cfg.algo.steps_per_env
    env = builder.make(cfg.num_envs, threads)
    clock = Clock(builder, env)
    trainer_cfg = TrainerCfg(
        cfg.algo, 0, frames * (ITERATIONS + 1), None, 0, 1e9, "cpu", threads if overlap else 1
    )
    Trainer(env, trainer_cfg, Extras(callbacks=[clock])).run()
    done = frames * ITERATIONS
    return done / sum(clock.training_s[1:]), done / sum(clock.bare_s[1:])


class Ticks(Callback):
    """Records when each iteration was done."""

    def __init__(self) -> None:
        self.at_s: list[float] = []

    def on_iteration(self, progress: Progress, metrics: dict[str, float]) -> None:
        """Record the time."""
        self.at_s.append(time.perf_counter())


def without_physics_ms(cfg: ExperimentCfg) -> float:
    """Return the time of an iteration without physics, only acting and learning, ms."""
    threads, ticks = len(os.sched_getaffinity(0)), Ticks()
    frames = cfg.num_envs * cfg.algo.steps_per_env * (ITERATIONS + 2)  # two iterations as a warm-up
    trainer_cfg = TrainerCfg(cfg.algo, 0, frames, None, 0, 1e9, "cpu", threads)
    Trainer(FreeEnv(cfg.num_envs), trainer_cfg, Extras(callbacks=[ticks])).run()
    return 1e3 * float(np.median(np.diff(ticks.at_s[1:])))


def first_step_s(task: str) -> float:
    """Return the time from the import to the first step in a new process, s."""
    code = FIRST_STEP.format(task=task)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return float(done.stdout)


def peak_memory_mib(task: str, *overrides: str) -> float:
    """Return the peak resident memory of a short `pgdm-run` with a video.

    This includes pages of a replay in memory, which the system reclaims when it needs them.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = [str(Path(sys.executable).with_name("pgdm-run")), f"task={task}", "--offline"]
        command += [f"run_dir={folder}/run", "total_frames=8192", *overrides]
        run = subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL)
        _, status, used = os.wait4(run.pid, 0)  # of this process alone; RUSAGE_CHILDREN is of all
    if status:
        raise SystemExit(f"{' '.join(command)} ended with status {status}")
    return used.ru_maxrss / 1024


def measure_round(task: str) -> dict[str, float]:
    """Return one value for each row that can be measured in any checkout."""
    # torch's helper threads spin after each parallel call, on a core that the physics needs.
    torch.set_num_threads(1)
    builder = env_builder(compose([f"task={task}"]), open_library())
    in_env, in_bare = step_side_by_side(builder, NUM_ENVS)
    values = {
        "bare": STEPS * NUM_ENVS / in_bare,
        "make_batch": STEPS * NUM_ENVS / in_env,
        "make_batch / bare": in_bare / in_env,
    }
    for algo, overlap in (("ppo", True), ("ppo_fast", True), ("sac", True), ("sac", False)):
        cfg = compose([f"task={task}", f"algo={algo}"])
        trained, bare = train(builder, cfg, overlap)
        name = algo if overlap else f"{algo}, physics and updates in turn"
        values[f"training {name}"] = trained
        values[f"bare, the steps of training {name}"] = bare
        values[f"training {name} / bare"] = trained / bare
    for algo in ("ppo", "ppo_fast", "sac"):
        cfg = compose([f"task={task}", f"algo={algo}"])
        values[f"an iteration of {algo} without physics (ms)"] = without_physics_ms(cfg)
    values["import to first step (s)"] = first_step_s(task)
    values["peak memory of a run (MiB)"] = peak_memory_mib(task)
    values["peak memory of a run with algo=sac (MiB)"] = peak_memory_mib(task, "algo=sac")
    return values


def measure(task: str, rounds: int, console: Console) -> dict[str, list[float]]:
    """Return the values of each row, one per round."""
    from loss_cost import measure_losses  # rows that another checkout may not have

    values: dict[str, list[float]] = {}
    for number in range(rounds):
        with console.status(f"round {number + 1} of {rounds}"):
            for name, value in (measure_round(task) | measure_losses(task)).items():
                values.setdefault(name, []).append(value)
    return values


def compare(task: str, rounds: int, other: Path, console: Console) -> None:
    """Measure this checkout and another in turn and print both."""
    checkouts = {"other": other.resolve(), "this": HERE}
    found: dict[str, dict[str, list[float]]] = {name: {} for name in checkouts}
    for number in range(rounds):
        for name in list(checkouts)[:: 1 - 2 * (number % 2)]:  # the order alternates
            with console.status(f"round {number + 1} of {rounds}, {name}"):
                for row, value in in_checkout(checkouts[name], task).items():
                    found[name].setdefault(row, []).append(value)
    table = Table(title=f"{task}, N={NUM_ENVS}, {os.cpu_count()} cores, medians of {rounds}")
    table.add_column("")
    for name in (*checkouts, "this / other", "min", "max"):
        table.add_column(name, justify="right")
    for row, before in found["other"].items():
        after = found["this"][row]
        ratios = [new / old for new, old in zip(after, before, strict=True)]
        shown = [f"{statistics.median(values):,.{digits(row)}f}" for values in (before, after)]
        spread = (statistics.median(ratios), min(ratios), max(ratios))
        table.add_row(row, *shown, *(f"{ratio:.3f}" for ratio in spread))
    console.print(table)


def in_checkout(checkout: Path, task: str) -> dict[str, float]:
    """Return a round's values, measured in a new process with the package of a checkout."""
    command = [sys.executable, str(Path(__file__).resolve()), "--task", task, "--one-round"]
    place = os.environ | {"PYTHONPATH": str(checkout / "src")}
    done = subprocess.run(command, env=place, stdout=subprocess.PIPE, text=True, check=True)
    package, values = json.loads(done.stdout.splitlines()[-1])
    if not Path(package).is_relative_to(checkout):
        raise SystemExit(f"measured {package}, which is not in {checkout}")
    return values


def digits(row: str) -> int:
    """Return the decimals to show in a row."""
    return 2 if "/ bare" in row or "/ pgdm" in row or "s)" in row else 0


def main() -> None:
    """Measure, print, store."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", default="hammer-use1")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--write", action="store_true", help=f"store the values in {RESULT.name}")
    parser.add_argument("--methods-only", action="store_true", help="only the methods' rows")
    parser.add_argument(
        "--against", type=Path, metavar="CHECKOUT", help="compare with another checkout"
    )
    parser.add_argument("--one-round", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.write and (options.methods_only or options.against):
        parser.error("--write stores all values of this checkout; use it alone")
    console = Console()
    if options.one_round:
        print(json.dumps([str(Path(pgdm.__file__).resolve()), measure_round(options.task)]))
        return
    if options.against:
        compare(options.task, options.rounds, options.against, console)
        return
    values = {} if options.methods_only else measure(options.task, options.rounds, console)
    values |= measure_methods(options.task, NUM_ENVS, options.rounds, console)
    table = Table(title=f"{options.task}, N={NUM_ENVS}, {os.cpu_count()} cores")
    for name in ("", "median", "min", "max"):
        table.add_column(name, justify="right" if name else "left")
    for row, found in values.items():
        shown = (statistics.median(found), min(found), max(found))
        table.add_row(row, *(f"{value:,.{digits(row)}f}" for value in shown))
    console.print(table)
    if options.write:
        about = {
            "command": " ".join(["python benchmark/throughput.py", *sys.argv[1:]]),
            "date": date.today().isoformat(),
            "machine": f"{os.cpu_count()} cores, {platform.machine()}",
            "task": options.task,
            "versions": versions(),
        }
        RESULT.write_text(json.dumps(about | {"figures": values}, indent=1) + "\n")


if __name__ == "__main__":
    main()
