from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import pytest

from fake_runs import STEP, make, train
from fake_runs import end as end_run
from pgdm.config.compose import compose_plain
from pgdm.errors import ConfigError, SweepError
from pgdm.sweep.estimate import estimate
from pgdm.sweep.plan import Plan, SweepCfg, check_fits, job_key, read_job, read_plan, record
from pgdm.sweep.planning import make_plan
from pgdm.sweep.status import PLAN

CFG = SweepCfg(name=None, dir=None, max_attempts=3, detach=False, dry_run=False, most_jobs=10_000)
SMALL = ("total_frames=40960",)


def planned(*jobs: tuple[str, ...], name: str = "mine", **changes: object) -> Plan:
    """Plan jobs given by their overrides."""
    composed = [(job, compose_plain([*SMALL, *job])) for job in jobs]
    return make_plan(composed, dataclasses.replace(CFG, **changes), name, "pgdm-run -m ...")[0]


def test_jobs_have_names_keys_and_folders(tmp_path: Path) -> None:
    plan = planned(("seed=0", "obs=paper"), ("seed=1", "obs=paper"))
    assert (plan.name, plan.folder) == ("mine", tmp_path / "runs" / "sweeps" / "mine")
    assert [job.name for job in plan.jobs] == ["task=hammer-use1 seed=0", "task=hammer-use1 seed=1"]
    assert len({job.key for job in plan.jobs}) == 2
    for job in plan.jobs:
        assert job.key == job_key(job.cfg)
        assert len(job.key) == 16 and int(job.key, 16) >= 0
        assert Path(job.cfg.run_dir).parent == plan.folder / "runs"
        assert f"hammer-use1-pgdm-planned-absolute-ppo-s{job.cfg.seed}-" in job.cfg.run_dir


def test_names_tell_what_differs_and_stay_when_jobs_are_added() -> None:
    one = planned(("task=duck-lift", "seed=3"))
    more = planned(("task=duck-lift", "seed=3"), ("task=cup-pour1", "seed=3"))
    assert one.jobs[0].name == more.jobs[0].name == "task=duck-lift seed=3"
    both = planned(("algo=ppo", "action=residual"), ("algo=ppo_fast", "action=residual"))
    assert [job.name for job in both.jobs] == [
        "task=hammer-use1 algo=ppo seed=0",
        "task=hammer-use1 algo=ppo_fast seed=0",
    ]
    moved = planned(("seed=0", "run_dir=a"), ("seed=1", "run_dir=b"))
    assert moved.jobs[1].name == "task=hammer-use1 seed=1"
    assert Path(moved.jobs[1].cfg.run_dir) == Path("b").absolute()


def test_keys_follow_from_what_changes_the_result() -> None:
    def key(*overrides: str) -> str:
        return planned(overrides).jobs[0].key

    same = (["num_threads=1"], ["tracking=none"], ["offline=true"], ["run_dir=a"], ["device=cpu"])
    assert {key(*overrides) for overrides in same} == {key()}
    others = (["seed=1"], ["obs=paper"], ["total_frames=8192"], ["task=duck-lift"])
    assert len({key(*overrides) for overrides in others} | {key()}) == 5


def test_what_would_be_done_twice_is_left_out_and_told() -> None:
    typed = (("seed=0",), ("seed=1",), ("seed=0", "num_threads=1"))
    jobs = [(overrides, compose_plain(overrides)) for overrides in typed]
    plan, notes = make_plan(jobs, CFG, "mine", "")
    assert len(plan.jobs) == 2
    assert notes == ["'seed=0 num_threads=1' repeats 'seed=0', and is left out"]


