"""Table + hand + objects -> one compiled model and a table of what is where in it."""

from __future__ import annotations

import copy
import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from pgdm.errors import SceneError
from pgdm.library import Library
from pgdm.library.check import compile_tracked
from pgdm.library.published_masses import RATIOS

# SPEC 5, R: the randomised contact geom outranks what it touches, so that its friction counts.
RANDOMIZED_PRIORITY = 10


# Fields of a model that say how its bodies, joints, contacts and actuators behave.
_PHYSICS = (
    *("body_pos", "body_quat", "body_mass", "body_inertia", "body_ipos", "body_iquat"),
    *("jnt_pos", "jnt_axis", "jnt_range", "jnt_margin", "jnt_solref", "jnt_solimp"),
    *("dof_damping", "dof_armature", "dof_frictionloss", "tendon_range", "wrap_prm"),
    *("geom_type", "geom_size", "geom_pos", "geom_quat", "geom_friction", "geom_condim"),
    *("geom_contype", "geom_conaffinity", "geom_margin", "geom_solref", "geom_solimp"),
    *("mesh_vert", "pair_geom1", "pair_geom2", "pair_dim", "pair_friction"),
    *("actuator_gainprm", "actuator_biasprm", "actuator_ctrlrange"),
)


@dataclass(frozen=True)
class PlacementCfg:
    """Where a body of an object stands, if not where the object's own file puts it."""

    body: str
    """Scene name of the body, such as ``door/frame``."""
    pos_m: list[float] | None
    """Position in the world frame, (3,) m, or None to leave it."""
    quat: list[float] | None
    """Orientation in the world frame, (4,) wxyz, or None to leave it."""


@dataclass(frozen=True)
class TaskCfg:
    """One task: what is followed along which motion (SPEC 1)."""

    id: str
    """Task id, ``<object>-<motion>`` or ``<hand>-<object>``."""
    objects: list[str]
    """Library names of the objects in the scene, in the order of their joints."""
    tracked_body: str
    """Scene name of the followed body; its centre of mass and orientation count."""
    motion: str
    """Library id of the exemplar motion with its stored start states."""
    timestep_s: float
    """Physics timestep, s."""
    placements: list[PlacementCfg]
    """Bodies placed elsewhere than in their own file."""
    randomize: bool
    """Whether friction and size of the first object's contact geom vary per reset (SPEC 5)."""
    tcdm30: bool
    """Whether the task belongs to the abridged suite."""
    pregrasp_source: str
    """Where the paper's pre-grasp came from: mocap, teleop, labeled or learned; search: ours."""
    trajectory_source: str
    """Where the exemplar motion came from: mocap, expert or animator; keyframes: pgdm's own."""
    paper_success: float | None
    """Success of the paper's PGDM after 50M frames, mean of 3 seeds (0..1)."""
    paper_com_error: float | None
    """The paper's error column, compared with ``com_error_released``, m."""


@dataclass(frozen=True)
class HandCfg:
    """What the MDP needs to know of a hand beyond its model."""

    name: str
    """Library name and scene prefix of the hand."""
    points: list[str]
    """Geoms (each in a body of the same name) whose poses are observed, in observation order."""
    fingertips: list[int]
    """Which of the points are fingertips."""
    human_fingers: list[str]
    """Human finger that each fingertip follows: index, middle, ring, little or thumb."""
    gravity_compensation: str
    """``all`` actuated joints are held against gravity, or only the ``base`` joints."""
    num_base_joints: int
    """Number of joints, first in qpos, that place the wrist."""
    num_wrist_joints: int
    """Number of joints after them that turn the palm; those that follow are the fingers'."""
    mean_fingers_rad: list[float]
    """Finger joints of the hand's mean pre-grasp, in the order of qpos, rad."""
    mount_body: str
    """Body that carries the base joints, child of the world."""


