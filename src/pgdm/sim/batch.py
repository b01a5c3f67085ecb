"""N simulations of one scene, stepped in parallel by ``mujoco.batch.Batch``."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np
import torch
from mujoco import batch as mujoco_batch
from torch import Tensor

from pgdm.errors import SceneError
from pgdm.sim.scene import Scene

Model = mujoco.MjModel
Data = mujoco.MjData

Array = np.ndarray | Tensor

_CURRENT = mujoco.mjtStage.mjSTAGE_VEL  # update what follows from positions and velocities


@dataclass(frozen=True)
class SimState:
    """Observable state of n simulations after the last substep: float64, world frame.

    ``point_*`` refers to the hand's tracked geoms (centres); ``object_pos`` is the object's
    centre of mass.
    """

    qpos: Tensor  # (n, nq) m, rad
    qvel: Tensor  # (n, nv) m/s, rad/s
    point_pos: Tensor  # (n, P, 3) m
    point_quat: Tensor  # (n, P, 4) wxyz, of the points' bodies
    point_vel: Tensor  # (n, P, 6) linear m/s, then angular rad/s
    object_pos: Tensor  # (n, 3) m
    object_quat: Tensor  # (n, 4) wxyz
    object_vel: Tensor  # (n, 6) linear m/s, then angular rad/s

    @classmethod
    def of(
        cls, qpos: Tensor, qvel: Tensor, pos: Tensor, quat: Tensor, cvel: Tensor, com: Tensor
    ) -> SimState:
        """Return the state from MuJoCo's quantities of P points' bodies, then the object's body.

        Args:
            qpos: (n, nq).
            qvel: (n, nv).
            pos: (n, P+1, 3) m, centres of the points' geoms, then the object's centre of mass.
            quat: (n, P+1, 4) wxyz.
            cvel: (n, P+1, 6) angular rad/s, then linear velocity m/s at ``com``.
            com: (n, P+1, 3) m, centre of mass of the kinematic tree to which the body belongs.
        """
        angular, linear_at_com = cvel[..., :3], cvel[..., 3:]
        vel = torch.cat((linear_at_com + torch.linalg.cross(angular, pos - com), angular), -1)
        return cls(
            qpos=qpos,
            qvel=qvel,
            point_pos=pos[:, :-1],
            point_quat=quat[:, :-1],
            point_vel=vel[:, :-1],
            object_pos=pos[:, -1],
            object_quat=quat[:, -1],
            object_vel=vel[:, -1],
        )


class Simulations(Protocol):
    """N simulations of a scene, by any engine; the methods are documented in `SimBatch`."""

    scene: Scene
    num_envs: int
    device: torch.device
    """Where `read` returns states, and where actuator targets are expected."""

    @property
    def rows(self) -> Array:
        """All that the next step depends on, one row per simulation, (N, nstate)."""
        ...

    @property
    def control_dt_s(self) -> float:
        """Duration of a control step, s."""
        ...

    @property
    def bytes_each(self) -> int:
        """Host memory of each simulation, bytes."""
        ...

    def data(self, sim: int) -> mujoco.MjData:
        """Return the MjData of one simulation."""
        ...

    def reset(self, ids: Array, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Reset simulations ids (k,) to qpos (nq,) and qvel (nv,)."""
        ...

    def step(self, ctrl: Array) -> Array:
        """Take one control step; return which simulations diverged, (N,) bool."""
        ...

    def read(self, ids: Array | None = None) -> SimState:
        """Return the current state."""
        ...

    def restore(self, rows: Array) -> None:
        """Restore all simulations from an earlier copy of ``rows``."""
        ...

    def variation(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the randomised object's friction (N, 3), half-width (N,) m and mass (N,) kg."""
        ...

    def set_variation(
        self, ids: np.ndarray, friction: np.ndarray, half_width: np.ndarray, mass: np.ndarray
    ) -> None:
        """Set the object's friction (k, 3), half-width (k,) m and mass (k,) kg in ids (k,)."""
        ...


class SimBatch:
    """N simulations of a scene, stepped by C MuJoCo on the CPU, float64.

    Args:
        scene: the scene to simulate.
        num_envs: N.
        num_threads: number of threads; 0 takes one per core available to this process. Results do
            not depend on it.
        substeps: physics steps per control step.
    """

    def __init__(self, scene: Scene, num_envs: int, num_threads: int, substeps: int) -> None:
        self.scene, self.device = scene, torch.device("cpu")
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
        in_order = (index.actuators == np.arange(index.num_actuators)).all()
        self._actuators = slice(None) if in_order else index.actuators
        if index.randomized_geom is not None:
            for name in ("geom_friction", "geom_size", "body_mass", "body_inertia"):
                self._batch.expand(name)

    @property
    def control_dt_s(self) -> float:
        """Duration of a control step, s; 0.04 in all tasks but hammer-strike."""
        return self.scene.model.opt.timestep * self._substeps

    @property
    def rows(self) -> np.ndarray:
        """Full integration state, one writable row per simulation, (N, nstate)."""
        return self._batch.state

    @property
    def bytes_each(self) -> int:
        """Memory of one simulation in its present state, bytes."""
        arrays = (self.rows, *self._f.values(), *self._d.values())
        data = self.data(0)  # each simulation has an MjData, with an arena for contacts
        return sum(a.nbytes for a in arrays) // self.num_envs + data.nbuffer + data.maxuse_arena

    def data(self, sim: int) -> mujoco.MjData:
        """Return the MjData of one simulation, a copy that the next call overwrites."""
        return self._batch.get_data(sim, self._scratch)

    def reset(self, ids: Array, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Reset simulations ids (k,) to qpos (nq,) and qvel (nv,)."""
        ids = np.asarray(ids)
        self._batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._warnings[ids] = 0
        self._f["qpos"][ids] = qpos
        self._f["qvel"][ids] = qvel
        self._batch.forward(ids, stage=_CURRENT)

    def step(self, ctrl: Array) -> np.ndarray:
        """Take one control step with targets of the hand's driven joints ctrl (N, nu), m and rad.

        Gravity compensation (released code): for the compensated joints, qfrc_applied is set to
        qfrc_bias (gravity and Coriolis forces) at the start of the step, for all substeps.

        Returns:
            Whether each simulation diverged, (N,) bool: MuJoCo raised an error or any warning (such
            as a bad position, velocity or acceleration, or no memory for contacts). The state of a
            diverged simulation is meaningless; other simulations are unaffected.
        """
        n = self._compensated
        self._f["ctrl"][:, self._actuators] = ctrl
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

    def read(self, ids: Array | None = None) -> SimState:
        """Return the current state of simulations ids, or of all."""
        rows = slice(None) if ids is None else np.asarray(ids)
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
        com = torch.from_numpy(self._d["subtree_com"][rows].take(self._roots, 1))
        qpos = torch.from_numpy(self._f["qpos"][rows].copy())
        qvel = torch.from_numpy(self._f["qvel"][rows].copy())
        return SimState.of(qpos, qvel, pos, quat, cvel, com)

    def body_pose(self, body: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the centre of mass (N, 3) m and orientation (N, 4) wxyz of a body, world frame."""
        return self._d["xipos"][:, body].copy(), self._d["xquat"][:, body].copy()

    def push(self, body: int, force: np.ndarray, point: np.ndarray) -> None:
        """Apply forces (N, 3) N to a body at points (N, 3) m, world frame.

        They act until the next reset or the next push of this body.
        """
        arm = point - self._d["xipos"][:, body]
        self._f["xfrc_applied"][:, body] = np.concatenate((force, np.cross(arm, force)), 1)

    def restore(self, rows: Array) -> None:
        """Restore the bit-exact state of rows (N, nstate) copied from ``rows`` earlier.

        Raises:
            SceneError: if the rows have the wrong shape: they are of another scene.
        """
        if rows.shape != self.rows.shape:
            raise SceneError(
                f"stored simulation rows have shape {rows.shape}, "
                f"this scene needs {self.rows.shape}"
            )
        self.rows[:] = rows
        self._batch.forward(stage=_CURRENT)
        self._warnings = self._f["warning"][..., 1].sum(axis=1)

    def variation(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the randomised object's friction (N, 3), half-width (N,) m and mass (N,) kg."""
        geom, body = self._randomized_geom(), self.scene.index.object_body
        friction, size = self._batch.expand("geom_friction"), self._batch.expand("geom_size")
        mass = self._batch.expand("body_mass")
        return friction[:, geom].copy(), size[:, geom, 0].copy(), mass[:, body].copy()

    def set_variation(
        self, ids: np.ndarray, friction: np.ndarray, half_width: np.ndarray, mass: np.ndarray
    ) -> None:
        """Set the object's friction (k, 3), half-width (k,) m and mass (k,) kg in simulations ids.

        The object's inertia is scaled with the mass, but does not follow the width (released code).
        """
        geom, body, model = self._randomized_geom(), self.scene.index.object_body, self.scene.model
        self._batch.expand("geom_friction")[ids, geom] = friction
        self._batch.expand("geom_size")[ids, geom, 0] = half_width
        self._batch.expand("body_mass")[ids, body] = mass
        ratio = mass / model.body_mass[body]
        self._batch.expand("body_inertia")[ids, body] = ratio[:, None] * model.body_inertia[body]
        self._batch.set_const(ids)

    def _randomized_geom(self) -> int:
        geom = self.scene.index.randomized_geom
        if geom is None:
            raise SceneError(f"task '{self.scene.task.id}' has no geom to randomise")
        return geom
