from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from pgdm.errors import ConfigError, RunError
from pgdm.rl.collector import RolloutCollector
from pgdm.rl.networks import ActorCritic, NetworkCfg
from pgdm.rl.ppo import PPOCfg, PPOLearner, check_batch, explained_variance
from pgdm.rl.vec_env import VecEnv
from pgdm.seeding import torch_stream
from toy_envs import PAPER, TOY, PointEnv, ScriptedEnv


def build(env: VecEnv, cfg: PPOCfg, num_threads: int = 1) -> tuple[PPOLearner, RolloutCollector]:
    network = NetworkCfg(
        env.obs_dim, env.action_dim, cfg.hidden, cfg.log_std_init, cfg.normalize_observations, 10.0
    )
    model = ActorCritic(network, torch_stream(0, "weights"))
    learner = PPOLearner(model, cfg, torch_stream(0, "minibatches"), num_threads)
    policy = TensorDictModule(model.sample, ["observation"], ["action", "loc"])
    return learner, RolloutCollector(env, policy, frames_per_batch=cfg.steps_per_env * env.num_envs)


def seen(rollout: TensorDict) -> torch.Tensor:
    """Return the observations acted upon, (T * N, D), in the order they came."""
    return rollout["observation"].transpose(0, 1).flatten(0, 1)


def test_each_sample_is_visited_once_in_each_epoch(monkeypatch: pytest.MonkeyPatch) -> None:
    learner, collector = build(PointEnv(8), TOY)
    visited: list[torch.Tensor] = []
    real = learner._loss.loss_policy

    def watch(minibatch: TensorDict) -> TensorDict:
        visited.append(minibatch["observation"])
        return real(minibatch)

    monkeypatch.setattr(learner._loss, "loss_policy", watch)
    rollout = collector.rollout()
    learner.learn(rollout)
    samples = seen(rollout)
    per_epoch = len(samples) // TOY.minibatch_size
    assert len(visited) == TOY.epochs * per_epoch
    orders = [torch.cat(visited[i : i + per_epoch]) for i in range(0, len(visited), per_epoch)]
    for order in orders:
        assert sorted(order.tolist()) == sorted(samples.tolist())
    assert not torch.equal(orders[0], orders[1])


def test_the_visiting_order_comes_from_the_named_stream() -> None:
    learner, _ = build(PointEnv(8), TOY)
    expected = torch.randperm(256, generator=torch_stream(0, "minibatches"))
    assert torch.equal(torch.cat(learner._minibatches(256)), expected)


def test_truncations_bootstrap_and_terminations_do_not() -> None:
    """With a critic that returns its observation, gamma 0.5 and lambda 0: target = r + g * V'."""
    cfg = replace(TOY, gamma=0.5, gae_lambda=0.0, steps_per_env=3, minibatch_size=6)
    ends, cuts = torch.zeros(3, 2, dtype=torch.bool), torch.zeros(3, 2, dtype=torch.bool)
    ends[1, 0], cuts[1, 1] = True, True
    learner, collector = build(ScriptedEnv(torch.ones(3, 2), ends, cuts), cfg)
    learner.model.value = lambda obs: obs[..., 0]  # type: ignore[method-assign]
    batch, _ = learner._prepare(collector.rollout())
    # The observation after step t is t + 1, after a restart its negative (must not be used).
    ended, cut = batch["value_target"].reshape(3, 2).T
    assert ended.tolist() == [1 + 0.5 * 1, 1, 1 + 0.5 * 3]
    assert cut.tolist() == [1 + 0.5 * 1, 1 + 0.5 * 2, 1 + 0.5 * 3]


