"""The exemplar motion as joint positions, to look at or to start from."""

from __future__ import annotations

import mujoco
import numpy as np
import torch

from pgdm import rotations
from pgdm.motion.reference import ObjectReference
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
