"""Turns a recorded human hand into a pre-grasp of a scene's hand.

The human joints come from the library or from a file. A task without them gets a substitute to
follow: a human hand whose joints are at the points of the task's own hand in its stored pre-grasp.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from pgdm.errors import ConfigError
from pgdm.library import Library, Motion, Start
from pgdm.library.experts import contacts as expert_contacts
from pgdm.library.files.columns import check_order
from pgdm.library.files.expert import Expert
from pgdm.library.files.pregrasp import Pregrasp
from pgdm.pregrasp.hand_geometry import posed
from pgdm.pregrasp.retarget.hand_ik import REACHED_M, HandIk, IkResult
from pgdm.pregrasp.retarget.ik import solve_hand
from pgdm.pregrasp.retarget.keypoints import Keypoints
from pgdm.pregrasp.retarget.recording import Recording
from pgdm.pregrasp.retarget.targets import HandShape
from pgdm.pregrasp.sources import is_reset_pose, object_joints
from pgdm.sim.contact import FREE_M
from pgdm.sim.scene import Scene

FAR_M = 0.05
"""A pre-grasp is refused if its fingertips are farther than this from their targets on average."""
DEEP_M = 0.001
"""A pre-grasp is refused if the hand penetrates something deeper than this."""


@dataclass(frozen=True)
class Retargeted:
    """A pre-grasp that follows a human hand, and how well it does."""

    pregrasp: Pregrasp
    result: IkResult
    frame: int  # index of the recording's frame that it follows
    fingers: tuple[str, ...]
    """Human finger that each fingertip follows."""
    measured: tuple[int, ...]
    """Indices of the fingertips whose human finger was measured; only these are judged."""

    @property
    def errors_m(self) -> np.ndarray:
        """Distances of the fingertips in ``measured`` from their targets."""
        return self.result.fingertip_errors_m[list(self.measured)]

    @property
    def unreachable(self) -> list[str]:
        """What is wrong, in words: fingertips out of reach, slides at a limit, or penetration."""
        errors = self.result.fingertip_errors_m
        found = [
            f"{self.fingers[i]} fingertip ends {1e3 * errors[i]:.0f} mm from its target"
            for i in self.result.unreached
            if i in self.measured
        ]
        if slides := self.result.slides_at_limit:
            found.append(f"the base is at the end of {', '.join(slides)}")
        if self.result.depth_m > FREE_M:
            found.append(f"the hand is {1e3 * self.result.depth_m:.1f} mm inside something")
        return found

    @property
    def fit(self) -> str:
        """How closely the hand follows, in words."""
        errors = self.errors_m
        return (
            f"fingertips {1e3 * errors.mean():.0f} mm from the human's on average, "
            f"{1e3 * errors.max():.0f} mm at most"
        )


def of_expert(expert: Expert, motion: Motion) -> Recording:
    """Return the library's human hand of a task as a recording; its first frame is the pre-grasp.

    The motion's positions are taken as those of the mesh's origin, as in the original recordings.
    """
    label = f"the library's human hand of {expert.task}"
    frames = tuple(Keypoints.of(joints, "mano", label) for joints in expert.human_joints)
    return Recording(frames, motion.translation, motion.orientation, label, chosen=0)


def of_hand(scene: Scene, start: Start) -> Recording:
    """Return a recording of one frame: a human hand whose joints are at a robot hand's points.

    Args:
        scene: scene of the task with its own hand.
        start: a stored start of that task.
    """
    points = posed(scene, start.qpos).geom_xpos[scene.index.point_geoms]
    human = HandShape(scene).keypoints(points)
    label = f"the pre-grasp of {scene.task.id}'s own {scene.hand.name}"
    return Recording((human,), origin=label, chosen=0)


def of_task(library: Library, own: Scene, motion: Motion) -> Recording:
    """Return the human hand of a task: recorded, or derived from the points of the task's own hand.

    Args:
        library: library with the task.
        own: scene of the task with its own hand.
        motion: motion of the task.

    Raises:
        ConfigError: the task has neither a human hand nor a pre-grasp of its own hand.
    """
    if motion.id in library.experts().experts:
        return of_expert(library.expert(motion.id), motion)
    for source in ("mined", "planned", "learned"):
        start = motion.starts.get(source)
        if start is not None and not is_reset_pose(own, start.qpos):
            return of_hand(own, start)
    raise ConfigError(
        f"task '{own.task.id}' has neither a human hand nor a pre-grasp of its own to follow; pass "
        "a file: pgdm pregrasp mocap TASK --file FILE"
    )


def frame_before_contact(recording: Recording, library: Library, scene: Scene) -> int:
    """Return the last frame of a recording before a finger touches the object.

    A finger counts as touching within 8 mm, as in the library's contacts. Returns 0 if the object's
    pose is unknown or a finger touches in the first frame, and the last frame if none ever touches.

    Raises:
        ConfigError: the object is attached to something, such as a door, and its recorded pose does
            not determine where its parts are.
        CorruptAssetError: the object has no parts to touch.
    """
    count, position, orientation = len(recording.frames), recording.position, recording.orientation
    if count == 1 or position is None or orientation is None:
        return 0
    if not scene.lies_free:
        raise ConfigError(
            f"{recording.origin}: has {count} frames, and the object of task '{scene.task.id}' "
            "is attached to something, so that contact cannot be detected: choose a frame (--frame)"
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
    """Return the pre-grasp in which a scene's hand follows a human hand.

    The object is where the task's stored start has it. If the recording has object poses, each
    frame is moved rigidly so that its object coincides with the task's.

    Args:
        scene: scene of the task, with the hand that is to do it.
        library: library with the object.
        motion: motion of the task.
        recording: recording of the human hand.
        frame: index of the frame to follow; by default ``recording.chosen`` (for the library's
            recordings the first, as in the mined pre-grasps), else the last before contact.
        seed: seed of the search that frees the hand.

    Raises:
        ConfigError: there is no such frame; the hand's points do not have the layout that inverse
            kinematics needs; the recorded quaternions seem to be in the order x y z w; or the
            object is attached to something, and the recording has either object poses or several
            frames of which none is chosen.
        CorruptAssetError: the object has no parts to touch.
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
    """Check that a pre-grasp is good enough to start from.

    Raises:
        ConfigError: its fingertips are far from their targets, or it penetrates something.
    """
    errors, depth = made.errors_m, made.result.depth_m
    if errors.mean() > FAR_M or depth > DEEP_M:
        raise ConfigError(
            f"hand '{scene.hand.name}' cannot do task '{scene.task.id}': "
            f"{'; '.join(made.unreachable)}. Pose it yourself (pgdm pregrasp label), or start "
            "without a pre-grasp (pregrasp=none)"
        )


