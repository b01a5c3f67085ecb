"""Comparing two compiled models value by value."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

TOLERANCE = 1e-9
"""Largest relative difference of values that count as equal."""

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
    """One value that differs between two models."""

    element: str
    """Element of the model, such as ``joint ARTx`` or ``geom wrist[2]`` (body and index)."""
    attribute: str
    """Attribute that differs, such as ``range``; ``present`` if only one model has the element."""
    first: str
    """Value in the first model."""
    second: str
    """Value in the second model."""
    physical: bool
    """False if it only changes how the model looks."""

    def __str__(self) -> str:
        return f"{self.element} {self.attribute}: {self.first} against {self.second}"


def compare(
    first: mujoco.MjModel, second: mujoco.MjModel, tolerance: float = TOLERANCE
) -> list[Difference]:
    """List what differs between two compiled models.

    Bodies, joints, geoms, tendons and actuators are matched by name, unnamed geoms by their index
    in their body, pairs by their geoms. Sites, cameras, lights, materials and keyframes do not
    affect the physics and are ignored. Equality constraints and contact exclusions are not compared
    either.

    Args:
        first: one model.
        second: the other.
        tolerance: largest relative difference of values that count as equal.
    """
    found = _Comparison(first, second, tolerance)
    found.order("body")
    found.elements("body", _BODY, "body_")
    found.parents()
    found.order("joint")
    found.elements("joint", _JOINT, "jnt_")
    found.dofs()
    found.elements("geom", _GEOM, "geom_")
    found.meshes()
    found.order("tendon")
    found.elements("tendon", _TENDON, "tendon_")
    found.wraps()
    found.order("actuator")
    found.elements("actuator", _ACTUATOR, "actuator_")
    found.elements("pair", _PAIR, "pair_")
    return found.result


def compare_options(first: mujoco.MjModel, second: mujoco.MjModel) -> list[Difference]:
    """List the physics options that differ.

    Compare scenes: the options of models attached to a scene have no effect.
    """
    found = _Comparison(first, second, TOLERANCE)
    for name in _OPTIONS.split():
        found.value("option", name, getattr(first.opt, name), getattr(second.opt, name))
    return found.result


def _names(model: mujoco.MjModel) -> dict[str, dict[str, int]]:
    """Return the index of each element by kind and name."""
    counts = (("body", model.nbody), ("joint", model.njnt), ("tendon", model.ntendon))
    names = {
        kind: {getattr(model, kind)(i).name or f"#{i}": i for i in range(count)}
        for kind, count in (*counts, ("actuator", model.nu))
    }
    geoms: dict[str, int] = {}
    for i in range(model.ngeom):
        body = model.body(model.geom_bodyid[i])
        geoms[model.geom(i).name or f"{body.name}[{i - body.geomadr[0]}]"] = i
    by_id = {i: name for name, i in geoms.items()}
    pairs: dict[str, int] = {}
    for i in range(model.npair):
        name = " and ".join(sorted((by_id[model.pair_geom1[i]], by_id[model.pair_geom2[i]])))
        # One released file lists a pair twice, which doubles the contact.
        pairs[f"{name} (again)" if name in pairs else name] = i
    return {**names, "geom": geoms, "pair": pairs}


class _Comparison:
    def __init__(self, first: mujoco.MjModel, second: mujoco.MjModel, tolerance: float) -> None:
        self._first, self._second, self._tolerance = first, second, tolerance
        self._names = _names(first), _names(second)
        self.result: list[Difference] = []

    def value(self, element: str, name: str, a: Any, b: Any, physical: bool = True) -> None:
        x, y = np.asarray(a, float), np.asarray(b, float)
        if name in ("quat", "iquat") and float(np.vdot(x, y)) < 0:
            y = -y  # the same rotation
        scale = max(float(np.abs(x).max(initial=0)), float(np.abs(y).max(initial=0)), 1e-300)
        if x.shape != y.shape or float(np.abs(x - y).max(initial=0)) > self._tolerance * scale:
            self._differ(element, name, _shown(x), _shown(y), physical)

    def order(self, kind: str) -> None:
        a, b = (names[kind] for names in self._names)
        for x, y in zip((n for n in a if n in b), (n for n in b if n in a), strict=True):
            if x != y:
                self._differ(kind, "order", x, y)
                return

    def elements(self, kind: str, attributes: str, prefix: str) -> None:
        a, b = (names[kind] for names in self._names)
        for name in sorted(a.keys() ^ b.keys()):
            has = ("yes", "no") if name in a else ("no", "yes")
            physical = kind != "geom" or self._collides(a.get(name), b.get(name))
            self._differ(f"{kind} {name}", "present", *has, physical)
        for name, i, j in self._common(kind):
            physical = kind != "geom" or self._collides(i, j)
            self._fields(f"{kind} {name}", attributes, prefix, i, j, physical)

    def dofs(self) -> None:
        for name, i, j in self._common("joint"):
            first, second = self._first.jnt_dofadr[i], self._second.jnt_dofadr[j]
            self._fields(f"joint {name}", _DOF, "dof_", first, second)

    def parents(self) -> None:
        for name, i, j in self._common("body"):
            x = self._first.body(self._first.body_parentid[i]).name
            y = self._second.body(self._second.body_parentid[j]).name
            if x != y:
                self._differ(f"body {name}", "parent", x, y)

    def meshes(self) -> None:
        for name, i, j in self._common("geom"):
            x, y = _vertices(self._first, i), _vertices(self._second, j)
            self.value(f"geom {name}", "mesh", x, y, self._collides(i, j))

    def wraps(self) -> None:
        for name, i, j in self._common("tendon"):
            x, y = _coefficients(self._first, i), _coefficients(self._second, j)
            if x != y:
                self._differ(f"tendon {name}", "coefficients", str(x), str(y))

    def _common(self, kind: str) -> Iterator[tuple[str, int, int]]:
        a, b = (names[kind] for names in self._names)
        yield from ((name, i, b[name]) for name, i in a.items() if name in b)

    def _fields(
        self, element: str, attributes: str, prefix: str, i: int, j: int, physical: bool = True
    ) -> None:
        for name in attributes.split():
            x, y = getattr(self._first, prefix + name)[i], getattr(self._second, prefix + name)[j]
            self.value(element, name, x, y, physical)

    def _differ(self, element: str, name: str, x: str, y: str, physical: bool = True) -> None:
        self.result.append(Difference(element, name, x, y, physical))

    def _collides(self, i: int | None, j: int | None) -> bool:
        return _in_contacts(self._first, i) or _in_contacts(self._second, j)


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
