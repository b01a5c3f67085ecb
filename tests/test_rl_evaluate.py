from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from pgdm.errors import CheckpointError
from pgdm.rl.checkpoint import CheckpointFolder, read_checkpoint, write_checkpoint
from pgdm.rl.evaluate import Evaluator, policy_of, run_episodes, summarise
from pgdm.rl.learner import AlgoCfg
from pgdm.rl.trainer import Extras, Trainer
from pgdm.seeding import torch_stream
from toy_envs import TOY, TOY_SAC, Ended, PointEnv, trainer_cfg


class Still:
    """A policy that does nothing."""

    def act(
        self, obs: Tensor, generator: torch.Generator | None = None, deterministic: bool = False
    ) -> Tensor:
        return torch.zeros(len(obs), 2)


class Noisy(Still):
    def act(
        self, obs: Tensor, generator: torch.Generator | None = None, deterministic: bool = False
    ) -> Tensor:
        if deterministic:
            return torch.zeros(len(obs), 2)
        return torch.randn(len(obs), 2, generator=generator)


class LadderEnv(PointEnv):
    """Simulation i's episodes take i + 1 steps; success is the number it has finished so far."""

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs)
        self.ladder, self.finished = torch.arange(num_envs) + 1, torch.zeros(num_envs)

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        self._t = self._t + 1
        done = self._t >= self.ladder
        self.finished += done
        metrics = {"length": self._t[done], "finished": self.finished[done]}
        episodes = Ended(metrics) if done.any() else None
        info = {"final_obs": self._obs(), "episodes": episodes, "terms": {}}
        self._t = self._t.masked_fill(done, 0)
        never = torch.zeros_like(done)
        return self._obs(), torch.zeros(self.num_envs), done, never, info


def test_only_the_first_episode_of_each_simulation_counts() -> None:
    results = run_episodes(LadderEnv(5), Still(), None)
    assert results is not None
    assert results["length"].tolist() == [1, 2, 3, 4, 5]
    assert results["finished"].tolist() == [1, 1, 1, 1, 1]


def test_means_and_standard_deviations() -> None:
    summary = summarise({"length": torch.tensor([1.0, 2, 3]), "one": torch.tensor([4.0])}, "a/")
    assert summary == {"a/length": 2.0, "a/length_std": 1.0, "a/one": 4.0}


def test_names_of_sampled_and_deterministic_metrics() -> None:
    metrics = Evaluator(lambda n: PointEnv(n, seed=1), 3, 1, seed=0).evaluate(Noisy())
    assert metrics is not None
    assert {"eval_sampled/return", "eval_sampled/return_std"} <= metrics.keys()
    assert "eval_deterministic/return" in metrics
    assert "eval_deterministic/return_std" not in metrics  # needs two episodes


def test_it_repeats_to_the_bit_and_touches_no_other_stream() -> None:
    evaluator = Evaluator(lambda n: PointEnv(n, seed=1), 8, 2, seed=0)
    before = torch.random.get_rng_state()
    first = evaluator.evaluate(Noisy())
    assert evaluator.evaluate(Noisy()) == first
    assert Evaluator(lambda n: PointEnv(n, seed=1), 8, 2, seed=0).evaluate(Noisy()) == first
    assert Evaluator(lambda n: PointEnv(n, seed=1), 8, 2, seed=1).evaluate(Noisy()) != first
    assert torch.equal(torch.random.get_rng_state(), before)


def test_environments_are_built_once() -> None:
    built: list[int] = []

    def make(n: int) -> PointEnv:
        built.append(n)
        return PointEnv(n)

    evaluator = Evaluator(make, 8, 2, seed=0)
    evaluator.evaluate(Still())
    evaluator.evaluate(Still())
    assert built == [8, 2]


def test_a_stop_abandons_the_evaluation_between_steps() -> None:
    polled: list[int] = []

    def stop() -> bool:
        polled.append(1)
        return len(polled) > 3

    evaluator = Evaluator(lambda n: PointEnv(n), 4, 1, seed=0)
    assert evaluator.evaluate(Still(), stop) is None
    assert len(polled) == 4
    assert evaluator.evaluate(Still()) is not None


@pytest.mark.parametrize(
    ("algo", "normalizes"),
    [
        (TOY, False),
        (replace(TOY, normalize_observations=True), True),
        (replace(TOY_SAC, warmup_steps=50), True),
    ],
    ids=["ppo", "ppo, normalised", "sac"],
)
def test_a_loaded_policy_acts_like_the_trained_one(
    tmp_path: Path, algo: AlgoCfg, normalizes: bool
) -> None:
    cfg = trainer_cfg(algo, total_frames=512)
    trainer = Trainer(PointEnv(scale=30.0), cfg, Extras(checkpoints=CheckpointFolder(tmp_path, 1)))
    trainer.run()
    [path] = CheckpointFolder(tmp_path, 1).all()
    policy = policy_of(read_checkpoint(path), path)
    obs = 30 * torch.randn(4, 5, generator=torch_stream(0, "test"))
    mean = trainer.model.act(obs, deterministic=True)
    assert torch.equal(policy.act(obs, deterministic=True), mean)
    sample = trainer.model.act(obs, torch_stream(1, "a"))
    assert torch.equal(policy.act(obs, torch_stream(1, "a")), sample)
    assert (policy.normalizer is not None) == normalizes


@pytest.mark.parametrize("network", [{"obs_dim": 3}, {"kind": "squashed"}, [], None])
def test_a_checkpoint_without_a_policy_is_refused(tmp_path: Path, network: object) -> None:
    write_checkpoint(tmp_path / "a.ckpt", {"network": network})
    with pytest.raises(CheckpointError, match="holds no policy"):
        policy_of(read_checkpoint(tmp_path / "a.ckpt"), tmp_path / "a.ckpt")
