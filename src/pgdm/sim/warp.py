"""N simulations of one scene on one device, stepped by MuJoCo Warp, float32; an optional extra.

A control step, with all its substeps and the quantities read afterwards, is one captured graph.
States are torch views of Warp's arrays: nothing is copied to the host. A reset writes only the rows
of its simulations. Torch and Warp both use the device's default stream, which keeps their work in
order.

Warp's results are reproducible on the CPU, but not on a GPU, where the order of summation varies.
"""

from __future__ import annotations

import copy
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from pgdm.errors import ConfigError, SceneError
from pgdm.sim.batch import Array, SimState
from pgdm.sim.scene import Scene

try:
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING  # before mujoco_warp initialises Warp
    import mujoco_warp as mjw
except ImportError as error:
    raise ConfigError(
        f"sim=warp needs MuJoCo Warp ({error}): pip install -c constraints.txt -e '.[gpu]'; "
        "or choose sim=default"
    ) from error

# Largest values over random rollouts of five scenes: 71 contacts and 462 constraint rows; means
# are below 11 and 94. All simulations share one pool of contacts; each has its own limit of rows.
_CONTACTS_PER_SIM = 48
_CONSTRAINT_ROWS = 512


class WarpBatch:
    """N simulations of a scene; the methods are documented in `pgdm.sim.batch.SimBatch`.

    Args:
        scene: the scene to simulate.
        num_envs: N.
        substeps: physics steps per control step.
        device: as torch names it: ``cuda``, ``cuda:1``, or ``cpu`` for tests.

    Raises:
        ConfigError: if Warp cannot use the device.
        SceneError: if Warp cannot simulate the scene.
    """

    def __init__(self, scene: Scene, num_envs: int, substeps: int, device: str) -> None:
        self.scene, self.num_envs, self._substeps = scene, num_envs, substeps
        self.device = torch.device(device)
        index = scene.index
        bodies = np.append(index.point_bodies, index.object_body)
        self._bodies = torch.as_tensor(bodies, device=self.device)
        self._roots = torch.as_tensor(scene.model.body_rootid[bodies], device=self.device).long()
        self._actuators = torch.as_tensor(index.actuators, device=self.device)
        self._geoms = torch.as_tensor(index.point_geoms, device=self.device)
        with wp.ScopedDevice(_warp_device(device)):
            self._build()
            self._step, self._refresh = self._captured(self._substep), self._captured(self._update)

    def _build(self) -> None:
        """Upload model and state, and create the torch views that are read and written."""
        scene, n = self.scene, self.num_envs
        varied: dict[str, int] = {}
        if scene.index.randomized_geom is not None:
            varied = dict.fromkeys(("geom_friction", "geom_size", "geom_rbound", *_OF_MASS), n)
            self._of_mass = copy.deepcopy(scene.model)
            self._scratch = mujoco.MjData(self._of_mass)
        data = mujoco.MjData(scene.model)
        mujoco.mj_forward(scene.model, data)
        try:
            self._model = mjw.put_model(scene.model, batch_sizes=varied)
            self._data = mjw.put_data(
                scene.model, data, nworld=n, nconmax=_CONTACTS_PER_SIM, njmax=_CONSTRAINT_ROWS
            )
        except (NotImplementedError, ValueError) as error:
            raise SceneError(
                f"MuJoCo Warp cannot simulate task '{scene.task.id}': {error}; choose sim=default"
            ) from error
        self._model.opt.warn_overflow = False  # `step` checks for overflow instead
        view = {name: wp.to_torch(getattr(self._data, name)) for name in {*_STATE, *_READ}}
        self._state = {name: view[name] for name in _STATE}
        self._read = {name: view[name] for name in _READ}
        self._overflow = wp.to_torch(self._data.overflow)

    def _substep(self) -> None:
        for _ in range(self._substeps):
            mjw.step(self._model, self._data)
        self._update()

    def _update(self) -> None:
        """Compute the quantities that are read: positions, velocities and bias forces."""
        for compute in (mjw.kinematics, mjw.com_pos, mjw.com_vel, mjw.rne):
            compute(self._model, self._data)

    def _captured(self, work: Any) -> Any:
        work()  # compiles the kernels, which cannot happen while capturing
        with wp.ScopedCapture() as capture:
            work()
        return capture.graph

    @property
    def control_dt_s(self) -> float:
        """Duration of a control step, s."""
        return self.scene.model.opt.timestep * self._substeps

    @property
    def bytes_each(self) -> int:
        """Host memory of each simulation, bytes: none, as the state is on the GPU."""
        return 0

    def data(self, sim: int) -> mujoco.MjData:
        """Return the MjData that C MuJoCo computes from one simulation's qpos and qvel."""
        data = mujoco.MjData(self.scene.model)
        data.qpos[:] = self._state["qpos"][sim].cpu().numpy()
        data.qvel[:] = self._state["qvel"][sim].cpu().numpy()
        mujoco.mj_forward(self.scene.model, data)
        return data

    @property
    def rows(self) -> Tensor:
        """All that the next step depends on, a copy, (N, nstate) float32."""
        columns = [values.reshape(self.num_envs, -1) for values in self._state.values()]
        return torch.cat(columns, 1)

    def reset(self, ids: Array, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Reset simulations ids (k,) to qpos (nq,) and qvel (nv,)."""
        ids = torch.as_tensor(ids, device=self.device)
        for values in self._state.values():
            values[ids] = 0.0
        self._state["qpos"][ids] = torch.as_tensor(qpos, dtype=torch.float32, device=self.device)
        self._state["qvel"][ids] = torch.as_tensor(qvel, dtype=torch.float32, device=self.device)
        wp.capture_launch(self._refresh)

    def step(self, ctrl: Array) -> Tensor:
        """Take one control step with targets of the hand's driven joints ctrl (N, nu), m and rad.

        Returns:
            Whether each simulation diverged, (N,) bool: a position is not finite, or contacts or
            constraint rows exceed their limits.
        """
        n = self.scene.index.num_compensated
        targets = torch.as_tensor(ctrl, device=self.device).float()
        self._state["ctrl"][:, self._actuators] = targets
        self._state["qfrc_applied"][:, :n] = self._read["qfrc_bias"][:, :n]
        self._overflow.zero_()
        wp.capture_launch(self._step)
        full = self._overflow != 0
        return full | ~torch.isfinite(self._state["qpos"]).all(1)

    def read(self, ids: Array | None = None) -> SimState:
        """Return the current state of simulations ids, or of all, converted to float64."""
        rows = slice(None) if ids is None else torch.as_tensor(ids, device=self.device)
        value = {name: values[rows].double() for name, values in self._read.items()}
        bodies, points = self._bodies, value["geom_xpos"][:, self._geoms]
        return SimState.of(
            value["qpos"],
            value["qvel"],
            torch.cat((points, value["xipos"][:, bodies[-1:]]), 1),
            value["xquat"][:, bodies],
            value["cvel"][:, bodies],
            value["subtree_com"][:, self._roots],
        )

    def restore(self, rows: Array) -> None:
        """Restore all simulations from an earlier copy of ``rows``.

        Raises:
            SceneError: if the rows have the wrong shape: they are of another scene or engine.
        """
        rows, shape = torch.as_tensor(rows, device=self.device), self.rows.shape
        if rows.shape != shape:
            raise SceneError(
                f"stored simulation rows have shape {tuple(rows.shape)}, this scene needs "
                f"{tuple(shape)} with sim.engine=warp"
            )
        first = 0
        for values in self._state.values():
            width = values[0].numel()
            values.copy_(rows[:, first : first + width].reshape(values.shape))
            first += width
        wp.capture_launch(self._refresh)

    def variation(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the randomised object's friction (N, 3), half-width (N,) m and mass (N,) kg."""
        friction, width = self._geom("geom_friction"), self._geom("geom_size")[:, 0]
        mass = self._per_sim("body_mass")[:, self.scene.index.object_body]
        friction, width, mass = (values.cpu().numpy().copy() for values in (friction, width, mass))
        return friction, width, mass

    def set_variation(
        self, ids: np.ndarray, friction: np.ndarray, half_width: np.ndarray, mass: np.ndarray
    ) -> None:
        """Set the object's friction (k, 3), half-width (k,) m and mass (k,) kg in ids (k,)."""
        rows = torch.as_tensor(ids, device=self.device)
        size = self._geom("geom_size")
        self._geom("geom_friction")[rows] = torch.as_tensor(friction).float().to(self.device)
        size[rows, 0] = torch.as_tensor(half_width).float().to(self.device)
        self._geom("geom_rbound")[rows] = torch.linalg.vector_norm(size[rows], dim=-1)  # of a box
        model, body, scratch = self._of_mass, self.scene.index.object_body, self._scratch
        inertia = self.scene.model.body_inertia[body] / self.scene.model.body_mass[body]
        for row, kg in zip(rows.tolist(), mass.tolist(), strict=True):
            model.body_mass[body], model.body_inertia[body] = kg, kg * inertia
            mujoco.mj_setConst(model, scratch)
            for name in _OF_MASS:
                self._per_sim(name)[row] = torch.from_numpy(getattr(model, name)).float()

    def _geom(self, field: str) -> Tensor:
        geom = self.scene.index.randomized_geom
        if geom is None:
            raise SceneError(f"task '{self.scene.task.id}' has no geom to randomise")
        return self._per_sim(field)[:, geom]

    def _per_sim(self, field: str) -> Tensor:
        return wp.to_torch(getattr(self._model, field))


_OF_MASS = ("body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "dof_invweight0")
"""Fields of the model that depend on the mass of a body."""
_STATE = ("qpos", "qvel", "qacc_warmstart", "time", "ctrl", "qfrc_applied")
"""Arrays that the next step depends on."""
_READ = ("qpos", "qvel", "qfrc_bias", "geom_xpos", "xquat", "xipos", "cvel", "subtree_com")
"""Arrays that are read after a step."""


def _warp_device(device: str) -> Any:
    """Return Warp's device for a torch device.

    Raises:
        ConfigError: if Warp cannot use it, for example without a driver.
    """
    try:
        return wp.get_device("cuda:0" if device == "cuda" else device)
    except (ValueError, RuntimeError) as error:
        have = ", ".join(d.alias for d in wp.get_devices())
        raise ConfigError(f"MuJoCo Warp cannot use device '{device}'; it has: {have}") from error
