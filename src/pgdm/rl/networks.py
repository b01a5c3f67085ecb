"""Policies and value functions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Generator, Tensor, nn

from pgdm.errors import RunError
from pgdm.rl.normalizer import Normalizer

# Gains of the initial weights in stable-baselines3, with which the paper's policies were trained.
_HIDDEN_GAIN, _MEAN_GAIN, _VALUE_GAIN = math.sqrt(2), 0.01, 1.0
_NO_GENERATOR = "sampling an action needs a generator; pass one or deterministic=True"
_LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)
_LOG_STD_RANGE = (-5.0, 1.0)  # bounds in a squashed policy, before tanh
_WARM_START_LIMIT = 0.95  # bound of a squashed policy's initial mean: beyond it tanh is too flat


@dataclass(frozen=True)
class NetworkCfg:
    """Settings to rebuild the networks of a checkpoint from."""

    obs_dim: int
    """D, numbers in an observation."""
    action_dim: int
    """A, numbers in an action."""
    hidden: list[int]
    """Widths of the hidden layers, for both networks."""
    log_std_init: float
    """Log of the policy's initial standard deviation."""
    normalize_observations: bool
    """Whether observations are standardised by their running statistics."""
    observation_clip: float
    """Standardised observations are clipped to plus or minus this many standard deviations."""


class Gaussian(NamedTuple):
    """N(loc, exp(log_std)^2) with independent entries; all rows share the standard deviations."""

    loc: Tensor
    """Means, (..., A)."""
    log_std: Tensor
    """Log of the standard deviations, (A,)."""

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density (...) of values (..., A)."""
        z, count = (value - self.loc) * torch.exp(-self.log_std), self.log_std.numel()
        return -0.5 * z.square().sum(-1) - self.log_std.sum() - count * _LOG_SQRT_2PI

    def entropy(self) -> Tensor:
        """Return the entropy (), nat; it is the same in each row."""
        return self.log_std.sum() + self.log_std.numel() * (0.5 + _LOG_SQRT_2PI)


class ActorCritic(nn.Module):
    """A Gaussian policy with learned, state-independent standard deviations, and a value function.

    Actions are neither squashed nor clipped here: the environment clips them, and log-probabilities
    are those of the unclipped actions (as in stable-baselines3).

    Args:
        cfg: sizes and initial values.
        generator: random stream of the orthogonal initial weights; None leaves the weights
            uninitialised, to be loaded later.
        mean_bias: initial mean (A,) of the policy, or None for 0.
    """

    def __init__(
        self,
        cfg: NetworkCfg,
        generator: Generator | None = None,
        mean_bias: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.cfg = cfg
        self.normalizer = (
            Normalizer(cfg.obs_dim, cfg.observation_clip) if cfg.normalize_observations else None
        )
        self.policy = _mlp(cfg.obs_dim, cfg.hidden, cfg.action_dim)
        self.critic = _mlp(cfg.obs_dim, cfg.hidden, 1)
        self.log_std = nn.Parameter(torch.full((cfg.action_dim,), float(cfg.log_std_init)))
        if generator is not None:
            _initialise(self.policy, _MEAN_GAIN, generator)
            _initialise(self.critic, _VALUE_GAIN, generator)
        if mean_bias is not None:
            last = self.policy[-1]
            assert isinstance(last, nn.Linear)
            with torch.no_grad():
                last.bias.copy_(mean_bias)

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return self.log_std.device

    def normalize(self, obs: Tensor) -> Tensor:
        """Return observations (..., D) as the networks expect them."""
        return obs if self.normalizer is None else self.normalizer(obs)

    def value(self, normalized: Tensor) -> Tensor:
        """Return the discounted return (...) expected from normalised observations (..., D)."""
        return self.critic(normalized).squeeze(-1)

    def mean(self, obs: Tensor) -> Tensor:
        """Return the policy's mean action (N, A) at raw observations (N, D)."""
        return self.policy(self.normalize(obs))

    @torch.no_grad()
    def sample(self, obs: Tensor, generator: Generator | None = None) -> tuple[Tensor, Tensor]:
        """Draw actions (N, A) at raw observations (N, D); return them and the policy's means.

        The noise is drawn on the CPU, so that it does not depend on the networks' device: from
        ``generator``, or if None, from torch's global stream.
        """
        mean = self.mean(obs.to(self.device))
        noise = torch.randn(mean.shape, generator=generator).to(self.device)
        return mean + self.log_std.exp() * noise, mean

    @torch.no_grad()
    def act(
        self, obs: Tensor, generator: Generator | None = None, deterministic: bool = False
    ) -> Tensor:
        """Return actions (N, A) on the CPU for raw observations (N, D).

        Args:
            obs: observations as the environment returns them.
            generator: stream of the noise; needed unless deterministic.
            deterministic: return the policy's mean instead of a sample.

        Raises:
            RunError: if a sample is wanted without a generator.
        """
        if deterministic:
            return self.mean(obs.to(self.device)).cpu()
        if generator is None:
            raise RunError(_NO_GENERATOR)
        return self.sample(obs, generator)[0].cpu()


@dataclass(frozen=True)
class SquashedCfg:
    """Settings to rebuild the policy of an off-policy checkpoint from."""

    kind: str
    """``squashed``; distinguishes these settings from a ``NetworkCfg``."""
    obs_dim: int
    """D, numbers in an observation."""
    action_dim: int
    """A, numbers in an action."""
    hidden: list[int]
    """Widths of the hidden layers."""
    log_std_init: float
    """Log of the initial standard deviation, before tanh."""
    observation_clip: float
    """Standardised observations are clipped to plus or minus this many standard deviations."""
    pre_tanh_limit: float | None = None
    """Largest average magnitude of the entries of a mean before tanh, or None; older checkpoints
    have none."""


