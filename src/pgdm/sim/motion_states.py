"""Exemplar and expert motions as joint positions of a scene, to show or to start from."""

from __future__ import annotations

import numpy as np
import torch

from pgdm import rotations
from pgdm.motion.reference import ExpertReference, ObjectReference
from pgdm.sim.hand_model import six_joints
from pgdm.sim.scene import Scene


def motion_qpos(scene: Scene, start: np.ndarray, reference: ObjectReference) -> np.ndarray:
    """Return qpos (T, nq) with the object on the exemplar motion, all else as in ``start`` (nq,).

    Without the six joints of a free object (`pgdm.sim.hand_model.BASE`) the object stays as well.
    """
    model, body = scene.model, scene.index.object_body
    qpos = np.repeat(start[None], len(reference), axis=0)
    if not six_joints(model, body):
        return qpos
    home_pos = torch.from_numpy(model.body_pos[body].copy())
    home_quat = torch.from_numpy(model.body_quat[body].copy())
    com = torch.from_numpy(model.body_ipos[body].copy())
    origin = reference.pos - rotations.rotate(reference.quat, com.expand_as(reference.pos))
    to_home = rotations.conjugate(home_quat)
    orientation = rotations.multiply(to_home, reference.quat)
    at = model.jnt_qposadr[model.body_jntadr[body]]
    qpos[:, at : at + 3] = rotations.rotate(to_home, origin - home_pos).numpy()
    qpos[:, at + 3 : at + 6] = rotations.unwrap(rotations.to_euler_xyz(orientation)).numpy()
    return qpos


def expert_qpos(
    scene: Scene, start: np.ndarray, reference: ObjectReference, joints: np.ndarray
) -> np.ndarray:
    """Return qpos (T, nq) with the object on the exemplar motion and the hand on the expert's.

    Args:
        scene: scene of the task.
        start: qpos (nq,) of everything else.
        reference: the exemplar motion; its positions are those of the object's centre of mass.
        joints: joint positions of the hand (T, n), m and rad.
    """
    qpos = motion_qpos(scene, start, reference)
    qpos[:, : scene.index.num_joints] = joints  # the hand's joints come first
    return qpos


def expert_marks(reference: ObjectReference, expert: ExpertReference) -> list[np.ndarray]:
    """Return where fingers touch the object at each of T poses, (n, 3) m each, world frame."""
    points = expert.contact_points(torch.arange(len(expert)), reference.pos, reference.quat)
    return [points[t][expert.in_contact[t]].numpy() for t in range(len(expert))]
