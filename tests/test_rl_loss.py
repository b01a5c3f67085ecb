from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.objectives import ValueEstimators
from torchrl_loss import clip_ppo_loss

from pgdm.rl.actor import GaussianActor
from pgdm.rl.loss import ProximalPolicyLoss, advantages
from pgdm.rl.networks import ActorCritic, Gaussian, NetworkCfg
from pgdm.seeding import torch_stream
from toy_envs import PAPER

NO, YES = False, True


def column(*values: float) -> Tensor:
    return torch.tensor(values)[:, None]


def after(
    reward: Tensor, terminated: Tensor, truncated: Tensor, discount: Tensor | None = None
) -> TensorDict:
    """Return what a rollout holds under ``next``, [N, T], from columns (T, N)."""
    columns = {"reward": reward, "terminated": terminated, "done": terminated | truncated}
    if discount is not None:
        columns["discount"] = discount
    return TensorDict({name: by_env(c) for name, c in columns.items()}, reward.t().shape)


def by_env(by_time: Tensor) -> Tensor:
    """Turn a column (T, N) into (N, T, 1)."""
    return by_time.t()[..., None]


def gae(
    values: Tensor,
    following: Tensor,
    reward: Tensor,
    ends: Tensor,
    cuts: Tensor,
    discount: Tensor | None = None,
) -> Tensor:
    steps = after(reward, ends, cuts, discount)
    values, following = by_env(values), by_env(following)
    advantage, target = advantages(values, following, steps, gamma=0.5, gae_lambda=0.5)
    torch.testing.assert_close(target, advantage + values)
    return advantage[0, :, 0]


def test_advantages_within_an_episode() -> None:
    # delta = r + 0.5 * next - value: 1 + 1 - 1 = 1;  2 + 1.5 - 2 = 1.5;  3 + 2 - 3 = 2
    # A = delta + 0.25 * A_next:      1 + 0.25 * 2 = 1.5;  1.5 + 0.25 * 2 = 2;  2
    never = column(NO, NO, NO)
    got = gae(column(1.0, 2, 3), column(2.0, 3, 4), column(1.0, 2, 3), never, never)
    torch.testing.assert_close(got, torch.tensor([1.5, 2.0, 2.0]))


def test_a_discount_of_the_environment_shrinks_the_bootstrap_and_the_sum() -> None:
    # delta = r + 0.5 * d * next - value, d = 1, 0.5, 0: 1; 2 + 0.75 - 2 = 0.75; 3 - 3 = 0
    # A = delta + 0.25 * d * A_next: 1 + 0.25 * 0.75 = 1.1875; 0.75 + 0.125 * 0 = 0.75; 0
    never, discount = column(NO, NO, NO), column(1.0, 0.5, 0.0)
    got = gae(column(1.0, 2, 3), column(2.0, 3, 4), column(1.0, 2, 3), never, never, discount)
    torch.testing.assert_close(got, torch.tensor([1.1875, 0.75, 0.0]))


def test_a_termination_stops_the_bootstrap_and_the_sum() -> None:
    # Step 1 terminates: delta = 2 - 2 = 0, and nothing flows back from step 2 (A = 2).
    # Step 0: 1 + 0.25 * 0 = 1.
    ends = column(NO, YES, NO)
    got = gae(column(1.0, 2, 3), column(2.0, 3, 4), column(1.0, 2, 3), ends, column(NO, NO, NO))
    torch.testing.assert_close(got, torch.tensor([1.0, 0.0, 2.0]))


def test_a_truncation_keeps_the_bootstrap_and_stops_the_sum() -> None:
    # Step 1 is truncated: delta = 2 + 0.5 * 3 - 2 = 1.5, A = 1.5; step 0: 1 + 0.25 * 1.5 = 1.375.
    cuts = column(NO, YES, NO)
    got = gae(column(1.0, 2, 3), column(2.0, 3, 4), column(1.0, 2, 3), column(NO, NO, NO), cuts)
    torch.testing.assert_close(got, torch.tensor([1.375, 1.5, 2.0]))


def test_simulations_do_not_mix() -> None:
    generator = torch_stream(0, "test")
    values, following, reward = (torch.randn(7, 3, generator=generator) for _ in range(3))
    ends = torch.rand(7, 3, generator=generator) < 0.3
    cuts = (torch.rand(7, 3, generator=generator) < 0.3) & ~ends
    discount = torch.rand(reward.shape, generator=generator)
    steps, settings = after(reward, ends, cuts, discount), {"gamma": 0.9, "gae_lambda": 0.8}
    together, _ = advantages(by_env(values), by_env(following), steps, **settings)
    for i in range(3):
        one = slice(i, i + 1)
        alone, _ = advantages(
            by_env(values[:, one]), by_env(following[:, one]), steps[one], **settings
        )
        torch.testing.assert_close(together[one], alone)


