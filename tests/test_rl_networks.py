from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import nn

from pgdm.errors import RunError
from pgdm.rl.networks import ActorCritic, Gaussian, NetworkCfg
from pgdm.seeding import torch_stream

CFG = NetworkCfg(
    obs_dim=322,
    action_dim=30,
    hidden=[256, 128],
    log_std_init=-1.6,
    normalize_observations=False,
    observation_clip=10.0,
)


def linears(net: nn.Sequential) -> list[nn.Linear]:
    return [layer for layer in net if isinstance(layer, nn.Linear)]


def test_layers_are_the_papers() -> None:
    model = ActorCritic(CFG, torch_stream(0, "weights"))
    for net, outputs in ((model.policy, 30), (model.critic, 1)):
        shapes = [(layer.in_features, layer.out_features) for layer in linears(net)]
        assert shapes == [(322, 256), (256, 128), (128, outputs)]
        assert sum(isinstance(layer, nn.Tanh) for layer in net) == 2
    torch.testing.assert_close(model.log_std.detach(), torch.full((30,), -1.6))


def test_weights_are_orthogonal_with_the_gains_of_stable_baselines3() -> None:
    model = ActorCritic(CFG, torch_stream(0, "weights"))
    gains = {model.policy: 0.01, model.critic: 1.0}
    for net, last_gain in gains.items():
        layers = linears(net)
        for layer in layers:
            gain = last_gain if layer is layers[-1] else math.sqrt(2)
            weight = layer.weight.detach()
            product = weight @ weight.T  # rows are orthogonal: every layer narrows
            expected = gain**2 * torch.eye(len(product))
            torch.testing.assert_close(product, expected, atol=1e-5, rtol=0)
            assert not layer.bias.detach().any()


def test_start_values_come_from_the_stream_and_leave_the_global_one_alone() -> None:
    before = torch.random.get_rng_state()
    first = ActorCritic(CFG, torch_stream(0, "weights")).state_dict()
    again = ActorCritic(CFG, torch_stream(0, "weights")).state_dict()
    other = ActorCritic(CFG, torch_stream(1, "weights")).state_dict()
    assert torch.equal(torch.random.get_rng_state(), before)
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["policy.0.weight"], other["policy.0.weight"])


def test_the_warm_start_is_the_means_bias() -> None:
    bias = torch.linspace(-1, 1, 30)
    model = ActorCritic(CFG, torch_stream(0, "weights"), bias)
    torch.testing.assert_close(model.act(torch.zeros(1, 322), deterministic=True)[0], bias)


def test_samples_follow_the_gaussian_and_are_not_clipped() -> None:
    cfg = replace(CFG, obs_dim=2, action_dim=2, hidden=[4], log_std_init=0.0)
    model = ActorCritic(cfg, torch_stream(0, "weights"), torch.tensor([0.0, 2.0]))
    action, mean = model.sample(torch.zeros(20_000, 2), torch_stream(0, "actions"))
    torch.testing.assert_close(action.mean(0), torch.tensor([0.0, 2.0]), atol=0.03, rtol=0)
    torch.testing.assert_close(action.std(0), torch.ones(2), atol=0.03, rtol=0)
    torch.testing.assert_close(mean, torch.tensor([[0.0, 2.0]]).expand(20_000, 2))
    assert not action.requires_grad


def test_log_prob_and_entropy_equal_torch() -> None:
    generator = torch_stream(0, "test")
    mean, action = torch.randn(4, 3, generator=generator), torch.randn(4, 3, generator=generator)
    log_std = torch.tensor([-1.6, 0.0, 0.5])
    normal, ours = torch.distributions.Normal(mean, log_std.exp()), Gaussian(mean, log_std)
    torch.testing.assert_close(ours.log_prob(action), normal.log_prob(action).sum(1))
    torch.testing.assert_close(ours.entropy(), normal.entropy()[0].sum())


def test_act_samples_from_the_given_stream() -> None:
    model = ActorCritic(CFG, torch_stream(0, "weights"))
    obs = torch.randn(3, 322, generator=torch_stream(0, "test"))
    first, again = (model.act(obs, torch_stream(5, "eval")) for _ in range(2))
    assert torch.equal(first, again)
    assert not torch.equal(first, model.act(obs, deterministic=True))
    with pytest.raises(RunError, match="generator"):
        model.act(obs)


def test_policy_and_value_share_nothing() -> None:
    model = ActorCritic(CFG, torch_stream(0, "weights"))
    obs = torch.randn(3, 322, generator=torch_stream(0, "test"))
    model.value(obs).sum().backward()
    assert all(p.grad is None for p in model.policy.parameters())
