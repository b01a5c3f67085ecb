"""Running mean and variance of observations."""

from __future__ import annotations

import torch
from torch import Tensor, nn

EPS = 1e-8
"""Added to the variance, as stable-baselines3 does, so that constant entries become 0."""


class Normalizer(nn.Module):
    """Standardises observations by the mean and variance of those passed to ``update``.

    Before the first ``update`` it only clips. PPO calls ``update`` after an iteration's gradient
    steps, so that acting and learning use the same statistics; SAC calls it after every step.

    Args:
        size: D, numbers in an observation.
        clip: results are clipped to this many standard deviations.
    """

    count: Tensor
    mean: Tensor
    var: Tensor

    def __init__(self, size: int, clip: float) -> None:
        super().__init__()
        self.clip = clip
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("var", torch.ones(size, dtype=torch.float64))

    def forward(self, obs: Tensor) -> Tensor:
        """Return observations (..., D) standardised and clipped, float32."""
        scale = (self.var + EPS).rsqrt().float()
        return ((obs - self.mean.float()) * scale).clamp(-self.clip, self.clip)

    @torch.no_grad()
    def update(self, obs: Tensor) -> None:
        """Add observations (M, D) to the statistics (parallel Welford, Chan et al. 1979).

        With w = M / (count + M), delta = batch mean - mean:
        mean <- mean + w delta,  var <- (1 - w) var + w batch var + w (1 - w) delta^2.
        """
        samples = obs.double()
        var, mean = torch.var_mean(samples, dim=0, correction=0)
        total = self.count + len(obs)
        delta = mean - self.mean
        share = len(obs) / total
        # With count 0 the starting values of mean and var carry no weight.
        spread = delta.square() * (share * (1 - share))
        self.var.copy_(self.var * (1 - share) + var * share + spread)
        self.mean.add_(delta * share)
        self.count.copy_(total)
