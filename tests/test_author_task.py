"""The user's own tasks: checks of motions, their sources, and the seven tasks that pgdm ships."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml

from command_line import TINY, command
from pgdm.author import TaskRequest, author_task
from pgdm.author.motion import MotionRequest
from pgdm.author.task import remove_task, task_path
from pgdm.cem import CemCfg
from pgdm.config.compose import compose
from pgdm.config.suites import suite
from pgdm.errors import ConfigError, CorruptAssetError, LibraryError, PgdmError, UnknownNameError
from pgdm.experiment import env_builder
from pgdm.library import animated, ensure, open_library
from pgdm.library.authored import own
from pgdm.library.authored.object import ObjectRequest, author_object
from pgdm.library.checks.motion import Poses, TableCheck, check_motion
from pgdm.library.checks.verify import damaged
from pgdm.library.files import motion as motion_file
from pgdm.library.files import pregrasp as pregrasp_file
from pgdm.library.files.pregrasp import Pregrasp
from pgdm.pregrasp import near
from pgdm.pregrasp.reach.planner import REACH, plan_reach
from pgdm.sim.contact import HandContact
from recorded_poses import line

LIFT = """keyframes:
  - {time_s: 0}
  - {time_s: 0.2}
  - {time_s: 0.9, pos_m: [0, 0, 0.1], euler_deg: [0, 0, 20]}
"""


@pytest.fixture
def brick(library_home: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the name of an own box, 5 x 6 x 12 cm; the searches are cut short."""
    del library_home
    for name, count in {"STARTS": 2, "ROUNDS": 12}.items():
        monkeypatch.setattr(near, name, count)
    hurry = replace(REACH, cem=CemCfg(8, 2), rounds=2, steps=10)
    monkeypatch.setattr("pgdm.author.task.plan_reach", partial(plan_reach, cfg=hurry))
    trimesh.creation.box((0.05, 0.06, 0.12)).export("brick.stl")
    author_object(ObjectRequest(Path("brick.stl"), "brick", mass_kg=0.15))
    Path("lift.yaml").write_text(LIFT)
    return "brick"


def request(motion: MotionRequest, **changes: object) -> TaskRequest:
    given: dict = {"id": "brick-lift", "object": "brick", "hand": "dmanus", "motion": motion}
    return TaskRequest(**given | changes)


def test_keyframes_become_a_task_that_runs(brick: str) -> None:
    made = author_task(request(MotionRequest(Path("lift.yaml"), None)), open_library())
    library = open_library()
    motion = library.motion("brick-lift")
    assert (motion.source, len(motion.translation)) == ("own", 24)
    # Half of the brick's height, then 10 cm more.
    assert motion.translation[[0, -1], 2] == pytest.approx([0.06, 0.16], abs=1e-3)
    assert HandContact(made.scene).depth(motion.starts["mined"].qpos) == 0.0
    cfg = compose(["task=brick-lift", "action=residual"])
    assert (cfg.hand.name, cfg.task.objects) == ("dmanus", ["brick"])
    builder = env_builder(cfg, library)
    assert builder.facts()["asset_source"] == "own+checkout"
    done = command("pgdm-run", "task=brick-lift", *TINY, "--offline", "run_dir=run")
    assert done.code == 0, done.err
    listed = command("pgdm", "tasks").out
    assert [row.split()[-1] for row in listed.splitlines() if "brick" in row] == ["own"]
    assert "own" in command("pgdm", "assets", "list").out
    shown = command("pgdm", "assets", "show", "brick-lift")
    assert shown.code == 0 and "source own (serves the task)" in shown.out, shown.err
    with pytest.raises(
        LibraryError, match="tasks that use object 'brick': brick-lift; remove it first"
    ):
        own.remove("brick")
    # The user's pre-grasps are for one motion: with another they are set aside.
    kept = pregrasp_file.path_of("brick-lift", "dmanus", "labeled")
    pregrasp_file.write(kept, Pregrasp(motion.starts["mined"], None, {}))
    anew = request(MotionRequest(Path("lift.yaml"), None), pregrasp="later", replace=True)
    noted = author_task(anew, library).pregrasp.notes[-1]
    aside = kept.parents[1].with_name("brick-lift.before-1")
    assert str(aside) in noted and (aside / "dmanus" / "labeled.npz").is_file()
    pregrasp_file.write(kept, Pregrasp(motion.starts["mined"], None, {}))
    assert remove_task("brick-lift") == kept.parents[1].with_name("brick-lift.before-2")
    assert not task_path("brick-lift").exists() and "brick-lift" not in open_library().tasks()


