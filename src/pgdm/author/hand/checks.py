"""Checks of a user's hand: self-collision, masses, limits, and how well its servos hold it."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from pgdm.errors import SceneError, amount
from pgdm.library.tasks import SUBSTEPS
from pgdm.sim.batch import SimBatch
from pgdm.sim.contact import HandContact
from pgdm.sim.scene import Scene

_OVERLAP_M = 5e-4
_HOLD_STEPS = 50  # control steps of 0.04 s
_AWAY_M = 2.0
_MASS_KG = (0.02, 20.0)
_LEAST_INERTIA = 1e-12  # kg m2


@dataclass(frozen=True)
class Checks:
    """Results of the checks of a hand."""

    joints: int
    """Number of joints, without the base."""
    coupled: int
    """Number of those joints that follow another joint."""
    mass_kg: float
    excluded: list[tuple[str, str]]
    """Pairs of links that overlap in the reset pose; they do not collide."""
    self_collisions: list[tuple[str, str]]
    """Further pairs that overlap in the mean hand, whose fingers are as in a mean pre-grasp."""
    height_m: float
    """Height of the hand's lowest point above the table in the reset pose."""
    reset_error_rad: float
    """Largest joint error, rad or m, after the servos held the reset pose for two seconds."""
    mean_error_rad: float
    """The same for the mean hand."""

    def rows(self) -> list[tuple[str, str]]:
        """Return name and text of each row of a table."""
        driven = self.joints - self.coupled
        return [
            ("joints", f"{self.joints}: {driven} with a servo each, {self.coupled} that follow"),
            ("limits", "every joint has limits; the reset pose is within them"),
            ("mass", f"{self.mass_kg:.3f} kg, inertias positive"),
            ("self-collision", self._overlaps()),
            ("servos", self._held()),
            ("height", f"lowest point {100 * self.height_m:.1f} cm above the table at reset"),
            ("contract", "the hand meets the requirements of a scene"),
        ]

    def _overlaps(self) -> str:
        if not self.excluded:
            text = "none in the reset pose"
        else:
            pairs = ", ".join(f"{one} and {two}" for one, two in self.excluded[:4])
            more = (
                f" and {amount(len(self.excluded) - 4, 'more pair')}"
                if len(self.excluded) > 4
                else ""
            )
            text = f"switched off where links overlap in the reset pose: {pairs}{more}"
        if self.self_collisions:
            pairs = ", ".join(f"{one} and {two}" for one, two in self.self_collisions[:4])
            text += f"; in the mean hand these overlap: {pairs}"
        return text

    def _held(self) -> str:
        return (
            f"hold the reset pose within {self.reset_error_rad:.3f} rad and the mean hand within "
            f"{self.mean_error_rad:.3f} rad"
        )


def overlapping(scene: Scene) -> list[tuple[str, str]]:
    """Return the pairs of links that overlap in the reset pose, named without the hand's prefix."""
    return _overlaps(scene, scene.index.reset)


def check(scene: Scene, excluded: list[tuple[str, str]], mean: np.ndarray) -> Checks:
    """Check a hand above a table.

    Args:
        scene: as from :func:`pgdm.sim.scene.bare_scene`.
        excluded: pairs of links that were excluded from collision.
        mean: joint positions (n,) of the mean hand, m and rad, base at zero.

    Raises:
        SceneError: a link has no mass or inertia, the hand is implausibly heavy or light, is inside
            the table at reset, or its simulation diverges.
    """
    model, name = scene.model, scene.hand.name
    mount = int(model.jnt_bodyid[0])
    mass = float(model.body_subtreemass[mount])
    if not _MASS_KG[0] <= mass <= _MASS_KG[1]:
        raise SceneError(
            f"hand '{name}' weighs {mass:.3g} kg; plausible: {_MASS_KG[0]:g} to {_MASS_KG[1]:g}. "
            "Correct its <inertial> elements, or the unit of its meshes"
        )
    for joint in range(6, scene.index.num_joints):
        body = int(model.jnt_bodyid[joint])
        if model.body_subtreemass[body] <= 0 or model.dof_M0[joint] < _LEAST_INERTIA:
            raise SceneError(
                f"hand '{name}': link '{model.body(body).name}' lacks mass or inertia; give "
                "it an <inertial> or collision geometry"
            )
    contact = HandContact(scene)
    qpos = _at(scene, scene.index.reset)
    if (depth := contact.depth(qpos)) > 0:
        raise SceneError(
            f"hand '{name}' is {1e3 * depth:.0f} mm inside the table in its reset pose; raise it "
            "with --mount X,Y,Z"
        )
    return Checks(
        joints=scene.index.num_joints - 6,
        coupled=len(scene.index.couplings.rows),
        mass_kg=mass,
        excluded=excluded,
        self_collisions=_overlaps(scene, mean),
        height_m=_lowest(scene, qpos),
        reset_error_rad=_held(scene, scene.index.reset),
        mean_error_rad=_held(scene, mean),
    )


def _at(scene: Scene, joints: np.ndarray) -> np.ndarray:
    """Return qpos (nq,) with the given hand joints, and the bare scene's ball out of the way."""
    qpos = np.zeros(scene.model.nq)
    qpos[: len(joints)] = joints
    qpos[len(joints)] = _AWAY_M
    return qpos


def _overlaps(scene: Scene, joints: np.ndarray) -> list[tuple[str, str]]:
    model, prefix = scene.model, f"{scene.hand.name}/"
    data = mujoco.MjData(model)
    data.qpos[:] = _at(scene, joints)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    found: dict[tuple[str, str], None] = {}
    for (one, two), dist in zip(data.contact.geom, data.contact.dist, strict=True):
        names = [model.body(int(model.geom_bodyid[geom])).name for geom in (one, two)]
        if dist < -_OVERLAP_M and all(name.startswith(prefix) for name in names):
            first, second = sorted(name.removeprefix(prefix) for name in names)
            found[first, second] = None
    return list(found)


def _lowest(scene: Scene, qpos: np.ndarray) -> float:
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    solid = (model.geom_contype | model.geom_conaffinity) != 0
    of_hand = model.body_rootid[model.geom_bodyid] == int(model.jnt_bodyid[0])
    heights = []
    for geom in np.flatnonzero(solid & of_hand):
        up = np.abs(data.geom_xmat[geom].reshape(3, 3)[2])
        centre = (
            data.geom_xpos[geom, 2]
            + data.geom_xmat[geom].reshape(3, 3)[2] @ (model.geom_aabb[geom, :3])
        )
        heights.append(centre - up @ model.geom_aabb[geom, 3:])
    return float(min(heights))


def _held(scene: Scene, joints: np.ndarray) -> float:
    """Return the largest error of the joints after the servos held a pose for two seconds.

    The unit is rad, or m for a slide; the base does not count.

    Raises:
        SceneError: the simulation diverges.
    """
    index = scene.index
    sim = SimBatch(scene, 1, 1, SUBSTEPS)
    sim.reset(np.array([0]), _at(scene, joints), np.zeros(scene.model.nv))
    targets = joints[index.driven].clip(index.ctrl_low, index.ctrl_high)[None]
    for _ in range(_HOLD_STEPS):
        if sim.step(targets).any():
            raise SceneError(
                f"hand '{scene.hand.name}': its simulation diverges while the servos hold it; give "
                "a lower --kp, or check masses and collision geometry"
            )
    return float(np.abs(sim.read().qpos[0, 6 : index.num_joints].numpy() - joints[6:]).max())