def test_the_value_after_a_termination_is_never_used() -> None:
    following = column(math.nan)
    got = gae(column(1.0), following, column(3.0), column(YES), column(NO))
    torch.testing.assert_close(got, torch.tensor([2.0]))


class Constant(nn.Module):
    """Returns 0 (..., 1) for any observation."""

    def forward(self, obs: Tensor) -> Tensor:
        return torch.zeros(*obs.shape[:-1], 1)


def hand_worked(ratio: list[float], advantage: list[float], normalize: bool = True) -> TensorDict:
    """Return the loss of samples with given probability ratios, advantages and value targets."""
    actor = GaussianActor(Constant(), nn.Parameter(torch.zeros(1)))
    critic = TensorDictModule(Constant(), ["observation"], ["state_value"])
    loss = ProximalPolicyLoss(
        actor,
        critic,
        clip_epsilon=0.2,
        entropy_coeff=0.001,
        critic_coeff=0.5,
        normalize_advantage=normalize,
    )
    action = torch.zeros(len(ratio), 1)
    now = Gaussian(torch.zeros(len(ratio), 1), torch.zeros(1)).log_prob(action)
    samples = {
        "observation": torch.zeros(len(ratio), 1),
        "action": action,
        "action_log_prob": now - torch.tensor(ratio).log(),
        "advantage": torch.tensor(advantage)[:, None],
        "value_target": torch.arange(1.0, len(ratio) + 1)[:, None],
    }
    return loss(TensorDict(samples, [len(ratio)])).detach()


@pytest.mark.parametrize(
    ("ratio", "advantage", "expected"),
    [
        (1.0, 2.0, 2.0),  # inside: r * A
        (1.5, 2.0, 2.4),  # good action, already likelier: clipped at 1.2
        (0.5, 2.0, 1.0),  # good action, became rarer: not clipped
        (1.5, -2.0, -3.0),  # bad action, became likelier: not clipped
        (0.5, -2.0, -1.6),  # bad action, already rarer: clipped at 0.8
    ],
)
def test_clip_branches(ratio: float, advantage: float, expected: float) -> None:
    out = hand_worked([ratio], [advantage], normalize=False)
    assert float(out["loss_objective"]) == pytest.approx(-expected)
    assert float(out["clip_fraction"]) == (0 if ratio == 1 else 1)


def test_hand_worked_loss() -> None:
    # Advantages 1 and 3: mean 2, sample deviation sqrt(2): -0.7071 and 0.7071.
    # Ratios 1.1 and 1.5: min terms 1.1 * -0.7071 and 1.2 * 0.7071; minus their mean -0.035355.
    # Value errors 1 and 2: mean square 2.5. Entropy of a unit Gaussian: 1.418939.
    out = hand_worked([1.1, 1.5], [1.0, 3.0])
    assert float(out["loss_objective"]) == pytest.approx(-0.0353553, abs=1e-6)
    assert float(out["loss_critic"]) == pytest.approx(0.5 * 2.5)
    assert float(out["entropy"]) == pytest.approx(1.4189385)
    assert float(out["loss_entropy"]) == pytest.approx(-0.001 * 1.4189385)
    # (0.1 - ln 1.1 + 0.5 - ln 1.5) / 2
    expected = (0.6 - math.log(1.1) - math.log(1.5)) / 2
    assert float(out["kl_approx"]) == pytest.approx(expected, abs=1e-6)
    # 2.6^2 / (2 * (1.21 + 2.25))
    assert float(out["ESS"]) == pytest.approx(6.76 / 6.92)
    assert float(out["clip_fraction"]) == 0.5


def test_a_single_sample_is_not_standardised() -> None:
    assert float(hand_worked([1.0], [2.0])["loss_objective"]) == -2.0


D, A, M = 7, 3, 64


def model_and_batch() -> tuple[ActorCritic, TensorDict]:
    """Return a model and a minibatch drawn from a somewhat different policy."""
    generator = torch_stream(1, "test")
    cfg = NetworkCfg(D, A, [16, 8], -0.5, normalize_observations=False, observation_clip=10.0)
    model = ActorCritic(cfg, generator)
    obs = torch.randn(M, D, generator=generator)
    action, mean = model.sample(obs, generator)
    log_prob = Gaussian(mean, model.log_std.detach()).log_prob(action)
    samples = {
        "observation": obs,
        "action": action,
        "action_log_prob": log_prob + 0.3 * torch.randn(M, generator=generator),
        "advantage": torch.randn(M, 1, generator=generator),
        "value_target": torch.randn(M, 1, generator=generator),
    }
    return model, TensorDict(samples, [M])


