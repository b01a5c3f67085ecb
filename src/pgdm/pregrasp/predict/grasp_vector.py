"""A hand beside an object as a vector of numbers, and back to joints.

The vector of a hand with J joints after its base, (9 + J,): where the middle of its fingertips
would be if its fingers were as on average, from the object's centre of mass, m; the first two
columns of the palm's orientation (6D rotation: Zhou et al., "On the Continuity of Rotation
Representations in Neural Networks", CVPR 2019); the joints, rad. All along the axes of the world.
"""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from mujoco.minimize import least_squares

from pgdm import rotations
from pgdm.sim.scene import Scene

POSITION, ROTATION, JOINTS = slice(0, 3), slice(3, 9), slice(9, None)
"""Parts of a vector."""


def rotation_of(columns: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) whose first two columns are nearest to given ones (6,).

    Gram-Schmidt: the first keeps its direction, the second its side.
    """
    first = _unit(columns[:3])
    second = _unit(columns[3:] - (first @ columns[3:]) * first)
    return np.stack((first, second, np.cross(first, second)), axis=1)


class GraspFrame:
    """Where a scene's hand is relative to its object, both ways.

    The base's joints are three slides, then three hinges that turn about X, Y and Z in turn, all
    in the mount's frame (SPEC 7). The palm is the body that the wrist's joints turn.

    Args:
        scene: hand and object.
        anchor_m: point of the palm that stands for the grasp (3,), in the palm's frame; without
            it, the palm's origin.
    """

    def __init__(self, scene: Scene, anchor_m: np.ndarray | None = None) -> None:
        self.scene = scene
        self.anchor_m = np.zeros(3) if anchor_m is None else np.asarray(anchor_m, float)
        hand, model = scene.hand, scene.model
        self._base, self._nu = hand.num_base_joints, model.nu
        self._palm = int(model.jnt_bodyid[self._base + hand.num_wrist_joints - 1])
        self._tips = scene.index.point_geoms[scene.index.fingertips]
        self._low, self._high = model.jnt_range[: self._nu].T
        self._data = mujoco.MjData(model)
        mount = np.empty(9)
        mujoco.mju_quat2Mat(mount, scene.index.mount_quat)
        self._mount = mount.reshape(3, 3)

    @property
    def size(self) -> int:
        """Length of a vector."""
        return 9 + self._nu - self._base

    def vector(self, qpos: np.ndarray) -> np.ndarray:
        """Return the vector (9+J,) of a state qpos (nq,), joints clipped to their limits."""
        data = self._at(qpos)
        palm = data.xmat[self._palm].reshape(3, 3)
        centre = data.xipos[self.scene.index.object_body]
        position = data.xpos[self._palm] + palm @ self.anchor_m - centre
        joints = qpos[: self._nu].clip(self._low, self._high)[self._base :]
        return np.concatenate((position, palm[:, 0], palm[:, 1], joints))

    def qpos(self, vector: np.ndarray, objects: np.ndarray) -> np.ndarray:
        """Return the scene's state (nq,) in which the hand is where a vector says.

        Where the base would leave its limits, base and wrist take the place within them whose
        fingertips and palm are nearest; the fingers stay.

        Args:
            vector: (9+J,).
            objects: a state (nq,) whose objects stay as they are.
        """
        centre = self._at(objects).xipos[self.scene.index.object_body].copy()
        joints = vector[JOINTS].clip(self._low[self._base :], self._high[self._base :])
        in_palm, palm_turn = self._mount_in_palm(joints)
        turn = rotation_of(vector[ROTATION])
        palm = vector[POSITION] + centre - turn @ self.anchor_m
        base = self.base_joints(palm + turn @ in_palm, turn @ palm_turn)
        asked = np.concatenate((base, joints, objects[self._nu :]))
        hand = asked[: self._nu].clip(self._low, self._high)
        if (hand == asked[: self._nu]).all():
            return asked
        moving = slice(0, self._base + self.scene.hand.num_wrist_joints)

        def away(columns: np.ndarray) -> np.ndarray:  # (moving, k) -> (3F+3, k)
            found = []
            for column in columns.T:
                trial = asked.copy()
                trial[moving] = column
                found.append(self._points(trial) - wanted)
            return np.stack(found, axis=1)

        wanted = self._points(asked)  # kinematics knows no limits
        bounds = [self._low[moving], self._high[moving]]
        best, _ = least_squares(hand[moving], away, bounds=bounds, verbose=0)
        asked[moving] = best.clip(*bounds)
        return asked

    def base_joints(self, position: np.ndarray, turn: np.ndarray) -> np.ndarray:
        """Return base joints (6,), m and rad, that bring the mount's body to a pose; not clipped.

        Of the two ways to turn there, the one that leaves the limits least.

        Args:
            position: of the body's origin (3,) m, world frame.
            turn: its orientation (3, 3).
        """
        slides = self._mount.T @ (position - self.scene.index.mount_pos)
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, (self._mount.T @ turn).ravel())
        x, y, z = rotations.to_euler_xyz(torch.from_numpy(quat)).tolist()
        ways = np.array([[x, y, z], [x + np.pi, np.pi - y, z + np.pi]])
        ways = np.remainder(ways + np.pi, 2 * np.pi) - np.pi
        low, high = self._low[3:6], self._high[3:6]
        outside = np.maximum(np.maximum(low - ways, ways - high), 0.0).sum(axis=1)
        return np.concatenate((slides, ways[int(outside.argmin())]))

    def fingertips(self, qpos: np.ndarray) -> np.ndarray:
        """Return the fingertips (F, 3) at qpos (nq,), m, from the object's centre of mass."""
        data = self._at(qpos)
        return data.geom_xpos[self._tips] - data.xipos[self.scene.index.object_body]

    def fingertips_in_palm(self, joints: np.ndarray) -> np.ndarray:
        """Return the fingertips (F, 3) m in the palm's frame, at the joints after the base (J,)."""
        data = self._with(joints)
        palm = data.xmat[self._palm].reshape(3, 3)
        return (data.geom_xpos[self._tips] - data.xpos[self._palm]) @ palm

    def fingertips_of(self, vector: np.ndarray) -> np.ndarray:
        """Return the fingertips (F, 3) that a vector means, m, from the object's centre of mass.

        Unlike :meth:`qpos` it does not ask whether the base gets there.
        """
        turn = rotation_of(vector[ROTATION])
        joints = vector[JOINTS].clip(self._low[self._base :], self._high[self._base :])
        return vector[POSITION] + (self.fingertips_in_palm(joints) - self.anchor_m) @ turn.T

    def _points(self, qpos: np.ndarray) -> np.ndarray:
        """Return fingertips and palm at qpos (nq,), (3F+3,) m, world frame."""
        data = self._at(qpos)
        return np.concatenate((data.geom_xpos[self._tips].ravel(), data.xpos[self._palm]))

    def _mount_in_palm(self, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pose of the mount's body in the palm's frame, (3,) m and (3, 3)."""
        data = self._with(joints)
        palm = data.xmat[self._palm].reshape(3, 3)
        return palm.T @ (self.scene.index.mount_pos - data.xpos[self._palm]), palm.T @ self._mount

    def _with(self, joints: np.ndarray) -> mujoco.MjData:
        qpos = np.zeros(self.scene.model.nq)
        qpos[self._base : self._nu] = joints
        return self._at(qpos)

    def _at(self, qpos: np.ndarray) -> mujoco.MjData:
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self.scene.model, self._data)
        return self._data


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-9)
