"""Sweeps from the command line: planned with the real Hydra, shown, and started if wanted."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from command_line import TINY, Outcome, command
from pgdm.config.compose import compose
from pgdm.library import Library, Motion, open_library
from pgdm.sweep.foresee import foresee
from pgdm.sweep.plan import Plan, read_plan, record

SMALL = ("-m", "--dry-run", "budget=smoke")


def shown(outcome: Outcome) -> dict[str, str]:
    """Return the rows of the plan that was shown."""
    assert outcome.code == 0, outcome.err
    rows = [line.strip().partition("  ") for line in outcome.out.splitlines()]
    return {key: value.strip() for key, _, value in rows if value}


def started(monkeypatch: pytest.MonkeyPatch) -> list[Plan]:
    """Have sweeps noted, and recorded, instead of run."""
    plans: list[Plan] = []

    def note(plan: Plan, *_: object) -> int:
        record(plan)
        plans.append(plan)
        return 0

    monkeypatch.setattr("pgdm.cli.plan.run_sweep", note)
    return plans


def test_a_dry_run_shows_the_plan_and_leaves_nothing(tmp_path: Path) -> None:
    outcome = command("pgdm-run", *SMALL, "task=quick6,dhand-cup", "seed=0,1", "obs=released,paper")
    rows = shown(outcome)
    assert outcome.out.startswith("sweep grid-smoke-released-paper-")
    assert rows["jobs"] == "24 (0 finished, 0 begun)"
    assert rows["tasks"].startswith("6: hammer-use1, cup-pour1, spheremedium-lift, dhand-cup")
    assert rows["seeds"] == "0, 1"
    assert (
        "pregrasp planned, action absolute, algo ppo, shaping none, obs released|paper"
        in (rows["settings"])
    )
    assert rows["differ in"] == "obs, seed, task"
    assert rows["frames"] == "8,192 a job, 196,608 in all, 196,608 left"
    assert rows["time"].endswith("there is no earlier run like these")
    assert "disk" not in rows
    assert "nothing was started" in outcome.out
    assert list(tmp_path.iterdir()) == []


def test_a_plan_with_replays_says_what_they_take_and_that_they_are_slower() -> None:
    rows = shown(command("pgdm-run", *SMALL, "algo=sac", "seed=0,1", "total_frames=1_000_000"))
    assert rows["disk"] == "about 1.5 GB for the replay of a job, until it has finished"
    kept = shown(command("pgdm-run", *SMALL, "algo=sac", "seed=0,1", "keep_replay=true"))
    assert kept["disk"].endswith("for the replay of a job, kept")
    assert "400 steps/s, which is assumed" in rows["time"]


@pytest.mark.parametrize(
    ("arguments", "name", "jobs"),
    [
        (["-m", "task=tcdm30"], "grid", 30),
        (["-m", "task=choice(tcdm30)", "seed=range(0,2)"], "grid", 60),
        (["-m", "task=glob(dhand-*)"], "grid", 10),
        (["-m", "task=dhand-*,-dhand-cup"], "grid", 9),
        (["-m", "task=duck-lift"], "grid", 1),
        (["-m", "+experiment=quickstart", "seed=0,1"], "grid-quickstart-", 2),
        (["+sweep=sim2real"], "sim2real", 3),
        (["-m", "+sweep=sim2real", "budget=smoke", "seed=5"], "sim2real-smoke", 1),
        (["+sweep=sim2real", "sweep.name=mine"], "mine", 3),
    ],
)
def test_what_is_typed_is_planned(arguments: list[str], name: str, jobs: int) -> None:
    outcome = command("pgdm-run", *arguments, "--dry-run")
    assert shown(outcome)["jobs"].startswith(f"{jobs} (")
    assert outcome.out.startswith(f"sweep {name}")


@pytest.mark.parametrize(
    ("study", "jobs", "frames"),
    [
        ("validate_tcdm50", 150, 50_000_000),
        ("baselines_tcdm30", 240, 50_000_000),
        ("ablations_tcdm30", 450, 50_000_000),
        ("sim2real", 3, 50_000_000),
    ],
)
def test_the_papers_studies(study: str, jobs: int, frames: int) -> None:
    rows = shown(command("pgdm-run", f"+sweep={study}", "--dry-run"))
    assert rows["jobs"].startswith(f"{jobs} (")
    assert rows["frames"].startswith(f"{frames:,} a job")
    assert "budget paper" in rows["settings"]


def test_settings_of_your_own(tmp_path: Path) -> None:
    own = tmp_path / "mine"
    for name, text in {
        "suite/two.yaml": "# Two.\ntasks: [duck-lift, dhand-cup]\n",
        "sweeps/study.yaml": "# Mine.\ntask: two\nseed: [0, 1]\n",
        # Hydra's own way to write a sweep down.
        "experiment/grid.yaml": "# @package _global_\n"
        'hydra: {sweeper: {params: {task: "two,duck-lift", seed: "0,1,2"}}}\n',
    }.items():
        (own / name).parent.mkdir(parents=True, exist_ok=True)
        (own / name).write_text(text)
    line = ["--config-dir", "mine", *SMALL]
    assert shown(command("pgdm-run", *line, "task=two"))["jobs"].startswith("2 (")
    assert shown(command("pgdm-run", *line, "+sweep=study"))["jobs"].startswith("4 (")
    rows = shown(command("pgdm-run", *line, "+experiment=grid", "seed=7"))
    assert (rows["jobs"][:3], rows["seeds"]) == ("2 (", "7")
    alone = command("pgdm-run", "--config-dir", "mine", "task=two")
    assert "two is a suite of 2 tasks" in alone.err


def test_a_sweep_is_recorded_and_grows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plans = started(monkeypatch)
    assert command("pgdm-run", "-m", *TINY, "task=duck-lift", "seed=0,1").code == 0
    assert command("pgdm-run", "-m", *TINY, "task=duck-lift,dhand-cup", "seed=1").code == 0
    assert [len(plan.jobs) for plan in plans] == [2, 2]
    assert plans[0].folder == plans[1].folder
    assert plans[0].command == f"pgdm-run -m {' '.join(TINY)} task=duck-lift seed=0,1"
    whole = read_plan(plans[0].folder)
    names = ["task=duck-lift seed=0", "task=duck-lift seed=1", "task=dhand-cup seed=1"]
    assert [job.name for job in whole.jobs] == names
    assert whole.jobs[0].overrides[-2:] == ("task=duck-lift", "seed=0")


def test_another_sweep_of_the_same_name_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    plans = started(monkeypatch)
    line = ["-m", *TINY, "sweep.name=mine", "seed=0,1"]
    assert command("pgdm-run", *line).code == 0
    assert command("pgdm-run", *line, "num_threads=2").code == 0  # not what is computed
    changed = command("pgdm-run", *line, "algo.clip=0.1")
    assert changed.code == 1
    assert len(changed.errors) == 1
    assert "algo.clip: 0.2 -> 0.1; other settings also in 1 more job" in changed.errors[0]
    assert "choose another sweep.name" in changed.errors[0]
    dry = command("pgdm-run", *line, "algo.clip=0.1", "--dry-run")
    assert "algo.clip: 0.2 -> 0.1" in dry.err
    assert len(plans) == 2


def test_jobs_that_would_repeat_others_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    plans = started(monkeypatch)
    outcome = command("pgdm-run", "-m", "seed=0,0,1", "budget=smoke")
    assert "note: 'seed=0 budget=smoke' repeats 'seed=0 budget=smoke'" in outcome.err
    assert [job.cfg.seed for job in plans[0].jobs] == [0, 1]


def test_what_is_finished_is_counted(library_home: Path) -> None:
    line = ["-m", "--offline", *TINY, "seed=0,1"]
    assert command("pgdm-run", *line, "seed=0").code == 0
    rows = shown(command("pgdm-run", *line, "--dry-run"))
    assert rows["jobs"] == "2 (1 finished, 0 begun)"
    assert rows["frames"] == "32 a job, 64 in all, 32 left"
    assert "measured in 1 earlier run" in rows["time"]


def test_a_start_that_no_run_would_find_refuses_the_sweep(library_home: Path) -> None:
    line = ["-m", "task=cup-pour1,duck-lift", "pregrasp=teleop", "--dry-run"]
    outcome = command("pgdm-run", *line)
    assert outcome.code == 2 and "'cup-pour1' has no stored start 'teleop'" in outcome.err


class Bare(Library):
    """The library, in which one task has no plan and another is missing, as in the package."""

    def motion(self, motion_id: str, source: str | None = None) -> Motion:
        """Return a motion; the cup's has its mined start only."""
        found = super().motion(motion_id, source)
        mined = {"mined": found.starts["mined"]}
        return replace(found, starts=mined) if motion_id == "cup-pour1" else found

    def tasks(self) -> dict[str, str]:
        """Return all tasks but the door."""
        return {task: source for task, source in super().tasks().items() if task != "door-open"}


