"""The pre-grasp of a new task: searched near the object, or taken from a file or another task."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import mujoco
import numpy as np
import torch

from pgdm.errors import ConfigError
from pgdm.library import Library, Start, figures, pregrasp_file
from pgdm.library.motion_checks import Poses
from pgdm.library.report import Progress
from pgdm.motion.reference import ObjectReference
from pgdm.pregrasp.near import NearPose, poses_near
from pgdm.pregrasp.quality import LiftTest
from pgdm.sim.contact import HandContact
from pgdm.sim.scene import Scene
from pgdm.wrist.path import carried_path

CHOICES = ("mean", "open", "later")

SLACK_M, SLACK_RAD = 0.03, 0.2
"""By how much the wrist, carried rigidly with the object, may leave its range: so much the fingers
and a policy's corrections make up for."""
_TOUCH_M = 1e-4
_SLIDES = 3  # of the base's joints, the first ones
_HAND_M = 0.3  # how much less than the object the wrist may have to go, where that turns
_CURE = "shorten the motion, or put the object elsewhere (place in the keyframes)"
_COMPARED = 5  # poses that are tried in the simulation


@dataclass(frozen=True)
class FoundPregrasp:
    """A hand at its pre-grasp."""

    qpos: np.ndarray  # (nq,) whole scene
    source: str
    """What the task's file says of it."""
    notes: list[str]


def make_pregrasp(
    choice: str, scene: Scene, qpos: np.ndarray, poses: Poses, library: Library, progress: Progress
) -> FoundPregrasp:
    """Make the pre-grasp of a new task.

    Args:
        choice: ``mean`` or ``open`` (a search with the fingers near that posture), ``later`` (the
            hand's reset pose), a pre-grasp's file, or a task whose fingers are taken.
        scene: the new task's.
        qpos: whole scene (nq,), the object where it rests.
        poses: the task's motion.
        library: where other tasks' pre-grasps are.
        progress: told how far the search is.

    Raises:
        ConfigError: there is no such pre-grasp, it does not fit, or the wrist cannot follow.
        SceneError: none was found that touches nothing.
    """
    if choice == "later":
        return FoundPregrasp(qpos, "none", ["starts from the hand's reset pose: no pre-grasp yet"])
    _check_travel(scene, poses)
    reach = wrist_beyond(scene, poses)
    if choice.endswith(".npz"):
        found = _from_file(Path(choice), scene, qpos)
    else:
        fingers = _fingers(choice, scene, library)
        told = partial(progress, "pre-grasp")
        poses_found = poses_near(scene, qpos, fingers, reach, progress=told)
        following = [pose for pose in poses_found if reach(pose.qpos) == 0.0]
        found = _firmest(scene, following or poses_found[:1])
    if reach(found.qpos) > 0.0:
        over = _wrist_over(scene, poses)(found.qpos)
        row, joint = np.unravel_index(int(over.argmax()), over.shape)
        raise ConfigError(
            f"the wrist cannot follow the motion: carried with the object, joint "
            f"{scene.model.joint(int(joint)).name} would leave its range by {over[row, joint]:.2f} "
            f"{'m' if joint < _SLIDES else 'rad'} more than a policy can make up for, worst in row "
            f"{row}; {_CURE}"
        )
    return found


def _check_travel(scene: Scene, poses: Poses) -> None:
    """Check that no base could carry the object that far, before a pose is searched.

    Raises:
        ConfigError: none could.
    """
    mount = np.empty(9)
    mujoco.mju_quat2Mat(mount, scene.index.mount_quat)
    travel = np.ptp(poses.pos @ mount.reshape(3, 3), axis=0)
    low, high = scene.model.jnt_range[:_SLIDES].T
    far = travel - (high - low + 2 * SLACK_M + _HAND_M)
    if far.max() > 0:
        joint = int(far.argmax())
        raise ConfigError(
            f"the wrist cannot follow the motion: the object goes {travel[joint]:.2f} m along "
            f"joint {scene.model.joint(joint).name}, which slides {high[joint] - low[joint]:.2f} "
            f"m; {_CURE}"
        )


