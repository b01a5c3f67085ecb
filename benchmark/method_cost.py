"""Measure the time of a method's terms in the batch env, for rows of ``throughput.py``."""

from __future__ import annotations

import time

import torch
from rich.console import Console

from pgdm.config.compose import compose
from pgdm.envs.build import EnvBuilder
from pgdm.experiment import env_builder
from pgdm.library import open_library
from pgdm.methods import METHODS

STEPS = 200  # control steps of all simulations in one measurement, as the differences are small
IMITATING = ("deepmimic", "full")


def step_methods_in_turn(builders: dict[str, EnvBuilder], num_envs: int) -> dict[str, float]:
    """Step an env of each method in turn with the same actions; return the time of each, s."""
    generator = torch.Generator().manual_seed(0)
    envs = {name: builder.make(num_envs) for name, builder in builders.items()}
    spent = dict.fromkeys(envs, 0.0)
    for step in range(STEPS):
        first = next(iter(envs.values()))
        noise = torch.randn((num_envs, first.action_dim), generator=generator)
        action = first.warm_start() + 0.2 * noise
        names = list(envs)
        # The order rotates, since each env runs with caches that the previous env has filled.
        for name in names[step % len(names) :] + names[: step % len(names)]:
            start = time.perf_counter()
            envs[name].step(action)
            spent[name] += time.perf_counter() - start
    return spent


def measure_methods(
    task: str, num_envs: int, rounds: int, console: Console
) -> dict[str, list[float]]:
    """Return each method's speed in every round, in steps/s and relative to PGDM's."""
    torch.set_num_threads(1)
    library = open_library()
    # Without the methods' own terminations, all of them step the same states.
    same = ["method.imitation.max_hand_error=null"]
    builders = {
        name: env_builder(
            compose([f"task={task}", f"method={name}", *(same if name in IMITATING else [])]),
            library,
        )
        for name in METHODS
    }
    speeds: dict[str, list[float]] = {}
    for number in range(rounds):
        with console.status(f"methods, round {number + 1} of {rounds}"):
            spent = step_methods_in_turn(builders, num_envs)
        for name, seconds in spent.items():
            speed = STEPS * num_envs / seconds
            speeds.setdefault(f"make_batch method={name}", []).append(speed)
            ratio = spent["pgdm"] / seconds
            speeds.setdefault(f"make_batch method={name} / pgdm", []).append(ratio)
    return speeds
