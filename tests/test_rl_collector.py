from __future__ import annotations

import math
import threading
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import IndependentNormal, NormalParamExtractor, ProbabilisticActor

from pgdm.errors import ConfigError, RunError
from pgdm.rl.actor import GaussianActor
from pgdm.rl.algos import build_learner
from pgdm.rl.collector import RolloutCollector
from pgdm.rl.torch_state import torch_threads
from pgdm.rl.vec_env import VecEnv
from pgdm.seeding import torch_stream
from toy_envs import TOY, FreeEnv, PointEnv, ScriptedEnv


def collector(env: VecEnv, steps: int) -> RolloutCollector:
    learner = build_learner(env, replace(TOY, hidden=[8], minibatch_size=1), 0, 0, "cpu", 1, None)
    policy = TensorDictModule(learner.model.sample, ["observation"], ["action", "loc"])
    return RolloutCollector(env, policy, frames_per_batch=steps * env.num_envs, learner=learner)


def actor(env: VecEnv, seed: int = 0) -> GaussianActor:
    net = nn.Linear(env.obs_dim, env.action_dim)
    nn.init.normal_(net.weight, generator=torch_stream(seed, "weights"))
    return GaussianActor(net, nn.Parameter(torch.full((env.action_dim,), -1.0)))


def of_torchrl(env: VecEnv) -> ProbabilisticActor:
    """Return a policy of TorchRL's own parts, which draws from torch's global stream."""
    net = nn.Linear(env.obs_dim, 2 * env.action_dim)
    nn.init.constant_(net.weight, 0.1)
    module = TensorDictModule(
        nn.Sequential(net, NormalParamExtractor()), ["observation"], ["loc", "scale"]
    )
    return ProbabilisticActor(module, ["loc", "scale"], distribution_class=IndependentNormal)


def flags(steps: int, at: tuple[int, int]) -> Tensor:
    ends = torch.zeros(steps, 2, dtype=torch.bool)
    ends[at] = True
    return ends


def same(left: TensorDict, right: TensorDict) -> bool:
    return bool((left == right).all())


def test_a_rollout_holds_what_happened() -> None:
    reward = torch.arange(8.0).reshape(4, 2)
    env = ScriptedEnv(reward, flags(4, (1, 0)), flags(4, (2, 1)))
    rollout = collector(env, 4).rollout()
    assert (rollout.batch_size, rollout.names) == (torch.Size([2, 4]), [None, "time"])
    after = rollout["next"]
    # The scripted observation is the step's number; after a restart its negative.
    assert rollout["observation"][..., 0].tolist() == [[0, 1, -2, 3], [0, 1, 2, -3]]
    # After the last step of an episode: the observation before the restart.
    assert after["observation"][..., 0].tolist() == [[1, 2, 3, 4], [1, 2, 3, 4]]
    assert torch.equal(after["reward"][..., 0].t(), reward)
    assert torch.equal(after["raw_terms", "script"].t(), reward)
    assert after["terminated"][..., 0].nonzero().tolist() == [[0, 1]]
    assert after["truncated"][..., 0].nonzero().tolist() == [[1, 2]]
    assert torch.equal(after["done"], after["terminated"] | after["truncated"])
    assert "discount" not in after.keys()  # noqa: SIM118 - a TensorDict has no other way


def test_the_environments_discount_is_kept() -> None:
    class Discounting(FreeEnv):
        def step(self, action: Tensor):  # noqa: ANN202 - as the parent's
            *result, info = super().step(action)
            return *result, info | {"discount": torch.full((2,), 1 / self.t)}

    rollout = collector(Discounting(2, 5, 1), 3).rollout()
    expected = torch.tensor([1, 1 / 2, 1 / 3]).expand(2, 3)
    torch.testing.assert_close(rollout["next", "discount"][..., 0], expected)


def test_means_are_those_that_the_actions_were_sampled_around() -> None:
    made = collector(PointEnv(4), 6)
    rollout = made.rollout()
    model = made._learner.model
    for t in range(6):
        expected = model.act(rollout["observation"][:, t], deterministic=True)
        torch.testing.assert_close(rollout["loc"][:, t], expected)
    assert (rollout["action"] != rollout["loc"]).all()


