"""Scene of a task: table, hand and objects as one compiled model, and an index of its parts."""

from __future__ import annotations

import copy
import hashlib
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from pgdm.errors import SceneError
from pgdm.library import Library
from pgdm.library.checks.compiled import compile_tracked
from pgdm.library.couplings import Couplings
from pgdm.sim.assembly import assemble
from pgdm.sim.hand_model import joint_actuators, reset_joints

OBJECT_MASSES = ("volume", "published")
WARP = "warp"
ENGINES = ("mujoco", WARP)

_NEVER_M = 10.0  # a depth that no penetration reaches
_FREE_JOINTS = 6  # of a free object: three slides and three hinges
# Fields of a model that determine its physics.
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
    """Pose of an object's body that replaces the pose in the object's file."""

    body: str
    """Scene name of the body, such as ``door/frame``."""
    pos_m: list[float] | None
    """Position in the parent's frame (an outermost body: the world), (3,) m; None: the file's."""
    quat: list[float] | None
    """Orientation in the same frame as ``pos_m``, (4,) wxyz; None: the file's."""


@dataclass(frozen=True)
class TaskCfg:
    """One task: which object should follow which exemplar motion."""

    id: str
    """Task id, ``<object>-<motion>`` or ``<hand>-<object>``."""
    objects: list[str]
    """Library names of the objects in the scene, in the order of their joints."""
    tracked_body: str
    """Scene name of the body whose centre of mass and orientation should follow the motion."""
    motion: str
    """Library id of the exemplar motion, which includes stored start states."""
    timestep_s: float
    """Physics timestep, s."""
    placements: list[PlacementCfg]
    """Bodies placed differently than in their files."""
    randomize: bool
    """Whether friction, size and mass of the object are randomised at every reset."""
    tcdm30: bool
    """Whether the task is one of the 30 on which the paper compares methods."""
    pregrasp_source: str
    """Origin of the mined pre-grasp, such as mocap, labeled or search."""
    trajectory_source: str
    """Origin of the exemplar motion, such as mocap, animator or keyframes."""
    paper_success: float | None
    """Success of the paper's PGDM after 50M frames, mean of 3 seeds (0..1)."""
    paper_com_error: float | None
    """The paper's error, comparable with ``com_error_released``, m."""


_BARE_TASK = TaskCfg(
    *("bare", ["ball"], "ball/object", "none", 0.004, [], False, False, "none", "none"),
    paper_success=None,
    paper_com_error=None,
)
_BARE = """<mujoco><option timestep="0.004" iterations="20" noslip_iterations="20"/>
<visual><headlight ambient=".35 .35 .35" diffuse=".35 .35 .35"/><global fovy="25"/></visual>
<asset><texture type="skybox" builtin="flat" rgb1=".93 .94 .95" rgb2=".93 .94 .95" width="8"
height="8"/></asset><worldbody><light pos="-1 -2 3" dir=".3 .6 -.9" diffuse=".35 .35 .35"/>
<geom name="table" type="box" size=".45 .45 .025" pos="0 0 -.025" rgba=".8 .78 .74 1"/>
</worldbody></mujoco>"""
_AXES = "".join(
    f'<joint type="{kind}" axis="{axis}"/>'
    for kind in ("slide", "hinge")
    for axis in ("1 0 0", "0 1 0", "0 0 1")
)
_BALL = f"""<mujoco model="ball"><worldbody><body name="object" pos="0 0 .031">{_AXES}
<geom size=".03" rgba=".16 .45 .65 1"/></body></worldbody></mujoco>"""


@dataclass(frozen=True)
class HandCfg:
    """Properties of a hand that its model does not contain."""

    name: str
    """Library name and scene prefix of the hand."""
    points: list[str]
    """Geoms (each in a body of the same name) whose poses are observed, in observation order."""
    fingertips: list[int]
    """Indices of the points that are fingertips."""
    human_fingers: list[str]
    """Human finger that each fingertip follows: index, middle, ring, little or thumb."""
    gravity_compensation: str
    """Joints with gravity compensation: ``all`` joints of the hand, or only the ``base``."""
    num_base_joints: int
    """Number of base joints, first in qpos, which move the hand as a whole."""
    num_wrist_joints: int
    """Number of joints after the base that turn the palm; the rest are the finger joints."""
    mean_fingers_rad: list[float]
    """Finger joints of the mean pre-grasp of the hand, in the order of qpos, rad."""
    mount_body: str
    """Body that the base joints move, a child of the world."""


@dataclass(frozen=True)
class SimCfg:
    """Physics engine and solver settings."""

    engine: str
    """``mujoco``: C MuJoCo, float64, on the CPU; ``warp``: MuJoCo Warp, float32, on ``device``, for
    training only: evaluations always run in C MuJoCo."""
    solver_iterations: int
    """Maximum iterations of the Newton solver per physics step."""
    noslip_iterations: int
    """Iterations of the noslip solver per physics step."""
    object_mass: str
    """``volume``: mass and inertia of objects as MuJoCo 4.0 computes them from their volume;
    ``published``: scaled to those that the MuJoCo of the paper's time computed, where known."""


