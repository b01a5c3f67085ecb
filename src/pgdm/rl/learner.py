"""What the trainer asks of a learner: PPO and SAC differ behind it, and nowhere else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import torch
from torch import Tensor

from pgdm.rl.collector import Rollout, Step
from pgdm.rl.vec_env import VecEnv


@dataclass(frozen=True)
class AlgoCfg:
    """Settings that every learner has."""

    usual_steps_per_s: ClassVar[float] = 1_000.0
    """Environment steps a second, between two idle cores and two busy ones."""
    usual_frame_bytes: ClassVar[int] = 0
    """What each frame takes on the disk as long as a run goes on; about."""

    learner: str
    """``ppo`` or ``sac``."""
    name: str
    """Name of the settings, as reports show it."""
    gamma: float
    """Discount per control step, 0..1."""
    learning_rate: float
    """Step size of Adam."""
    steps_per_env: int
    """T, control steps of each simulation in one iteration."""
    hidden: list[int]
    """Widths of the hidden layers of each network."""
    log_std_init: float
    """Log of the policy's standard deviation at the start."""
    warm_start: bool
    """Whether the policy's mean starts at the environment's ``warm_start()``."""
    observation_clip: float
    """Standardised observations are clipped here, standard deviations."""

    def check(self, num_envs: int) -> None:
        """Check what depends on the number of simulations.

        Raises:
            ConfigError: with the values, if they do not fit.
        """

    def disk_bytes(self, env: VecEnv, num_envs: int, total_frames: int) -> int:
        """Return the bytes that a training of so many frames keeps on the disk as it goes."""
        return 0


class Model(Protocol):
    """A policy that a learner improves."""

    @property
    def cfg(self) -> Any:
        """What it is built from, with ``as_dict()``."""
        ...

    def sample(self, obs: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw actions (N, A) at raw observations (N, D); return them and the policy's means."""
        ...

    def act(
        self, obs: Tensor, generator: torch.Generator | None = None, deterministic: bool = False
    ) -> Tensor:
        """Return actions (N, A) on the CPU for raw observations (N, D)."""
        ...


class Learner(Protocol):
    """Improves a policy from what it did."""

    @property
    def model(self) -> Model:
        """The policy that acts."""
        ...

    @property
    def overlaps(self) -> bool:
        """Whether ``during_step`` has work that may go on beside the physics of a step."""
        ...

    def during_step(self) -> None:
        """Work while the simulations take a step, with what was seen before it."""
        ...

    def after_step(self, step: Step) -> None:
        """Take in what a step led to."""
        ...

    def learn(self, rollout: Rollout) -> dict[str, float]:
        """Work after an iteration's last step; return what is logged.

        Raises:
            RunError: if a loss or gradient is not finite; that step is then not taken.
        """
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return all that the next iteration depends on."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``."""
        ...
