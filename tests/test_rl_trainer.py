from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pgdm.errors import CheckpointError, ConfigError, RunError
from pgdm.mdp.schedules import Ramp
from pgdm.rl.callback import Callback, Progress
from pgdm.rl.checkpoint import CheckpointFolder, read_checkpoint
from pgdm.rl.evaluate import Evaluator, policy_of
from pgdm.rl.trainer import Extras, Trainer
from toy_envs import TOY, PointEnv, trainer_cfg


class Record(Callback):
    """Records every event and its values except times."""

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


def test_the_same_seed_repeats_to_the_bit_and_another_does_not() -> None:
    def trained(seed: int) -> tuple[dict[str, torch.Tensor], list[tuple]]:
        record = Record()
        trainer = Trainer(
            PointEnv(), trainer_cfg(seed=seed, total_frames=1024), Extras(callbacks=[record])
        )
        trainer.run()
        return weights(trainer), record.moments

    first, again, other = trained(3), trained(3), trained(4)
    assert_same(first[0], again[0])
    assert first[1] == again[1]
    assert not torch.equal(first[0]["policy.0.weight"], other[0]["policy.0.weight"])


def test_evaluations_and_checkpoints_do_not_disturb_the_training(tmp_path: Path) -> None:
    bare = Trainer(PointEnv(), trainer_cfg(total_frames=1024))
    bare.run()
    cfg = trainer_cfg(total_frames=1024, eval_interval_frames=256, checkpoint_interval_s=0.0)
    busy = Trainer(
        PointEnv(),
        cfg,
        Extras(
            evaluation=evaluator(), checkpoints=CheckpointFolder(tmp_path, 2), callbacks=[Record()]
        ),
    )
    busy.run()
    assert_same(weights(bare), weights(busy))


def test_events_come_in_order(tmp_path: Path) -> None:
    record = Record()
    cfg = trainer_cfg(total_frames=1024, eval_interval_frames=512)
    extras = Extras(
        evaluation=evaluator(), checkpoints=CheckpointFolder(tmp_path, 2), callbacks=[record]
    )
    Trainer(PointEnv(), cfg, extras).run()
    moments = [m[:2] for m in record.moments if m[0] != "checkpoint"]
    assert moments == [
        ("start", 0),
        ("evaluation", 0),
        ("iteration", 256),
        ("iteration", 512),
        ("evaluation", 512),
        ("iteration", 768),
        ("iteration", 1024),
        ("evaluation", 1024),
        ("end", 1024),
    ]
    assert record.moments[-1] == ("end", 1024, "finished")
    files = [name for _, _, name in record.named("checkpoint")]
    assert files[0] == "best.ckpt"  # the first evaluation is the best so far
    assert files[-1] == "frames_000000001024.ckpt"


def test_train_metrics_have_the_names_that_others_rely_on() -> None:
    record = Record()
    Trainer(PointEnv(), trainer_cfg(total_frames=1024), Extras(callbacks=[record])).run()
    [*_, (_, _, metrics)] = record.named("iteration")
    assert metrics.keys() >= {
        f"train/{name}"
        for name in (
            *("reward", "return", "length", "success", "loss_policy", "loss_value", "entropy"),
            *("kl", "clip_fraction", "explained_variance", "ess", "grad_norm", "action_std", "lr"),
        )
    }


def test_the_last_iteration_is_completed_and_counted() -> None:
    outcome = Trainer(PointEnv(), trainer_cfg(total_frames=700)).run()
    assert (outcome.progress.frames, outcome.progress.iteration) == (768, 3)
    assert outcome.progress.total_frames == 700
    assert outcome.progress.elapsed_s > 0


@pytest.mark.parametrize(("warm", "bias"), [(True, [0.25, -0.5]), (False, [0.0, 0.0])])
def test_the_policys_mean_starts_at_the_warm_start(warm: bool, bias: list[float]) -> None:
    trainer = Trainer(PointEnv(), trainer_cfg(replace(TOY, warm_start=warm)))
    torch.testing.assert_close(trainer.model.policy[-1].bias.detach(), torch.tensor(bias))


def test_schedules_are_applied_before_each_iteration() -> None:
    env = PointEnv()
    seen: list[int] = []

    def ramp(frames: int) -> dict[str, float]:
        seen.append(frames)
        return {"near": frames / 1024}

    Trainer(env, trainer_cfg(total_frames=1024), Extras(schedules=[ramp])).run()
    assert seen == [0, 256, 512, 768]
    assert env.weights["near"] == 0.75


