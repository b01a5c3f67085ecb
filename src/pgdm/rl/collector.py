"""Acting in an environment: a TorchRL collector that can be saved and restored bit-exactly."""

from __future__ import annotations

import math
import warnings
from collections import OrderedDict
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.weight_update.weight_sync_schemes import WeightStrategy

from pgdm.errors import ConfigError, RunError
from pgdm.rl.torch_state import Aside, drawing_from, torch_threads
from pgdm.rl.vec_env import FinishedEpisodes, VecEnv
from pgdm.seeding import torch_stream

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # about TorchRL's own classes
    from torchrl.collectors import BaseCollector

if TYPE_CHECKING:
    from pgdm.rl.learner import Learner

_STREAM = "actions"


class RolloutCollector(BaseCollector):
    """Steps N simulations with a policy and yields rollouts of T steps each.

    TorchRL's own collectors sample actions from torch's global random stream and cannot save the
    state of the simulations. This class has its own random stream and a complete ``state_dict``: a
    collector restored from it continues bit-exactly.

    A rollout is a new TensorDict of batch size [N, T] on the environment's device. It holds
    ``observation`` (N, T, D), the policy's outputs, such as ``action`` (N, T, A), and under
    ``next``: ``observation`` (N, T, D), at an episode's end the last before the restart;
    ``reward``, ``terminated``, ``truncated`` and ``done``, each (N, T, 1); ``raw_terms``
    {name: (N, T)}, the reward terms before weighting; ``discount`` (N, T, 1), if the environment
    returns discounts.

    Args:
        env: the simulations; finished ones restart automatically. They are reset here.
        policy: reads ``observation`` (N, D), writes ``action`` (N, A). It is not copied, so a
            training loop that changes its weights in place needs no `update_policy_weights_`.
        frames_per_batch: N * T, environment steps in a rollout.
        total_frames: environment steps after which iteration stops, rounded up to whole rollouts;
            -1: unlimited.
        seed: seed of the action noise.
        learner: its ``during_step`` runs during each step, its ``after_step`` after it.

    Raises:
        ConfigError: if ``frames_per_batch`` is not a multiple of N.
    """

    def __init__(
        self,
        env: VecEnv,
        policy: TensorDictModuleBase,
        *,
        frames_per_batch: int,
        total_frames: int = -1,
        seed: int = 0,
        learner: Learner | None = None,
    ) -> None:
        super().__init__()
        if frames_per_batch % env.num_envs:
            raise ConfigError(
                f"frames_per_batch {frames_per_batch} is not a multiple of the {env.num_envs} "
                "simulations"
            )
        self.env, self.policy, self.total_frames = env, policy, total_frames
        self.frames_per_batch = self.requested_frames_per_batch = frames_per_batch
        self.metrics: dict[str, float] = {}
        """Last rollout's mean reward per step, finished episodes, and their mean metrics."""
        self._learner, self._frames = learner, 0
        self._generator = torch_stream(seed, _STREAM)
        # What the learner does during a step does not depend on the step's result, so whether the
        # two really overlap changes nothing but the speed.
        self._aside = Aside("pgdm-physics", learner is not None and learner.overlaps)
        self.reset()

    def reset(self) -> None:
        """Restart all simulations."""
        self._obs = self.env.reset()

    def iterator(self) -> Iterator[TensorDict]:
        """Yield rollouts until ``total_frames``.

        Raises:
            RunError: if the environment returns a reward or observation that is not finite.
        """
        while self.total_frames < 0 or self._frames < self.total_frames:
            yield self.rollout()

    def rollout(self) -> TensorDict:
        """Take T steps from where the last rollout stopped; see the class.

        Raises:
            RunError: if the environment returns a reward or observation that is not finite.
        """
        if self.pre_collect_hook is not None:
            self.pre_collect_hook()
        finished: list[FinishedEpisodes] = []
        with torch_threads(1):
            steps = range(self.frames_per_batch // self.env.num_envs)
            columns = _stacked([self._step(t, finished) for t in steps])
        by_time = TensorDict(columns, [len(steps), self.env.num_envs], device=self.env.device)
        self._frames += self.frames_per_batch
        self.metrics = _metrics(by_time, finished)
        rollout = by_time.transpose(0, 1)
        rollout.names = [None, "time"]
        if self.post_collect_hook is not None:
            self.post_collect_hook(rollout)
        return rollout

    def _step(self, t: int, finished: list[FinishedEpisodes]) -> dict[str, Any]:
        """Take a control step; return its columns and append finished episodes to ``finished``.

        Plain dictionaries: one TensorDict per step would make PPO 3% slower.
        """
        seen = TensorDict({"observation": self._obs}, [self.env.num_envs], device=self.env.device)
        random = set_exploration_type(ExplorationType.RANDOM)
        with torch.no_grad(), random, drawing_from(self._generator):
            step: dict[str, Any] = dict(self.policy(seen).items())
        action = step["action"]
        result = self._aside(lambda: self.env.step(action))
        if self._learner is not None:
            self._learner.during_step()
        self._obs, reward, terminated, truncated, info = result()
        # A sum is finite only if all its terms are; it is ten times cheaper than checking each.
        if not math.isfinite(float(reward.sum()) + float(self._obs.sum())):
            _check_finite(t, self._obs, reward, info)
        step["next"] = {
            "observation": info["final_obs"],
            "reward": reward[:, None],
            "terminated": terminated[:, None],
            "truncated": truncated[:, None],
            "done": (terminated | truncated)[:, None],
            "raw_terms": info["raw_terms"],
        }
        if (discount := info.get("discount")) is not None:
            step["next"]["discount"] = discount[:, None]
        if info["episodes"] is not None:
            finished.append(info["episodes"])
        if self._learner is not None:
            self._learner.after_step(step)
        return step

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Reseed the action noise, and the environment if it has a method ``reseed``.

        The simulations keep their states. Returns the seed for the next collector: ``seed`` itself
        if ``static_seed``, else the next integer.
        """
        self._generator.set_state(torch_stream(seed, _STREAM).get_state())
        if (reseed := getattr(self.env, "reseed", None)) is not None:
            reseed(seed)
        return seed if static_seed else seed + 1

    def get_model(self, model_id: str) -> TensorDictModuleBase:
        """Return the policy, the only model here, for TorchRL's weight synchronisation."""
        if model_id != "policy":
            raise KeyError(f"this collector has no model '{model_id}', only 'policy'")
        return self.policy

    def _maybe_fallback_update(
        self, policy_or_weights: Any = None, *, model_id: str | None = None
    ) -> None:
        """Copy weights into the policy. Without weights do nothing: the policy is not a copy."""
        policy = self.get_model(model_id or "policy")
        strategy = WeightStrategy()
        if policy_or_weights is not None:
            strategy.apply_weights(policy, strategy.extract_weights(policy_or_weights))

    def state_dict(self) -> OrderedDict[str, Any]:
        """Return all that the next rollout depends on, except the policy."""
        return OrderedDict(
            env=self.env.state_dict(),
            obs=self._obs.cpu().clone(),
            generator=self._generator.get_state(),
            frames=self._frames,
        )

    def load_state_dict(self, state_dict: OrderedDict[str, Any]) -> None:
        """Continue from ``state_dict``."""
        self.env.load_state_dict(state_dict["env"])
        self._obs = state_dict["obs"].to(self.env.device, copy=True)
        self._generator.set_state(state_dict["generator"])
        self._frames = state_dict["frames"]

    def shutdown(
        self, timeout: float | None = None, close_env: bool = True, raise_on_error: bool = True
    ) -> None:
        """Stop the collector's thread, if it has one; simulations need no closing."""
        self._aside.close()


def _stacked(steps: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the columns of T steps, each stacked along a new first dimension."""
    return {
        name: _stacked([step[name] for step in steps])
        if isinstance(first, dict)
        else torch.stack([step[name] for step in steps])
        for name, first in steps[0].items()
    }


def _metrics(steps: TensorDict, finished: list[FinishedEpisodes]) -> dict[str, float]:
    """Return a rollout's mean reward, number of finished episodes, and their mean metrics.

    Episodes in which a metric is undefined (NaN) are left out of that metric's mean.
    """
    after: Any = steps["next"]
    metrics = {"reward": float(after["reward"].mean()), "episodes": float(after["done"].sum())}
    if not finished:
        return metrics
    episodes = finished[0].with_later(finished[1:]).metrics()
    return metrics | {name: float(values.double().nanmean()) for name, values in episodes.items()}


def _check_finite(t: int, obs: Tensor, reward: Tensor, info: dict[str, Any]) -> None:
    """Raise an error that names the first value that is not finite."""
    terms = {f"reward term '{name}'": value for name, value in info.get("terms", {}).items()}
    for name, values in {**terms, "the reward": reward, "the observation": obs}.items():
        bad = (~torch.isfinite(values)).nonzero()
        if len(bad):
            row, *entry = bad[0].tolist()
            which = f"entry {entry[0]} of " if entry else ""
            raise RunError(
                f"{which}{name} is {float(values[tuple(bad[0])])} in simulation {row} at step {t} "
                "of the iteration; nothing was learned from it, the last checkpoint is good"
            )
