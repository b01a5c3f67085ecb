"""A training that is killed and resumed equals one that never stopped, to the bit."""

from __future__ import annotations

import json
import multiprocessing
import random
import time
from collections.abc import Iterator
from dataclasses import replace
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any

import pytest
import torch

from pgdm.rl.callback import Callback, Progress
from pgdm.rl.checkpoint import CheckpointFolder
from pgdm.rl.evaluate import Evaluator
from pgdm.rl.learner import AlgoCfg
from pgdm.rl.trainer import Extras, Trainer
from toy_envs import TOY, TOY_SAC, PointEnv, trainer_cfg

ITERATIONS = 15
PAUSE_S = 0.06
"""Added to each iteration, so that three kills fit into a training."""
# Wide enough for torch to split the products over its threads.
PPO = replace(TOY, steps_per_env=64, minibatch_size=256, epochs=1, hidden=[256, 128])
ALGOS: dict[str, AlgoCfg] = {
    "ppo": PPO,
    "ppo, normalised": replace(PPO, normalize_observations=True),
    # 8 updates an iteration: the count since the policy's last update must survive too.
    "sac": replace(TOY_SAC, steps_per_env=8, warmup_steps=4, batch_size=32, actor_interval=3),
    "sac, correlated noise, averaged, limited": replace(
        TOY_SAC,
        steps_per_env=8,
        warmup_steps=4,
        batch_size=32,
        noise_correlation=0.9,
        average_rate=0.1,
        pre_tanh_limit=0.2,
    ),
}


class Lines(Callback):
    """Appends all metrics except times to a file, slowly."""

    def __init__(self, path: Path, pause_s: float) -> None:
        self._path, self._pause_s = path, pause_s

    def on_iteration(self, progress: Progress, metrics: dict[str, float]) -> None:
        time.sleep(self._pause_s)
        self._write("train", progress, metrics)

    def on_evaluation(self, progress: Progress, metrics: dict[str, float]) -> None:
        self._write("eval", progress, metrics)

    def _write(self, kind: str, progress: Progress, metrics: dict[str, float]) -> None:
        kept = {name: value.hex() for name, value in metrics.items() if "steps_per_s" not in name}
        with self._path.open("a") as file:
            file.write(json.dumps([kind, progress.frames, progress.iteration, kept]) + "\n")


def train(folder: Path, threads: int, algo: str, pause_s: float) -> None:
    """Start or resume the training in a folder; runs in its own process."""
    frames = per_iteration(algo)
    cfg = trainer_cfg(
        ALGOS[algo],
        total_frames=ITERATIONS * frames,
        eval_interval_frames=3 * frames,
        checkpoint_interval_s=0.0,
        num_threads=threads,
    )
    checkpoints = CheckpointFolder(folder, 2)
    extras = Extras(
        evaluation=Evaluator(lambda n: PointEnv(n, seed=1), 4, 1, seed=3),
        checkpoints=checkpoints,
        callbacks=[Lines(folder / "lines", pause_s)],
        replay_folder=folder / "replay",
    )
    trainer = Trainer(PointEnv(scale=30.0), cfg, extras)
    state = checkpoints.latest()
    if state is not None:
        trainer.load_state_dict(state)
    trainer.run()
    (folder / "done").touch()


def per_iteration(algo: str) -> int:
    return 8 * ALGOS[algo].steps_per_env


def lines(folder: Path) -> dict[tuple[str, int], Any]:
    """Return the logged lines; lines logged twice must be equal."""
    logged: dict[tuple[str, int], Any] = {}
    for line in (folder / "lines").read_text().splitlines():
        try:
            kind, frames, iteration, metrics = json.loads(line)
        except ValueError:
            continue  # cut off by a kill
        entry = logged.setdefault((kind, frames), (iteration, metrics))
        assert entry == (iteration, metrics)
    return logged


@pytest.fixture(scope="module")
def processes() -> Iterator[ForkServerContext]:
    """A server that has imported everything: starting a training costs milliseconds."""
    context = multiprocessing.get_context("forkserver")
    late = ("pgdm.rl.collector", "pgdm.rl.loss", "pgdm.rl.replay", "pgdm.rl.sac_loss")
    context.set_forkserver_preload(["test_rl_resume", *late])
    yield context


def run(context: ForkServerContext, *args: Any) -> Any:
    process = context.Process(target=train, args=args)
    process.start()
    return process


def kill_at_random(process: Any, folder: Path) -> bool:
    """Kill a training after a random number of further iterations; return if it was running."""

    def logged() -> int:
        file = folder / "lines"
        return file.read_bytes().count(b"\n") if file.exists() else 0

    enough = logged() + random.randint(2, 3)  # the last of them is not saved yet
    while logged() < enough and process.is_alive():
        time.sleep(0.002)
    time.sleep(random.uniform(0.0, 2 * PAUSE_S))
    alive = process.is_alive()
    process.kill()
    process.join()
    return alive


@pytest.mark.parametrize("algo", ALGOS)
@pytest.mark.parametrize("threads", [1, 2])
def test_killed_three_times_equals_never_stopped(
    processes: ForkServerContext, tmp_path: Path, threads: int, algo: str
) -> None:
    straight, killed = tmp_path / "straight", tmp_path / "killed"
    for folder in (straight, killed):
        folder.mkdir()
    process = run(processes, straight, threads, algo, 0.0)
    process.join()
    assert process.exitcode == 0

    for _ in range(3):
        process = run(processes, killed, threads, algo, PAUSE_S)
        assert kill_at_random(process, killed), "the training finished before it could be killed"
    process = run(processes, killed, threads, algo, 0.0)
    process.join()
    assert process.exitcode == 0

    last, other = (CheckpointFolder(folder, 2).latest() for folder in (straight, killed))
    assert last is not None and other is not None
    assert last["frames"] == ITERATIONS * per_iteration(algo)
    for state in (last, other):
        state.pop("elapsed_s")
    assert flat(other) == flat(last)
    assert lines(killed) == lines(straight)
    assert len(lines(straight)) == ITERATIONS + 6


def flat(state: Any) -> Any:
    """Return a state with its tensors as comparable values."""
    if isinstance(state, torch.Tensor):
        return (state.dtype, tuple(state.shape), state.numpy().tobytes())
    if isinstance(state, dict):
        return {name: flat(value) for name, value in state.items()}
    if isinstance(state, list | tuple):
        return [flat(value) for value in state]
    return state
