"""The interface that collector and learners need of an environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, Self

import torch
from torch import Tensor

VecStep = tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]


class FinishedEpisodes(Protocol):
    """Episodes that have finished, in the order of their rows."""

    def metrics(self) -> dict[str, Tensor]:
        """Return each metric's values (k,), in the order of the episodes."""
        ...

    def with_later(self, later: Sequence[Self]) -> Self:
        """Return one object with these episodes, then the later ones."""
        ...


class VecEnv(Protocol):
    """N copies of one task, stepped together.

    All tensors are on ``device``, and those returned are not changed later. After ``terminated``
    nothing is bootstrapped. After ``truncated`` the episode could have continued: bootstrap from
    the value of ``info["final_obs"]``.
    """

    num_envs: int
    """N, number of simulations."""
    obs_dim: int
    """D, numbers in an observation."""
    action_dim: int
    """A, numbers in an action."""
    device: torch.device
    """Device of all tensors except those in ``state_dict``, which are on the CPU."""

    def reset(self) -> Tensor:
        """Restart all simulations; return observations (N, D) float32."""
        ...

    def step(self, action: Tensor) -> VecStep:
        """Take one control step with actions (N, A) float32; the environment clips them.

        Returns:
            obs (N, D) float32, for finished rows the first after the restart; reward (N,) float32;
            terminated (N,) bool; truncated (N,) bool; info with ``final_obs`` (N, D), for
            finished rows the last observation before the restart; ``episodes``, the
            `FinishedEpisodes` in the order of their rows, or None; the reward terms {name: (N,)}
            before (``raw_terms``) and after (``terms``) weighting; and optionally ``discount``
            (N,) in [0, 1], a factor on all rewards after the step, by default 1.
        """
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return everything the next step depends on, as tensors and plain containers."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``, bit-exactly."""
        ...

    def warm_start(self) -> Tensor | None:
        """Return the action (A,) that a policy's mean should start at, or None."""
        ...

    def reward_weights(self) -> dict[str, float]:
        """Return the current weight of each reward term, in the order of ``raw_terms``."""
        ...

    def set_weights(self, weights: dict[str, float]) -> None:
        """Change reward weights by term name."""
        ...