class SquashedPolicy(nn.Module):
    """A Gaussian with state-dependent mean and standard deviation, squashed by tanh to (-1, 1).

    Where tanh is flat an action neither explores nor learns. With ``pre_tanh_limit`` L, a mean m
    whose entries have an average magnitude above L is scaled down to L before tanh (output
    normalisation, Wang et al. 2020).

    Args:
        cfg: sizes and initial values.
        generator: stream of the initial weights; None leaves them uninitialised.
        mean_bias: initial squashed mean (A,), clamped to +-0.95; None for 0.
    """

    def __init__(
        self,
        cfg: SquashedCfg,
        generator: Generator | None = None,
        mean_bias: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.cfg = cfg
        self.normalizer = Normalizer(cfg.obs_dim, cfg.observation_clip)
        self.net = silu_mlp(cfg.obs_dim, cfg.hidden, 2 * cfg.action_dim, generator)
        last = self.net[-1]
        assert isinstance(last, nn.Linear)
        if generator is not None:
            with torch.no_grad():
                last.weight.mul_(_MEAN_GAIN)
                last.bias[: cfg.action_dim] = 0.0
                last.bias[cfg.action_dim :] = cfg.log_std_init
        if mean_bias is not None:
            limit = _WARM_START_LIMIT
            with torch.no_grad():
                last.bias[: cfg.action_dim] = mean_bias.clamp(-limit, limit).atanh()

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return next(self.net.parameters()).device

    def forward(self, normalized: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and std before tanh, (M, A) each, at normalised observations (M, D)."""
        mean, log_std = precise_end(self.net, normalized).chunk(2, -1)
        if (limit := self.cfg.pre_tanh_limit) is not None:
            mean = mean / (mean.abs().mean(-1, keepdim=True) / limit).clamp(min=1.0)
        return mean, log_std.clamp(*_LOG_STD_RANGE).exp()

    def mean(self, obs: Tensor) -> Tensor:
        """Return the squashed mean (N, A) at raw observations (N, D)."""
        return torch.tanh(self(self.normalizer(obs))[0])

    @torch.no_grad()
    def sample(
        self, obs: Tensor, generator: Generator | None = None, noise: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Draw actions (N, A); return them and the squashed means, see `ActorCritic.sample`.

        ``noise`` (N, A), standard normal, is used instead of drawing it.
        """
        mean, std = self(self.normalizer(obs.to(self.device)))
        if noise is None:
            noise = torch.randn(mean.shape, generator=generator)
        return torch.tanh(mean + std * noise.to(self.device)), torch.tanh(mean)

    @torch.no_grad()
    def act(
        self, obs: Tensor, generator: Generator | None = None, deterministic: bool = False
    ) -> Tensor:
        """Return actions (N, A) on the CPU for raw observations (N, D); see `ActorCritic.act`.

        Raises:
            RunError: if a sample is wanted without a generator.
        """
        if deterministic:
            return self.mean(obs.to(self.device)).cpu()
        if generator is None:
            raise RunError(_NO_GENERATOR)
        return self.sample(obs, generator)[0].cpu()


class ActionValue(nn.Module):
    """A critic Q(s, a): the value (M, 1) of actions (M, A) at normalised observations (M, D)."""

    def __init__(
        self, obs_dim: int, action_dim: int, hidden: Sequence[int], generator: Generator
    ) -> None:
        super().__init__()
        self.net = silu_mlp(obs_dim + action_dim, hidden, 1, generator)

    def forward(self, normalized: Tensor, action: Tensor) -> Tensor:
        """Return the value, (M, 1)."""
        return precise_end(self.net, torch.cat((normalized, action), -1))


def precise_end(net: nn.Sequential, inputs: Tensor) -> Tensor:
    """Return a network's outputs, with the last layer in float32 even under autocast.

    The cost is negligible, whereas bfloat16 would round a value near 12 to a multiple of 0.06.
    """
    hidden = net[:-1](inputs)
    with torch.autocast(inputs.device.type, enabled=False):
        return net[-1](hidden.float())


def silu_mlp(
    inputs: int, hidden: Sequence[int], outputs: int, generator: Generator | None
) -> nn.Sequential:
    """Return an MLP with layer norm and SiLU, initial weights uniform in +-1/sqrt(fan-in)."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [_linear(inputs, width), nn.LayerNorm(width), nn.SiLU()]
        inputs = width
    net = nn.Sequential(*layers, _linear(inputs, outputs))
    if generator is not None:
        for layer in (m for m in net if isinstance(m, nn.Linear)):
            bound = 1 / math.sqrt(layer.in_features)
            nn.init.uniform_(layer.weight, -bound, bound, generator=generator)
            nn.init.uniform_(layer.bias, -bound, bound, generator=generator)
    return net


def _mlp(inputs: int, hidden: Sequence[int], outputs: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [_linear(inputs, width), nn.Tanh()]
        inputs = width
    return nn.Sequential(*layers, _linear(inputs, outputs))


def _linear(inputs: int, outputs: int) -> nn.Module:
    # skip_init: torch's own initial values would be drawn from the global stream.
    return nn.utils.skip_init(nn.Linear, inputs, outputs)


def _initialise(net: nn.Sequential, last_gain: float, generator: Generator) -> None:
    layers = [layer for layer in net if isinstance(layer, nn.Linear)]
    for layer in layers:
        gain = last_gain if layer is layers[-1] else _HIDDEN_GAIN
        nn.init.orthogonal_(layer.weight, gain, generator=generator)
        nn.init.zeros_(layer.bias)
