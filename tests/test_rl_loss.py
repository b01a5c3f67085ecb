from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torchrl_loss import as_tensordict, clip_ppo_loss

from pgdm.rl.loss import PolicyLoss, Samples, advantages, policy_loss, value_loss
from pgdm.rl.networks import ActorCritic, NetworkCfg, gaussian_entropy, gaussian_log_prob
from pgdm.seeding import torch_stream
from toy_envs import PAPER

SETTINGS = {
    "clip": PAPER.clip,
    "entropy_coef": PAPER.entropy_coef,
    "normalize_advantage": True,
}
NO, YES = False, True


def column(*values: float) -> Tensor:
    return torch.tensor(values)[:, None]


def gae(
    values: Tensor,
    following: Tensor,
    reward: Tensor,
    ends: Tensor,
    cuts: Tensor,
    discount: Tensor | None = None,
) -> Tensor:
    advantage, target = advantages(
        values, following, reward, ends, cuts, discount, gamma=0.5, gae_lambda=0.5
    )
    torch.testing.assert_close(target, advantage + values)
    return advantage[:, 0]


def test_advantages_without_an_end() -> None:
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
    # Step 1 is cut: delta = 2 + 0.5 * 3 - 2 = 1.5, A = 1.5; step 0: 1 + 0.25 * 1.5 = 1.375.
    cuts = column(NO, YES, NO)
    got = gae(column(1.0, 2, 3), column(2.0, 3, 4), column(1.0, 2, 3), column(NO, NO, NO), cuts)
    torch.testing.assert_close(got, torch.tensor([1.375, 1.5, 2.0]))


def test_simulations_do_not_mix() -> None:
    generator = torch_stream(0, "test")
    values, following, reward = (torch.randn(7, 3, generator=generator) for _ in range(3))
    ends = torch.rand(7, 3, generator=generator) < 0.3
    cuts = (torch.rand(7, 3, generator=generator) < 0.3) & ~ends
    discount = torch.rand(reward.shape)
    together, _ = advantages(
        values, following, reward, ends, cuts, discount, gamma=0.9, gae_lambda=0.8
    )
    for i in range(3):
        one = slice(i, i + 1)
        alone, _ = advantages(
            values[:, one], following[:, one], reward[:, one], ends[:, one], cuts[:, one],
            discount[:, one], gamma=0.9, gae_lambda=0.8,
        )  # fmt: skip
        torch.testing.assert_close(together[:, one], alone)


def test_the_value_after_a_termination_is_never_used() -> None:
    following = column(math.nan)
    got = gae(column(1.0), following, column(3.0), column(YES), column(NO))
    torch.testing.assert_close(got, torch.tensor([2.0]))


def hand_batch(ratio: list[float], advantage: list[float]) -> tuple[Tensor, Tensor, Samples]:
    """Return mean, log-std and samples whose probability ratios and advantages are given."""
    mean, log_std, action = torch.zeros(len(ratio), 1), torch.zeros(1), torch.zeros(len(ratio), 1)
    now = gaussian_log_prob(mean, log_std, action)
    old = now - torch.tensor(ratio).log()
    samples = Samples(
        torch.zeros(len(ratio), 1), action, old, torch.tensor(advantage), torch.zeros(len(ratio))
    )
    return mean, log_std, samples


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
    mean, log_std, samples = hand_batch([ratio], [advantage])
    settings = SETTINGS | {"normalize_advantage": False}
    terms = policy_loss(mean, log_std, samples, **settings)
    assert float(terms.surrogate) == pytest.approx(-expected)
    assert float(terms.clip_fraction) == (0 if ratio == 1 else 1)


def test_hand_worked_loss() -> None:
    # Advantages 1 and 3: mean 2, sample deviation sqrt(2): -0.7071 and 0.7071.
    # Ratios 1.1 and 1.5: min terms 1.1 * -0.7071 and 1.2 * 0.7071; minus their mean -0.035355.
    # Value errors 1 and 2: mean square 2.5. Entropy of a unit Gaussian: 1.418939.
    mean, log_std, samples = hand_batch([1.1, 1.5], [1.0, 3.0])
    terms = policy_loss(mean, log_std, samples, **SETTINGS)
    assert float(terms.surrogate) == pytest.approx(-0.0353553, abs=1e-6)
    assert float(value_loss(torch.tensor([1.0, -2.0]), samples.target)) == pytest.approx(2.5)
    assert float(terms.entropy) == pytest.approx(1.4189385)
    assert float(terms.total) == pytest.approx(-0.0353553 - 0.001 * 1.4189385, abs=1e-6)
    # (0.1 - ln 1.1 + 0.5 - ln 1.5) / 2
    assert float(terms.kl) == pytest.approx((0.6 - math.log(1.1) - math.log(1.5)) / 2, abs=1e-6)
    # 2.6^2 / (2 * (1.21 + 2.25))
    assert float(terms.ess) == pytest.approx(6.76 / 6.92)
    assert float(terms.clip_fraction) == 0.5