def ours(model: ActorCritic) -> ProximalPolicyLoss:
    return ProximalPolicyLoss(
        GaussianActor(model.policy, model.log_std),
        TensorDictModule(model.critic, ["observation"], ["state_value"]),
        clip_epsilon=PAPER.clip,
        entropy_coeff=PAPER.entropy_coef,
        critic_coeff=PAPER.value_coef,
    )


def total(out: Any) -> Tensor:
    return out["loss_objective"] + out["loss_critic"] + out["loss_entropy"]


def gradients(model: nn.Module, loss: Tensor) -> list[Tensor]:
    return list(torch.autograd.grad(loss, list(model.parameters())))


def test_equals_torchrl() -> None:
    model, batch = model_and_batch()
    mine, theirs = ours(model)(batch), clip_ppo_loss(model, PAPER)(batch)
    close = {"rtol": 1e-4, "atol": 1e-6}
    for key in ("loss_objective", "loss_critic", "loss_entropy", "entropy", "clip_fraction", "ESS"):
        torch.testing.assert_close(mine[key], theirs[key], **close)
    pairs = zip(gradients(model, total(mine)), gradients(model, total(theirs)), strict=True)
    for left, right in pairs:
        torch.testing.assert_close(left, right, **close)


def test_the_halves_are_the_whole_and_share_no_gradient() -> None:
    model, batch = model_and_batch()
    loss = ours(model)
    whole, policy, (critic, *_) = loss(batch), loss.loss_policy(batch), loss.loss_critic(batch)
    assert set(whole.keys()) == set(loss.out_keys) == {*policy.keys(), "loss_critic"}
    for key, value in {**policy, "loss_critic": critic}.items():
        assert torch.equal(whole[key], value)
    (policy["loss_objective"] + policy["loss_entropy"]).backward()
    assert all(p.grad is None for p in model.critic.parameters())
    assert all(p.grad is not None for p in [*model.policy.parameters(), model.log_std])
    model.zero_grad()
    critic.backward()
    assert all(p.grad is None for p in [*model.policy.parameters(), model.log_std])


def test_without_a_critic_there_is_the_policys_half() -> None:
    model, batch = model_and_batch()
    loss = ProximalPolicyLoss(GaussianActor(model.policy, model.log_std), entropy_coeff=0.001)
    expected = ours(model)(batch)
    out = loss(batch.exclude("value_target"))
    assert set(out.keys()) == set(loss.out_keys) == set(expected.keys()) - {"loss_critic"}
    assert torch.equal(out["loss_objective"], expected["loss_objective"])
    with pytest.raises(ValueError, match="state_value is missing"):
        loss(rollout_of(model).exclude("advantage"))


def test_it_is_a_torchrl_loss_module() -> None:
    """Its parameters, tensors in and out instead of a TensorDict, other keys, coefficients."""
    model, batch = model_and_batch()
    loss = ours(model)
    assert {id(p) for p in loss.parameters()} == {id(p) for p in model.parameters()}
    rollout = rollout_of(model).exclude("advantage")
    keys = set(rollout.keys(include_nested=True))
    expected = loss(rollout)
    assert set(rollout.keys(include_nested=True)) == keys  # nothing is written into its input
    joined = {key: key if isinstance(key, str) else "_".join(key) for key in loss.in_keys}
    got = loss(**{name: rollout[key] for key, name in joined.items()})
    for key, value in zip(loss.out_keys, got, strict=True):
        torch.testing.assert_close(value, expected[key])
    before = loss(batch)
    loss.set_keys(advantage="gain", action="torque", sample_log_prob="density")
    names = {"advantage": "gain", "action": "torque", "action_log_prob": "density"}
    renamed = TensorDict({names.get(k, k): v for k, v in batch.items()}, [M])
    assert torch.equal(loss(renamed)["loss_objective"], before["loss_objective"])
    loss.clip_epsilon, loss.entropy_coeff = 0.01, 0.5
    after = loss(renamed)
    assert after["clip_fraction"] > before["clip_fraction"]
    torch.testing.assert_close(after["loss_entropy"], 500 * before["loss_entropy"])


def rollout_of(model: ActorCritic) -> TensorDict:
    """Return samples [N, T] in order, as TorchRL's estimators need them."""
    generator = torch_stream(2, "test")
    one = torch.Size([4, 16])
    terminated = torch.rand(*one, 1, generator=generator) < 0.1
    following = {
        "observation": torch.randn(*one, D, generator=generator),
        "reward": torch.randn(*one, 1, generator=generator),
        "terminated": terminated,
        "done": terminated,
    }
    _, batch = model_and_batch()
    samples = batch.exclude("value_target").reshape(one)
    return samples.set("next", TensorDict(following, one))


