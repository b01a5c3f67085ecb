"""Converts a hand's pose relative to an object to a grasp vector, and back to joints.

The grasp vector of a hand with J joints after its base is (9 + J,); position and rotation are in
world axes:

- position of the anchor, a point fixed to the palm, relative to the object's centre of mass, m (3);
  a predictor's anchor is its examples' mean fingertip position in the palm's frame
- first two columns of the palm's rotation (6), a representation without discontinuities (Zhou et
  al., "On the Continuity of Rotation Representations in Neural Networks", CVPR 2019)
- positions of the joints after the base, rad (J)
"""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco.minimize import least_squares

from pgdm.pregrasp.hand_geometry import base_joints, mount_rotation, unit
from pgdm.sim.scene import Scene

POSITION, ROTATION, JOINTS = slice(0, 3), slice(3, 9), slice(9, None)
"""Parts of a grasp vector."""


def rotation_of(columns: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) from its first two columns (6,), which Gram-Schmidt corrects."""
    first = unit(columns[:3])
    second = unit(columns[3:] - (first @ columns[3:]) * first)
    return np.stack((first, second, np.cross(first, second)), axis=1)


class GraspFrame:
    """Converts between the states of a scene and grasp vectors.

    The base has three slides, then three intrinsic X-Y-Z hinges, all in the mount's frame. The palm
    is the body that the last joint before the fingers moves.

    Args:
        scene: scene with hand and object.
        anchor_m: anchor (3,) m, in the palm's frame; by default the palm's origin.
    """

    def __init__(self, scene: Scene, anchor_m: np.ndarray | None = None) -> None:
        self.scene = scene
        self.anchor_m = np.zeros(3) if anchor_m is None else np.asarray(anchor_m, float)
        hand, model = scene.hand, scene.model
        self._base, self._n = hand.num_base_joints, scene.index.num_joints
        self._palm = int(model.jnt_bodyid[self._base + hand.num_wrist_joints - 1])
        self._tips = scene.index.point_geoms[scene.index.fingertips]
        self._low, self._high = model.jnt_range[: self._n].T
        self._data, self._mount = mujoco.MjData(model), mount_rotation(scene)

    @property
    def size(self) -> int:
        """Length of a grasp vector, 9 + J."""
        return 9 + self._n - self._base

    def vector(self, qpos: np.ndarray) -> np.ndarray:
        """Return the grasp vector (9+J,) of a state qpos (nq,).

        Its joints are clipped to their limits; its position and rotation are those of the state.
        """
        data = self._at(qpos)
        palm = data.xmat[self._palm].reshape(3, 3)
        centre = data.xipos[self.scene.index.object_body]
        position = data.xpos[self._palm] + palm @ self.anchor_m - centre
        joints = qpos[: self._n].clip(self._low, self._high)[self._base :]
        return np.concatenate((position, palm[:, 0], palm[:, 1], joints))

    def qpos(self, vector: np.ndarray, objects: np.ndarray) -> np.ndarray:
        """Return the scene's state (nq,) with the hand at a grasp vector.

        If the base would exceed its limits, the base and wrist joints are optimised within their
        limits, for the least squared position error of fingertips and palm; the fingers stay.

        Args:
            vector: grasp vector (9+J,).
            objects: a state (nq,) with the objects in place.
        """
        centre = self._at(objects).xipos[self.scene.index.object_body].copy()
        joints = vector[JOINTS].clip(self._low[self._base :], self._high[self._base :])
        in_palm, rotation_in_palm = self._mount_in_palm(joints)
        rotation = rotation_of(vector[ROTATION])
        palm = vector[POSITION] + centre - rotation @ self.anchor_m
        base = self._base_joints(palm + rotation @ in_palm, rotation @ rotation_in_palm)
        asked = np.concatenate((base, joints, objects[self._n :]))
        self.scene.index.couplings.apply(asked)
        hand = asked[: self._n].clip(self._low, self._high)
        if (hand == asked[: self._n]).all():
            return asked
        moving = slice(0, self._base + self.scene.hand.num_wrist_joints)

        def away(columns: np.ndarray) -> np.ndarray:  # (moving, k) -> (3F+3, k)
            found = []
            for column in columns.T:
                trial = asked.copy()
                trial[moving] = column
                found.append(self._points(trial) - wanted)
            return np.stack(found, axis=1)

        wanted = self._points(asked)  # forward kinematics ignores joint limits
        bounds = [self._low[moving], self._high[moving]]
        best, _ = least_squares(hand[moving], away, bounds=bounds, verbose=0)
        asked[moving] = best.clip(*bounds)
        return asked

    def _base_joints(self, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Return base joint positions (6,) that bring the mount body to a pose, not clipped.

        Of the two solutions for the Euler angles, the one that exceeds the limits less is used.
        """
        slides, hinges = base_joints(self.scene, position, rotation)
        hinges = np.remainder(hinges + np.pi, 2 * np.pi) - np.pi
        low, high = self._low[3:6], self._high[3:6]
        outside = np.maximum(np.maximum(low - hinges, hinges - high), 0.0).sum(axis=1)
        return np.concatenate((slides, hinges[int(outside.argmin())]))

    def fingertips(self, qpos: np.ndarray) -> np.ndarray:
        """Return the fingertips (F, 3) m at qpos (nq,), relative to the object's centre of mass."""
        data = self._at(qpos)
        return data.geom_xpos[self._tips] - data.xipos[self.scene.index.object_body]

    def fingertips_in_palm(self, joints: np.ndarray) -> np.ndarray:
        """Return the fingertips (F, 3) m in the palm's frame, given the joints after the base."""
        data = self._with(joints)
        palm = data.xmat[self._palm].reshape(3, 3)
        return (data.geom_xpos[self._tips] - data.xpos[self._palm]) @ palm

    def fingertips_of(self, vector: np.ndarray) -> np.ndarray:
        """Return a grasp vector's fingertips (F, 3) m, relative to the object's centre of mass.

        Unlike in :meth:`qpos`, the base's limits are ignored.
        """
        rotation = rotation_of(vector[ROTATION])
        joints = vector[JOINTS].clip(self._low[self._base :], self._high[self._base :])
        return vector[POSITION] + (self.fingertips_in_palm(joints) - self.anchor_m) @ rotation.T

    def _points(self, qpos: np.ndarray) -> np.ndarray:
        """Return the positions of fingertips and palm (3F+3,) m, world frame, at qpos (nq,)."""
        data = self._at(qpos)
        return np.concatenate((data.geom_xpos[self._tips].ravel(), data.xpos[self._palm]))

    def _mount_in_palm(self, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pose of the mount body in the palm's frame, (3,) m and (3, 3)."""
        data = self._with(joints)
        palm = data.xmat[self._palm].reshape(3, 3)
        return palm.T @ (self.scene.index.mount_pos - data.xpos[self._palm]), palm.T @ self._mount

    def _with(self, joints: np.ndarray) -> mujoco.MjData:
        qpos = np.zeros(self.scene.model.nq)
        qpos[self._base : self._n] = joints
        self.scene.index.couplings.apply(qpos)
        return self._at(qpos)

    def _at(self, qpos: np.ndarray) -> mujoco.MjData:
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self.scene.model, self._data)
        return self._data