@pytest.fixture
def recorded(brick: str) -> Path:
    """Return poses that lift the brick from 3 mm above where it rests, 2 mm too deep later."""
    rows = line(0.3, 40)
    rows[:, 2] = 0.063 + rows[:, 0]
    rows[:, 0] = 0.0
    np.savez("rec.npz", poses=rows)
    return Path("rec.npz")


def test_a_recording_is_blended_to_start_where_the_object_rests(recorded: Path) -> None:
    made = author_task(request(MotionRequest(None, recorded), pregrasp="later"), open_library())
    assert made.motion.poses.pos[0, 2] == pytest.approx(0.06, abs=1e-3)
    assert made.motion.poses.pos[-1, 2] == pytest.approx(0.063 + line(0.3, 40)[-1, 0])
    assert made.motion.notes[0].startswith("the columns have no names and were read as x y z qw")
    assert made.motion.notes[1].startswith("the motion's first 0.6 s were blended to start where")
    assert (made.pregrasp.qpos[:16] == 0).all()


def test_a_recording_that_starts_in_the_air_needs_settling(recorded: Path) -> None:
    rows = np.load(recorded)["poses"]
    rows[:, 2] += 0.1
    np.savez("high.npz", poses=rows)
    high = MotionRequest(None, Path("high.npz"))
    with pytest.raises(ConfigError, match=r"does not rest where the motion starts: .*--settle"):
        author_task(request(high, pregrasp="later"), open_library())
    settled = MotionRequest(None, Path("high.npz"), settle=True)
    made = author_task(request(settled, pregrasp="later"), open_library())
    assert made.motion.poses.pos[0, 2] == pytest.approx(0.06, abs=1e-3)


def test_positions_may_be_of_the_meshs_origin(library_home: Path) -> None:
    box = trimesh.creation.box((0.05, 0.06, 0.12)).apply_translation([0, 0, 0.06])
    box.export("brick.stl")  # its origin is under its floor
    author_object(ObjectRequest(Path("brick.stl"), "brick"))
    rows = line(0.3, 40)
    rows[:, 2], rows[:, 0] = rows[:, 0], 0.0
    np.savez("rec.npz", poses=rows)
    given = MotionRequest(None, Path("rec.npz"), origin="mesh")
    made = author_task(request(given, pregrasp="later"), open_library())
    assert made.motion.poses.pos[0, 2] == pytest.approx(0.06, abs=1e-3)