def test_a_single_sample_is_not_standardised() -> None:
    mean, log_std, samples = hand_batch([1.0], [2.0])
    terms = policy_loss(mean, log_std, samples, **SETTINGS)
    assert float(terms.surrogate) == -2.0


def test_log_prob_and_entropy_equal_torch() -> None:
    generator = torch_stream(0, "test")
    mean, action = torch.randn(4, 3, generator=generator), torch.randn(4, 3, generator=generator)
    log_std = torch.tensor([-1.6, 0.0, 0.5])
    normal = torch.distributions.Normal(mean, log_std.exp())
    torch.testing.assert_close(
        gaussian_log_prob(mean, log_std, action), normal.log_prob(action).sum(1)
    )
    torch.testing.assert_close(gaussian_entropy(log_std), normal.entropy()[0].sum())


D, A, M = 7, 3, 64


def model_and_batch() -> tuple[ActorCritic, Samples]:
    """Return a model and a minibatch drawn from a somewhat different policy."""
    generator = torch_stream(1, "test")
    cfg = NetworkCfg(D, A, [16, 8], -0.5, normalize_observations=False, observation_clip=10.0)
    model = ActorCritic(cfg, generator)
    obs = torch.randn(M, D, generator=generator)
    action, mean = model.sample(obs, generator)
    log_prob = gaussian_log_prob(mean, model.log_std.detach(), action)
    log_prob = log_prob + 0.3 * torch.randn(M, generator=generator)
    advantage, target = torch.randn(M, generator=generator), torch.randn(M, generator=generator)
    return model, Samples(obs, action, log_prob, advantage, target)


def ours(model: ActorCritic, batch: Samples) -> tuple[Tensor, PolicyLoss, Tensor]:
    """Return the whole loss, the policy's part and the value function's, unweighted."""
    policy = policy_loss(model.mean(batch.obs), model.log_std, batch, **SETTINGS)
    error = value_loss(model.value(batch.obs), batch.target)
    return policy.total + PAPER.value_coef * error, policy, error


def gradients(model: nn.Module, loss: Tensor) -> list[Tensor]:
    return list(torch.autograd.grad(loss, list(model.parameters())))


def test_equals_torchrl() -> None:
    model, batch = model_and_batch()
    loss = clip_ppo_loss(model, PAPER)
    out = loss(as_tensordict(batch, loss))
    total = out["loss_objective"] + out["loss_critic"] + out["loss_entropy"]
    whole, policy, error = ours(model, batch)
    close = {"rtol": 1e-4, "atol": 1e-6}
    torch.testing.assert_close(policy.surrogate, out["loss_objective"], **close)
    torch.testing.assert_close(PAPER.value_coef * error, out["loss_critic"], **close)
    torch.testing.assert_close(policy.entropy, out["entropy"], **close)
    torch.testing.assert_close(whole, total, **close)
    torch.testing.assert_close(policy.clip_fraction, out["clip_fraction"], **close)
    torch.testing.assert_close(policy.ess, out["ESS"], **close)
    for left, right in zip(gradients(model, whole), gradients(model, total), strict=True):
        torch.testing.assert_close(left, right, **close)


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
    buffer.observations[:, 0] = batch.obs.numpy()
    buffer.actions[:, 0] = batch.action.numpy()
    buffer.log_probs[:, 0] = batch.log_prob.numpy()
    buffer.advantages[:, 0] = batch.advantage.numpy()
    buffer.returns[:, 0] = batch.target.numpy()
    buffer.full = True
    theirs.train()

    whole, policy_part, error = ours(model, batch)
    steps = torch.autograd.grad(whole, mine)
    for their_part, my_part, gradient in zip(before, mine, steps, strict=True):
        torch.testing.assert_close(their_part, my_part - 0.1 * gradient, rtol=1e-4, atol=1e-6)
    logged = theirs.logger.name_to_value
    terms = PolicyLoss(*(term.detach() for term in policy_part))
    assert logged["train/policy_gradient_loss"] == pytest.approx(float(terms.surrogate), rel=1e-4)
    assert logged["train/value_loss"] == pytest.approx(float(error.detach()), rel=1e-4)
    assert logged["train/entropy_loss"] == pytest.approx(-float(terms.entropy), rel=1e-4)
    assert logged["train/approx_kl"] == pytest.approx(float(terms.kl), rel=1e-3)
    assert logged["train/clip_fraction"] == pytest.approx(float(terms.clip_fraction))
