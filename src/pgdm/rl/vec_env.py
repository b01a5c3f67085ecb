"""What the learner asks of an environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, Self

from torch import Tensor

VecStep = tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]


class Finished(Protocol):
    """Episodes that have ended."""

    def metrics(self) -> dict[str, Tensor]:
        """Return each metric's values (k,), in the order of the episodes."""
        ...

    def with_later(self, later: Sequence[Self]) -> Self:
        """Return these episodes and others as one, in this order."""
        ...


class VecEnv(Protocol):
    """N copies of one task, stepped together; all tensors are on the CPU.

    ``terminated`` says that nothing comes after: the learner adds no value of the last
    observation. ``truncated`` says that the episode was cut although it could have gone on: the
    value of ``info["final_obs"]`` stands for the rest.
    """

    num_envs: int
    """N, number of simulations."""
    obs_dim: int
    """D, numbers in an observation."""
    action_dim: int
    """A, numbers in an action."""

    def reset(self) -> Tensor:
        """Restart all simulations; return observations (N, D) float32."""
        ...

    def step(self, action: Tensor) -> VecStep:
        """Take one control step with actions (N, A) float32; the environment clips them.

        Returns:
            obs (N, D) float32, of finished rows those after the restart; reward (N,) float32;
            terminated (N,) bool; truncated (N,) bool; info with ``final_obs`` (N, D), the true
            last observations, ``episodes``, those that finished (`Finished`) in the order of
            their rows, or None, and {name: (N,)} of the reward terms, ``raw_terms`` before and
            ``terms`` after weighting; ``discount`` (N,) in [0, 1], by which what comes after the
            step counts less, or None, or nothing, for 1.
        """
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return everything the next step depends on, as tensors and plain containers."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``, to the bit."""
        ...

    def warm_start(self) -> Tensor | None:
        """Return the action (A,) a policy's mean should start from, or None."""
        ...

    def reward_weights(self) -> dict[str, float]:
        """Return the weight of each reward term now, in the order of ``raw_terms``."""
        ...

    def set_weights(self, weights: dict[str, float]) -> None:
        """Change reward weights by term name."""
        ...
