"""Measure `sim=warp` on a GPU: speed of control steps and training, memory. Writes JSON.

    python benchmark/gpu.py --out gpu.json                       on a GPU, in under ten minutes
    python benchmark/gpu.py --device cpu --out gpu.json          a small test on Warp's CPU device

Control steps are measured for each number of simulations and scene, training with `algo=ppo_wide`
for each number of simulations on the first scene, without evaluation and kernel compilation. No
measurement starts after --limit seconds.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from pgdm.config.compose import compose
from pgdm.envs.batch_env import BatchEnv
from pgdm.experiment import env_builder
from pgdm.library import ensure
from pgdm.rl.callback import Callback, Progress
from pgdm.rl.trainer import Extras, Trainer, TrainerCfg
from pgdm.runs.provenance import versions

SCENES = ("hammer-use1", "wineglass-drink1", "spheremedium-lift", "dmanus-sim2real", "door-open")
WIDTHS = {"cuda": (2048, 8192, 16384), "cpu": (4, 16)}
STEPS = {"cuda": 100, "cpu": 10}
PAPER_FRAMES = 50_000_000


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--device", default="cuda", help="cuda, cuda:1, ... or cpu")
    parser.add_argument("--scenes", nargs="+", default=SCENES)
    parser.add_argument("--limit", type=float, default=480, help="start nothing after this time, s")
    parser.add_argument("--out", type=Path, default=Path("gpu.json"))
    options = parser.parse_args()
    kind = options.device.partition(":")[0]
    deadline, rows = time.monotonic() + options.limit, list[dict[str, Any]]()
    jobs = [partial(stepping, s, w, options.device) for s in options.scenes for w in WIDTHS[kind]]
    jobs[3:3] = [partial(training, options.scenes[0], w, options.device) for w in WIDTHS[kind]]
    for job in jobs:  # training comes early, in case there is no time for all scenes
        if time.monotonic() < deadline:
            rows.append(job())
            print(*(f"{key} {value}" for key, value in rows[-1].items()), sep=", ", flush=True)
    machine = torch.cuda.get_device_name() if kind == "cuda" else platform.processor()
    content = {"date": date.today().isoformat(), "machine": machine, "versions": versions()}
    options.out.write_text(json.dumps(content | {"rows": rows}, indent=1) + "\n")
    show(rows)


def stepping(task: str, width: int, device: str) -> dict[str, Any]:
    """Return control steps per second of N simulations with noisy actions, MDP included."""
    env, compile_s = made(task, width, device)
    steps = STEPS[device.partition(":")[0]]
    torch.manual_seed(0)
    actions = [
        env.warm_start().to(env.device)
        + 0.1 * torch.randn(width, env.action_dim, device=env.device)
        for _ in range(8)
    ]
    env.step(actions[0])
    synchronize(env.device)
    began, diverged = time.perf_counter(), torch.zeros((), device=env.device)
    for k in range(steps):
        diverged += env.step(actions[k % len(actions)])[3].sum()
    synchronize(env.device)
    return {
        "what": "control steps",
        "task": task,
        "simulations": width,
        "per_s": width * steps / (time.perf_counter() - began),
        "set_up_s": compile_s,
        "diverged": float(diverged) / (width * steps),
        "memory_gib": memory(env.device),
    }


class Timer(Callback):
    """Notes when each iteration ended."""

    def __init__(self, device: torch.device) -> None:
        self._device, self.marks = device, list[tuple[int, float]]()

    def on_iteration(self, progress: Progress, metrics: dict[str, float]) -> None:
        """Note the time."""
        synchronize(self._device)
        self.marks.append((progress.frames, time.perf_counter()))


def training(task: str, width: int, device: str) -> dict[str, Any]:
    """Return frames per second of a run, the first iteration left out."""
    env, _ = made(task, width, device)
    # The same number of gradient steps for every number of simulations.
    sizes = [f"num_envs={width}", f"algo.minibatch_size={width}"]
    cfg = compose([f"task={task}", "algo=ppo_wide", *sizes]).algo
    frames = 6 * width * cfg.steps_per_env
    timer = Timer(env.device)
    settings = TrainerCfg(
        algo=cfg,
        seed=0,
        total_frames=frames,
        time_limit_s=None,
        eval_interval_frames=0,
        checkpoint_interval_s=1e9,
        device=device,
        num_threads=1,
    )
    Trainer(env, settings, Extras(callbacks=[timer])).run()
    (first, began), (last, ended) = timer.marks[0], timer.marks[-1]
    per_s = (last - first) / (ended - began)
    return {
        "what": "training ppo_wide",
        "task": task,
        "simulations": width,
        "per_s": per_s,
        "minutes_to_50M": PAPER_FRAMES / per_s / 60,
        "memory_gib": memory(env.device),
    }


def made(task: str, width: int, device: str) -> tuple[BatchEnv, float]:
    """Return an environment and the time to create it, kernel compilation included, s."""
    began = time.perf_counter()
    cfg = compose([f"task={task}", "sim=warp"])
    library = ensure(cfg.task.motion, False, print)
    env = env_builder(cfg, library, print).make(width, device=device)
    return env, time.perf_counter() - began


def synchronize(device: torch.device) -> None:
    """Wait for a GPU to finish."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def memory(device: torch.device) -> float | None:
    """Return the memory in use on a GPU by all processes, GiB."""
    if device.type != "cuda":
        return None
    free, total = torch.cuda.mem_get_info(device)
    return (total - free) / 2**30


def show(rows: list[dict[str, Any]]) -> None:
    """Print rows as a table."""
    table = Table("", "task", "simulations", "per s", "to 50M (min)", "set-up (s)", "GiB")
    for row in rows:
        values = [row.get(key) for key in ("minutes_to_50M", "set_up_s", "memory_gib")]
        rest = ["" if value is None else f"{value:.1f}" for value in values]
        table.add_row(
            row["what"], row["task"], f"{row['simulations']:,}", f"{row['per_s']:,.0f}", *rest
        )
    Console().print(table)


if __name__ == "__main__":
    main()
