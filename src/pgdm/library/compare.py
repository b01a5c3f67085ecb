"""Comparing two compiled models figure by figure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

TOLERANCE = 1e-9
"""Figures that agree to this, relative to the larger one, count as equal."""

_BODY = "mass inertia ipos iquat pos quat gravcomp"
_JOINT = "type limited range pos axis stiffness margin solref solimp actfrcrange actgravcomp"
_DOF = "armature damping frictionloss solref solimp"
_GEOM = (
    "type size pos quat contype conaffinity condim priority friction margin gap solmix solref "
    "solimp"
)
_TENDON = (
    "limited range stiffness damping frictionloss armature margin solref_lim solimp_lim "
    "lengthspring solref_fri solimp_fri"
)
_ACTUATOR = (
    "trntype dyntype gaintype biastype gainprm biasprm dynprm ctrllimited ctrlrange forcelimited "
    "forcerange gear"
)
_PAIR = "dim solref solreffriction solimp margin gap friction"
_OPTIONS = (
    "timestep gravity iterations noslip_iterations ls_iterations tolerance noslip_tolerance "
    "impratio cone solver integrator jacobian disableflags enableflags wind density viscosity "
    "o_margin o_solref o_solimp o_friction"
)


@dataclass(frozen=True)
class Difference:
    """One figure that differs between two models."""

    element: str
    """What it belongs to, such as ``joint ARTx`` or ``geom wrist[2]``."""
    figure: str
    """Which figure, such as ``range``; ``present`` where only one model has the element."""
    first: str
    """Its value in the first model."""
    second: str
    """Its value in the second model."""
    physical: bool
    """False if it only changes the picture."""

    def __str__(self) -> str:
        return f"{self.element} {self.figure}: {self.first} against {self.second}"


def compare(
    first: mujoco.MjModel, second: mujoco.MjModel, tolerance: float = TOLERANCE
) -> list[Difference]:
    """List what differs between two compiled models.

    Bodies, joints, geoms, tendons and actuators are matched by name, unnamed geoms by their place
    in their body, pairs by their geoms. Sites, cameras, lights, materials and keyframes move
    nothing and are left out.

    Args:
        first: one model.
        second: the other.
        tolerance: relative difference up to which figures count as equal.
    """
    found = _Comparison(first, second, tolerance)
    found.order("body")
    found.elements("body", _BODY, "body_", _names(first, "body"), _names(second, "body"))
    found.parents()
    found.order("joint")
    joints = _names(first, "joint"), _names(second, "joint")
    found.elements("joint", _JOINT, "jnt_", *joints)
    found.elements("joint", _DOF, "dof_", *joints, index=("jnt_dofadr", "jnt_dofadr"))
    geoms = _geom_names(first), _geom_names(second)
    found.elements("geom", _GEOM, "geom_", *geoms)
    found.meshes(*geoms)
    found.order("tendon")
    tendons = _names(first, "tendon"), _names(second, "tendon")
    found.elements("tendon", _TENDON, "tendon_", *tendons)
    found.wraps(*tendons)
    found.order("actuator")
    actuators = _names(first, "actuator"), _names(second, "actuator")
    found.elements("actuator", _ACTUATOR, "actuator_", *actuators)
    found.pairs(_pair_names(first, geoms[0]), _pair_names(second, geoms[1]))
    return found.result


def compare_options(first: mujoco.MjModel, second: mujoco.MjModel) -> list[Difference]:
    """List the physics options that differ; only the scene's matter, attached models have none."""
    found = _Comparison(first, second, TOLERANCE)
    for name in _OPTIONS.split():
        found.figure("option", name, getattr(first.opt, name), getattr(second.opt, name), True)
    return found.result


def _names(model: mujoco.MjModel, kind: str) -> dict[str, int]:
    count = {
        "body": model.nbody,
        "joint": model.njnt,
        "tendon": model.ntendon,
        "actuator": model.nu,
    }[kind]
    get: Callable[[int], Any] = getattr(model, kind)
    return {get(i).name or f"#{i}": i for i in range(count)}


def _geom_names(model: mujoco.MjModel) -> dict[str, int]:
    names: dict[str, int] = {}
    for i in range(model.ngeom):
        body = model.body(model.geom_bodyid[i])
        names[model.geom(i).name or f"{body.name}[{i - body.geomadr[0]}]"] = i
    return names


def _pair_names(model: mujoco.MjModel, geoms: dict[str, int]) -> dict[str, int]:
    by_id = {i: name for name, i in geoms.items()}
    names: dict[str, int] = {}
    for i in range(model.npair):
        both = sorted((by_id[model.pair_geom1[i]], by_id[model.pair_geom2[i]]))
        name = " and ".join(both)
        # One released file lists a pair twice, which doubles its contacts.
        names[f"{name} (again)" if name in names else name] = i
    return names


