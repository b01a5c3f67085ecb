"""TorchRL's soft actor-critic loss with pgdm's networks and its own random stream."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import Tensor
from torchrl.modules import TanhNormal
from torchrl.objectives import SACLoss
from torchrl.objectives.value import TD0Estimator

from pgdm.rl.networks import ActionValue, SquashedPolicy
from pgdm.rl.torch_state import drawing_from


class DiscountedTD0(TD0Estimator):
    """The one-step target r + gamma d V', with the environment's ``discount`` d (M, 1), or d = 1.

    V' is 0 after a termination.
    """

    def value_estimate(self, tensordict: Any, *args: Any, **kwargs: Any) -> Tensor:
        """Return the target, (M, 1)."""
        after = tensordict["next"]
        if (discount := after.get("discount", None)) is not None:
            key = self.tensor_keys.value
            tensordict = tensordict.copy()
            tensordict["next"] = after.copy().set(key, after[key] * discount)
        return super().value_estimate(tensordict, *args, **kwargs)


class SoftActorCriticLoss(SACLoss):
    """`SACLoss` with its own random stream; critics and policy have separate methods.

    With critics Q_i, target critics Q'_i, temperature alpha, target entropy H, the policy's actions
    a ~ pi(s) and a' ~ pi(s'), and y the target of `DiscountedTD0` with
    V' = min_i Q'_i(s', a') - alpha log pi(a'|s'):

    critics: sum_i mean((Q_i - y)^2) at replayed actions;
    policy: mean(alpha log pi(a|s) - min_i Q_i(s, a));
    temperature: -log(alpha) mean(log pi(a|s) + H).

    The critics are evaluated one after the other, not under vmap; benchmark/throughput.py compares
    the two.

    Args:
        policy: the actor.
        critics: the critics, all of the same shape.
        gamma: discount per control step.
        temperature: alpha at the start.
        target_entropy: H, nat.
        generator: random stream of the actions that the losses sample.
    """

    log_alpha: torch.nn.Parameter

    def __init__(
        self,
        policy: SquashedPolicy,
        critics: list[ActionValue],
        *,
        gamma: float,
        temperature: float,
        target_entropy: float,
        generator: torch.Generator,
    ) -> None:
        actor = ProbabilisticTensorDictSequential(
            [
                TensorDictModule(policy, ["observation"], ["loc", "scale"]),
                ProbabilisticTensorDictModule(
                    ["loc", "scale"],
                    ["action"],
                    distribution_class=TanhNormal,
                    return_log_prob=True,
                ),
            ]
        )
        super().__init__(
            actor,
            [
                TensorDictModule(critic, ["observation", "action"], ["state_action_value"])
                for critic in critics
            ],
            num_qvalue_nets=len(critics),
            loss_function="l2",
            alpha_init=temperature,
            target_entropy=target_entropy,
            deactivate_vmap=True,
        )
        estimator: Any = DiscountedTD0  # TorchRL accepts a class instead of a name
        self.make_value_estimator(estimator, value_network=None, gamma=gamma)
        self._generator = generator

    def steer_to(self, entropy: float) -> None:
        """Change the target entropy, nat."""
        target: Any = self.target_entropy  # a buffer
        target.fill_(entropy)

    def critic_loss(self, batch: TensorDict) -> Tensor:
        """Return the mean squared error () of the critics, summed over them."""
        with drawing_from(self._generator, self.log_alpha.device):
            return self.qvalue_v2_loss(batch)[0]

    def policy_and_temperature_loss(self, batch: TensorDict) -> tuple[Tensor, Tensor, Tensor]:
        """Return the policy's loss (), the temperature's (), and the policy's entropy (), nat."""
        with drawing_from(self._generator, self.log_alpha.device):
            loss, about = self.actor_loss(batch)
        log_prob = about["log_prob"]
        return loss, self.alpha_loss(log_prob).mean(), -log_prob.mean()