@dataclass(frozen=True)
class SceneIndex:
    """Ids and constants of a scene, looked up once."""

    point_geoms: np.ndarray  # (P,) geom ids
    point_bodies: np.ndarray  # (P,) body ids
    object_body: int
    fingertips: np.ndarray  # (F,) indices of the points
    num_joints: int  # n, of the hand; they are first in qpos
    num_actuators: int  # nu; less than n if joints are coupled
    driven: np.ndarray  # (nu,) the hand's joints that have an actuator, ascending
    actuators: np.ndarray  # (nu,) ids of the actuators of ``driven``; targets are in this order
    couplings: Couplings  # of the joints without actuator
    reset: np.ndarray  # (n,) m, rad: the reset pose
    num_compensated: int  # joints with gravity compensation, first in qvel
    num_base_joints: int
    ctrl_low: np.ndarray  # (nu,) m, rad
    ctrl_high: np.ndarray  # (nu,)
    joint_low: np.ndarray  # (n,) m, rad: control range; for a coupled joint its joint range
    joint_high: np.ndarray  # (n,)
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
    """Library source or sources of the task's assets, such as ``own+checkout``."""
    object_prefixes: tuple[str, ...]
    """Prefixes of the names of the objects' bodies; they may differ from the library names."""

    @property
    def lies_free(self) -> bool:
        """Whether the tracked object is free: six joints between it and the world."""
        body, joints = self.index.object_body, 0
        while body:
            joints += int(self.model.body_jntnum[body])
            body = int(self.model.body_parentid[body])
        return joints == _FREE_JOINTS

    def digest(self) -> str:
        """Return a SHA-256 of the model's fields and options that determine the physics."""
        digest = hashlib.sha256()
        for name in _PHYSICS:
            digest.update(np.ascontiguousarray(getattr(self.model, name)).tobytes())
        option = self.model.opt
        index = self.index
        if len(index.couplings.rows):
            digest.update(self.model.eq_data[index.couplings.rows].tobytes())
        if index.reset.any():
            digest.update(index.reset.tobytes())
        numbers = (option.timestep, option.iterations, option.noslip_iterations, option.cone)
        digest.update(repr(numbers).encode())
        return digest.hexdigest()


def build_scene(library: Library, task: TaskCfg, hand: HandCfg, sim: SimCfg) -> Scene:
    """Compile the scene of a task.

    Raises:
        SceneError: if it does not compile, a body, geom or joint is missing, or the hand's model
            violates pgdm's requirements.
        LibraryError: if the library lacks an asset.
    """
    spec, folders, randomized = assemble(library, task, hand, sim)
    try:
        model = compile_tracked(spec, task.tracked_body)
    except ValueError as error:
        raise SceneError(f"the scene of task '{task.id}' does not compile: {error}") from error
    index, origins = _index(model, task, hand, randomized), library.origins(task.motion, hand.name)
    return Scene(model, index, task, hand, origins, tuple(folders)[2:])


def bare_scene(model: mujoco.MjSpec, hand: HandCfg) -> Scene:
    """Compile a hand with a ball on a table, to inspect a hand that has no task yet.

    Args:
        model: the hand's model; not changed.
        hand: settings of the hand.

    Raises:
        SceneError: as for :func:`build_scene`.
    """
    spec = mujoco.MjSpec.from_string(_BARE)
    spec.attach(model.copy(), frame=spec.worldbody.add_frame(), prefix=f"{hand.name}/")
    spec.attach(mujoco.MjSpec.from_string(_BALL), frame=spec.worldbody.add_frame(), prefix="ball/")
    try:
        compiled = compile_tracked(spec, _BARE_TASK.tracked_body)
    except ValueError as error:
        raise SceneError(f"hand '{hand.name}' does not compile: {error}") from error
    index = _index(compiled, _BARE_TASK, hand, None)
    return Scene(compiled, index, _BARE_TASK, hand, "", ("ball/",))


def hand_alone(scene: Scene) -> Scene:
    """Return the scene without contacts of the objects' models, such as a door and its frame.

    The bodies remain in the model, so that its state has the same layout.
    """
    model = copy.deepcopy(scene.model)
    bodies = [model.body(i).name.startswith(scene.object_prefixes) for i in range(model.nbody)]
    of_object = np.array(bodies)[model.geom_bodyid]
    model.geom_contype[of_object] = model.geom_conaffinity[of_object] = 0
    # Explicit contact pairs ignore contype, but produce no force at a margin of -10 m. The gap
    # keeps their detection as before: for some shapes MuJoCo misreads a negative detection margin.
    named = of_object[model.pair_geom1] | of_object[model.pair_geom2]
    model.pair_margin[named], model.pair_gap[named] = -_NEVER_M, _NEVER_M
    return replace(scene, model=model)


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
    found = joint_actuators(model, hand)
    driven, count = np.flatnonzero(found >= 0), len(found)
    actuators = found[driven]
    low, high = model.actuator_ctrlrange[actuators].T.copy()
    joint_low, joint_high = model.jnt_range[:count].T.copy()
    joint_low[driven], joint_high[driven] = low, high
    compensated = count if hand.gravity_compensation == "all" else hand.num_base_joints
    geom = mujoco.mjtObj.mjOBJ_GEOM
    return SceneIndex(
        point_geoms=np.array([find(geom, p) for p in points]),
        point_bodies=np.array([find(mujoco.mjtObj.mjOBJ_BODY, p) for p in points]),
        object_body=find(mujoco.mjtObj.mjOBJ_BODY, task.tracked_body),
        fingertips=np.array(hand.fingertips),
        num_joints=count,
        num_actuators=model.nu,
        driven=driven,
        actuators=actuators,
        couplings=Couplings(model, count),
        reset=reset_joints(model, hand, count),
        num_compensated=compensated,
        num_base_joints=hand.num_base_joints,
        ctrl_low=low,
        ctrl_high=high,
        joint_low=joint_low,
        joint_high=joint_high,
        mount_pos=model.body_pos[mount].copy(),
        mount_quat=model.body_quat[mount].copy(),
        randomized_geom=None if randomized is None else find(geom, randomized),
    )