def _firmest(scene: Scene, poses: list[NearPose]) -> FoundPregrasp:
    """Return, of the nearest poses, the one from which most random closings lift the object."""
    lift, still = LiftTest(scene, figures.SUBSTEPS), np.zeros(scene.model.nv)
    rates = [lift(Start(pose.qpos, still, None)) for pose in poses[:_COMPARED]]
    best = int(np.nanargmax(rates)) if lift.possible else 0
    pose = poses[best]
    tips = ", ".join(f"{1e3 * d:.0f}" for d in pose.tip_distances_m)
    notes = [
        f"pre-grasp: fingertips {tips} mm from the object, nothing touched; "
        f"{rates[best]:.0%} of random closings of the hand lift it"
    ]
    return FoundPregrasp(pose.qpos, "search", notes)


def wrist_beyond(scene: Scene, poses: Poses) -> Callable[[np.ndarray], float]:
    """Return what tells, for qpos (nq,), by how much the wrist would leave its range, m or rad."""
    over = _wrist_over(scene, poses)
    return lambda qpos: float(over(qpos).max().clip(0.0))


def _wrist_over(scene: Scene, poses: Poses) -> Callable[[np.ndarray], np.ndarray]:
    """Return what tells, for qpos (nq,), by how much each base joint is beyond, (T, B) m or rad."""
    reference = ObjectReference(torch.from_numpy(poses.pos), torch.from_numpy(poses.quat))
    low, high = scene.model.jnt_range[: scene.index.num_base_joints].T
    slack = np.array([SLACK_M] * _SLIDES + [SLACK_RAD] * (len(low) - _SLIDES))

    def over(qpos: np.ndarray) -> np.ndarray:
        path = carried_path(scene.index, reference, torch.from_numpy(qpos)).numpy()
        return np.maximum(low - slack - path, path - high - slack)

    return over


def _from_file(path: Path, scene: Scene, qpos: np.ndarray) -> FoundPregrasp:
    if not path.is_file():
        raise ConfigError(f"--pregrasp {path}: there is no such file")
    stored, nu = pregrasp_file.read(path).pose.qpos, scene.model.nu
    if stored.shape != qpos.shape:
        raise ConfigError(
            f"--pregrasp {path}: has {stored.size} joint positions, hand '{scene.hand.name}' with "
            f"this object has {qpos.size}"
        )
    found = np.concatenate((stored[:nu], qpos[nu:]))
    depth = HandContact(scene).depth(found)
    if depth > _TOUCH_M:
        raise ConfigError(
            f"--pregrasp {path}: the hand is {1e3 * depth:.1f} mm inside the object or the table"
        )
    return FoundPregrasp(found, "file", [f"pre-grasp as in {path.name}"])


def _fingers(choice: str, scene: Scene, library: Library) -> np.ndarray:
    """Return the finger joints (J,) rad that a search should stay near."""
    first = scene.hand.num_base_joints + scene.hand.num_wrist_joints
    count = scene.model.nu - first
    if choice == "open":
        return np.zeros(count)
    if choice == "mean":
        mean = np.array(scene.hand.mean_fingers_rad)
        if mean.shape != (count,):
            raise ConfigError(
                f"hand '{scene.hand.name}' states {mean.size} mean finger joints, it has {count}: "
                "use --pregrasp open"
            )
        return mean
    if choice not in library.tasks():
        raise ConfigError(
            f"--pregrasp '{choice}' is neither {', '.join(CHOICES)}, a .npz file, nor a task of "
            "the library ('pgdm assets list')"
        )
    entry = library.entry(choice)
    if entry.hand != scene.hand.name or "mined" not in entry.starts:
        raise ConfigError(
            f"--pregrasp '{choice}': its pre-grasp is of hand '{entry.hand}', this task's hand is "
            f"'{scene.hand.name}'"
        )
    return library.motion(choice).starts["mined"].qpos[first : scene.model.nu]
