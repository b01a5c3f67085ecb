"""Penetration of a hand into the rest of its scene, and fingertip distance to the object."""

from __future__ import annotations

import mujoco
import numpy as np

from pgdm.sim.scene import Scene

FREE_M = 1e-4
"""Largest penetration at which a hand still counts as touching nothing, m."""
FAR_M = 0.5
"""Upper bound of the fingertip distance."""


class HandContact:
    """Penetration of a scene's hand into everything else: table, object, board, door.

    Args:
        scene: a scene; its hand's joints are first in qpos.
    """

    def __init__(self, scene: Scene) -> None:
        model, hand = scene.model, scene.hand
        self._model, self._data = model, mujoco.MjData(model)
        self.first_finger_joint = hand.num_base_joints + hand.num_wrist_joints
        """Index of the first finger joint in qpos; finger joints are the last of the hand's."""
        joints = model.jnt_bodyid[: scene.index.num_joints]
        of_hand = np.isin(model.body_rootid, model.body_rootid[joints])
        self._of_hand = of_hand[model.geom_bodyid]
        with_joint = set(joints[self.first_finger_joint :].tolist())
        parents = model.body_parentid
        root = np.full(model.nbody, -1)  # of each body, the first body of its finger; -1 if none
        for body in range(1, model.nbody):  # parents come before their children
            inherited = root[parents[body]]
            root[body] = body if inherited < 0 and body in with_joint else inherited
        bases = sorted(set(root[root >= 0].tolist()))
        number = {-1: -1} | {base: i for i, base in enumerate(bases)}
        finger = np.array([number[base] for base in root.tolist()])
        self.num_fingers = len(bases)
        self._finger_of_geom = finger[model.geom_bodyid]
        self.finger_of_joint = finger[joints[self.first_finger_joint :]]
        """Index of the finger of each finger joint."""

    def finger_of_geom(self, geom: int) -> int:
        """Return the index of the finger that a geom belongs to, -1 if none."""
        return int(self._finger_of_geom[geom])

    def depth(self, qpos: np.ndarray) -> float:
        """Return the hand's deepest penetration at qpos (nq,), m; 0 if there is none."""
        return float(self.depths(qpos).max())

    def depths(self, qpos: np.ndarray) -> np.ndarray:
        """Return the deepest penetration of each finger, then of the rest of the hand, (F+1,) m."""
        depths = np.zeros(self.num_fingers + 1)
        for finger, dist in zip(*self._near(self._at(qpos), 0.0), strict=True):
            depths[finger] = max(depths[finger], -dist)
        return depths

    def overlap(self, qpos: np.ndarray, clearance_m: float) -> float:
        """Return the sum of max(0, clearance - distance) over the hand's contacts at qpos (nq,), m.

        MuJoCo reports contacts only within the geoms' margins; a clearance above them has no
        further effect.
        """
        return self.too_near(self._at(qpos), clearance_m)

    def too_near(self, data: mujoco.MjData, clearance_m: float) -> float:
        """Return the same as `overlap`, m, for a state with current contacts."""
        dist = self._near(data, clearance_m)[1]
        return float((clearance_m - dist).sum())

    def _at(self, qpos: np.ndarray) -> mujoco.MjData:
        """Return a state at qpos (nq,) with current contacts."""
        model, data = self._model, self._data
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        return data

    def _near(self, data: mujoco.MjData, clearance_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Return finger (-1: rest of the hand) and distance of the contacts within a clearance."""
        pairs, dist = data.contact.geom, data.contact.dist
        of_hand = self._of_hand[pairs]  # (contacts, 2)
        near = (of_hand[:, 0] != of_hand[:, 1]) & (dist < clearance_m)
        geoms = np.where(of_hand[near, 0], pairs[near, 0], pairs[near, 1])
        return self._finger_of_geom[geoms], dist[near]


class FingertipDistance:
    """Distance from the surface of each finger's last link to the object's surface.

    Args:
        scene: scene of the task.
    """

    def __init__(self, scene: Scene) -> None:
        model, index = scene.model, scene.index
        self._model = model
        solid = (model.geom_contype | model.geom_conaffinity) != 0
        of_object = model.body_weldid[model.geom_bodyid] == model.body_weldid[index.object_body]
        self._object = np.flatnonzero(solid & of_object).tolist()
        self._links = []
        for body in index.point_bodies[index.fingertips].tolist():
            # A fingertip's point may be on a separate body at the end of the last link.
            while not (solid & (model.geom_bodyid == body)).any():
                body = model.body_parentid[body]
            self._links.append(np.flatnonzero(solid & (model.geom_bodyid == body)).tolist())

    def __call__(self, data: mujoco.MjData) -> np.ndarray:
        """Return the distances (F,) m of a state with current kinematics.

        They are negative on overlap and at most ``FAR_M``.
        """
        return np.array([self._least(data, link) for link in self._links])

    def _least(self, data: mujoco.MjData, link: list[int]) -> float:
        least = FAR_M
        for mine in link:
            for other in self._object:
                found = mujoco.mj_geomDistance(self._model, data, mine, other, least, None)
                least = min(least, found)
        return least
