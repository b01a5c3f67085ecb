"""TorchRL's own ``ClipPPOLoss`` with pgdm's networks, for comparison with pgdm's subclass."""

from __future__ import annotations

from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss

from pgdm.rl.networks import ActorCritic
from pgdm.rl.ppo import PPOCfg


class _LocScale(nn.Module):
    """The policy in the form that TorchRL's distributions expect."""

    def __init__(self, model: ActorCritic) -> None:
        super().__init__()
        self.policy, self.log_std = model.policy, model.log_std

    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        mean = self.policy(obs)
        return mean, self.log_std.exp().expand_as(mean)


def clip_ppo_loss(model: ActorCritic, cfg: PPOCfg) -> ClipPPOLoss:
    """Return TorchRL's loss of a model, with the settings of ``cfg``.

    Its samples [M] hold ``observation``, ``action``, ``action_log_prob``, ``advantage`` (M, 1) and
    ``value_target`` (M, 1).
    """
    actor = ProbabilisticActor(
        TensorDictModule(_LocScale(model), ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    loss = ClipPPOLoss(
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
    loss.set_keys(sample_log_prob="action_log_prob")
    return loss
