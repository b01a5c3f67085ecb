"""From a recorded human hand to a pre-grasp of a scene's hand.

The human joints are the library's, a file's, or, where there are none, those of the task's own hand
at its stored pre-grasp: so any hand can take up any motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from pgdm.errors import ConfigError
from pgdm.library import Library, Motion, Start, expert_contacts
from pgdm.library.expert_file import Expert
from pgdm.library.pregrasp_file import Pregrasp
from pgdm.pregrasp.ik import REACHED_M, HandIk, IkResult, solve_hand
from pgdm.pregrasp.keypoints import Keypoints
from pgdm.pregrasp.recording import Recording
from pgdm.pregrasp.targets import HandShape
from pgdm.sim.contact import FREE_M
from pgdm.sim.scene import Scene

FAR_M = 0.05
"""Fingertips that are farther from their targets than this in the mean make no pre-grasp."""
DEEP_M = 0.001
"""A hand that cuts deeper into something than this is no pre-grasp."""


@dataclass(frozen=True)
class Retargeted:
    """A pre-grasp made from a human hand, with what is unreachable."""

    pregrasp: Pregrasp
    result: IkResult
    frame: int
    fingers: tuple[str, ...]
    """Human finger of each fingertip."""
    measured: tuple[int, ...]
    """Fingertips whose human finger was measured; the others count for nothing."""

    @property
    def errors_m(self) -> np.ndarray:
        """Distances of the measured fingertips from their targets."""
        return self.result.fingertip_errors_m[list(self.measured)]

    @property
    def unreachable(self) -> list[str]:
        """Sentences about what the hand cannot do; empty if it can do all."""
        errors = self.result.fingertip_errors_m
        said = [
            f"{self.fingers[i]} fingertip ends {1e3 * errors[i]:.0f} mm from its target"
            for i in self.result.unreached()
            if i in self.measured
        ]
        slides = [name for name in self.result.at_limit if _is_slide(name)]
        if slides:
            said.append(f"the base is at the end of {', '.join(slides)}")
        if self.result.depth_m > FREE_M:
            said.append(f"the hand cuts {1e3 * self.result.depth_m:.1f} mm into something")
        return said

    @property
    def fit(self) -> str:
        """A phrase that tells how well the hand fits."""
        errors = self.errors_m
        return (
            f"fingertips {1e3 * errors.mean():.0f} mm from the human's in the mean, "
            f"{1e3 * errors.max():.0f} mm at most"
        )


def object_joints(motion: Motion, scene: Scene) -> np.ndarray:
    """Return the objects' joints (nq - nu,) where the task starts.

    Raises:
        ConfigError: the motion does not store where its objects start.
    """
    stored = motion.starts.get("mined") or next(iter(motion.starts.values()), None)
    if stored is None:
        raise ConfigError(f"motion '{motion.id}' does not store where its objects start")
    count = scene.model.nq - scene.model.nu
    return np.array(stored.qpos[len(stored.qpos) - count :])


def of_expert(expert: Expert, motion: Motion) -> Recording:
    """Return the human hand that the library has for a task; the pre-grasp is its first frame.

    The motion's positions are those of the object's origin, as in the recordings they come from.
    """
    label = f"the library's human hand of {expert.task}"
    frames = tuple(Keypoints.of(joints, "mano", label) for joints in expert.human_joints)
    return Recording(frames, motion.translation, motion.orientation, label, chosen=0)


def of_hand(scene: Scene, start: Start) -> Recording:
    """Return the one frame of a human hand that has its joints where a robot's are.

    Args:
        scene: of the task with its own hand.
        start: a start of it.
    """
    data = mujoco.MjData(scene.model)
    data.qpos[:] = start.qpos
    mujoco.mj_kinematics(scene.model, data)
    human = HandShape(scene).keypoints(data.geom_xpos[scene.index.point_geoms])
    label = f"the pre-grasp of {scene.task.id}'s own {scene.hand.name}"
    return Recording((human,), origin=label, chosen=0)


def of_task(library: Library, own: Scene, motion: Motion) -> Recording:
    """Return the human hand of a task: recorded, or in the place of its own hand.

    Args:
        library: with the task.
        own: scene of the task with its own hand.
        motion: of the task.

    Raises:
        ConfigError: the task has neither.
    """
    if motion.id in library.experts().experts:
        return of_expert(library.expert(motion.id), motion)
    for source in ("mined", "planned", "learned"):
        start = motion.starts.get(source)
        if start is not None and not start.is_reset_pose(own.model.nu):
            return of_hand(own, start)
    raise ConfigError(
        f"task '{own.task.id}' has neither a human hand nor a pre-grasp of its own to follow; give "
        "a file: pgdm pregrasp mocap TASK --file FILE"
    )


def frame_before_contact(recording: Recording, library: Library, scene: Scene) -> int:
    """Return the last frame of a recording before a finger touches the object.

    A finger touches from 8 mm on, as in the library's contacts. 0 where the object's pose is not
    known or the hand touches from the first frame on; the last one where it never does.

    Raises:
        ConfigError: the object hangs on something, so that one pose does not tell where it is.
        CorruptAssetError: the object has no parts to touch.
    """
    count, position, orientation = len(recording.frames), recording.position, recording.orientation
    if count == 1 or position is None or orientation is None:
        return 0
    if not scene.lies_free:
        raise ConfigError(
            f"{recording.origin}: has {count} frames, and the object of task '{scene.task.id}' "
            "hangs on something, so that contact cannot be seen: say which one with --frame"
        )
    xml = library.object_xml(scene.task.objects[0], scene.asset_source)
    joints = np.stack([hand.joints for hand in recording.frames])
    near = expert_contacts.measure(xml, position, orientation, joints).distances
    touching = (near < expert_contacts.CONTACT_M).any(axis=1)
    return max(int(touching.argmax()) - 1, 0) if touching.any() else count - 1


def retarget(
    scene: Scene,
    library: Library,
    motion: Motion,
    recording: Recording,
    frame: int | None = None,
    seed: int = 0,
) -> Retargeted:
    """Return the pre-grasp of a scene's hand that follows a human hand.

    The object is where the task's stored start has it. A recording with object poses is moved as a
    whole, so that its object lies there too.

    Args:
        scene: of the task, with the hand that is to take it up.
        library: with the object.
        motion: of the task.
        recording: the human hand.
        frame: which of its frames; by default the recording's choice (of the library's own the
            first, the benchmark's pre-grasp), else the last one before contact.
        seed: of the search.

    Raises:
        ConfigError: there is no such frame, the hand's points cannot follow a human hand, or the
            recording has poses of an object that hangs on something.
    """
    objects = object_joints(motion, scene)
    recording = _placed(recording, scene, objects)
    if frame is None:
        frame = recording.chosen
    if frame is None:
        frame = frame_before_contact(recording, library, scene)
    if not 0 <= frame < len(recording.frames):
        raise ConfigError(
            f"frame {frame} is not in {recording.origin}: it has 0 to {len(recording.frames) - 1}"
        )
    ik = HandIk(scene)
    result = solve_hand(ik, recording.frames[frame], objects, seed=seed)
    pose = Start(result.qpos, np.zeros(scene.model.nv), None)
    measured = tuple(ik.shape.measured(recording.frames[frame]))
    made = Retargeted(Pregrasp(pose, None, {}), result, frame, ik.shape.fingers, measured)
    return replace(made, pregrasp=Pregrasp(pose, None, _note(made, recording.origin)))


def check(made: Retargeted, scene: Scene) -> None:
    """Check that a pre-grasp is worth starting at.

    Raises:
        ConfigError: its fingertips are far from where they should be, or it cuts into something.
    """
    errors, depth = made.errors_m, made.result.depth_m
    if errors.mean() > FAR_M or depth > DEEP_M:
        raise ConfigError(
            f"hand '{scene.hand.name}' cannot take up task '{scene.task.id}': "
            f"{'; '.join(made.unreachable)}. Pose it by hand (pgdm pregrasp label), or start "
            "without a pre-grasp (pregrasp=none)"
        )


def _placed(recording: Recording, scene: Scene, objects: np.ndarray) -> Recording:
    """Return a recording whose object lies where the task has it, in every frame."""
    data = mujoco.MjData(scene.model)
    data.qpos[scene.model.nu :] = objects
    mujoco.mj_kinematics(scene.model, data)
    body, count = scene.index.object_body, len(recording.frames)
    while scene.model.body_parentid[body]:  # a recorded pose is that of the mesh's origin
        body = int(scene.model.body_parentid[body])
    there, turn = data.xpos[body].copy(), data.xmat[body].reshape(3, 3).copy()
    position = np.repeat(there[None], count, axis=0)
    orientation = np.repeat(data.xquat[body][None], count, axis=0)
    if recording.position is None or recording.orientation is None:
        return replace(recording, position=position, orientation=orientation)
    if not scene.lies_free:
        raise ConfigError(
            f"{recording.origin}: the object of task '{scene.task.id}' hangs on something; leave "
            "object_position and object_orientation out, the hand's joints in the task's world"
        )
    frames, was = [], np.empty(9)
    for hand, place, quaternion in zip(
        recording.frames, recording.position, recording.orientation, strict=True
    ):
        mujoco.mju_quat2Mat(was, quaternion)
        rotation = turn @ was.reshape(3, 3).T
        frames.append(hand.moved(rotation, there - rotation @ place))
    return replace(recording, frames=tuple(frames), position=position, orientation=orientation)


def _note(made: Retargeted, origin: str) -> dict[str, Any]:
    result = made.result
    errors = dict(zip(made.fingers, result.fingertip_errors_m, strict=True))
    return {
        "made_by": "inverse kinematics",
        "from": origin,
        "frame": made.frame,
        "anchor": result.targets.anchor,
        "scale": round(result.targets.scale, 3),
        "fingertip_errors_mm": {name: round(1e3 * float(e), 1) for name, e in errors.items()},
        "palm_error_rad": round(result.palm_error_rad, 3),
        "depth_mm": round(1e3 * result.depth_m, 2),
        "at_limit": list(result.at_limit),
        "unreachable": made.unreachable,
        "reached_m": REACHED_M,
    }


def _is_slide(name: str) -> bool:
    """Return whether a joint of a hand's base slides: they are named alike in all hands."""
    return name.rpartition("/")[2].startswith("ART")
