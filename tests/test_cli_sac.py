"""Soft actor-critic on the command line: its replay in the run folder, its policy afterwards."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from command_line import TINY, TINY_SAC, Outcome, command, unchanged
from pgdm.config.compose import compose
from pgdm.errors import CheckpointError
from pgdm.experiment import env_builder
from pgdm.library import open_library
from pgdm.rl.checkpoint import CheckpointFolder
from pgdm.runs.files import read_json
from pgdm.runs.log import Record, RunLog
from test_rl_resume import flat

FAST = (
    *("+experiment=fast", "task=duck-lift", "algo.updates_per_step=1"),
    *("total_frames=64", "keep_replay=true"),
)
"""Long enough for training to complete an episode, of 20 steps."""
FILES = {"observation", "action", "terms", "discount", "terminated", "next_observation"}


def sac_run(*arguments: str) -> Outcome:
    return command("pgdm-run", "--offline", *TINY_SAC, "run_dir=run", *arguments)


def replay(run: Path) -> set[str]:
    return {path.stem for path in (run / "replay").glob("*.bin")}


def test_a_dry_run_says_how_large_the_replay_is(library_home: Path, tmp_path: Path) -> None:
    # 16 frames an iteration: the last one is completed.
    outcome = sac_run("total_frames=1000001", "--dry-run")
    assert outcome.code == 0, outcome.err
    probe = env_builder(compose(["algo=sac"]), open_library()).make(1, 1)
    terms = len(probe.reward_weights())
    frame = 2 * (2 * probe.obs_dim + probe.action_dim) + 4 * terms + 1
    text = " ".join((outcome.out + outcome.err).split())
    assert f"the replay takes {1_000_016 * frame / 1e9:.2f} GB of disk" in text
    assert "removed when the run has finished" in text
    assert "+experiment=fast" not in text
    papers = sac_run("total_frames=50_000_000", "budget=paper", "--dry-run")
    length = compose(["+experiment=fast"]).total_frames
    assert f"+experiment=fast trains for {length:,} frames" in " ".join(papers.out.split())
    kept = sac_run("total_frames=1000001", "keep_replay=true", "--dry-run")
    assert "and is kept" in " ".join((kept.out + kept.err).split())
    ppo = command("pgdm-run", "--offline", *TINY, "--dry-run")
    assert "replay" not in ppo.out + ppo.err
    assert list(tmp_path.iterdir()) == []


def test_a_run_its_policy_and_the_end_of_its_replay(library_home: Path, tmp_path: Path) -> None:
    run = sac_run("seed=3")
    assert (run.code, run.errors) == (0, [])
    assert "hammer-use1 (pgdm, absolute action, sac, seed 3)" in run.out
    assert replay(tmp_path / "run") == set()
    assert not (tmp_path / "run" / "replay").exists()

    outcome = command("pgdm", "eval", "run", "--offline")
    assert outcome.code == 0, outcome.err
    rows = [
        next(line for line in out.splitlines() if "return" in line).split("│")
        for out in (run.out, outcome.out)
    ]
    assert [cell.strip() for cell in rows[1][2:4]] == [cell.strip() for cell in rows[0][3:5]]

    again = sac_run("seed=3")
    assert again.code == 0
    assert "finished already" in again.err
    longer = sac_run("seed=3", "total_frames=64")
    assert longer.code == 1
    [error] = longer.errors
    assert re.search(r"replay in run.replay is gone .*removed when a run has finished", error)
    assert "unless keep_replay=true" in error
    assert "another run_dir" in error
    assert replay(tmp_path / "run") == set()  # nothing that takes room is left behind
    assert read_json(tmp_path / "run" / "result.json")["status"] == "finished"


def test_a_run_that_came_to_its_time_limit_shows_what_it_has(
    library_home: Path, tmp_path: Path
) -> None:
    limited = ("total_frames=1_000_000", "time_limit_min=0.02")
    run = sac_run(*limited)
    assert (run.code, run.errors) == (0, [])
    assert re.search(r"time_limit_min=0.02 was reached at [\d,]+ of 1,000,000 frames", run.err)
    result = read_json(tmp_path / "run" / "result.json")
    frames = result["frames"]
    assert frames < result["total_frames"] == 1_000_000
    assert (result["status"], result["ended_by"]) == ("finished", "time_limit")
    assert result["wall_time_s"] >= 1.2
    assert not (tmp_path / "run" / "replay").exists()
    again = sac_run(*limited)
    assert (again.code, again.errors) == (0, [])
    assert "finished already" in again.err
    assert read_json(tmp_path / "run" / "result.json")["frames"] == frames


def test_a_replay_that_was_kept_lets_the_run_go_on(library_home: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    assert sac_run("keep_replay=true").code == 0
    assert replay(folder) == FILES
    assert sac_run().code == 0  # only shows the result
    assert replay(folder) == FILES
    longer = sac_run("total_frames=64")
    assert (longer.code, longer.errors) == (0, [])
    assert "resuming run at 32 frames" in " ".join(longer.err.split())
    assert read_json(folder / "result.json")["frames"] == 64
    assert not (folder / "replay").exists()


def test_a_run_that_died_before_its_result_still_has_its_replay(
    library_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "run"
    with monkeypatch.context() as patched:
        patched.setattr("pgdm.runs.result.write_json", _no_room)
        assert sac_run().code == 1
    assert replay(folder) == FILES
    again = sac_run()
    assert (again.code, again.errors) == (0, [])
    assert read_json(folder / "result.json")["status"] == "finished"
    assert not (folder / "replay").exists()


def _no_room(path: Path, content: object) -> None:
    raise OSError(28, "No space left on device", str(path))


def test_a_replay_that_was_lost_halfway_is_told(library_home: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    assert sac_run("keep_replay=true").code == 0
    file = folder / "replay" / "action.bin"
    original = file.read_bytes()
    file.write_bytes(original[:100] + bytes([original[100] ^ 1]) + original[101:])
    altered = sac_run("keep_replay=true", "total_frames=64")
    assert len(altered.errors) == 1
    assert "does not hold the 32 frames" in altered.errors[0]
    assert "'action' differs" in altered.errors[0]
    file.write_bytes(original)  # restored, as the message says
    assert sac_run("keep_replay=true", "total_frames=64").code == 0
    shutil.rmtree(folder / "replay")
    gone = sac_run("keep_replay=true", "total_frames=96")
    assert "is gone" in gone.errors[0]
    assert not (folder / "replay").exists()


@pytest.mark.parametrize("other", [None, "duck-lift", "dmanus-crackerbox"])
def test_a_replay_that_was_cut_or_is_of_another_task_is_refused(
    other: str | None, library_home: Path, tmp_path: Path
) -> None:
    """The observations of duck-lift are as long as those of the run, D'Manus' are not."""
    mine, theirs = (tmp_path / run / "replay" for run in ("run", "other"))
    assert sac_run("keep_replay=true").code == 0
    if other is None:
        os.truncate(mine / "next_observation.bin", 1000)
    else:
        assert sac_run("keep_replay=true", f"task={other}", "run_dir=other").code == 0
        same = [(folder / "observation.bin").stat().st_size for folder in (mine, theirs)]
        assert (len(set(same)) == 1) is (other == "duck-lift")
        shutil.rmtree(mine)
        shutil.copytree(theirs, mine)
    with unchanged(tmp_path / "run"):
        refused = sac_run("keep_replay=true", "total_frames=64")
    assert refused.code == 1
    [error] = refused.errors
    assert "replay in run/replay does not hold the 32 frames of the checkpoint" in error
    assert "restore it, or start anew in another run_dir" in error
    assert "Traceback" not in refused.err


def test_a_start_that_is_refused_leaves_the_replay_as_it_was(
    library_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "run"
    assert sac_run("keep_replay=true").code == 0
    before = {path: path.stat().st_size for path in (folder / "replay").iterdir()}

    def refuse(*_: object) -> None:
        raise CheckpointError("the checkpoint is of another network")

    with monkeypatch.context() as patched:
        patched.setattr("pgdm.rl.trainer.Trainer.load_state_dict", refuse)
        assert sac_run("keep_replay=true", "total_frames=64").errors
        assert {path: path.stat().st_size for path in (folder / "replay").iterdir()} == before
        shutil.rmtree(folder / "replay")
        assert sac_run("total_frames=64").errors
    assert not (folder / "replay").exists()
    monkeypatch.setattr("pgdm.experiment.check_assets", refuse)
    monkeypatch.setattr("pgdm.experiment._trainer", lambda *_: pytest.fail("too early"))
    assert "another network" in sac_run("total_frames=64").errors[0]


def records(run: Path, kind: str) -> list[Record]:
    return [line for line in RunLog(run / "metrics.jsonl").read() if line["kind"] == kind]


def replayed_terms(run: Path) -> dict[str, np.ndarray]:
    """Return the reward terms of all frames of a replay, unweighted."""
    about = read_json(run / "replay" / "columns.json")["terms"]
    stored = np.fromfile(run / "replay" / about["file"], about["dtype"])
    return dict(zip(about["entries"], stored.reshape(-1, len(about["entries"])).T, strict=True))


@pytest.mark.usefixtures("expert_home")
@pytest.mark.parametrize(
    ("setting", "added"),
    [
        ("method=deepmimic", {"imitation", "grasp"}),
        ("method=graff", {"contact", "grasp"}),
        ("pregrasp=none", set()),
        ("ablation=distance_15cm", set()),
    ],
)
def test_fast_has_the_terms_of_methods_and_no_grasp_term_without_a_pregrasp(
    setting: str, added: set[str], tmp_path: Path
) -> None:
    outcome = sac_run(*FAST, setting)
    assert (outcome.code, outcome.errors) == (0, [])
    run, terms = tmp_path / "run", {"tracking", "lift"} | added
    for kind, expected in (("train", terms), ("eval", terms - {"grasp"})):
        names = {name for line in records(run, kind) for name in line}
        assert {name.split("/")[-1] for name in names if "/raw/" in name} == expected
    replayed = replayed_terms(run)
    assert set(replayed) == terms
    assert all(replayed[name].any() for name in ("tracking", *added))


@pytest.mark.usefixtures("expert_home")
def test_a_curriculum_keeps_unweighted_terms_and_goes_on_where_it_stopped(tmp_path: Path) -> None:
    ramp = (*FAST, "method=curriculum", "method.curriculum.ramp_frames=64")
    learners = []
    for name, lengths in (("straight", (48,)), ("stopped", (32, 48))):
        for frames in lengths:
            assert sac_run(*ramp, f"total_frames={frames}", f"run_dir={name}").code == 0
        run = tmp_path / name
        weights = [line["train/weight/tracking"] for line in records(run, "train")]
        assert weights == [0.0, 2.5, 5.0]
        assert replayed_terms(run)["tracking"][:16].all()  # seen while the weight was 0
        state = CheckpointFolder(run / "checkpoints", 2).latest()
        assert state is not None
        learners.append(flat(state["learner"]))
    assert learners[0] == learners[1]
