"""Speed of pgdm: stepping, training, start and memory. Prints one table, medians of five.

    python benchmark/throughput.py [--task hammer-use1] [--rounds 5] [--write] [--methods-only]

Beside everything runs bare ``mujoco.batch.Batch`` doing the very same steps (targets, gravity
compensation, restarts, from the same states) with nothing around it: step by step beside the batch
env, and after each iteration of a training that iteration's steps again, so that the machine's
drift hits both alike.
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
from torch import Tensor
from torchrl_loss import as_tensordict, clip_ppo_loss

from pgdm.config.schema import ExperimentCfg
from pgdm.config.store import compose
from pgdm.envs.batch_env import BatchEnv
from pgdm.envs.build import EnvBuilder
from pgdm.experiment import env_builder
from pgdm.library import open_library
from pgdm.rl.callback import Callback, Progress
from pgdm.rl.loss import Samples, policy_loss, value_loss
from pgdm.rl.networks import (
    ActionValue,
    ActorCritic,
    NetworkCfg,
    SquashedCfg,
    SquashedPolicy,
    gaussian_log_prob,
)
from pgdm.rl.sac import SACCfg
from pgdm.rl.sac_loss import SoftActorCriticLoss, TensorDict
from pgdm.rl.trainer import Extras, Trainer, TrainerCfg
from pgdm.tracking.provenance import versions

RESULT = Path(__file__).parent / "results" / "throughput.json"
NUM_ENVS = 64  # simulations of the batch env; a training has as many as its settings say
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


@dataclass
class Script:
    """What the simulations of an env did: their states at the start, then step by step."""

    states: np.ndarray
    targets: list[np.ndarray] = field(default_factory=list)
    restarted: list[np.ndarray] = field(default_factory=list)


class Recorder:
    """Writes down what an env asks of its simulations."""

    def __init__(self, env: BatchEnv) -> None:
        self._sim, self._step, self._reset = env.sim, env.sim.step, env.sim.reset
        self.script = Script(env.sim.rows.copy())
        # The env's own calls pass through here: two list entries a step, some microseconds.
        env.sim.step, env.sim.reset = self._on_step, self._on_reset

    def start(self) -> None:
        """Begin a new script."""
        self.script = Script(self._sim.rows.copy())

    def _on_step(self, ctrl: np.ndarray) -> np.ndarray:
        self.script.targets.append(ctrl.copy())
        self.script.restarted.append(np.zeros(0, np.int64))
        return self._step(ctrl)

    def _on_reset(self, ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> None:
        if self.script.restarted:  # the reset before the first step is in the states
            self.script.restarted[-1] = ids.copy()
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
    """Do it again with the bare physics; return s, and the states (N, nstate) it ended in."""
    bare = Bare(builder, script.states)
    start = time.perf_counter()
    for target, restarted in zip(script.targets, script.restarted, strict=True):
        bare.step(target, restarted)
    return time.perf_counter() - start, bare.states


def step_side_by_side(builder: EnvBuilder, num_envs: int) -> tuple[float, float]:
    """Step env and bare physics in turn, one control step each; return s of both."""
    generator = torch.Generator().manual_seed(0)
    env = builder.make(num_envs)
    recorder, bare = Recorder(env), Bare(builder, env.sim.rows)
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
    """Takes the time of each iteration, and that of its steps with the bare physics after it."""

    def __init__(self, builder: EnvBuilder, env: BatchEnv) -> None:
        self._builder, self._env, self._recorder = builder, env, Recorder(env)
        self.training_s: list[float] = []
        self.bare_s: list[float] = []
        self._since = 0.0

    def on_start(self, trainer: Trainer) -> None:
        """Begin."""
        self._begin()

    def on_iteration(self, progress: Progress, metrics: dict[str, float]) -> None:
        """Note the iteration's time, and that of the bare physics."""
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

    Evaluation and saving are left out; the first iteration warms up. Without ``overlap`` soft
    actor-critic learns while no simulation moves; each then has the machine to itself.
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


def gradient_step_ms(cfg: ExperimentCfg) -> tuple[float, float]:
    """Return ms of one minibatch's loss and gradient: pgdm's, and TorchRL's ``ClipPPOLoss``."""
    generator = torch.Generator().manual_seed(0)
    algo, obs_dim, action_dim = cfg.algo, 322, 30
    network = NetworkCfg(obs_dim, action_dim, list(algo.hidden), algo.log_std_init, False, 10.0)
    model = ActorCritic(network, generator)
    obs = torch.randn(algo.minibatch_size, obs_dim, generator=generator)
    action, mean = model.sample(obs, generator)
    log_prob = gaussian_log_prob(mean, model.log_std.detach(), action)
    advantage, target = torch.randn((2, algo.minibatch_size), generator=generator)
    batch = Samples(obs, action, log_prob, advantage, target)
    theirs = clip_ppo_loss(model, algo)
    data = as_tensordict(batch, theirs)

    def ours() -> Tensor:
        policy = policy_loss(
            model.mean(obs),
            model.log_std,
            batch,
            clip=algo.clip,
            entropy_coef=algo.entropy_coef,
            normalize_advantage=algo.normalize_advantage,
        )
        return policy.total + algo.value_coef * value_loss(model.value(obs), target)

    def torchrls() -> Tensor:
        out = theirs(data)
        return out["loss_objective"] + out["loss_critic"] + out["loss_entropy"]

    spent = {ours: 0.0, torchrls: 0.0}
    for _ in range(STEPS):
        for loss in spent:
            model.zero_grad()
            start = time.perf_counter()
            loss().backward()
            spent[loss] += time.perf_counter() - start
    return 1e3 * spent[ours] / STEPS, 1e3 * spent[torchrls] / STEPS