def test_poses_in_the_table_are_refused_or_raised(recorded: Path) -> None:
    rows = np.load(recorded)["poses"]
    rows[:, 2] -= np.interp(np.arange(40), [0, 20, 30, 39], [0.0, 0.0, 0.35, 0.35])
    np.savez("deep.npz", poses=rows)
    with pytest.raises(ConfigError, match=r"mm below the table in row .*--lift-above-table"):
        author_task(
            request(MotionRequest(None, Path("deep.npz")), pregrasp="later"), open_library()
        )
    lifted = MotionRequest(None, Path("deep.npz"), lift=True)
    made = author_task(request(lifted, pregrasp="later"), open_library())
    assert any(note.startswith("raised by up to") for note in made.motion.notes)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"id": "hammer-use1"}, ConfigError, "'hammer-use1' is taken by pgdm"),
        ({"id": "tcdm50"}, ConfigError, "'tcdm50' is taken by pgdm"),
        ({"id": "Big Lift"}, ConfigError, "task id 'Big Lift' is not valid"),
        ({"object": "brik"}, UnknownNameError, "your own 'brik'; did you mean brick"),
        ({"hand": "dhnd"}, UnknownNameError, "unknown hand 'dhnd'; did you mean dhand"),
        ({"id": "brick"}, ConfigError, "you have an object 'brick'; choose another id"),
        ({"object": "door"}, UnknownNameError, "unknown object for a task of your own 'door'"),
        ({"pregrasp": "x.npz"}, ConfigError, "--pregrasp x.npz: there is no such file"),
        ({"pregrasp": "none"}, ConfigError, "neither mean, open, later, a .npz file, nor a task"),
        (
            {"pregrasp": "cup-pour1"},
            ConfigError,
            "is a task of hand 'adroit'; give one .* of hand 'dmanus'",
        ),
    ],
)
def test_names_are_checked(brick: str, changes: dict, error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        author_task(request(MotionRequest(Path("lift.yaml"), None), **changes), open_library())
    assert own.read().tasks == {} and not task_path("brick-lift").exists()


def test_a_task_needs_one_motion_within_reach(brick: str) -> None:
    lift = Path("lift.yaml")
    for motion in (MotionRequest(None, None), MotionRequest(lift, lift)):
        with pytest.raises(ConfigError, match="a task needs one motion"):
            author_task(request(motion), open_library())
    Path("far.yaml").write_text(
        LIFT.replace("[0, 0, 0.1]", "[0.9, 0, 0.1]").replace("0.9,", "2,", 1)
    )
    far = request(MotionRequest(Path("far.yaml"), None))
    with pytest.raises(PgdmError, match="the hand cannot follow the motion"):
        author_task(far, open_library())
    Path("away.yaml").write_text("place: {pos_m: [0.6, 0]}\n" + LIFT)
    with pytest.raises(ConfigError, match=r"off the table|does not come to rest"):
        author_task(request(MotionRequest(Path("away.yaml"), None)), open_library())


@pytest.fixture
def fresh_home(library_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a ``PGDM_HOME`` with the checkout's assets that may be added to."""
    home = tmp_path / "home"
    (home / "library").mkdir(parents=True)
    (home / "library" / "checkout").symlink_to(library_home / "library" / "checkout")
    monkeypatch.setenv("PGDM_HOME", str(home))
    return home


def test_the_animated_tasks_are_compiled_on_demand_and_once(fresh_home: Path) -> None:
    assert set(animated.TASKS) == set(suite("animated7"))
    first = ensure(animated.TASKS[0], offline=True)
    assert sorted(first.sources()["animated"].tasks) == list(animated.TASKS)
    path = first.motion_path(animated.TASKS[0])
    made = os.stat(path).st_mtime_ns
    assert (
        os.stat(ensure(animated.TASKS[1], True).motion_path(animated.TASKS[0])).st_mtime_ns == made
    )
    assert damaged(first) == []
    path.unlink()
    with pytest.raises(LibraryError, match=r"missing .* Remove the library's folder 'animated'; "):
        first.motion_path(animated.TASKS[0])
    shutil.rmtree(fresh_home / "library" / "animated")
    assert ensure(animated.TASKS[0], True).motion_path(animated.TASKS[0]) == path
    manifest = fresh_home / "library" / "animated" / "manifest.json"
    manifest.write_text(manifest.read_text().replace(animated.origin(), "older keyframes"))
    assert ensure(animated.TASKS[0], True).sources()["animated"].origin == animated.origin()


def test_the_animated_tasks_can_be_carried(fresh_home: Path) -> None:
    library = ensure(animated.TASKS[0], offline=True)
    hands = []
    for task in animated.TASKS:
        motion = library.motion(task)
        check_motion(Poses(motion.translation, motion.orientation), task)
        facts = yaml.safe_load(Path(animated.FOLDER / f"{task}.yaml").read_text())
        cfg = compose([f"task={task}"])
        assert (cfg.hand.name, cfg.task.objects) == (facts["hand"], [facts["object"]])
        hands.append(cfg.hand.name)
    assert sorted(hands) == ["dhand"] * 5 + ["dmanus"] * 2


@pytest.mark.slow
@pytest.mark.parametrize("task", animated.TASKS)
def test_an_animated_task_starts_free_and_steps(fresh_home: Path, task: str) -> None:
    import torch

    from pgdm.mdp.actions import normalize

    library = ensure(task, offline=True)
    builder = env_builder(compose([f"task={task}", "action=residual"]), library)
    start = library.motion(task).starts["mined"]
    assert HandContact(builder.scene).depth(start.qpos) == 0.0
    body = builder.scene.index.object_body
    motion = library.motion(task)
    depths = TableCheck(builder.scene.model, body).depths(
        Poses(motion.translation, motion.orientation)
    )
    assert depths.max() < 1e-3
    env = builder.make(num_envs=2, num_threads=1)
    hold = normalize(builder.scene.index, torch.from_numpy(start.qpos.copy())).float()
    hold[: builder.scene.index.num_base_joints] = 0.0  # zero residual
    for _ in range(8):
        obs, reward, *_ = env.step(hold.expand(2, -1))
    # At rest the object stays under its target until the motion begins.
    assert torch.isfinite(obs).all() and (reward > 9).all()


def test_a_motion_file_keeps_its_form(brick: str) -> None:
    author_task(request(MotionRequest(Path("lift.yaml"), None), pregrasp="later"), open_library())
    path = open_library().motion_path("brick-lift")
    assert motion_file.read(path, "brick-lift", "own").substeps == 10
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(CorruptAssetError, match="was changed"):
        open_library().motion("brick-lift")