def test_acting_and_learning_see_the_same_statistics() -> None:
    cfg = replace(TOY, normalize_observations=True)
    learner, collector = build(PointEnv(8, scale=30.0), cfg)
    normalizer = learner.model.normalizer
    assert normalizer is not None
    first = collector.rollout()
    batch, _ = learner._prepare(first)
    torch.testing.assert_close(batch["observation"], seen(first).clamp(-10, 10))
    metrics = learner.learn(first)
    assert float(normalizer.count) == 256
    second = collector.rollout()
    samples, _ = learner._prepare(second)
    torch.testing.assert_close(samples["observation"], normalizer(seen(second)))
    # The policy that acted and the one that learns agree: the ratios of the first step are 1.
    logged = learner._update(samples, torch.arange(64))
    kl, clipped = float(logged[3]), float(logged[4])
    assert kl == pytest.approx(0, abs=1e-6)
    assert clipped == 0
    assert math.isfinite(metrics["loss_policy"])


def test_logged_values() -> None:
    learner, collector = build(PointEnv(8), TOY)
    metrics = learner.learn(collector.rollout())
    assert set(metrics) == {
        *("loss_policy", "loss_value", "entropy", "kl", "clip_fraction", "ess", "grad_norm"),
        *("explained_variance", "action_std", "lr"),
    }
    assert metrics["lr"] == TOY.learning_rate
    assert metrics["action_std"] == pytest.approx(math.exp(-1), rel=0.1)
    assert 0 < metrics["ess"] <= 1


def test_gradients_are_scaled_down_to_the_norm() -> None:
    cfg = replace(TOY, max_grad_norm=1e-3)
    learner, collector = build(PointEnv(8), cfg)
    batch, _ = learner._prepare(collector.rollout())
    logged = learner._update(batch, torch.arange(64))
    assert float(logged[-1]) > 1e-3  # the norm before scaling is logged
    grads = torch.cat([p.grad.flatten() for p in learner.model.parameters() if p.grad is not None])
    assert float(grads.norm()) == pytest.approx(1e-3, rel=1e-3)


def test_the_number_of_threads_does_not_change_a_bit() -> None:
    cfg = replace(TOY, hidden=[256, 128])  # wide enough for torch to split the products
    results = []
    for threads in (1, 2, 4):
        learner, collector = build(PointEnv(8), cfg, threads)
        metrics = learner.learn(collector.rollout())
        results.append((metrics, learner.model.state_dict()))
    for metrics, state in results[1:]:
        assert metrics == results[0][0]
        assert all(torch.equal(state[name], results[0][1][name]) for name in state)


def test_a_loss_that_is_not_finite_is_named_and_changes_nothing() -> None:
    learner, collector = build(PointEnv(8), TOY)
    rollout = collector.rollout()
    rollout["loc"][:] = math.inf  # actions of probability 0: infinite ratios
    before = {name: value.clone() for name, value in learner.model.state_dict().items()}
    with pytest.raises(RunError, match=r"^loss_policy is not finite .*last checkpoint is good"):
        learner.learn(rollout)
    after = learner.model.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_a_value_loss_that_is_not_finite_is_named() -> None:
    learner, collector = build(PointEnv(8), TOY)
    rollout = collector.rollout()
    rollout["next", "reward"][2, 3] = math.inf
    with pytest.raises(RunError, match=r"loss_value inf|loss_policy is not finite"):
        learner.learn(rollout)


def test_explained_variance() -> None:
    target = torch.tensor([1.0, 2.0, 3.0, 4.0])
    assert explained_variance(target, target) == 1
    assert explained_variance(torch.full((4,), 2.5), target) == 0
    # Errors 1, -1, 1, -1 have variance 1, the target has 1.25.
    assert explained_variance(torch.tensor([0.0, 3, 2, 5]), target) == pytest.approx(1 - 1 / 1.25)
    assert math.isnan(explained_variance(target, torch.ones(4)))


def test_uneven_minibatches_are_refused_with_the_sizes() -> None:
    check_batch(PAPER, 32)
    with pytest.raises(ConfigError, match=r"256 does not divide the 3968 samples.*num_envs 31"):
        check_batch(PAPER, 31)
    with pytest.raises(ConfigError, match="does not divide the 128"):
        check_batch(PAPER, 1)
