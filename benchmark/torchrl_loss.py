"""TorchRL's ``ClipPPOLoss`` over pgdm's networks, to set pgdm's own loss beside it."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

from torch import Tensor, nn

from pgdm.rl.loss import Samples
from pgdm.rl.networks import ActorCritic
from pgdm.rl.ppo import PPOCfg

if TYPE_CHECKING:
    from tensordict import TensorDict
    from torchrl.objectives import ClipPPOLoss


class _LocScale(nn.Module):
    """The policy in the form that TorchRL's distributions take."""

    def __init__(self, model: ActorCritic) -> None:
        super().__init__()
        self.policy, self.log_std = model.policy, model.log_std

    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        mean = self.policy(obs)
        return mean, self.log_std.exp().expand_as(mean)


def clip_ppo_loss(model: ActorCritic, cfg: PPOCfg) -> ClipPPOLoss:
    """Return TorchRL's loss of a model, with the settings of ``cfg``."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from tensordict.nn import TensorDictModule
        from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
        from torchrl.objectives import ClipPPOLoss

    actor = ProbabilisticActor(
        TensorDictModule(_LocScale(model), ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    return ClipPPOLoss(
        actor,
        ValueOperator(model.critic, in_keys=["observation"]),
        clip_epsilon=cfg.clip,
        entropy_bonus=True,
        entropy_coeff=cfg.entropy_coef,
        critic_coeff=cfg.value_coef,
        loss_critic_type="l2",
        normalize_advantage=cfg.normalize_advantage,
        clip_value=False,
        separate_losses=False,
        reduction="mean",
        functional=False,
    )


def as_tensordict(batch: Samples, loss: ClipPPOLoss) -> TensorDict:
    """Return a minibatch in the form that the loss takes."""
    from tensordict import TensorDict

    return TensorDict(
        {
            "observation": batch.obs,
            "action": batch.action,
            loss.tensor_keys.sample_log_prob: batch.log_prob,
            "advantage": batch.advantage[:, None],
            "value_target": batch.target[:, None],
        },
        batch_size=[len(batch.obs)],
    )
