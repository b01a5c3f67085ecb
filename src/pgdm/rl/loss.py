"""Advantages and the clipped loss of PPO.

The loss is written out here and not taken from TorchRL: its ``ClipPPOLoss`` takes 8.2 ms where
this takes 5.4 (loss and gradient of a minibatch on one thread, benchmark/throughput.py; 80 an
iteration), and joins policy and value function, which the learner keeps in a thread each. The tests
hold this one equal to it and to stable-baselines3's.
"""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pgdm.rl.networks import gaussian_entropy, gaussian_log_prob

_ADVANTAGE_EPS = 1e-8
"""Added to the deviation that advantages are divided by, as stable-baselines3 does."""


class Samples(NamedTuple):
    """M steps to learn from, in any order."""

    obs: Tensor
    """(M, D) normalised observations."""
    action: Tensor
    """(M, A) actions as sampled, before the environment clipped them."""
    log_prob: Tensor
    """(M,) log-probability of the action when it was taken."""
    advantage: Tensor
    """(M,) how much better than expected it went."""
    target: Tensor
    """(M,) what the value function should have said."""


class PolicyLoss(NamedTuple):
    """The policy's part of the loss and what is logged beside it; all ()."""

    total: Tensor
    """What is minimised: surrogate - entropy_coef * entropy."""
    surrogate: Tensor
    """The clipped objective, negated."""
    entropy: Tensor
    """Entropy of the policy, nat."""
    kl: Tensor
    """Approximate divergence from the policy that acted, mean of (r - 1) - log r, nat."""
    clip_fraction: Tensor
    """Share of the samples whose probability ratio r lies outside the clip range."""
    ess: Tensor
    """Effective sample size under the ratios, as a share of M."""


def policy_loss(
    mean: Tensor,
    log_std: Tensor,
    samples: Samples,
    *,
    clip: float,
    entropy_coef: float,
    normalize_advantage: bool,
) -> PolicyLoss:
    """Return the clipped loss (Schulman et al. 2017) as stable-baselines3 computes it.

    Args:
        mean: the policy's means now, (M, A).
        log_std: log of its standard deviations, (A,).
        samples: a minibatch.
        clip: the probability ratio counts only within 1 - clip .. 1 + clip.
        entropy_coef: weight of the entropy bonus.
        normalize_advantage: standardise the advantages within the minibatch.
    """
    advantage = samples.advantage
    if normalize_advantage and len(advantage) > 1:
        advantage = (advantage - advantage.mean()) / (advantage.std() + _ADVANTAGE_EPS)
    log_ratio = gaussian_log_prob(mean, log_std, samples.action) - samples.log_prob
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1 - clip, 1 + clip)
    surrogate = -torch.minimum(ratio * advantage, clipped * advantage).mean()
    entropy = gaussian_entropy(log_std)
    with torch.no_grad():
        kl = (ratio - 1 - log_ratio).mean()
        outside = (ratio != clipped).float().mean()
        ess = ratio.sum().square() / (ratio.square().sum() * len(ratio))
    return PolicyLoss(surrogate - entropy_coef * entropy, surrogate, entropy, kl, outside, ess)


def value_loss(value: Tensor, target: Tensor) -> Tensor:
    """Return the mean squared error () of the value function's answers (M,)."""
    return torch.nn.functional.mse_loss(value, target)


def advantages(
    values: Tensor,
    next_values: Tensor,
    reward: Tensor,
    terminated: Tensor,
    truncated: Tensor,
    discount: Tensor | None,
    *,
    gamma: float,
    gae_lambda: float,
) -> tuple[Tensor, Tensor]:
    """Return advantages and value targets, each (T, N), by TorchRL's generalised estimator.

    Args:
        values: value of the observation acted upon, (T, N).
        next_values: value of the observation that followed, (T, N); of a truncated row that of
            the true last observation. Not used where terminated.
        reward: (T, N).
        terminated: nothing came after, (T, N) bool.
        truncated: the episode was cut there, (T, N) bool.
        discount: by how much what comes after the step counts less, besides gamma, (T, N), or
            None for 1.
        gamma: discount per step.
        gae_lambda: decay of the longer estimates.
    """
    with warnings.catch_warnings():
        # Imported here, and quietly, because it costs 2 s, and warns that its compiled part (which
        # nothing here uses) was built for another torch.
        warnings.simplefilter("ignore")
        from torchrl.objectives.value.functional import generalized_advantage_estimate

    def layout(x: Tensor) -> Tensor:  # (T, N) -> (N, T, 1)
        return x.t().unsqueeze(-1)

    # TorchRL asks for a number, and takes one for each step as well.
    gammas: Any = gamma if discount is None else gamma * layout(discount)
    # A value that is not finite would survive the multiplication with 0 that switches it off.
    following = next_values.masked_fill(terminated, 0.0)
    advantage, target = generalized_advantage_estimate(
        gammas,
        gae_lambda,
        layout(values),
        layout(following),
        layout(reward),
        layout(terminated | truncated),
        layout(terminated),
    )
    return advantage.squeeze(-1).t(), target.squeeze(-1).t()
