"""Geometry of a scene's hand: mount, base joints, straight and mean fingers, thumb."""

from __future__ import annotations

import mujoco
import numpy as np
import torch

from pgdm import rotations
from pgdm.errors import ConfigError, amount
from pgdm.sim.contact import HandContact
from pgdm.sim.scene import Scene


def unit(vector: np.ndarray) -> np.ndarray:
    """Return a vector divided by its length; the zero vector stays zero."""
    return vector / max(float(np.linalg.norm(vector)), 1e-9)


def mount_rotation(scene: Scene) -> np.ndarray:
    """Return the rotation (3, 3) from the mount's frame, that of the base joints, to the world."""
    mount = np.empty(9)
    mujoco.mju_quat2Mat(mount, scene.index.mount_quat)
    return mount.reshape(3, 3)


def base_joints(
    scene: Scene, position: np.ndarray, rotation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return base joint positions that bring the mount body to a pose; limits are ignored.

    Args:
        scene: a scene; its base has three slides, then intrinsic X-Y-Z hinges.
        position: position of the mount body's origin (3,) m, world frame.
        rotation: orientation of the mount body (3, 3), world frame.

    Returns:
        The slides (3,) m, and the two triples of hinge angles that give the rotation, (2, 3) rad.
    """
    mount, quat = mount_rotation(scene), np.empty(4)
    mujoco.mju_mat2Quat(quat, (mount.T @ rotation).ravel())
    x, y, z = rotations.to_euler_xyz(torch.from_numpy(quat)).tolist()
    hinges = np.array([[x, y, z], [x + np.pi, np.pi - y, z + np.pi]])
    return mount.T @ (position - scene.index.mount_pos), hinges


def posed(scene: Scene, qpos: np.ndarray) -> mujoco.MjData:
    """Return the scene's kinematics at qpos (nq,), without contacts."""
    data = mujoco.MjData(scene.model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(scene.model, data)
    return data


def object_to_hand(scene: Scene, qpos: np.ndarray) -> np.ndarray:
    """Return the vector from the object's centre of mass to the mean of the hand's tracked points.

    It is (3,) m, world frame.
    """
    data = posed(scene, qpos)
    points = data.geom_xpos[scene.index.point_geoms]
    return points.mean(axis=0) - data.xipos[scene.index.object_body]


def straight(scene: Scene) -> np.ndarray:
    """Return the hand's joints (n,) at zero, or at the limit nearest to zero."""
    index = scene.index
    joints = np.zeros(index.num_joints).clip(*scene.model.jnt_range[: index.num_joints].T)
    return index.couplings.apply(joints)


def opposing_finger(scene: Scene, contact: HandContact) -> int:
    """Return the index of the thumb among the fingers of ``contact``.

    It is the finger that ``hand.human_fingers`` assigns to the human thumb; without a complete
    assignment, the finger whose tip is farthest from the mean of the other tips while all fingers
    are straight.
    """
    model, index, human = scene.model, scene.index, scene.hand.human_fingers
    if "thumb" in human and len(human) == len(index.fingertips):
        tip = index.point_geoms[index.fingertips[human.index("thumb")]]
        return contact.finger_of_geom(int(tip))
    data = mujoco.MjData(model)
    data.qpos[: index.num_joints] = straight(scene)
    mujoco.mj_kinematics(model, data)
    tips = index.point_geoms[index.fingertips]
    places = data.geom_xpos[tips]
    middle = (places.sum(0) - places) / max(len(tips) - 1, 1)  # of the others
    return contact.finger_of_geom(int(tips[np.linalg.norm(places - middle, axis=1).argmax()]))


def mean_fingers(scene: Scene) -> np.ndarray:
    """Return finger joint positions (J,) rad of the hand's mean pre-grasp.

    Raises:
        ConfigError: ``hand.mean_fingers_rad`` does not have one entry for each finger joint.
    """
    hand = scene.hand
    count = scene.index.num_joints - hand.num_base_joints - hand.num_wrist_joints
    if len(hand.mean_fingers_rad) != count:
        raise ConfigError(
            f"hand.mean_fingers_rad has {amount(len(hand.mean_fingers_rad), 'number')}, but hand "
            f"'{hand.name}' has {amount(count, 'finger joint')} after hand.num_base_joints and "
            "hand.num_wrist_joints"
        )
    return np.array(hand.mean_fingers_rad)