@pytest.mark.parametrize(
    ("changes", "jobs", "message"),
    [
        ({"name": "a/b"}, [()], "sweep.name 'a/b' is not valid"),
        ({"name": ".."}, [()], "sweep.name '..' is not valid"),
        ({"name": ""}, [()], "sweep.name '' is not valid"),
        ({"max_attempts": 0}, [()], "sweep.max_attempts is 0; it must be at least 1"),
        ({}, [("seed=0", "run_dir=a"), ("seed=1", "run_dir=a")], "would share run_dir '.*a'"),
        ({}, [("seed=0",), ("seed=-1",)], r"seed is -1.*in the run task=hammer-use1 seed=-1; none"),
        ({}, [("~seed",)], r"missing seed.*in the run"),
    ],
)
def test_what_is_no_plan(
    changes: dict[str, object], jobs: list[tuple[str, ...]], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        planned(*jobs, **changes)


def test_a_folder_of_your_own(tmp_path: Path) -> None:
    plan = planned((), dir="elsewhere", name="x")
    assert plan.folder == tmp_path / "elsewhere"
    assert planned((), name="x").folder != planned((), name="y").folder


# The plan in its folder.


def test_a_plan_is_read_as_it_was_written(tmp_path: Path) -> None:
    plan = planned(("seed=0",), ("seed=1", "run_dir=outside"))
    record(plan)
    assert read_plan(plan.folder) == plan
    plan.folder.rename(tmp_path / "moved")
    moved = read_plan(tmp_path / "moved")
    assert Path(moved.jobs[0].cfg.run_dir).parent == tmp_path / "moved" / "runs"
    assert moved.jobs[1].cfg.run_dir == str(tmp_path / "outside")


def test_a_plan_older_than_a_key_is_read_and_its_jobs_are_the_same() -> None:
    plan = planned(("seed=0",), ("seed=1",))
    record(plan)
    file = plan.folder / PLAN
    whole = json.loads(file.read_text())
    for job in whole["jobs"]:
        del job["config"]["sim"]["object_mass"]
    file.write_text(json.dumps(whole))
    assert read_plan(plan.folder) == plan
    assert [job.key for job in check_fits(plan)] == [job.key for job in plan.jobs]


def test_more_jobs_are_added_to_those_that_are_there() -> None:
    record(planned(("seed=0",), ("seed=1",)))
    record(planned(("seed=1",), ("seed=2",)))
    record(planned(("seed=2",)))
    known = read_plan(planned(()).folder)
    assert [job.cfg.seed for job in known.jobs] == [0, 1, 2]


def test_settings_beside_the_result_may_change() -> None:
    record(planned(("seed=0", "num_threads=1")))
    record(planned(("seed=0", "num_threads=2")))
    (job,) = read_plan(planned(()).folder).jobs
    assert job.cfg.num_threads == 2


def test_changed_settings_are_refused_with_what_differs() -> None:
    record(planned(("seed=0",), ("seed=1",)))
    before = (planned(()).folder / PLAN).read_bytes()
    changed = planned(("seed=0", "algo.clip=0.1"), ("seed=1", "algo.clip=0.1"))
    with pytest.raises(SweepError) as caught:
        record(changed)
    message = str(caught.value)
    assert message.startswith("sweep 'mine' in '")
    assert (
        "(task=hammer-use1 seed=0: algo.clip: 0.2 -> 0.1; other settings also in 1 more job)"
        in message
    )
    assert message.endswith("choose another sweep.name, or the settings it was planned with")
    assert (planned(()).folder / PLAN).read_bytes() == before
    with pytest.raises(SweepError, match="total_frames: 40960 -> 81920"):
        check_fits(planned(("seed=0", "total_frames=81920")))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda whole: whole | {"format": 9}, "has the format of another pgdm"),
        (lambda whole: {}, "is damaged"),
        (lambda whole: [], "is damaged"),
        (lambda whole: whole | {"jobs": [{"key": "a"}]}, "is damaged"),
        (lambda whole: {**whole, "jobs": [_without_seed(whole)]}, r"missing seed.*sweep.name"),
    ],
)
def test_a_damaged_plan(change: Callable[[dict], object], message: str) -> None:
    plan = planned(())
    record(plan)
    whole = json.loads((plan.folder / PLAN).read_text())
    (plan.folder / PLAN).write_text(json.dumps(change(whole)))
    with pytest.raises(SweepError, match=message):
        record(plan)


