"""The pre-grasp of a new task: searched near the object, or read from a file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from pgdm.errors import ConfigError
from pgdm.library import Library, Start
from pgdm.library.checks.motion import Poses
from pgdm.library.files import pregrasp as pregrasp_file
from pgdm.library.progress import StepProgress, counted
from pgdm.library.tasks import SUBSTEPS
from pgdm.motion.reference import ObjectReference
from pgdm.pregrasp.hand_geometry import mean_fingers, mount_rotation
from pgdm.pregrasp.near import NearPose, poses_near
from pgdm.pregrasp.quality import LiftTest
from pgdm.sim.contact import HandContact
from pgdm.sim.scene import Scene
from pgdm.wrist.path import carried_path

CHOICES = ("mean", "open", "later")

SLACK_M, SLACK_RAD = 0.03, 0.2
"""How far a base joint may leave its range when the hand moves rigidly with the object: fingers
and the policy's corrections can compensate for that much."""
_TOUCH_M = 1e-4
_SLIDES = 3  # the first joints of the base
_HAND_M = 0.3  # if the object turns, the base may travel this much less than the object
_CURE = "shorten the motion, or put the object elsewhere (place in the keyframes)"
_COMPARED = 5  # how many of the nearest poses are lift-tested


@dataclass(frozen=True)
class FoundPregrasp:
    """A hand at its pre-grasp."""

    qpos: np.ndarray  # (nq,) whole scene
    source: str
    """``pregrasp_source`` of the task's file."""
    notes: list[str]


def make_pregrasp(
    choice: str,
    scene: Scene,
    qpos: np.ndarray,
    poses: Poses,
    library: Library,
    progress: StepProgress,
) -> FoundPregrasp:
    """Find the pre-grasp of a new task.

    Args:
        choice: ``mean`` or ``open`` (a search with the fingers near that posture), ``later`` (the
            hand's reset pose), the path of a ``.npz`` pre-grasp, or the id of a task of the
            same hand (a search near the finger pose of its mined pre-grasp).
        scene: scene of the new task.
        qpos: positions of the whole scene (nq,), with the object at rest.
        poses: the task's motion.
        library: library with the other tasks' pre-grasps.
        progress: reports search and lift tests.

    Raises:
        ConfigError: there is no such pre-grasp, it does not fit, or the hand cannot follow the
            motion.
        SceneError: every pose that the search found touches something.
    """
    if choice == "later":
        note = "no pre-grasp yet: episodes start from the hand's reset pose"
        return FoundPregrasp(qpos, "none", [note])
    _check_travel(scene, poses)
    over = _base_over(scene, poses)

    def beyond(qpos: np.ndarray) -> float:
        return float(over(qpos).max().clip(0.0))

    if choice.endswith(".npz"):
        found = _from_file(Path(choice), scene, qpos)
    else:
        fingers = _fingers(choice, scene, library)
        nearest = poses_near(scene, qpos, fingers, beyond, progress=progress)
        following = [pose for pose in nearest if beyond(pose.qpos) == 0.0]
        found = _firmest(scene, following or nearest[:1], progress)
    excess = over(found.qpos)
    if excess.max() > 0.0:
        row, joint = np.unravel_index(int(excess.argmax()), excess.shape)
        raise ConfigError(
            f"the hand cannot follow the motion: if it moved rigidly with the object, joint "
            f"{scene.model.joint(int(joint)).name} would leave its range by "
            f"{excess[row, joint]:.2f} {'m' if joint < _SLIDES else 'rad'} more than a policy can "
            f"compensate for, most at step {row}; {_CURE}"
        )
    return found


def _check_travel(scene: Scene, poses: Poses) -> None:
    """Check that the base's slides are long enough for the motion, before the pre-grasp is sought.

    Raises:
        ConfigError: they are too short, whatever the pre-grasp.
    """
    travel = np.ptp(poses.pos @ mount_rotation(scene), axis=0)
    low, high = scene.model.jnt_range[:_SLIDES].T
    far = travel - (high - low + 2 * SLACK_M + _HAND_M)
    if far.max() > 0:
        joint = int(far.argmax())
        raise ConfigError(
            f"the hand cannot follow the motion: the object goes {travel[joint]:.2f} m along "
            f"joint {scene.model.joint(joint).name}, which slides {high[joint] - low[joint]:.2f} "
            f"m; {_CURE}"
        )


def _firmest(scene: Scene, poses: list[NearPose], progress: StepProgress) -> FoundPregrasp:
    """Return, of the nearest poses, the one whose random closings lift the object most often.

    If the object cannot be lifted, return the nearest pose.
    """
    lift, still = LiftTest(scene, SUBSTEPS), np.zeros(scene.model.nv)
    tested = counted("lift tests", poses[:_COMPARED], progress)
    rates = [lift(Start(pose.qpos, still, None)) for pose in tested]
    best = int(np.nanargmax(rates)) if lift.possible else 0
    pose = poses[best]
    tips = ", ".join(f"{1e3 * d:.0f}" for d in pose.tip_distances_m)
    note = f"pre-grasp: fingertips {tips} mm from the object, nothing touched"
    if lift.possible:
        note += f"; {rates[best]:.0%} of random closings of the hand lift it"
    return FoundPregrasp(pose.qpos, "search", [note])


def _base_over(scene: Scene, poses: Poses) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function of qpos (nq,) that returns the excess of base joints (T, B) m or rad.

    The excess is how far a joint is beyond its range plus slack, negative inside.
    """
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
    stored, count = pregrasp_file.read(path).pose.qpos, scene.index.num_joints
    if stored.shape != qpos.shape:
        raise ConfigError(
            f"--pregrasp {path}: has {stored.size} joint positions, hand '{scene.hand.name}' with "
            f"this object has {qpos.size}"
        )
    found = np.concatenate((stored[:count], qpos[count:]))
    depth = HandContact(scene).depth(found)
    if depth > _TOUCH_M:
        raise ConfigError(
            f"--pregrasp {path}: the hand is {1e3 * depth:.1f} mm inside the object or the table"
        )
    return FoundPregrasp(found, "file", [f"pre-grasp from {path.name}"])


def _fingers(choice: str, scene: Scene, library: Library) -> np.ndarray:
    """Return finger joint positions (J,), rad, to which the search should stay close."""
    first = scene.hand.num_base_joints + scene.hand.num_wrist_joints
    if choice == "open":
        return np.zeros(scene.index.num_joints - first)
    if choice == "mean":
        return mean_fingers(scene)
    if choice not in library.tasks():
        raise ConfigError(
            f"--pregrasp '{choice}' is neither {', '.join(CHOICES)}, a .npz file, nor a task of "
            "the library ('pgdm assets list')"
        )
    entry = library.entry(choice)
    if entry.hand != scene.hand.name or "mined" not in entry.starts:
        raise ConfigError(
            f"--pregrasp '{choice}' is a task of hand '{entry.hand}'; give one that has a mined "
            f"pre-grasp of hand '{scene.hand.name}'"
        )
    return library.motion(choice).starts["mined"].qpos[first : scene.index.num_joints]