@dataclass(frozen=True)
class SimCfg:
    """Solver settings (SPEC 1, Scene)."""

    solver_iterations: int
    """Newton iterations at most per physics step."""
    noslip_iterations: int
    """Iterations of the noslip solver per physics step."""
    object_mass: str
    """``volume``: mass and inertia of objects as MuJoCo 4.0 takes them from their volume;
    ``published``: scaled to the masses that MuJoCo had when the benchmark was published."""


OBJECT_MASSES = ("volume", "published")


_NEVER_M = 10.0  # no two geoms are that deep in each other
_FREE_JOINTS = 6  # three slides and three hinges, as the benchmark has them


@dataclass(frozen=True)
class SceneIndex:
    """Ids and constants of a scene, looked up by name once."""

    point_geoms: np.ndarray  # (P,) geom ids
    point_bodies: np.ndarray  # (P,) body ids
    object_body: int
    fingertips: np.ndarray  # (F,) rows of the points
    num_actuators: int
    num_compensated: int  # joints held against gravity, first in qvel
    num_base_joints: int
    ctrl_low: np.ndarray  # (nu,)
    ctrl_high: np.ndarray  # (nu,)
    mount_pos: np.ndarray  # (3,) m, world frame, base joints at zero
    mount_quat: np.ndarray  # (4,) wxyz
    randomized_geom: int | None


@dataclass(frozen=True)
class Scene:
    """A compiled scene."""

    model: mujoco.MjModel
    index: SceneIndex
    task: TaskCfg
    hand: HandCfg
    asset_source: str
    """The library's source that serves the task's assets, or its sources: ``own+checkout``."""
    object_prefixes: tuple[str, ...]
    """How names of the objects' bodies begin; not always with the library's name."""

    @property
    def lies_free(self) -> bool:
        """Whether the tracked object hangs on nothing: six joints between it and the world."""
        body, joints = self.index.object_body, 0
        while body:
            joints += int(self.model.body_jntnum[body])
            body = int(self.model.body_parentid[body])
        return joints == _FREE_JOINTS

    def digest(self) -> str:
        """Return a SHA-256 over all that the physics depends on: equal scenes move equally."""
        digest = hashlib.sha256()
        for name in _PHYSICS:
            digest.update(np.ascontiguousarray(getattr(self.model, name)).tobytes())
        option = self.model.opt
        numbers = (option.timestep, option.iterations, option.noslip_iterations, option.cone)
        digest.update(repr(numbers).encode())
        return digest.hexdigest()


def build_scene(library: Library, task: TaskCfg, hand: HandCfg, sim: SimCfg) -> Scene:
    """Compile the scene of a task.

    Raises:
        SceneError: if it does not compile or a body, geom or joint is missing.
        LibraryError: if the library lacks an asset.
    """
    source = library.source_of(task.motion)
    spec = _load(library.scene_xml(source))
    spec.option.timestep = task.timestep_s
    spec.option.iterations = sim.solver_iterations
    spec.option.noslip_iterations = sim.noslip_iterations
    parts = [_load(library.hand_xml(hand.name, source))]
    for name in task.objects:
        parts.append(_load(library.object_xml(name, source)))
        if sim.object_mass == "published":
            scale_mass(parts[-1], RATIOS.get(name, 1.0))
    for part in parts:
        spec.attach(part, frame=spec.worldbody.add_frame(), prefix=f"{part.modelname}/")
    for placement in task.placements:
        _place(spec, placement)
    randomized = _randomized_geom(spec, task) if task.randomize else None
    try:
        model = compile_tracked(spec, task.tracked_body)
    except ValueError as error:
        raise SceneError(f"the scene of task '{task.id}' does not compile: {error}") from error
    index, origins = _index(model, task, hand, randomized), library.origins(task.motion)
    prefixes = tuple(f"{part.modelname}/" for part in parts[1:])
    return Scene(model, index, task, hand, origins, prefixes)