def test_scheduled_weights_are_recorded_and_survive_a_resume_and_another_width(
    tmp_path: Path,
) -> None:
    ramp = Ramp("near", 2.0, 1024)

    def weights(record: Record) -> list[tuple[int, float]]:
        iterations = record.named("iteration")
        return [(frames, metrics["train/weight/near"]) for _, frames, metrics in iterations]

    cfg = trainer_cfg(total_frames=1536)
    straight, first, second, wide = Record(), Record(), Record(), Record()
    Trainer(PointEnv(), cfg, Extras(schedules=[ramp], callbacks=[straight])).run()
    # Frames after an iteration, with the weight from its start.
    expected = [(256, 0.0), (512, 0.5), (768, 1.0), (1024, 1.5), (1280, 2.0), (1536, 2.0)]
    assert weights(straight) == expected

    folder = CheckpointFolder(tmp_path, 2)
    stopping = replace(stop_after(first, 2), schedules=[ramp], checkpoints=folder)
    Trainer(PointEnv(), cfg, stopping).run()
    env = PointEnv()
    trainer = Trainer(env, cfg, Extras(schedules=[ramp], callbacks=[second]))
    state = folder.latest()
    assert state is not None
    trainer.load_state_dict(state)
    trainer.run()
    assert weights(first) + weights(second) == expected
    assert env.weights["near"] == 2.0

    # Twice the simulations: half the iterations, on the same line over frames.
    Trainer(PointEnv(16), cfg, Extras(schedules=[ramp], callbacks=[wide])).run()
    assert weights(wide) == [(512, 0.0), (1024, 1.0), (1536, 2.0)]


def stop_after(record: Record, iterations: int) -> Extras:
    return Extras(callbacks=[record], stop=lambda: len(record.named("iteration")) >= iterations)


def test_a_stop_saves_and_a_restored_training_equals_a_straight_one(tmp_path: Path) -> None:
    cfg = trainer_cfg(total_frames=1536, eval_interval_frames=512)
    straight_record, record = Record(), Record()
    straight = Trainer(PointEnv(), cfg, Extras(evaluation=evaluator(), callbacks=[straight_record]))
    whole = straight.run()

    folder = CheckpointFolder(tmp_path, 2)
    stopping = replace(stop_after(record, 2), evaluation=evaluator(), checkpoints=folder)
    outcome = Trainer(PointEnv(), cfg, stopping).run()
    assert outcome.status == "interrupted"
    assert outcome.progress.iteration == 2
    state = folder.latest()
    assert state is not None
    # Stopped before an evaluation that was due: done after the resume.
    assert (state["frames"], state["evaluated_at"]) == (512, 0)

    resumed = Trainer(
        PointEnv(seed=99),
        cfg,
        Extras(evaluation=evaluator(), checkpoints=folder, callbacks=[record]),
    )
    resumed.load_state_dict(state)
    end = resumed.run()
    assert end.status == "finished"
    assert end.evaluation == whole.evaluation
    assert end.progress.elapsed_s > state["elapsed_s"]
    assert_same(weights(resumed), weights(straight))
    kinds = ("iteration", "evaluation")
    assert record.named(*kinds) == straight_record.named(*kinds)


def test_a_finished_training_can_be_extended(tmp_path: Path) -> None:
    straight = Trainer(PointEnv(), trainer_cfg(total_frames=1024))
    straight.run()
    folder = CheckpointFolder(tmp_path, 2)
    Trainer(PointEnv(), trainer_cfg(total_frames=512), Extras(checkpoints=folder)).run()
    longer = Trainer(PointEnv(), trainer_cfg(total_frames=1024), Extras(checkpoints=folder))
    longer.load_state_dict(folder.latest() or {})
    assert longer.run().progress.frames == 1024
    assert_same(weights(longer), weights(straight))


def test_a_time_limit_finishes_a_training_early_summed_over_attempts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter(range(10_000))  # each reading of the clock adds a second
    monkeypatch.setattr("pgdm.rl.trainer.time.monotonic", lambda: float(next(clock)))
    folder = CheckpointFolder(tmp_path, 2)

    def trainer(limit_s: float) -> Trainer:
        evaluation = Evaluator(lambda n: PointEnv(n, seed=1), 4, 1, seed=3)
        extras = Extras(evaluation=evaluation, checkpoints=folder)
        return Trainer(PointEnv(), trainer_cfg(time_limit_s=limit_s), extras)

    first = trainer(20.0).run()
    assert first.status == "finished"
    assert 0 < first.progress.frames == first.progress.total_frames < 4096
    state = folder.latest()
    assert state is not None
    assert state["frames"] == state["evaluated_at"] == first.progress.frames
    assert first.evaluation == state["last_evaluation"]

    same, longer = trainer(20.0), trainer(40.0)
    for resumed in (same, longer):
        resumed.load_state_dict(state)
    assert same.run().progress.frames == first.progress.frames
    assert longer.run().progress.frames > first.progress.frames