class _Comparison:
    def __init__(self, first: mujoco.MjModel, second: mujoco.MjModel, tolerance: float) -> None:
        self.first, self.second, self.tolerance = first, second, tolerance
        self.result: list[Difference] = []

    def figure(self, element: str, name: str, a: Any, b: Any, physical: bool) -> None:
        x, y = np.asarray(a, float), np.asarray(b, float)
        if name in ("quat", "iquat") and float(np.vdot(x, y)) < 0:
            y = -y  # the same rotation
        scale = max(float(np.abs(x).max(initial=0)), float(np.abs(y).max(initial=0)), 1e-300)
        if x.shape != y.shape or float(np.abs(x - y).max(initial=0)) > self.tolerance * scale:
            self.result.append(Difference(element, name, _shown(x), _shown(y), physical))

    def order(self, kind: str) -> None:
        a, b = _names(self.first, kind), _names(self.second, kind)
        common_a, common_b = [n for n in a if n in b], [n for n in b if n in a]
        for x, y in zip(common_a, common_b, strict=True):
            if x != y:
                self.result.append(Difference(kind, "order", x, y, True))
                return

    def elements(
        self,
        kind: str,
        figures: str,
        prefix: str,
        a: dict[str, int],
        b: dict[str, int],
        index: tuple[str, str] | None = None,
    ) -> None:
        if index is None:
            self._presence(kind, a, b)
        for name in [n for n in a if n in b]:
            i, j = a[name], b[name]
            physical = kind != "geom" or self._collides(i, j)
            if index is not None:
                i = getattr(self.first, index[0])[i]
                j = getattr(self.second, index[1])[j]
            for figure in figures.split():
                field = prefix + figure
                values = getattr(self.first, field)[i], getattr(self.second, field)[j]
                self.figure(f"{kind} {name}", figure, *values, physical)

    def parents(self) -> None:
        a, b = _names(self.first, "body"), _names(self.second, "body")
        for name in [n for n in a if n in b]:
            x = self.first.body(self.first.body_parentid[a[name]]).name
            y = self.second.body(self.second.body_parentid[b[name]]).name
            if x != y:
                self.result.append(Difference(f"body {name}", "parent", x, y, True))

    def meshes(self, a: dict[str, int], b: dict[str, int]) -> None:
        for name in [n for n in a if n in b]:
            x, y = _vertices(self.first, a[name]), _vertices(self.second, b[name])
            self.figure(f"geom {name}", "mesh", x, y, self._collides(a[name], b[name]))

    def wraps(self, a: dict[str, int], b: dict[str, int]) -> None:
        for name in [n for n in a if n in b]:
            x, y = _coefficients(self.first, a[name]), _coefficients(self.second, b[name])
            if x != y:
                self.result.append(
                    Difference(f"tendon {name}", "coefficients", str(x), str(y), True)
                )

    def pairs(self, a: dict[str, int], b: dict[str, int]) -> None:
        self._presence("pair", a, b)
        for name in [n for n in a if n in b]:
            for figure in _PAIR.split():
                x = getattr(self.first, f"pair_{figure}")[a[name]]
                y = getattr(self.second, f"pair_{figure}")[b[name]]
                self.figure(f"pair {name}", figure, x, y, True)

    def _presence(self, kind: str, a: dict[str, int], b: dict[str, int]) -> None:
        for name in sorted(set(a) ^ set(b)):
            has = ("yes", "no") if name in a else ("no", "yes")
            physical = kind != "geom" or self._collides(a.get(name), b.get(name))
            self.result.append(Difference(f"{kind} {name}", "present", *has, physical))

    def _collides(self, i: int | None, j: int | None) -> bool:
        return _in_contacts(self.first, i) or _in_contacts(self.second, j)


def _in_contacts(model: mujoco.MjModel, geom: int | None) -> bool:
    if geom is None:
        return False
    collides = model.geom_contype[geom] or model.geom_conaffinity[geom]
    return bool(collides) or geom in model.pair_geom1 or geom in model.pair_geom2


def _vertices(model: mujoco.MjModel, geom: int) -> np.ndarray:
    mesh = model.geom_dataid[geom]
    if mesh < 0 or model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_MESH:
        return np.zeros(0)
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    return model.mesh_vert[start : start + count].ravel()


def _coefficients(model: mujoco.MjModel, tendon: int) -> dict[str, float]:
    start, count = model.tendon_adr[tendon], model.tendon_num[tendon]
    return {
        model.joint(model.wrap_objid[k]).name: float(model.wrap_prm[k])
        for k in range(start, start + count)
        if model.wrap_type[k] == mujoco.mjtWrap.mjWRAP_JOINT
    }


def _shown(value: np.ndarray) -> str:
    flat: Sequence[float] = value.ravel().tolist()
    if len(flat) > 10:
        return f"{len(flat)} numbers"
    return " ".join(f"{v:.7g}" for v in flat)
