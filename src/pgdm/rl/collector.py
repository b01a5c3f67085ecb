"""Acting in the environment and keeping what happened."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor

from pgdm.errors import RunError
from pgdm.rl.vec_env import Finished, VecEnv

if TYPE_CHECKING:
    from pgdm.rl.learner import Learner


T = TypeVar("T")


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch use ``count`` threads inside.

    While simulations step, torch gets one: its helper threads keep a core spinning for about
    4 ms after each call (libgomp), which the simulation's own threads need.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class Aside:
    """Work that may go on in a second thread, with one thread of torch.

    Args:
        name: of the thread.
        wanted: whether there is one; if not, work is done when its result is asked for.
    """

    def __init__(self, name: str, wanted: bool) -> None:
        self._pool = None
        if wanted:
            one = {"initializer": torch.set_num_threads, "initargs": (1,)}
            self._pool = ThreadPoolExecutor(1, name, **one)

    def __call__(self, work: Callable[[], T]) -> Callable[[], T]:
        """Start work; call what is returned for its result."""
        return work if self._pool is None else self._pool.submit(work).result


@dataclass(frozen=True)
class Step:
    """One control step of N simulations."""

    obs: Tensor
    """(N, D) observations that were acted upon."""
    action: Tensor
    """(N, A) actions as sampled."""
    terminated: Tensor
    """(N,) bool, nothing came after."""
    truncated: Tensor
    """(N,) bool, the episode was cut."""
    info: dict[str, Any]
    """As the environment gave it: ``final_obs``, ``raw_terms`` and more."""


@dataclass
class Rollout:
    """T steps of N simulations. The tensors are reused by the next iteration."""

    obs: Tensor
    """(T + 1, N, D) observations as the environment gave them; the last are those to go on from."""
    action: Tensor
    """(T, N, A) actions as sampled."""
    mean: Tensor
    """(T, N, A) the policy's means that they were sampled around."""
    reward: Tensor
    """(T, N) rewards."""
    terminated: Tensor
    """(T, N) bool, nothing came after."""
    truncated: Tensor
    """(T, N) bool, the episode was cut."""
    discount: Tensor | None = None
    """(T, N) in [0, 1], by how much what comes after the step counts less, besides gamma."""
    last_obs: list[tuple[int, Tensor, Tensor]] = field(default_factory=list)
    """Of each step with truncated rows: t, the rows (k,), their true last observations (k, D)."""
    finished: list[Finished] = field(default_factory=list)
    """Episodes that finished, one entry a step."""

    @classmethod
    def empty(cls, steps: int, env: VecEnv) -> Rollout:
        """Return room for ``steps`` steps of an environment."""
        n = env.num_envs
        return cls(
            obs=torch.zeros(steps + 1, n, env.obs_dim),
            action=torch.zeros(steps, n, env.action_dim),
            mean=torch.zeros(steps, n, env.action_dim),
            reward=torch.zeros(steps, n),
            terminated=torch.zeros(steps, n, dtype=torch.bool),
            truncated=torch.zeros(steps, n, dtype=torch.bool),
        )

    def metrics(self) -> dict[str, float]:
        """Return the mean reward of a step, and the means over the finished episodes, if any.

        An episode in which a metric does not apply has NaN, and is left out of its mean.
        """
        count = int((self.terminated | self.truncated).sum())
        metrics = {"reward": float(self.reward.mean()), "episodes": float(count)}
        if not self.finished:
            return metrics
        episodes = self.finished[0].with_later(self.finished[1:]).metrics()
        return metrics | {
            name: float(values.double().nanmean()) for name, values in episodes.items()
        }


class Collector:
    """Steps the environment with a learner's policy and fills one rollout after the other.

    Args:
        env: the environment.
        learner: whose policy acts; it may work beside each step and takes in what came of it.
        steps: T, steps of each simulation in a rollout.
        generator: stream of the action noise.
    """

    def __init__(
        self, env: VecEnv, learner: Learner, steps: int, generator: torch.Generator
    ) -> None:
        self.env, self.learner = env, learner
        self.steps, self.generator = steps, generator
        self._rollout = Rollout.empty(steps, env)
        # The policy that acts never waits for the learner's work beside the step before: whether
        # both really happen at the same time changes nothing but the speed.
        self._aside = Aside("pgdm-physics", learner.overlaps)

    @property
    def frames(self) -> int:
        """Environment steps in one rollout."""
        return self.steps * self.env.num_envs

    def reset(self) -> None:
        """Start all simulations afresh."""
        self._rollout.obs[-1] = self.env.reset()

    def collect(self) -> Rollout:
        """Go on from where the last rollout ended, for ``steps`` steps.

        Raises:
            RunError: if the environment gives a reward or an observation that is not finite.
        """
        rollout = self._rollout
        rollout.obs[0] = rollout.obs[-1].clone()
        rollout.last_obs, rollout.finished = [], []
        with torch_threads(1):
            for t in range(self.steps):
                self._step(rollout, t)
        return rollout

    def _step(self, rollout: Rollout, t: int) -> None:
        acted_on, action = rollout.obs[t], rollout.action[t]
        rollout.action[t], rollout.mean[t] = self.learner.model.sample(acted_on, self.generator)
        result = self._aside(lambda: self.env.step(action))
        self.learner.during_step()
        obs, reward, terminated, truncated, info = result()
        rollout.obs[t + 1], rollout.reward[t] = obs, reward
        rollout.terminated[t], rollout.truncated[t] = terminated, truncated
        if (discount := info.get("discount")) is not None:
            if rollout.discount is None:
                rollout.discount = torch.ones_like(rollout.reward)
            rollout.discount[t] = discount
        # A sum is finite only if all its parts are, and costs a tenth of looking at each.
        if not math.isfinite(float(reward.sum()) + float(obs.sum())):
            _check_finite(t, obs, reward, info)
        self.learner.after_step(Step(acted_on, action, terminated, truncated, info))
        if truncated.any():
            rows = truncated.nonzero()[:, 0]
            rollout.last_obs.append((t, rows, info["final_obs"][rows].clone()))
        if info["episodes"] is not None:
            rollout.finished.append(info["episodes"])

    def state_dict(self) -> dict[str, Any]:
        """Return what the next rollout depends on, the policy aside."""
        return {
            "env": self.env.state_dict(),
            "obs": self._rollout.obs[-1].clone(),
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``."""
        self.env.load_state_dict(state["env"])
        self._rollout.obs[-1] = state["obs"]
        self.generator.set_state(state["generator"])


def _check_finite(t: int, obs: Tensor, reward: Tensor, info: dict[str, Any]) -> None:
    """Raise an error that names the first bad number."""
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
