"""From a recorded hand to a stored start: frames, files, locks, commands."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from command_line import TINY, command
from pgdm.config.compose import compose
from pgdm.config.hands import own_hand
from pgdm.errors import ConfigError, LibraryError
from pgdm.experiment import assets, env_builder
from pgdm.library import open_library
from pgdm.library.files import pregrasp as pregrasp_file
from pgdm.library.files.pregrasp import Pregrasp
from pgdm.pregrasp import on_demand as provide
from pgdm.pregrasp.reach.plan import ReachPlan
from pgdm.pregrasp.retarget import mocap
from pgdm.pregrasp.retarget.recording import Recording
from pgdm.sim.scene import Scene
from task_scenes import opened

pytestmark = pytest.mark.usefixtures("expert_home")


def scene(task: str, hand: str = "adroit") -> Scene:
    return opened(task, hand)[0]


def expert(task: str) -> Recording:
    library = open_library()
    return mocap.of_expert(library.expert(task), library.motion(task))


def test_the_library_s_pregrasp_is_the_first_frame() -> None:
    library = open_library()
    motion = library.motion("mouse-lift")
    made = mocap.retarget(scene("mouse-lift"), library, motion, expert("mouse-lift"))
    assert made.frame == 0
    stored = motion.starts["mined"].qpos
    np.testing.assert_array_equal(made.pregrasp.pose.qpos[30:], stored[30:])
    assert made.pregrasp.note["from"] == "the library's human hand of mouse-lift"
    assert set(made.pregrasp.note["fingertip_errors_mm"]) == set(made.fingers)


def test_a_recording_is_moved_as_a_whole_to_the_task_s_object() -> None:
    """The same hand and object, recorded elsewhere, give the same pose."""
    library, motion = open_library(), open_library().motion("mouse-lift")
    here = expert("mouse-lift")
    assert here.position is not None and here.orientation is not None
    turn, quat = np.empty(9), np.array([np.cos(0.5), 0.0, 0.0, np.sin(0.5)])
    mujoco.mju_quat2Mat(turn, quat)
    rotation, shift = turn.reshape(3, 3), np.array([1.0, -2.0, 0.3])
    turned = np.empty(4)
    mujoco.mju_mulQuat(turned, quat, here.orientation[0])
    there = Recording(
        (here.frames[0].moved(rotation, shift),),
        (here.position[:1] @ rotation.T) + shift,
        turned[None],
        "elsewhere",
    )
    first, second = (
        mocap.retarget(scene("mouse-lift"), library, motion, one) for one in (here, there)
    )
    away = first.result.targets.points - second.result.targets.points
    assert np.abs(away).max() < 1e-6


def test_an_object_recorded_with_w_last_is_not_taken_for_another_pose() -> None:
    here = expert("mouse-lift")
    assert here.orientation is not None
    wrong = replace(here, orientation=np.roll(here.orientation, -1, axis=1), ordered=False)
    library, motion = open_library(), open_library().motion("mouse-lift")
    with pytest.raises(ConfigError, match=r"frame 0: read as w x y z .*orientation_order: xyzw"):
        mocap.retarget(scene("mouse-lift"), library, motion, wrong)


def test_the_frame_before_contact() -> None:
    """A hand that comes straight down: the last frame without a finger within 8 mm."""
    library, one = open_library(), scene("mouse-lift")
    here = expert("mouse-lift")
    assert here.position is not None and here.orientation is not None
    heights = np.linspace(0.2, 0.0, 21)
    frames = tuple(here.frames[0].moved(np.eye(3), np.array([0, 0, z])) for z in heights)
    pose = [np.repeat(p[:1], 21, axis=0) for p in (here.position, here.orientation)]
    down = Recording(frames, *pose, "down")
    frame = mocap.frame_before_contact(down, library, one)
    assert 12 <= frame < 20
    alone = replace(down, frames=frames[: frame + 2], position=pose[0][: frame + 2])
    alone = replace(alone, orientation=pose[1][: frame + 2])
    assert mocap.frame_before_contact(alone, library, one) == frame
    free = Recording(frames[:frame], pose[0][:frame], pose[1][:frame], "free")
    assert mocap.frame_before_contact(free, library, one) == frame - 1
    with pytest.raises(ConfigError, match="frame 21 is not in down: it has 0 to 20"):
        mocap.retarget(one, library, library.motion("mouse-lift"), down, frame=21)


def test_what_is_out_of_reach_is_reported() -> None:
    library, motion = open_library(), open_library().motion("mouse-lift")
    far = expert("mouse-lift").frames[0].moved(np.eye(3), np.array([1.0, 0.0, 0.0]))
    made = mocap.retarget(scene("mouse-lift"), library, motion, Recording((far,), origin="far"))
    assert any("fingertip ends" in line for line in made.unreachable)
    assert any("the base is at the end of adroit/ARTx" in line for line in made.unreachable)
    with pytest.raises(ConfigError, match=r"'adroit' cannot do task 'mouse-lift'.*label"):
        mocap.check(made, scene("mouse-lift"))


def wanted(task: str, hand: str, source: str) -> provide.Wanted:
    cfg = compose([f"task={task}", f"hand={hand}"])
    return provide.Wanted(cfg.task, cfg.hand, own_hand(cfg, open_library()), cfg.sim, source)


def test_only_what_can_be_computed_is_computed() -> None:
    assert not wanted("mouse-lift", "adroit", "planned").can_be_made
    assert wanted("mouse-lift", "dhand", "planned").can_be_made
    assert wanted("mouse-lift", "adroit", "mocap").can_be_made
    assert not wanted("mouse-lift", "dhand", "labeled").can_be_made
    assert not wanted("mouse-lift", "adroit", "learned").can_be_made  # no predictor was trained
    said: list[str] = []
    provide.ensure_start(
        open_library(), wanted("mouse-lift", "dhand", "none"), True, notify=said.append
    )
    assert said == []


def test_a_folder_that_cannot_be_written_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    Path("file").write_text("")
    monkeypatch.setenv("PGDM_USER_DIR", str(Path("file").absolute()))
    with pytest.raises(LibraryError, match="cannot be written"):
        provide.ensure_start(open_library(), wanted("mouse-lift", "dhand", "planned"), True)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, None),
        ({"base_error_m": 0.15}, "base 150"),
        ({"finger_error_rad": 0.8}, "fingers 0.8"),
        ({"object_moved_m": 0.02}, "object 20"),
        ({"depth_m": 0.004}, "hand 4 mm inside"),
    ],
)
def test_a_bad_plan_is_rejected(
    change: dict, said: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, motion = scene("mouse-lift"), open_library().motion("mouse-lift")
    good = ReachPlan(
        actions=np.zeros((2, one.model.nu)), state=motion.starts["planned"], base_error_m=0.0,
        base_error_rad=0.0, finger_error_rad=0.0, object_moved_m=0.0, object_turned_rad=0.0,
        depth_m=0.0, target_depth_m=0.0, beyond_m=0.0, beyond_rad=0.0, rounds=1, seconds=1.0,
    )  # fmt: skip
    monkeypatch.setattr(provide, "plan_reach", lambda *_, **__: replace(good, **change))
    told: list[str] = []
    asked = Pregrasp(motion.starts["mined"], None, {})
    made = provide.with_plan(asked, one, motion, told.append)
    assert made.note["reach"]["plan_taken"] is (said is None)
    assert (made.reached is None) is (said is not None)
    assert told == [] if said is None else said in told[0]


def test_a_task_without_a_pregrasp_gives_no_hand_to_follow() -> None:
    motion = open_library().motion("spheremedium-relocate")
    still = replace(motion.starts["mined"], qpos=np.zeros(36))
    with pytest.raises(ConfigError, match="neither a human hand nor a pre-grasp"):
        mocap.of_task(
            open_library(),
            scene("spheremedium-relocate"),
            replace(motion, starts={"mined": still}, id="own"),
        )


def test_an_attached_object_has_no_single_pose() -> None:
    one, motion = scene("door-open"), open_library().motion("door-open")
    frames = expert("mouse-lift").frames[:2]
    with pytest.raises(
        ConfigError, match="has 2 frames, and the object of task 'door-open' is attached"
    ):
        mocap.retarget(one, open_library(), motion, Recording(frames, origin="mine"))
    posed = Recording(frames[:1], np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]), "mine")
    with pytest.raises(ConfigError, match="leave object_position and object_orientation out"):
        mocap.retarget(one, open_library(), motion, posed)


@pytest.mark.slow
def test_one_process_computes_a_start_and_the_others_wait() -> None:
    said: list[str] = []
    one = wanted("mouse-lift", "dmanus", "planned")

    def ensure() -> None:
        provide.ensure_start(open_library(), one, True, notify=said.append, num_threads=1)

    together = [threading.Thread(target=ensure) for _ in range(3)]
    for thread in together:
        thread.start()
    for thread in together:
        thread.join()
    assert sum("computing it once" in line for line in said) == 1
    assert sum("waiting for it" in line for line in said) == 2
    stored = pregrasp_file.read(one.path)
    again = one.path.read_bytes()
    one.path.unlink()
    ensure()
    assert one.path.read_bytes() == again  # equal assets, equal start
    assert stored.note["reach"]["plan_taken"] and stored.reached is not None


@pytest.mark.slow
def test_a_run_with_another_hand_computes_its_start() -> None:
    done = command("pgdm-run", "task=mouse-lift", "hand=dhand", "run_dir=run", "--offline", *TINY)
    assert done.code == 0, done.err
    assert "computing it once by inverse kinematics" in done.err + done.out
    cfg = compose(["task=mouse-lift", "hand=dhand"])
    builder = env_builder(cfg, assets(cfg, print))
    stored = pregrasp_file.find("mouse-lift", "dhand", "planned")
    assert stored is not None and stored.reached is not None
    assert builder.facts()["pregrasp_sha256"] == stored.sha256
    np.testing.assert_array_equal(builder.mdp.start.qpos, stored.reached.qpos)


def test_the_command_reads_a_file(tmp_path: Path) -> None:
    joints = expert("mouse-lift").frames[0].joints
    position, orientation = expert("mouse-lift").position, expert("mouse-lift").orientation
    assert position is not None and orientation is not None
    file = tmp_path / "hand.npz"
    np.savez(file, joints=joints, object_position=position[0], object_orientation=orientation[0])
    arguments = ["pgdm", "pregrasp", "mocap", "mouse-lift", "--hand", "dmanus", "--file", str(file)]
    done = command(*arguments, "--no-reach", "--offline")
    assert done.code == 0, done.err
    assert "from " + str(file) in done.out.replace("\n", "") and "frame 0" in done.out
    stored = pregrasp_file.find("mouse-lift", "dmanus", "mocap")
    assert stored is not None and stored.reached is None
    shown = command("pgdm", "pregrasp", "show", "mouse-lift", "--hand", "dmanus", "--offline")
    assert "inverse kinematics" in shown.out, shown.err
    np.savez(file, joints=1e3 * joints)
    wrong = command(*arguments, "--no-reach", "--offline")
    assert wrong.code != 0 and "millimetres" in wrong.err
    assert len(wrong.errors) == 1


def test_points_of_a_hand_and_back() -> None:
    """A robot hand can follow the human hand at its own points."""
    library, motion = open_library(), open_library().motion("dmanus-crackerbox")
    own = scene("dmanus-crackerbox", "dmanus")
    human = mocap.of_hand(own, motion.starts["mined"])
    made = mocap.retarget(own, library, motion, human)
    assert made.errors_m.max() < 0.006