def _placed(recording: Recording, scene: Scene, objects: np.ndarray) -> Recording:
    """Return the recording with each frame moved so that its object is where the task has it."""
    data = posed(scene, np.concatenate((scene.index.reset, objects)))
    body, count = scene.index.object_body, len(recording.frames)
    while scene.model.body_parentid[body]:  # the root body is at the mesh's origin, as recorded
        body = int(scene.model.body_parentid[body])
    there, home_rotation = data.xpos[body].copy(), data.xmat[body].reshape(3, 3).copy()
    position = np.repeat(there[None], count, axis=0)
    orientation = np.repeat(data.xquat[body][None], count, axis=0)
    if recording.position is None or recording.orientation is None:
        return replace(recording, position=position, orientation=orientation)
    if not scene.lies_free:
        raise ConfigError(
            f"{recording.origin}: the object of task '{scene.task.id}' is attached to something; "
            "leave object_position and object_orientation out, and give the hand's joints in the "
            "task's world frame"
        )
    if not recording.ordered:
        label, cure = f"{recording.origin}: frame 0", "name it: object_orientation_order: xyzw"
        check_order(recording.orientation[0], Rotation.from_matrix(home_rotation), label, cure)
    frames, was = [], np.empty(9)
    for hand, place, quaternion in zip(
        recording.frames, recording.position, recording.orientation, strict=True
    ):
        mujoco.mju_quat2Mat(was, quaternion)
        rotation = home_rotation @ was.reshape(3, 3).T
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