@pytest.mark.usefixtures("library_home")
def test_what_the_assets_here_have_not_is_told() -> None:
    whole = open_library()
    folders = {source: whole.folder(source) for source in whole.sources()}
    library = Bare(whole.root, whole.sources(), folders)
    cfgs = [
        compose([f"task={task}", f"pregrasp={start}", f"method={method}"])
        for task, start, method in (
            *[("cup-pour1", "planned", "pgdm")] * 2,
            ("cup-pour1", "mined", "pgdm"),
            ("cup-pour1", "none", "pgdm"),
            ("duck-lift", "planned", "graff"),
            ("piggybank-use1", "planned", "graff"),
            ("door-open", "planned", "pgdm"),
        )
    ]
    start, lacking, approximate = foresee(cfgs, library)
    assert start.startswith("pregrasp=planned: 2 runs will start from 'mined'")
    assert lacking.endswith("here: door-open")
    assert approximate.endswith("approximate: piggybank-use1")


def test_a_sweep_says_that_wrists_are_planned_first(library_home: Path) -> None:
    tasks = "hammer-use1", "cup-pour1"
    cfgs = [
        compose(["+experiment=fast", f"task={task}", f"seed={seed}"])
        for task in tasks
        for seed in (0, 1)
    ]
    assert any("2 tasks with a wrist plan" in text for text in foresee(cfgs, open_library()))
    assert not any("wrist" in text for text in foresee([compose([])], open_library()))


def test_the_plan_file_is_plain(monkeypatch: pytest.MonkeyPatch) -> None:
    plans = started(monkeypatch)
    command("pgdm-run", "-m", "seed=0", "budget=smoke")
    whole = json.loads((plans[0].folder / "plan.json").read_text())
    assert set(whole) == {"format", "name", "command", "jobs"}
    (job,) = whole["jobs"]
    assert set(job) == {"key", "name", "overrides", "config"}
    assert job["config"]["run_dir"].startswith("runs/hammer-use1-pgdm-")