def _without_seed(whole: dict) -> dict:
    job = whole["jobs"][0]
    config = {key: value for key, value in job["config"].items() if key != "seed"}
    return {**job, "config": config}


def test_a_worker_reads_its_own_job_only() -> None:
    plan = planned(("seed=0",), ("seed=1",))
    record(plan)
    file = plan.folder / PLAN
    whole = json.loads(file.read_text())
    del whole["jobs"][0]["config"]["seed"]  # damaged, but not read
    file.write_text(json.dumps(whole))
    assert read_job(plan.folder, plan.jobs[1].key) == plan.jobs[1]
    with pytest.raises(SweepError, match="missing seed"):
        read_plan(plan.folder)
    with pytest.raises(SweepError, match="has no job 0123; run the sweep's command again"):
        read_job(plan.folder, "0123")


def test_no_sweep_here(tmp_path: Path) -> None:
    with pytest.raises(SweepError, match=r"holds no sweep: it has no plan\.json"):
        read_plan(tmp_path)


# What it will cost.


def test_the_speed_is_assumed_where_nothing_was_measured(tmp_path: Path) -> None:
    cost = estimate(planned(("seed=0",), ("seed=1",)), tmp_path)
    assert (cost.finished, cost.begun, cost.frames_left) == (0, 0, 2 * 40960)
    assert (cost.steps_per_s, cost.measured_runs) == (1_000, 0)
    assert cost.hours == pytest.approx(81920 / 1_000 / 3600)


def test_what_is_done_is_not_left(tmp_path: Path) -> None:
    plan = planned(("seed=0",), ("seed=1",), ("seed=2",))
    for job, last in zip(plan.jobs, (10, 4, None), strict=False):
        if last:
            folder = make(Path(job.cfg.run_dir), seed=job.cfg.seed)
            train(folder, last=last)
            if last == 10:
                end_run(folder)
    cost = estimate(plan, tmp_path / "none")
    assert (cost.finished, cost.begun) == (1, 1)
    assert cost.frames_left == 6 * STEP + 10 * STEP


def test_a_killed_run_at_its_last_frame_is_not_finished(tmp_path: Path) -> None:
    plan = planned(())
    train(make(Path(plan.jobs[0].cfg.run_dir)))
    assert estimate(plan, tmp_path / "none").finished == 0


def test_the_speed_is_that_of_the_runs_most_alike(tmp_path: Path) -> None:
    def run(name: str, speed: float, algo: str, action: str, task: str) -> None:
        folder = make(tmp_path / "runs" / name, algo={"name": algo}, action={"kind": action},
                      task={"id": task}, num_envs=32, device="cpu")  # fmt: skip
        result = {"status": "finished", "steps_per_s": speed}
        (folder.path / "result.json").write_text(json.dumps(result))

    plan = planned(("task=duck-lift",))
    run("a", 10.0, "ppo_fast", "residual", "duck-lift")
    assert estimate(plan, tmp_path / "runs").measured_runs == 0
    run("b", 100.0, "ppo", "residual", "duck-lift")
    assert estimate(plan, tmp_path / "runs").steps_per_s == 100.0
    run("c", 200.0, "ppo", "absolute", "cup-pour1")
    run("d", 300.0, "ppo", "absolute", "cup-pour1")
    assert estimate(plan, tmp_path / "runs").steps_per_s == 250.0
    run("e", 400.0, "ppo", "absolute", "duck-lift")
    cost = estimate(plan, tmp_path / "runs")
    assert (cost.steps_per_s, cost.measured_runs) == (400.0, 1)
    (tmp_path / "runs" / "e" / "config.yaml").write_text("[")
    assert estimate(plan, tmp_path / "runs").measured_runs == 2