@pytest.mark.parametrize("kind", [ValueEstimators.GAE, ValueEstimators.TD0])
def test_the_value_estimator_fills_in_what_is_missing(kind: ValueEstimators) -> None:
    model, _ = model_and_batch()
    loss = ours(model)
    loss.make_value_estimator(kind, gamma=0.9)
    rollout = rollout_of(model).exclude("advantage")
    estimated = loss.value_estimator(rollout.copy())
    out = loss(rollout)
    assert torch.equal(out["loss_critic"], loss(estimated.detach())["loss_critic"])
    assert torch.equal(out["loss_objective"], loss(estimated.detach())["loss_objective"])


def test_advantages_equal_torchrls_module() -> None:
    model, _ = model_and_batch()
    loss = ours(model)
    loss.make_value_estimator(ValueEstimators.GAE, gamma=0.9, lmbda=0.8)
    rollout = rollout_of(model)
    with torch.no_grad():
        expected = loss.value_estimator(rollout.copy())
        values = [model.critic(x["observation"]) for x in (rollout, rollout["next"])]
        got, target = advantages(*values, rollout["next"], gamma=0.9, gae_lambda=0.8)
    torch.testing.assert_close(got, expected["advantage"])
    torch.testing.assert_close(target, expected["value_target"])


def test_equals_stable_baselines3() -> None:
    """One minibatch, one plain gradient step of their PPO against ours."""
    pytest.importorskip("stable_baselines3")
    gymnasium = pytest.importorskip("gymnasium")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from stable_baselines3 import PPO
        from stable_baselines3.common.logger import Logger

    class Shape(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-9, 9, (D,), np.float32)
        action_space = gymnasium.spaces.Box(-1, 1, (A,), np.float32)

    model, batch = model_and_batch()
    theirs = PPO(
        "MlpPolicy", Shape(), learning_rate=0.1, n_steps=M, batch_size=M, n_epochs=1,
        clip_range=PAPER.clip, ent_coef=PAPER.entropy_coef, vf_coef=PAPER.value_coef,
        max_grad_norm=1e9, normalize_advantage=True, device="cpu",
        policy_kwargs={
            "net_arch": {"pi": [16, 8], "vf": [16, 8]}, "activation_fn": nn.Tanh,
            "log_std_init": -0.5, "optimizer_class": torch.optim.SGD, "optimizer_kwargs": {},
        },
    )  # fmt: skip
    theirs.set_logger(Logger(folder=None, output_formats=[]))
    policy = theirs.policy
    actor = [*policy.mlp_extractor.policy_net, policy.action_net]
    critic = [*policy.mlp_extractor.value_net, policy.value_net]
    before = [p for m in (*actor, *critic) for p in m.parameters()] + [policy.log_std]
    mine = [*model.policy.parameters(), *model.critic.parameters(), model.log_std]
    with torch.no_grad():
        for their_part, my_part in zip(before, mine, strict=True):
            their_part.copy_(my_part)
    buffer = theirs.rollout_buffer
    buffer.observations[:, 0] = batch["observation"].numpy()
    buffer.actions[:, 0] = batch["action"].numpy()
    buffer.log_probs[:, 0] = batch["action_log_prob"].numpy()
    buffer.advantages[:, 0] = batch["advantage"][:, 0].numpy()
    buffer.returns[:, 0] = batch["value_target"][:, 0].numpy()
    buffer.full = True
    theirs.train()

    out = ours(model)(batch)
    steps = torch.autograd.grad(total(out), mine)
    for their_part, my_part, gradient in zip(before, mine, steps, strict=True):
        torch.testing.assert_close(their_part, my_part - 0.1 * gradient, rtol=1e-4, atol=1e-6)
    logged, out = theirs.logger.name_to_value, {k: float(v) for k, v in out.detach().items()}
    names = {"policy_gradient_loss": "loss_objective", "clip_fraction": "clip_fraction"}
    for their_name, my_name in names.items():
        assert logged[f"train/{their_name}"] == pytest.approx(out[my_name], rel=1e-4)
    assert logged["train/approx_kl"] == pytest.approx(out["kl_approx"], rel=1e-3)
    assert logged["train/entropy_loss"] == pytest.approx(-out["entropy"], rel=1e-4)
    error = out["loss_critic"] / PAPER.value_coef
    assert logged["train/value_loss"] == pytest.approx(error, rel=1e-4)
