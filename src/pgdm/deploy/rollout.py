"""Episodes of a policy with all data that a playback needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from pgdm.envs.batch_env import BatchEnv
from pgdm.errors import RunError, amount
from pgdm.rl.evaluate import Policy


@dataclass(frozen=True)
class Rollout:
    """One episode of T control steps."""

    commands: np.ndarray  # (T, nu) targets of the hand's joints at control steps, m and rad
    qpos: np.ndarray  # (T+1, nq) before each step and after the last
    object_pos: np.ndarray  # (T+1, 3) m, centre of mass, world frame
    object_quat: np.ndarray  # (T+1, 4) wxyz
    dt_s: float
    metrics: dict[str, float]
    variation: dict[str, float]
    """Friction, half-width (m) and mass (kg) of a randomised object; empty for other objects."""


def roll_out(
    env: BatchEnv,
    policy: Policy,
    generator: torch.Generator | None,
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> list[Rollout]:
    """Run one episode in each simulation.

    Args:
        env: N simulations, ``auto_reset=False``.
        policy: the policy.
        generator: stream of the action noise; None: the mean action.
        progress: called with the steps taken and the total.

    Returns:
        The episodes that lasted to the end of the motion, sorted by mean object error, the best
        first.

    Raises:
        RunError: if no episode did.
    """
    obs, total = env.reset(), len(env.mdp.reference) - 1
    states, commands = [env.sim.read()], []
    alive, closest = np.ones(env.num_envs, bool), np.zeros(env.num_envs)
    metrics: dict[str, torch.Tensor] = {}
    for step in range(total):
        progress(step, total)
        action = policy.act(obs, generator, deterministic=generator is None)
        commands.append(env.mdp.actions.act(action, env.t).numpy())
        obs, _, terminated, truncated, info = env.step(action)
        states.append(env.sim.read())
        closest += env.object_error().numpy()
        ended = (terminated | truncated).numpy()
        if step < total - 1:
            alive &= ~ended
        else:  # the motion ends, and with it all episodes
            metrics = info["episodes"].metrics()
    whole = np.flatnonzero(alive)
    if not len(whole):
        raise RunError(
            f"of {amount(env.num_envs, 'episode')} none can be played: the policy loses the "
            "object, or the simulation diverges, before the end of the motion; train longer, or "
            "roll out more --episodes"
        )
    columns = {
        key: np.stack([getattr(state, key).numpy() for state in states], 1)
        for key in ("qpos", "object_pos", "object_quat")
    }
    targets, dt_s = np.stack(commands, 1), env.sim.control_dt_s
    return [
        Rollout(
            commands=targets[i],
            qpos=columns["qpos"][i],
            object_pos=columns["object_pos"][i],
            object_quat=columns["object_quat"][i],
            dt_s=dt_s,
            metrics={name: float(values[i]) for name, values in metrics.items()},
            variation=_variation(env, i),
        )
        for i in whole[np.argsort(closest[whole], kind="stable")]
    ]


def _variation(env: BatchEnv, row: int) -> dict[str, float]:
    if env.sim.scene.index.randomized_geom is None:
        return {}
    friction, half_width, mass = env.sim.variation()
    drawn = {"friction": friction[row, 0], "half_width_m": half_width[row], "mass_kg": mass[row]}
    return {name: float(value) for name, value in drawn.items()}
