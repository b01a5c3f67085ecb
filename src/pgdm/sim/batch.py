"""N simulations of one scene, stepped on all cores by ``mujoco.batch.Batch``."""

from __future__ import annotations

import os
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from mujoco import batch as mujoco_batch
from torch import Tensor

from pgdm.errors import SceneError
from pgdm.sim.scene import Scene

Model = mujoco.MjModel
Data = mujoco.MjData

_CURRENT = mujoco.mjtStage.mjSTAGE_VEL  # what the agent sees is current after the last substep


@dataclass(frozen=True)
class SimState:
    """What the agent can see of n simulations: float64, world frame, current.

    Points are the hand's tracked geoms, at their centres; the object is at its centre of mass.
    """

    qpos: Tensor  # (n, nq) m, rad
    qvel: Tensor  # (n, nv) m/s, rad/s
    point_pos: Tensor  # (n, P, 3) m
    point_quat: Tensor  # (n, P, 4) wxyz, of the points' bodies
    point_vel: Tensor  # (n, P, 6) linear m/s, then angular rad/s
    object_pos: Tensor  # (n, 3) m
    object_quat: Tensor  # (n, 4) wxyz
    object_vel: Tensor  # (n, 6) linear m/s, then angular rad/s


class SimBatch:
    """N simulations of a scene.

    Args:
        scene: what to simulate.
        num_envs: N.
        num_threads: threads that step them; 0 takes one per core that
            this process may use. Results do not depend on it.
        substeps: physics steps per control step.
    """

    def __init__(self, scene: Scene, num_envs: int, num_threads: int, substeps: int) -> None:
        self.scene = scene
        self.num_envs = num_envs
        self._substeps = substeps
        threads = num_threads or len(os.sched_getaffinity(0))
        self._batch = mujoco_batch.Batch(scene.model, num_envs, threads, persistent=True)
        fields = ("qpos", "qvel", "ctrl", "qfrc_applied", "qfrc_bias", "xfrc_applied", "warning")
        self._f = {name: getattr(self._batch, name) for name in fields}
        derived = ("geom_xpos", "xquat", "xipos", "cvel", "subtree_com")
        self._d = {name: self._batch.bind(name) for name in derived}
        self._scratch = mujoco.MjData(scene.model)
        self._warnings = np.zeros(num_envs, np.int64)
        index = scene.index
        self._bodies = np.append(index.point_bodies, index.object_body)
        self._roots = scene.model.body_rootid[self._bodies]
        self._compensated = index.num_compensated
        if index.randomized_geom is not None:
            self._batch.expand("geom_friction")
            self._batch.expand("geom_size")

    @property
    def control_dt_s(self) -> float:
        """Time of one control step, s; 0.04 in all tasks but hammer-strike."""
        return self.scene.model.opt.timestep * self._substeps

    @property
    def rows(self) -> np.ndarray:
        """Whole integration state, one writable row a simulation, (N, nstate)."""
        return self._batch.state

    def data(self, sim: int) -> mujoco.MjData:
        """Return one simulation's MjData, a copy that its next call writes over."""
        return self._batch.get_data(sim, self._scratch)

    def reset(self, ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Restart simulations ids (k,) from qpos (nq,) and qvel (nv,)."""
        self._batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._warnings[ids] = 0
        self._f["qpos"][ids] = qpos
        self._f["qvel"][ids] = qvel
        self._batch.forward(ids, stage=_CURRENT)

    def step(self, ctrl: np.ndarray) -> np.ndarray:
        """Take one control step with actuator targets ctrl (N, nu).

        Gravity is compensated with the bias forces at the step's start, held for its substeps.

        Returns:
            Which simulations diverged, (N,) bool: MuJoCo raised an error or a warning (bad
            position, velocity or acceleration, no memory for contacts). Their state is not
            meaningful any more; the others are not touched.
        """
        n = self._compensated
        self._f["ctrl"][:] = ctrl
        self._f["qfrc_applied"][:, :n] = self._f["qfrc_bias"][:, :n]
        failed: list[int] = []
        try:
            self._batch.step(nstep=self._substeps, stage=_CURRENT)
        except mujoco_batch.SimulationError as error:
            failed = list(error.ids)
        before, self._warnings = self._warnings, self._f["warning"][..., 1].sum(axis=1)
        diverged = self._warnings != before
        diverged[failed] = True
        return diverged

    def read(self, ids: np.ndarray | None = None) -> SimState:
        """Return the current state of simulations ids, or of all."""
        rows = slice(None) if ids is None else ids
        index = self.scene.index
        pos = torch.from_numpy(
            np.concatenate(
                (
                    self._d["geom_xpos"][rows].take(index.point_geoms, 1),
                    self._d["xipos"][rows, index.object_body][:, None],
                ),
                axis=1,
            )
        )
        quat = torch.from_numpy(self._d["xquat"][rows].take(self._bodies, 1))
        cvel = torch.from_numpy(self._d["cvel"][rows].take(self._bodies, 1))
        angular, linear_at_com = cvel[..., :3], cvel[..., 3:]  # linear: at the COM of the tree
        arm = pos - torch.from_numpy(self._d["subtree_com"][rows].take(self._roots, 1))
        linear = linear_at_com + torch.linalg.cross(angular, arm)
        vel = torch.cat((linear, angular), -1)
        return SimState(
            qpos=torch.from_numpy(self._f["qpos"][rows].copy()),
            qvel=torch.from_numpy(self._f["qvel"][rows].copy()),
            point_pos=pos[:, :-1],
            point_quat=quat[:, :-1],
            point_vel=vel[:, :-1],
            object_pos=pos[:, -1],
            object_quat=quat[:, -1],
            object_vel=vel[:, -1],
        )

    def body_pose(self, body: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the centre of mass (N, 3) m and orientation (N, 4) wxyz of a body, world frame."""
        return self._d["xipos"][:, body].copy(), self._d["xquat"][:, body].copy()

    def push(self, body: int, force: np.ndarray, point: np.ndarray) -> None:
        """Let forces (N, 3) N act on a body at points (N, 3) m, world frame, until a reset."""
        arm = point - self._d["xipos"][:, body]
        self._f["xfrc_applied"][:, body] = np.concatenate((force, np.cross(arm, force)), 1)

    def restore(self, rows: np.ndarray) -> None:
        """Continue from rows (N, nstate) that ``rows`` once gave, to the bit.

        Raises:
            SceneError: if the rows have another shape: they belong to another scene.
        """
        if rows.shape != self.rows.shape:
            raise SceneError(
                f"stored simulation rows have shape {rows.shape}, "
                f"this scene needs {self.rows.shape}"
            )
        self.rows[:] = rows
        self._batch.forward(stage=_CURRENT)
        self._warnings = self._f["warning"][..., 1].sum(axis=1)

    def contact(self) -> tuple[np.ndarray, np.ndarray]:
        """Return friction (N, 3) and half-width (N,) m of the randomised geom."""
        geom = self._randomized_geom()
        friction, size = self._batch.expand("geom_friction"), self._batch.expand("geom_size")
        return friction[:, geom].copy(), size[:, geom, 0].copy()

    def set_contact(self, ids: np.ndarray, friction: np.ndarray, half_width: np.ndarray) -> None:
        """Set friction (k, 3) and half-width (k,) m of the randomised geom in simulations ids."""
        geom = self._randomized_geom()
        self._batch.expand("geom_friction")[ids, geom] = friction
        self._batch.expand("geom_size")[ids, geom, 0] = half_width

    def _randomized_geom(self) -> int:
        geom = self.scene.index.randomized_geom
        if geom is None:
            raise SceneError(f"task '{self.scene.task.id}' has no geom to randomise")
        return geom
