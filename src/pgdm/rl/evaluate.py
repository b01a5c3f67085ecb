"""Measuring a policy: whole episodes, sampled and deterministic, away from the training."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor

from pgdm.errors import CheckpointError
from pgdm.rl.checkpoint import read_checkpoint
from pgdm.rl.collector import torch_threads
from pgdm.rl.networks import ActorCritic, NetworkCfg, SquashedCfg, SquashedPolicy
from pgdm.rl.vec_env import VecEnv
from pgdm.seeding import torch_stream


@dataclass(frozen=True)
class EvalCfg:
    """How and how often a policy is measured."""

    episodes: int
    """Episodes of the sampled policy in one evaluation."""
    interval_frames: int
    """Environment steps between two evaluations; 0: only at the start and the end."""
    video: bool
    """Whether to record a video of the evaluated policy."""
    video_every_eval: bool
    """Whether to record it at every evaluation, not only at the last."""


class Policy(Protocol):
    """Anything that can be evaluated."""

    def act(
        self, obs: Tensor, generator: torch.Generator | None = None, deterministic: bool = False
    ) -> Tensor:
        """Return actions (N, A) for observations (N, D)."""
        ...


def run_episodes(
    env: VecEnv,
    policy: Policy,
    generator: torch.Generator | None,
    stop: Callable[[], bool] = lambda: False,
) -> dict[str, Tensor] | None:
    """Run one episode in each simulation, from a reset on.

    Simulations that finish early go on, but only their first episode counts.

    Args:
        env: the environment; all its simulations are restarted.
        policy: who acts.
        generator: stream of the action noise; None: the deterministic policy.
        stop: asked before each step; True gives up.

    Returns:
        Each metric's value (N,) in every simulation's episode, or None if it was stopped.
    """
    obs = env.reset()
    waiting = torch.ones(env.num_envs, dtype=torch.bool)
    results: dict[str, Tensor] = {}
    with torch_threads(1):  # simulations need the cores, see torch_threads
        while waiting.any():
            if stop():
                return None
            action = policy.act(obs, generator, deterministic=generator is None)
            obs, _, terminated, truncated, info = env.step(action)
            rows = (terminated | truncated).nonzero()[:, 0]
            first = waiting[rows]
            finished = info["episodes"]
            for name, values in (finished.metrics() if len(rows) else {}).items():
                column = results.setdefault(name, torch.full((env.num_envs,), torch.nan).double())
                column[rows[first]] = values[first].double()
            waiting[rows] = False
    return results


class Evaluator:
    """Measures a policy on simulations of its own.

    Every evaluation starts from the same state of the simulations and of the noise, so it depends
    on the policy alone: a run that was stopped and resumed measures the same.

    Args:
        make_env: builds an environment of so many simulations; called once for each of the two.
        episodes: episodes of the sampled policy.
        deterministic_episodes: of the deterministic one; 1 unless the task itself is random.
        seed: the run's seed.
    """

    def __init__(
        self,
        make_env: Callable[[int], VecEnv],
        episodes: int,
        deterministic_episodes: int,
        seed: int,
    ) -> None:
        self._make_env, self._seed = make_env, seed
        self._episodes = {
            "eval_sampled": episodes,
            "eval_deterministic": deterministic_episodes,
        }
        self._envs: dict[str, VecEnv] = {}
        self._starts: dict[str, dict] = {}

    def evaluate(
        self, policy: Policy, stop: Callable[[], bool] = lambda: False
    ) -> dict[str, float] | None:
        """Return ``eval_sampled/<metric>``, ``eval_deterministic/<metric>``, means over episodes.

        Where there are several episodes, ``<metric>_std`` is their (sample) standard deviation.
        None if ``stop`` said so.
        """
        metrics: dict[str, float] = {}
        for kind in self._episodes:
            noise = torch_stream(self._seed, "eval") if kind == "eval_sampled" else None
            results = run_episodes(self._fresh(kind), policy, noise, stop)
            if results is None:
                return None
            metrics |= summarise(results, prefix=f"{kind}/")
        return metrics

    def _fresh(self, kind: str) -> VecEnv:
        """Return the environment of one kind as it was when new."""
        if kind not in self._envs:
            env = self._envs[kind] = self._make_env(self._episodes[kind])
            env.reset()
            self._starts[kind] = env.state_dict()
        self._envs[kind].load_state_dict(self._starts[kind])
        return self._envs[kind]


def summarise(results: dict[str, Tensor], prefix: str = "") -> dict[str, float]:
    """Return each metric's mean over its episodes (k,), and its spread where k > 1.

    Episodes in which a metric does not apply have NaN, and are left out.
    """
    summary: dict[str, float] = {}
    for name, values in results.items():
        known = values[~values.isnan()]
        summary[f"{prefix}{name}"] = float(known.mean())
        if len(values) > 1:
            summary[f"{prefix}{name}_std"] = float(known.std()) if len(known) > 1 else math.nan
    return summary


def load_policy(path: Path) -> ActorCritic | SquashedPolicy:
    """Return the policy of a checkpoint, on the CPU, with its observation statistics.

    Raises:
        CheckpointError: if the file is missing, damaged or holds no policy.
    """
    state = read_checkpoint(path)
    try:
        network = state["network"]
        squashed = "kind" in network  # an ActorCritic's says none
        model = (
            SquashedPolicy(SquashedCfg(**network))
            if squashed
            else ActorCritic(NetworkCfg(**network))
        )
        model.load_state_dict(state["learner"]["model"])
    except (KeyError, TypeError, RuntimeError) as error:
        raise CheckpointError(f"{path} holds no policy of this version: {error}") from error
    return model.eval()
