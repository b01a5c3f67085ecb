from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from toy_envs import TOY, PointEnv, trainer_cfg

from pgdm.errors import CheckpointError, ConfigError, RunError
from pgdm.rl.callback import Callback, Progress
from pgdm.rl.checkpoint import CheckpointFolder
from pgdm.rl.evaluate import Evaluator, load_policy
from pgdm.rl.trainer import Extras, Trainer


class Record(Callback):
    """Notes every moment and its numbers, times aside."""

    def __init__(self) -> None:
        self.moments: list[tuple] = []

    def on_start(self, trainer: Trainer) -> None:
        self.moments.append(("start", trainer.progress.frames))

    def on_iteration(self, progress: Progress, metrics: dict[str, float]) -> None:
        kept = {name: value for name, value in metrics.items() if "steps_per_s" not in name}
        self.moments.append(("iteration", progress.frames, kept))

    def on_evaluation(self, progress: Progress, metrics: dict[str, float]) -> None:
        self.moments.append(("evaluation", progress.frames, metrics))

    def on_checkpoint(self, progress: Progress, path: Path) -> None:
        self.moments.append(("checkpoint", progress.frames, path.name))

    def on_end(self, progress: Progress, status: str) -> None:
        self.moments.append(("end", progress.frames, status))

    def named(self, *names: str) -> list[tuple]:
        return [moment for moment in self.moments if moment[0] in names]


def evaluator(episodes: int = 16) -> Evaluator:
    return Evaluator(lambda n: PointEnv(n, seed=1), episodes, 4, seed=3)


def weights(trainer: Trainer) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in trainer.model.state_dict().items()}


def assert_same(left: dict[str, torch.Tensor], right: dict[str, torch.Tensor]) -> None:
    assert left.keys() == right.keys()
    for name in left:
        assert torch.equal(left[name], right[name]), name


def test_ppo_brings_the_point_to_the_origin() -> None:
    record = Record()
    cfg = trainer_cfg(total_frames=20_480)
    outcome = Trainer(PointEnv(), cfg, Extras(evaluation=evaluator(), callbacks=[record])).run()
    first, last = (metrics for _, _, metrics in record.named("evaluation"))
    assert first["eval_sampled/success"] < 0.2
    assert last["eval_sampled/success"] > 0.7
    assert last["eval_deterministic/success"] > 0.9
    assert last["eval_sampled/return"] > 2 * first["eval_sampled/return"]  # both are negative
    assert outcome.status == "finished"
    assert outcome.evaluation == last