def test_the_next_rollout_continues_where_the_last_one_stopped() -> None:
    in_two, in_one = collector(PointEnv(4), 5), collector(PointEnv(4), 10)
    whole = in_one.rollout()
    first = in_two.rollout()
    kept = first.clone()
    second = in_two.rollout()
    assert same(torch.cat((first, second), 1), whole)
    assert same(first, kept)  # not overwritten by the next one


def test_iteration_stops_at_the_total_with_a_complete_rollout() -> None:
    env = PointEnv(4)
    made = RolloutCollector(env, actor(env), frames_per_batch=20, total_frames=50)
    assert len(made) == 3
    assert [rollout.numel() for rollout in made] == [20, 20, 20]
    assert made.stats()["frames"] == 60 and made.stats()["completed"]
    assert list(made) == []
    endless = iter(RolloutCollector(env, actor(env), frames_per_batch=20))
    assert all(next(endless).numel() == 20 for _ in range(5))
    with pytest.raises(ConfigError, match="frames_per_batch 21 is not a multiple of the 4"):
        RolloutCollector(env, actor(env), frames_per_batch=21)


@pytest.mark.parametrize("build", [actor, of_torchrl])
def test_it_draws_from_its_own_stream(build: Any) -> None:
    def collected(seed: int, disturb: int) -> TensorDict:
        env = PointEnv(4)
        made = RolloutCollector(env, build(env), frames_per_batch=20, seed=seed)
        torch.manual_seed(disturb)
        before = torch.get_rng_state()
        rollouts = [made.rollout(), made.rollout()]
        assert torch.equal(torch.get_rng_state(), before)
        return torch.cat(rollouts, 1)

    torch.manual_seed(0)
    first, again, other = collected(1, 0), collected(1, 5), collected(2, 0)
    assert not torch.equal(first["action"], other["action"])
    assert (first["action"] != first["loc"]).all()
    assert torch.equal(first["action"], again["action"])


@pytest.mark.parametrize("build", [actor, of_torchrl])
def test_it_continues_from_its_state_to_the_bit(build: Any) -> None:
    env, other = PointEnv(4), PointEnv(4, seed=9)
    policy = build(env)
    made = RolloutCollector(env, policy, frames_per_batch=100, total_frames=300)
    rollouts = iter(made)
    next(rollouts)
    state = made.state_dict()
    expected = list(rollouts)
    restored = RolloutCollector(other, policy, frames_per_batch=100, total_frames=300, seed=9)
    restored.load_state_dict(state)
    got = list(restored)
    assert len(got) == len(expected) == 2
    assert all(same(left, right) for left, right in zip(got, expected, strict=True))


def test_a_seed_restarts_the_streams() -> None:
    class Reseeded(PointEnv):
        def reseed(self, seed: int) -> None:
            self._generator = torch_stream(seed, "point")

    env = Reseeded(4)
    made = RolloutCollector(env, actor(env), frames_per_batch=20)
    assert made.set_seed(7) == 8
    made.reset()
    first = made.rollout()
    assert made.set_seed(7, static_seed=True) == 7
    made.reset()
    assert same(made.rollout(), first)
    made.set_seed(8)
    made.reset()
    assert not torch.equal(made.rollout()["observation"], first["observation"])


def test_the_policys_weights_can_be_replaced() -> None:
    env = PointEnv(4)
    made = RolloutCollector(env, actor(env), frames_per_batch=20)
    made.update_policy_weights_()  # shared: nothing to do
    for seed, given in ((1, lambda other: other), (2, TensorDict.from_module)):
        other = actor(env, seed)
        assert not torch.equal(made.policy.net.weight, other.net.weight)
        made.update_policy_weights_(given(other))
        assert torch.equal(made.policy.net.weight, other.net.weight)
        assert made.policy.net.weight is not other.net.weight
    with pytest.raises(KeyError, match="no model 'critic'"):
        made.update_policy_weights_(actor(env), model_id="critic")


