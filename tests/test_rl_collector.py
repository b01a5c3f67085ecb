from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from pgdm.errors import RunError
from pgdm.rl.algos import build_learner
from pgdm.rl.collector import Collector, torch_threads
from pgdm.rl.vec_env import VecEnv
from pgdm.seeding import torch_stream
from toy_envs import TOY, FreeEnv, PointEnv, ScriptedEnv


def collector(env: VecEnv, steps: int) -> Collector:
    learner = build_learner(env, replace(TOY, hidden=[8], minibatch_size=1), 0, 0, "cpu", 1, None)
    made = Collector(env, learner, steps, torch_stream(0, "actions"))
    made.reset()
    return made


def flags(steps: int, at: tuple[int, int]) -> Tensor:
    ends = torch.zeros(steps, 2, dtype=torch.bool)
    ends[at] = True
    return ends


def test_a_rollout_holds_what_happened() -> None:
    reward = torch.arange(8.0).reshape(4, 2)
    env = ScriptedEnv(reward, flags(4, (1, 0)), flags(4, (2, 1)))
    rollout = collector(env, 4).collect()
    # The scripted observation is the step's number; after a restart its negative.
    assert rollout.obs[:, 0, 0].tolist() == [0, 1, -2, 3, 4]
    assert rollout.obs[:, 1, 0].tolist() == [0, 1, 2, -3, 4]
    assert torch.equal(rollout.reward, reward)
    assert rollout.terminated.nonzero().tolist() == [[1, 0]]
    assert rollout.truncated.nonzero().tolist() == [[2, 1]]
    # Of the truncated row alone the true last observation is kept, for its value.
    [(t, rows, last)] = rollout.last_obs
    assert (t, rows.tolist(), last.tolist()) == (2, [1], [[3.0]])


def test_means_are_those_that_the_actions_were_sampled_around() -> None:
    made = collector(PointEnv(4), 6)
    rollout = made.collect()
    model = made.learner.model
    for t in range(6):
        expected = model.act(rollout.obs[t], deterministic=True)
        torch.testing.assert_close(rollout.mean[t], expected)
    assert (rollout.action != rollout.mean).all()


def test_the_next_rollout_goes_on_where_the_last_one_ended() -> None:
    in_two, in_one = collector(PointEnv(4), 5), collector(PointEnv(4), 10)
    whole = in_one.collect()
    first = in_two.collect().obs.clone()
    second = in_two.collect().obs
    torch.testing.assert_close(torch.cat((first[:-1], second)), whole.obs)
    assert in_two.frames == 20


def test_metrics_are_means_over_the_episodes_that_finished() -> None:
    made = collector(PointEnv(4), 45)  # episodes of 20 steps, unless they leave the square
    rollout = made.collect()
    metrics = rollout.metrics()
    ends = int((rollout.terminated | rollout.truncated).sum())
    assert metrics["episodes"] == ends >= 8
    lengths = torch.cat([ended.metrics()["length"] for ended in rollout.finished]).double()
    assert len(lengths) == ends
    assert metrics["length"] == float(lengths.mean())
    assert metrics["reward"] == pytest.approx(float(rollout.reward.mean()))


def test_without_a_finished_episode_there_are_no_episode_metrics() -> None:
    assert set(collector(PointEnv(4), 3).collect().metrics()) == {"reward", "episodes"}


def test_a_reward_that_is_not_finite_is_named() -> None:
    reward = torch.zeros(4, 2)
    reward[2, 1] = math.nan
    with pytest.raises(RunError, match=r"reward term 'script' is nan in simulation 1 at step 2"):
        collector(ScriptedEnv(reward), 4).collect()


def test_an_observation_that_is_not_finite_is_named() -> None:
    env = FreeEnv(2, 5, 1)
    env._frames[3, 1, 4] = math.inf
    with pytest.raises(RunError, match=r"entry 4 of the observation is inf in simulation 1"):
        collector(env, 4).collect()


def test_infinities_of_both_signs_do_not_hide_each_other() -> None:
    reward = torch.tensor([[math.inf, -math.inf]])
    with pytest.raises(RunError, match="is inf in simulation 0 at step 0"):
        collector(ScriptedEnv(reward), 1).collect()


def test_acting_uses_one_thread_and_gives_the_rest_back() -> None:
    seen: list[int] = []

    class Watch(FreeEnv):
        def step(self, action: Tensor):  # noqa: ANN202 - as the parent's
            seen.append(torch.get_num_threads())
            return super().step(action)

    with torch_threads(2):
        collector(Watch(2, 5, 1), 3).collect()
        assert torch.get_num_threads() == 2
    assert seen == [1, 1, 1]