def hand_alone(scene: Scene) -> Scene:
    """Return a scene in which nothing touches the objects, nor what they hang on.

    They stay where they are in the model, so that its state has the same layout.
    """
    model = copy.deepcopy(scene.model)
    bodies = [model.body(i).name.startswith(scene.object_prefixes) for i in range(model.nbody)]
    of_object = np.array(bodies)[model.geom_bodyid]
    model.geom_contype[of_object] = model.geom_conaffinity[of_object] = 0
    # Explicit contact pairs ignore contype: at a margin of -10 m they never produce force. The gap
    # keeps them detected as before, since for some shapes MuJoCo takes a negative margin as depth.
    named = of_object[model.pair_geom1] | of_object[model.pair_geom2]
    model.pair_margin[named], model.pair_gap[named] = -_NEVER_M, _NEVER_M
    return replace(scene, model=model)


def scale_mass(spec: mujoco.MjSpec, ratio: float) -> None:
    """Scale mass and inertia of all bodies of a model that is yet to be compiled, in place.

    Not in the compiled model: there ``mj_setConst`` leaves ``stat.meaninertia`` behind, on which
    the solver's tolerance depends.
    """
    for geom in spec.geoms:
        if np.isnan(geom.mass):
            geom.density *= ratio
        else:
            geom.mass *= ratio
    for body in spec.bodies:
        if body.explicitinertial:
            body.mass *= ratio
            body.inertia = ratio * body.inertia
            body.fullinertia = ratio * body.fullinertia


def _load(file: Path) -> mujoco.MjSpec:
    try:
        return mujoco.MjSpec.from_file(str(file))
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise SceneError(
            f"{file} is damaged ({reason}); 'pgdm assets verify' lists what else is, "
            "'pgdm assets fetch' or 'pgdm assets import PATH' makes it anew"
        ) from error


def _place(spec: mujoco.MjSpec, placement: PlacementCfg) -> None:
    body = spec.body(placement.body)
    if body is None:
        names = ", ".join(sorted(b.name for b in spec.bodies if b.name))
        raise SceneError(f"no body '{placement.body}' to place; the scene has: {names}")
    if placement.pos_m is not None:
        body.pos = placement.pos_m
    if placement.quat is not None:
        body.quat = placement.quat


def _randomized_geom(spec: mujoco.MjSpec, task: TaskCfg) -> str:
    """Return the name of the first object's contact geom, and raise its contact priority."""
    body = spec.body(task.tracked_body)
    geoms = [] if body is None else [g for g in body.geoms if g.contype or g.conaffinity]
    if len(geoms) != 1:
        raise SceneError(f"task '{task.id}': randomize needs one contact geom, found {len(geoms)}")
    geoms[0].priority = RANDOMIZED_PRIORITY
    return geoms[0].name


def _index(
    model: mujoco.MjModel, task: TaskCfg, hand: HandCfg, randomized: str | None
) -> SceneIndex:
    def find(kind: mujoco.mjtObj, name: str) -> int:
        found = mujoco.mj_name2id(model, kind, name)
        if found < 0:
            raise SceneError(f"task '{task.id}': the scene has no {kind.name[6:].lower()} '{name}'")
        return found

    points = [f"{hand.name}/{point}" for point in hand.points]
    mount = find(mujoco.mjtObj.mjOBJ_BODY, f"{hand.name}/{hand.mount_body}")
    compensated = model.nu if hand.gravity_compensation == "all" else hand.num_base_joints
    geom = mujoco.mjtObj.mjOBJ_GEOM
    return SceneIndex(
        point_geoms=np.array([find(geom, p) for p in points]),
        point_bodies=np.array([find(mujoco.mjtObj.mjOBJ_BODY, p) for p in points]),
        object_body=find(mujoco.mjtObj.mjOBJ_BODY, task.tracked_body),
        fingertips=np.array(hand.fingertips),
        num_actuators=model.nu,
        num_compensated=compensated,
        num_base_joints=hand.num_base_joints,
        ctrl_low=model.actuator_ctrlrange[:, 0].copy(),
        ctrl_high=model.actuator_ctrlrange[:, 1].copy(),
        mount_pos=model.body_pos[mount].copy(),
        mount_quat=model.body_quat[mount].copy(),
        randomized_geom=None if randomized is None else find(geom, randomized),
    )
