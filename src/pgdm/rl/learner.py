"""The interface between trainer and learner, which PPO and SAC implement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import torch
from torch import Tensor

from pgdm.rl.vec_env import VecEnv

if TYPE_CHECKING:  # torchrl takes 2 s to import
    from tensordict import TensorDict


@dataclass(frozen=True)
class AlgoCfg:
    """Settings that every learner has."""

    usual_steps_per_s: ClassVar[float] = 1_000.0
    """Typical training speed on two cores that are partly busy with other work, frames/s."""
    usual_frame_bytes: ClassVar[int] = 0
    """Approximate disk space that each frame needs until the run has finished, bytes."""

    learner: str
    """``ppo`` or ``sac``."""
    name: str
    """Name of these settings, as shown in reports."""
    gamma: float
    """Discount per control step, 0..1."""
    learning_rate: float
    """Step size of Adam."""
    steps_per_env: int
    """T, control steps of each simulation in one iteration."""
    hidden: list[int]
    """Widths of the hidden layers, of each network."""
    log_std_init: float
    """Log of the policy's standard deviation at the start."""
    warm_start: bool
    """Whether the policy's mean starts at the environment's ``warm_start()``."""
    observation_clip: float
    """Standardised observations are clipped to plus or minus this many standard deviations."""

    def check(self, num_envs: int) -> None:
        """Check the settings, also against the number of simulations.

        Raises:
            ConfigError: if they are invalid; the message has the values.
        """

    @property
    def networks(self) -> int:
        """Number of trained networks, each with the layers ``hidden``."""
        return 2

    def memory_bytes(self, env: VecEnv, num_envs: int) -> int:
        """Estimate the memory of a rollout, networks, gradients and Adam's averages, bytes."""
        widths = [env.obs_dim, *self.hidden, env.action_dim]
        weights = self.networks * sum(a * b for a, b in pairwise(widths))
        frame = 2 * (env.obs_dim + env.action_dim)
        return 4 * (4 * weights + num_envs * self.steps_per_env * frame)

    def disk_bytes(self, env: VecEnv, num_envs: int, total_frames: int) -> int:
        """Return the disk space that a run of ``total_frames`` needs while it runs, bytes."""
        return 0


class Model(Protocol):
    """A policy that a learner improves."""

    @property
    def cfg(self) -> Any:
        """Settings from which the policy is built, a dataclass of plain values."""
        ...

    def sample(
        self, obs: Tensor, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor]:
        """Draw actions (N, A) at raw observations (N, D); return them and the policy's means."""
        ...

    def act(
        self, obs: Tensor, generator: torch.Generator | None = None, deterministic: bool = False
    ) -> Tensor:
        """Return actions (N, A) on the CPU for raw observations (N, D)."""
        ...


class Learner(Protocol):
    """Improves a policy from its experience: during each step, after it, and after each rollout."""

    @property
    def model(self) -> Model:
        """The policy that acts."""
        ...

    @property
    def overlaps(self) -> bool:
        """Whether ``during_step`` may run in parallel with the physics."""
        ...

    def explore(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Draw training actions (N, A) at raw observations (N, D); return them and the means."""
        ...

    def during_step(self) -> None:
        """Learn while the simulations take a step, from earlier steps only.

        Raises:
            RunError: if a loss is not finite.
        """
        ...

    def after_step(self, step: Mapping[str, Any]) -> None:
        """Receive the step just taken: nested columns (N, ...) with the keys of a rollout."""
        ...

    def learn(self, rollout: TensorDict) -> dict[str, float]:
        """Learn from an iteration's rollout [N, T]; return metrics to log.

        Raises:
            RunError: if a loss, gradient or weight is not finite.
        """
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return all that the next iteration depends on."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``."""
        ...