def test_hooks_run_before_and_after_each_rollout() -> None:
    env, seen = PointEnv(4), []
    made = RolloutCollector(env, actor(env), frames_per_batch=20, total_frames=40)
    made.pre_collect_hook = lambda: seen.append("before")
    made.post_collect_hook = lambda rollout: seen.append(rollout.numel())
    assert len(list(made)) == 2
    assert seen == ["before", 20, "before", 20]


def test_shutdown_stops_the_thread_of_the_physics() -> None:
    def running() -> list[str]:
        return [t.name for t in threading.enumerate() if t.name.startswith("pgdm-physics")]

    class Idle:
        overlaps, model = True, None

        def during_step(self) -> None:
            assert running()

        def after_step(self, step: Mapping[str, Any]) -> None:
            assert step["next"]["reward"].shape == (4, 1)

    env, before = PointEnv(4), running()
    learner: Any = Idle()
    made = RolloutCollector(env, actor(env), frames_per_batch=20, learner=learner)
    made.rollout()
    assert len(running()) == len(before) + 1
    made.shutdown()
    assert running() == before


def test_an_actor_samples_unless_exploration_is_off() -> None:
    env = PointEnv(4)
    policy, obs = actor(env), torch.randn(4, env.obs_dim, generator=torch_stream(0, "obs"))
    sampled = policy(TensorDict({"observation": obs}, [4]))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        still = policy(TensorDict({"observation": obs}, [4]))
    assert torch.equal(still["action"], policy.net(obs))
    assert (sampled["action"] != still["action"]).all()
    normal = torch.distributions.Normal(policy.net(obs), math.exp(-1))
    expected = normal.log_prob(sampled["action"]).sum(-1)
    torch.testing.assert_close(sampled["action_log_prob"], expected)


def test_metrics_are_means_over_the_episodes_that_finished() -> None:
    made = collector(PointEnv(4), 45)  # episodes of 20 steps, unless they leave the square
    rollout = made.rollout()
    metrics = made.metrics
    done = rollout["next", "done"][..., 0]
    assert metrics["episodes"] == int(done.sum()) >= 8
    # An episode's length is the last step's number, which the observation shows as a share of 20.
    lengths = 20 * rollout["next", "observation"][..., -1][done]
    assert metrics["length"] == pytest.approx(float(lengths.mean()))
    assert metrics["reward"] == pytest.approx(float(rollout["next", "reward"].mean()))


def test_without_a_finished_episode_there_are_no_episode_metrics() -> None:
    made = collector(PointEnv(4), 3)
    made.rollout()
    assert set(made.metrics) == {"reward", "episodes"}


def test_a_reward_that_is_not_finite_is_named() -> None:
    reward = torch.zeros(4, 2)
    reward[2, 1] = math.nan
    with pytest.raises(RunError, match=r"reward term 'script' is nan in simulation 1 at step 2"):
        collector(ScriptedEnv(reward), 4).rollout()


def test_an_observation_that_is_not_finite_is_named() -> None:
    env = FreeEnv(2, 5, 1)
    env._frames[3, 1, 4] = math.inf
    with pytest.raises(RunError, match=r"entry 4 of the observation is inf in simulation 1"):
        collector(env, 4).rollout()


def test_infinities_of_both_signs_do_not_hide_each_other() -> None:
    reward = torch.tensor([[math.inf, -math.inf]])
    with pytest.raises(RunError, match="is inf in simulation 0 at step 0"):
        collector(ScriptedEnv(reward), 1).rollout()


def test_acting_uses_one_thread_and_restores_the_rest() -> None:
    seen: list[int] = []

    class Watch(FreeEnv):
        def step(self, action: Tensor):  # noqa: ANN202 - as the parent's
            seen.append(torch.get_num_threads())
            return super().step(action)

    with torch_threads(2):
        collector(Watch(2, 5, 1), 3).rollout()
        assert torch.get_num_threads() == 2
    assert seen == [1, 1, 1]
