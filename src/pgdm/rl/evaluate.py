"""Evaluation of a policy: whole episodes, sampled and deterministic, in separate simulations."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from pgdm.errors import CheckpointError
from pgdm.rl.checkpoint import State
from pgdm.rl.networks import ActorCritic, NetworkCfg, SquashedCfg, SquashedPolicy
from pgdm.rl.torch_state import torch_threads
from pgdm.rl.vec_env import VecEnv
from pgdm.seeding import torch_stream


@dataclass(frozen=True)
class EvalCfg:
    """How and how often a policy is evaluated."""

    episodes: int
    """Episodes of the sampled policy in one evaluation. The deterministic policy runs one episode,
    or as many as the sampled one if the task is randomised."""
    interval_frames: int
    """Environment steps between two evaluations; 0: only before and after the training."""
    video: bool
    """Whether to record a video of the evaluated policy."""
    video_every_eval: bool
    """Whether to record a video at every evaluation instead of only the last."""


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
    """Run one episode in each simulation, starting with a reset.

    Simulations that finish early continue, but only their first episode counts.

    Args:
        env: the environment; all its simulations are restarted.
        policy: the policy to evaluate.
        generator: stream of the action noise; None: the deterministic policy.
        stop: polled before each step; True abandons the evaluation.

    Returns:
        Each metric's values (N,), one per simulation, or None if it was stopped.
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
    """Evaluates a policy in simulations used for nothing else.

    Every evaluation starts from the same simulation states and random streams, so its result
    depends on the policy alone, also after a run was stopped and resumed.

    Args:
        make_env: builds an environment with the given number of simulations; called once for the
            sampled and once for the deterministic policy.
        episodes: episodes of the sampled policy.
        deterministic_episodes: episodes of the deterministic policy; 1 unless the task itself is
            randomised.
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
        """Return each metric's mean over episodes, or None if stopped.

        Keys are ``eval_sampled/<metric>`` and ``eval_deterministic/<metric>``; with several
        episodes, ``..._std`` is the sample standard deviation.
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
        """Return the environment of one kind in its initial state."""
        if kind not in self._envs:
            env = self._envs[kind] = self._make_env(self._episodes[kind])
            env.reset()
            self._starts[kind] = env.state_dict()
        self._envs[kind].load_state_dict(self._starts[kind])
        return self._envs[kind]


def summarise(results: dict[str, Tensor], prefix: str = "") -> dict[str, float]:
    """Return each metric's mean over k episodes, and its sample standard deviation if k > 1.

    Episodes in which a metric is undefined (NaN) are left out.
    """
    summary: dict[str, float] = {}
    for name, values in results.items():
        known = values[~values.isnan()]
        summary[f"{prefix}{name}"] = float(known.mean())
        if len(values) > 1:
            summary[f"{prefix}{name}_std"] = float(known.std()) if len(known) > 1 else math.nan
    return summary


def policy_of(state: State, path: Path) -> ActorCritic | SquashedPolicy:
    """Return the policy in a checkpoint's state.

    Raises:
        CheckpointError: if the state holds no policy; the message names ``path``, its file.
    """
    try:
        return network_of(state["network"], state["learner"]["model"])
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        reason = f"{type(error).__name__}: {error!s:.200}"
        raise CheckpointError(f"{path} holds no policy of this version ({reason})") from error


def network_of(
    settings: Mapping[str, Any], weights: Mapping[str, Tensor]
) -> ActorCritic | SquashedPolicy:
    """Return a policy from its settings and its state dict; float16 weights become float32.

    Raises:
        LookupError, TypeError, ValueError, AttributeError, RuntimeError: if settings or weights
            are invalid or do not match.
    """
    with torch.device("meta"):  # allocate nothing: the sizes come from a file
        squashed = "kind" in settings  # absent from the settings of an ActorCritic
        model = (
            SquashedPolicy(SquashedCfg(**settings))
            if squashed
            else ActorCritic(NetworkCfg(**settings))
        )
    kinds = {name: value.dtype for name, value in model.state_dict().items()}
    fitting = {name: value.to(kinds.get(name, value.dtype)) for name, value in weights.items()}
    model.load_state_dict(fitting, assign=True)
    return model.eval()