def test_resuming_a_finished_training_does_nothing(tmp_path: Path) -> None:
    folder, record = CheckpointFolder(tmp_path, 2), Record()
    extras = Extras(evaluation=evaluator(), checkpoints=folder)
    first = Trainer(PointEnv(), trainer_cfg(total_frames=512), extras).run()
    again = Trainer(PointEnv(), trainer_cfg(total_frames=512), replace(extras, callbacks=[record]))
    again.load_state_dict(folder.latest() or {})
    outcome = again.run()
    assert outcome.status == "finished"
    assert outcome.evaluation == first.evaluation
    assert [moment[0] for moment in record.moments] == ["start", "end"]


def test_the_best_policy_is_kept(tmp_path: Path) -> None:
    scores = iter([(0.1, 5.0), (0.3, 1.0), (0.3, 2.0), (0.2, 9.0), (float("nan"), 0.0)])

    class Scripted:
        def evaluate(self, policy: object, stop: object) -> dict[str, float]:
            success, total = next(scores)
            return {"eval_sampled/success": success, "eval_sampled/return": total}

    folder, record = CheckpointFolder(tmp_path, 2), Record()
    cfg = trainer_cfg(total_frames=1024, eval_interval_frames=1)
    extras = Extras(evaluation=Scripted(), checkpoints=folder, callbacks=[record])
    Trainer(PointEnv(), cfg, extras).run()
    best = [frames for _, frames, name in record.named("checkpoint") if name == "best.ckpt"]
    assert best == [0, 256, 512]
    policy = policy_of(read_checkpoint(folder.best), folder.best)
    assert policy.cfg.hidden == TOY.hidden


def test_the_metadata_is_in_the_checkpoint(tmp_path: Path) -> None:
    folder = CheckpointFolder(tmp_path, 2)
    extras = Extras(checkpoints=folder, metadata={"task": "point", "numbers": [1, 2.5]})
    Trainer(PointEnv(), trainer_cfg(total_frames=256), extras).run()
    state = folder.latest()
    assert state is not None
    assert state["metadata"] == {"task": "point", "numbers": [1, 2.5]}


def test_checkpoints_are_written_by_time(tmp_path: Path) -> None:
    record = Record()
    cfg = trainer_cfg(total_frames=1024, checkpoint_interval_s=0.0)
    extras = Extras(checkpoints=CheckpointFolder(tmp_path, 2), callbacks=[record])
    Trainer(PointEnv(), cfg, extras).run()
    assert [frames for _, frames, _ in record.named("checkpoint")] == [0, 256, 512, 768, 1024]
    assert len(list(tmp_path.iterdir())) == 2


def test_a_nan_fails_the_training_and_leaves_a_good_checkpoint(tmp_path: Path) -> None:
    record = Record()
    env = PointEnv()
    folder = CheckpointFolder(tmp_path, 2)

    def poison(frames: int) -> dict[str, float]:
        return {"near": float("nan") if frames >= 512 else 1.0}

    cfg = trainer_cfg(total_frames=1024, checkpoint_interval_s=0.0)
    extras = Extras(checkpoints=folder, schedules=[poison], callbacks=[record])
    with pytest.raises(RunError, match="reward term 'near' is nan in simulation 0 at step 0"):
        Trainer(env, cfg, extras).run()
    assert record.moments[-1] == ("end", 512, "failed")
    state = folder.latest()
    assert state is not None
    assert state["frames"] == 512
    assert all(torch.isfinite(value).all() for value in state["learner"]["model"].values())


def test_a_checkpoint_of_another_network_is_refused() -> None:
    state = Trainer(PointEnv(), trainer_cfg()).state_dict()
    other = Trainer(PointEnv(), trainer_cfg(replace(TOY, hidden=[16])))
    with pytest.raises(CheckpointError, match=r"hidden is \[32, 32\] there and \[16\] here"):
        other.load_state_dict(state)
    same = Trainer(PointEnv(), trainer_cfg())
    del state["frames"]
    with pytest.raises(CheckpointError, match="it is not the state of a run"):
        same.load_state_dict(state)


def test_minibatches_that_do_not_divide_are_refused_at_construction() -> None:
    with pytest.raises(ConfigError, match="does not divide"):
        Trainer(PointEnv(7), trainer_cfg())
