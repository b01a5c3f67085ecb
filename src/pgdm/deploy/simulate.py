"""A playback in simulation: arm, hand, table and object in one scene, commands played open-loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from pgdm.config.schema import ExperimentCfg
from pgdm.deploy.arm import Setup
from pgdm.deploy.limits import JOINTS, POSITION_RAD, TORQUE, smooth
from pgdm.deploy.playback import Playback, PlaybackError
from pgdm.errors import SceneError
from pgdm.library import Library
from pgdm.library.checks.compiled import compile_tracked
from pgdm.library.couplings import Couplings
from pgdm.library.robohive.arms import FLANGE_M
from pgdm.sim.assembly import add_objects, load
from pgdm.sim.batch import SimBatch
from pgdm.sim.randomize import Randomizer
from pgdm.sim.scene import HandCfg, Scene, SceneIndex, TaskCfg

# Stiffness of Franka's joint impedance controller in Franka's examples.
STIFFNESS = (3000.0, 3000.0, 3000.0, 2500.0, 2500.0, 2000.0, 2000.0)  # N m/rad
LIFTED_M = 0.02
"""An object counts as lifted if it is more than this above its start."""

_TIMESTEP_S, _SUBSTEPS = 0.002, 2
_SCENE = "scene of arm and hand"


@dataclass(frozen=True)
class Outcome:
    """Results of playing a playback on K objects, at S times."""

    time_s: np.ndarray  # (S,)
    height_m: np.ndarray  # (S, K) of the centre of mass above its start; -inf once diverged
    expected_m: float
    """Height of the object above its start at the end of the rollout, m."""
    arm_error_rad: np.ndarray  # (7,) largest |command - joint| in all simulations not diverged
    diverged: np.ndarray  # (K,) bool
    qpos: np.ndarray  # (S, nq) of the first simulation

    @property
    def held(self) -> np.ndarray:
        """Which objects end lifted and at least half as high as expected, (K,) bool."""
        high = self.height_m[-1] >= 0.5 * self.expected_m
        return high & (self.height_m[-1] > LIFTED_M) & ~self.diverged

    @property
    def lifted_s(self) -> np.ndarray:
        """How long each object is lifted, (K,) s."""
        return (self.height_m > LIFTED_M).sum(0) * float(self.time_s[1] - self.time_s[0])


def arm_scene(library: Library, cfg: ExperimentCfg, arm_file: Path, setup: Setup) -> Scene:
    """Compile the scene of a run's task with the hand at the flange of the arm.

    The arm's joints replace the six base joints. All joints of arm and hand follow position
    commands. The arm compensates the weight of arm and hand, as Franka's controller does.

    Raises:
        SceneError: if a file is damaged, or the scene does not compile.
        LibraryError: if the library lacks an asset.
    """
    task, hand, source = cfg.task, cfg.hand, library.source_of(cfg.task.motion)
    spec = load(library.scene_xml(source))
    spec.option.timestep = _TIMESTEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    arm = load(arm_file)
    pos, quat = setup.arm_pose()
    spec.attach(arm, frame=spec.worldbody.add_frame(pos=pos, quat=quat), prefix="panda/")
    for joint, stiffness, torque, reach in zip(
        JOINTS, STIFFNESS, TORQUE, POSITION_RAD, strict=True
    ):
        actuator = spec.add_actuator(name=f"panda/{joint}", target=f"panda/{joint}")
        actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
        actuator.set_to_position(kp=stiffness, dampratio=1.0)
        # Otherwise both ranges would have the table scene's defaults.
        actuator.ctrllimited, actuator.ctrlrange = True, reach
        actuator.forcelimited, actuator.forcerange = True, [-torque, torque]
    pos, quat = setup.mount_pose()
    pos[2] += FLANGE_M
    flange = spec.body("panda/link7").add_frame(pos=pos, quat=quat)
    spec.attach(
        _without_base(library.hand_xml(hand.name, source), hand),
        frame=flange,
        prefix=f"{hand.name}/",
    )
    folders, drawn = add_objects(spec, library, task, cfg.sim)
    try:
        model = compile_tracked(spec, task.tracked_body)
    except ValueError as error:
        raise SceneError(f"the {_SCENE} of '{task.id}' does not compile: {error}") from error
    geom = None if drawn is None else model.geom(drawn).id
    index = _index(model, task, hand, geom)
    return Scene(model, index, task, hand, library.origins(task.motion, hand.name), tuple(folders))


def _without_base(file: Path, hand: HandCfg) -> mujoco.MjSpec:
    """Return the hand without base joints, its mount body at the origin."""
    spec = load(file)
    names = [joint.name for joint in spec.joints[: hand.num_base_joints]]
    for actuator in [a for a in spec.actuators if a.target in names]:
        spec.delete(actuator)
    for name in names:
        spec.delete(spec.joint(name))
    mount = spec.body(hand.mount_body)
    mount.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    mount.pos, mount.quat = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]
    return spec


def _index(
    model: mujoco.MjModel, task: TaskCfg, hand: HandCfg, randomized: int | None
) -> SceneIndex:
    points = [f"{hand.name}/{point}" for point in hand.points]
    joints = model.actuator_trnid[:, 0]
    order, couplings = np.argsort(joints), Couplings(model, model.njnt)
    if len(couplings.rows) or not (joints[order] == np.arange(model.nu)).all():
        raise SceneError(f"the {_SCENE} of '{task.id}' has joints without actuators")
    low, high = model.jnt_range[: model.nu].T
    mount = model.body(f"{hand.name}/{hand.mount_body}").id
    return SceneIndex(
        point_geoms=np.array([model.geom(point).id for point in points]),
        point_bodies=np.array([model.body(point).id for point in points]),
        object_body=model.body(task.tracked_body).id,
        fingertips=np.array(hand.fingertips),
        num_joints=model.nu,
        num_actuators=model.nu,
        driven=np.arange(model.nu),
        actuators=order,
        couplings=couplings,
        reset=np.zeros(model.nu),
        num_compensated=len(JOINTS),
        num_base_joints=len(JOINTS),
        ctrl_low=low.copy(),
        ctrl_high=high.copy(),
        joint_low=low.copy(),
        joint_high=high.copy(),
        mount_pos=model.body_pos[mount].copy(),
        mount_quat=model.body_quat[mount].copy(),
        randomized_geom=randomized,
    )


def start_of(playback: Playback, scene: Scene, num_hand_joints: int) -> np.ndarray:
    """Return the qpos (nq,) in which a playback begins.

    Arm and hand are at its first commands, the object where the rollout started.

    Args:
        playback: the playback.
        scene: from :func:`arm_scene`.
        num_hand_joints: number of joints of the hand in the task, base joints included.

    Raises:
        PlaybackError: if the playback's facts do not say where the object is, or its facts or hand
            joints do not fit the scene.
    """
    stored = playback.facts.get("start_qpos")
    stored = stored if isinstance(stored, list) else []
    width = num_hand_joints + scene.model.nq - scene.model.nu
    numbers = all(type(x) in (int, float) for x in stored)
    if not numbers or len(stored) != width or not np.isfinite(stored).all():
        raise PlaybackError(
            f"the playback's start_qpos is not a list of {width} finite numbers, as this task needs"
        )
    names = tuple(scene.model.joint(i).name.rpartition("/")[2] for i in range(scene.model.nu))
    if names[len(JOINTS) :] != playback.hand_joints:
        raise PlaybackError(
            f"the playback's hand_joints are {', '.join(playback.hand_joints)[:80]}; this "
            f"hand's are {', '.join(names[len(JOINTS) :])}"
        )
    return np.concatenate(
        (playback.arm_joints_rad[0], playback.hand_joints_rad[0], stored[num_hand_joints:])
    )


def simulate(
    scene: Scene,
    playback: Playback,
    start: np.ndarray,
    count: int,
    seed: int,
    threads: int,
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> Outcome:
    """Play a playback open-loop in ``count`` simulations; a randomised object differs in each.

    Args:
        scene: from :func:`arm_scene`.
        playback: the playback.
        start: qpos (nq,), from :func:`start_of`.
        count: K, number of simulations.
        seed: seed of the objects' randomisation.
        threads: number of threads.
        progress: called with the steps taken and the total.
    """
    sim = SimBatch(scene, count, threads, _SUBSTEPS)
    every = np.arange(count)
    if scene.task.randomize:
        Randomizer(seed, "playback", count).apply(sim, every)
    sim.reset(every, start, np.zeros(scene.model.nv))
    commands = np.hstack((playback.arm_joints_rad, playback.hand_joints_rad))
    times = np.arange(0.0, playback.duration_s, sim.control_dt_s)
    targets = smooth(playback.time_s, commands)(times)
    first = sim.read().object_pos[:, 2].numpy()
    heights, states = [np.zeros(count)], [sim.data(0).qpos.copy()]
    diverged, error = np.zeros(count, bool), np.zeros(len(JOINTS))
    for step, target in enumerate(targets[1:]):
        progress(step, len(targets))
        diverged |= sim.step(np.tile(target, (count, 1)))
        state = sim.read()
        heights.append(np.where(diverged, -np.inf, state.object_pos[:, 2].numpy() - first))
        away = np.abs(state.qpos[:, : len(JOINTS)].numpy() - target[: len(JOINTS)])
        error = np.maximum(error, np.where(diverged[:, None], 0.0, away).max(0))
        states.append(state.qpos[0].numpy())
    rise = float(playback.object_pos_m[-1, 2] - playback.object_pos_m[0, 2])
    return Outcome(times, np.array(heights), rise, error, diverged, np.array(states))
