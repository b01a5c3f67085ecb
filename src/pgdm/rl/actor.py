"""A Gaussian policy in the form that TorchRL's losses and collectors expect."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import nn
from torchrl.envs.utils import ExplorationType, exploration_type

from pgdm.rl.networks import Gaussian


class GaussianActor(TensorDictModuleBase):
    """A policy N(net(observation), exp(log_std)^2) with state-independent standard deviations.

    Reads ``observation`` (..., D); writes ``loc`` and ``action``, (..., A), and
    ``action_log_prob`` (...). It samples if TorchRL's exploration type is random or None; otherwise
    the action is the mean.

    Args:
        net: maps observations (..., D) to means (..., A).
        log_std: log of the standard deviations, (A,).
    """

    def __init__(self, net: nn.Module, log_std: nn.Parameter) -> None:
        super().__init__()
        self.net, self.log_std = net, log_std
        self.in_keys, self.out_keys = ["observation"], ["loc", "action", "action_log_prob"]
        # What TorchRL's losses look up.
        self.dist_sample_keys, self.log_prob_keys = ["action"], ["action_log_prob"]

    def get_dist(self, samples: Mapping[Any, Any]) -> Gaussian:
        """Return the distribution of the actions at ``observation``."""
        return Gaussian(self.net(samples["observation"]), self.log_std)

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write an action; see the class."""
        dist = self.get_dist(tensordict)
        sampled = exploration_type() in (None, ExplorationType.RANDOM)
        noise = torch.randn_like(dist.loc) if sampled else torch.zeros_like(dist.loc)
        action = (dist.loc + self.log_std.exp() * noise).detach()
        found = {"loc": dist.loc, "action": action, "action_log_prob": dist.log_prob(action)}
        return tensordict.update(found)
