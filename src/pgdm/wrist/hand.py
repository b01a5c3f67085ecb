"""Simulation of the hand alone: it touches no object, but may bear an object's weight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from pgdm.errors import SceneError
from pgdm.sim.batch import SimBatch
from pgdm.sim.scene import Scene
from pgdm.wrist.path import BASE_JOINTS, GraspPoint
from pgdm.wrist.problem import WristProblem


@dataclass(frozen=True)
class Rollout:
    """States and poses of the hand over K control steps."""

    qpos: np.ndarray  # (K+1, nq)
    qvel: np.ndarray  # (K+1, nv)
    points: np.ndarray  # (K, 3) m, world frame: the grasp point after each step
    orientations: Rotation  # (K,) world frame: of the palm, after each step


class HandAlone:
    """Simulates the hand of a wrist-plan problem without contact with objects.

    Args:
        problem: gives the motion, the start state, the finger targets and the load.
        scene: the problem's scene, with the objects' contacts switched off.
    """

    def __init__(self, problem: WristProblem, scene: Scene) -> None:
        self._problem, hand = problem, scene.hand
        self.palm = int(scene.model.jnt_bodyid[hand.num_base_joints + hand.num_wrist_joints - 1])
        self.sim = SimBatch(scene, 1, 1, problem.substeps)
        self._restart()
        pos, orientation = self._palm(self.sim)
        self._load = problem.load_n()
        self.start_orientation = orientation[0]
        self._grasp = GraspPoint.at(problem.reference.pos.numpy()[0], pos[0], orientation[0])

    def rollout(self, commands: np.ndarray) -> Rollout:
        """Return the states that base commands (K, 6), m and rad, lead to from the start state.

        Raises:
            SceneError: if the simulation diverges.
        """
        self._restart()
        states, poses = [self.sim.read()], []
        ctrl = self._problem.fingers[None].copy()
        for k, command in enumerate(commands):
            ctrl[0, :BASE_JOINTS] = command
            self.step(self.sim, ctrl, np.array([k + 1]))
            states.append(self.sim.read())
            poses.append(self.grasp_point(self.sim))
        return Rollout(
            np.concatenate([state.qpos.numpy() for state in states]),
            np.concatenate([state.qvel.numpy() for state in states]),
            np.concatenate([points for points, _ in poses]),
            Rotation.concatenate([orientation for _, orientation in poses]),
        )

    def step(self, sim: SimBatch, ctrl: np.ndarray, steps: np.ndarray) -> None:
        """Take a control step in each of N simulations.

        Args:
            sim: the simulations.
            ctrl: actuator targets (N, nu).
            steps: steps of the motion (N,), which determine the load.

        Raises:
            SceneError: if a simulation diverges.
        """
        if self._load.any():
            force = np.zeros((len(steps), 3))
            force[:, 2] = -self._load[steps]
            sim.push(self.palm, force, self.grasp_point(sim)[0])
        if sim.step(ctrl).any():
            task = self._problem.scene.task.id
            raise SceneError(f"task '{task}': the simulation of the hand alone diverged")

    def grasp_point(self, sim: SimBatch) -> tuple[np.ndarray, Rotation]:
        """Return the grasp points (N, 3) m and the palm orientations (N,), world frame."""
        pos, orientation = self._palm(sim)
        return self._grasp.of(pos, orientation), orientation

    def _palm(self, sim: SimBatch) -> tuple[np.ndarray, Rotation]:
        pos, quat = sim.body_pose(self.palm)
        return pos, Rotation.from_quat(quat, scalar_first=True)

    def _restart(self) -> None:
        self.sim.reset(np.array([0]), self._problem.qpos, self._problem.qvel)
