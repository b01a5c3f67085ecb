"""The exemplar motion and the expert's as joint positions, to look at or to start from."""

from __future__ import annotations

import mujoco
import numpy as np
import torch

from pgdm import rotations
from pgdm.motion.reference import ExpertReference, ObjectReference
from pgdm.sim.scene import Scene


def motion_qpos(scene: Scene, start: np.ndarray, reference: ObjectReference) -> np.ndarray:
    """Return qpos (T, nq) of the motion: the hand stays at ``start``, the object follows.

    An object without six joints of its own (three slides, then three hinges, as TCDM's) stays.
    """
    model, body = scene.model, scene.index.object_body
    qpos = np.repeat(start[None], len(reference), axis=0)
    first = model.body_jntadr[body]
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    kinds = model.jnt_type[first : first + model.body_jntnum[body]].tolist()
    if kinds != [slide] * 3 + [hinge] * 3:
        return qpos
    home_pos = torch.from_numpy(model.body_pos[body].copy())
    home_quat = torch.from_numpy(model.body_quat[body].copy())
    com = torch.from_numpy(model.body_ipos[body].copy())
    origin = reference.pos - rotations.rotate(reference.quat, com.expand_as(reference.pos))
    to_home = rotations.conjugate(home_quat)
    turn = rotations.multiply(to_home, reference.quat)
    at = model.jnt_qposadr[first]
    qpos[:, at : at + 3] = rotations.rotate(to_home, origin - home_pos).numpy()
    qpos[:, at + 3 : at + 6] = rotations.unwrap(rotations.to_euler_xyz(turn)).numpy()
    return qpos


def expert_qpos(
    scene: Scene, start: np.ndarray, reference: ObjectReference, joints: np.ndarray
) -> np.ndarray:
    """Return qpos (T, nq) at which hand and object move as the expert's did.

    Args:
        scene: the task's.
        start: joint positions (nq,) of whatever else is in the scene.
        reference: the object's motion, its positions those of the centre of mass.
        joints: the hand's (T, nu), m and rad.
    """
    qpos = motion_qpos(scene, start, reference)
    qpos[:, : scene.index.num_actuators] = joints  # the hand's joints come first
    return qpos


def expert_marks(reference: ObjectReference, expert: ExpertReference) -> list[np.ndarray]:
    """Return where fingers touch the object at each of T poses, (n, 3) m each, world frame."""
    points = expert.contact_points(torch.arange(len(expert)), reference.pos, reference.quat)
    return [points[t][expert.in_contact[t]].numpy() for t in range(len(expert))]