def critic_gradient_ms(cfg: ExperimentCfg) -> tuple[float, float]:
    """Return ms of one batch's critic loss and gradient, critics one by one and under vmap."""
    algo, generator = cfg.algo, torch.Generator().manual_seed(0)
    assert isinstance(algo, SACCfg)
    m, obs_dim, action_dim = algo.batch_size, 322, 30
    network = SquashedCfg("squashed", obs_dim, action_dim, list(algo.hidden), -1.6, 10.0)
    policy = SquashedPolicy(network, generator)
    critics = [ActionValue(obs_dim, action_dim, algo.hidden, generator) for _ in range(2)]
    after = {name: torch.zeros(m, 1, dtype=torch.bool) for name in ("done", "terminated")}
    after |= {"observation": torch.randn(m, obs_dim), "reward": torch.rand(m, 1)}
    columns = {"observation": torch.randn(m, obs_dim), "action": torch.rand(m, action_dim)}
    batch = TensorDict({**columns, "next": TensorDict(after, batch_size=m)}, batch_size=m)
    spent = []
    for vmap in (False, True):
        loss = SoftActorCriticLoss(
            policy,
            critics,
            gamma=algo.gamma,
            temperature=0.01,
            target_entropy=-30.0,
            generator=generator,
        )
        loss.deactivate_vmap = not vmap
        loss._make_vmap()
        params, times = list(loss.qvalue_network_params.parameters()), []
        for _ in range(STEPS):
            start = time.perf_counter()
            with torch.autocast("cpu", dtype=torch.bfloat16, enabled=algo.bfloat16):
                value = loss.critic_loss(batch)
            torch.autograd.grad(value, params)
            times.append(time.perf_counter() - start)
        spent.append(1e3 * statistics.median(times))
    return spent[0], spent[1]


def first_step_s(task: str) -> float:
    """Return s from a fresh process's import to its first step."""
    code = FIRST_STEP.format(task=task)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return float(done.stdout)


def peak_memory_mib(task: str, *overrides: str) -> float:
    """Return the largest resident memory of a short `pgdm-run` with a film.

    The pages of a replay that are in memory count; the system takes them back when it needs them.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = [str(Path(sys.executable).with_name("pgdm-run")), f"task={task}", "--offline"]
        command += [f"run_dir={folder}/run", "total_frames=8192", *overrides]
        subprocess.run(command, cwd=folder, capture_output=True, check=True)
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024


def measure(task: str, rounds: int, console: Console) -> dict[str, list[float]]:
    """Return each figure's value in every round."""
    # torch's helper threads spin after each parallel call, on a core that the physics needs.
    torch.set_num_threads(1)
    builder = env_builder(compose([f"task={task}"]), open_library())
    figures: dict[str, list[float]] = {}

    def note(name: str, value: float) -> None:
        figures.setdefault(name, []).append(value)

    for number in range(rounds):
        with console.status(f"round {number + 1} of {rounds}"):
            in_env, in_bare = step_side_by_side(builder, NUM_ENVS)
            note("bare", STEPS * NUM_ENVS / in_bare)
            note("make_batch", STEPS * NUM_ENVS / in_env)
            note("make_batch / bare", in_bare / in_env)
            for algo, overlap in (("ppo", True), ("ppo_fast", True), ("sac", True), ("sac", False)):
                cfg = compose([f"task={task}", f"algo={algo}"])
                trained, bare = train(builder, cfg, overlap)
                name = algo if overlap else f"{algo}, physics and updates in turn"
                note(f"training {name}", trained)
                note(f"bare, the steps of training {name}", bare)
                note(f"training {name} / bare", trained / bare)
            one_by_one, under_vmap = critic_gradient_ms(compose([f"task={task}", "algo=sac"]))
            note("loss and gradient of SAC's critics, one thread (ms)", one_by_one)
            note("the same under TorchRL's vmap (ms)", under_vmap)
            own, torchrls = gradient_step_ms(compose([f"task={task}"]))
            note("loss and gradient, one thread (ms)", own)
            note("the same by TorchRL's ClipPPOLoss (ms)", torchrls)
            note("import to first step (s)", first_step_s(task))
            note("peak memory of a run (MiB)", peak_memory_mib(task))
            note("peak memory of a run with algo=sac (MiB)", peak_memory_mib(task, "algo=sac"))
    return figures


def main() -> None:
    """Measure, print, store."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="hammer-use1")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--write", action="store_true", help=f"store the figures in {RESULT.name}")
    parser.add_argument("--methods-only", action="store_true", help="only the methods' rows")
    options = parser.parse_args()
    if options.write and options.methods_only:
        parser.error("--write stores all figures; leave --methods-only out")
    console = Console()
    figures = {} if options.methods_only else measure(options.task, options.rounds, console)
    figures |= measure_methods(options.task, NUM_ENVS, options.rounds, console)
    table = Table(title=f"{options.task}, N=64, {os.cpu_count()} cores")
    for name in ("figure", "median", "min", "max"):
        table.add_column(name, justify="left" if name == "figure" else "right")
    for name, values in figures.items():
        digits = 2 if "/ bare" in name or "/ pgdm" in name or "s)" in name else 0
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
