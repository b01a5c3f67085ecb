"""Start states with something taken away from the pre-grasp: its fingers, or its proximity."""

from __future__ import annotations

from dataclasses import dataclass, replace
from operator import attrgetter

import mujoco
import numpy as np

from pgdm.errors import ConfigError, SceneError, UnknownNameError
from pgdm.pregrasp.ablated import Ablated
from pgdm.pregrasp.sources import StartState
from pgdm.sim.batch import SimBatch
from pgdm.sim.contact import HandContact
from pgdm.sim.scene import Scene

FINGERS = ("keep", "open", "mean")

OBJECT_TOLERANCE_M = 0.005
"""By how much fingers that move to their pose may displace the object."""
OVERLAP_M = 0.0015
"""Deeper than this no ablated start is in anything: hands at rest on an object are, in the
simulation, where contacts give way. Less deep it may be as far as the stored start is."""
REACH_TOLERANCE_RAD = 0.2
"""How near moving fingers must come to their pose in the simulation: Adroit's weak servos hang
0.1 rad behind where tendons couple two joints."""
RETREAT_STEP_M, SLOW_STEP_M = 0.001, 0.005
"""Resolution of the wrist's retreat: for fingers as asked for, and for fingers that stop."""
_FINGER_SHARES = np.linspace(0.0, 1.0, 51)  # of the way to the pose, to see where a finger stops
_RETREAT_STEPS, _FINGER_STEPS, _HOLD_STEPS = 8, 25, 10  # control steps of 0.04 s
_EXACT_M = 1e-9
_TRIALS = 3  # poses that are tried in the simulation


@dataclass(frozen=True)
class AblationCfg:
    """What is taken away from the pre-grasp (SPEC 4)."""

    name: str
    """Name of the ablation; ``none`` takes nothing away."""
    fingers: str
    """``keep``: as in the pre-grasp; ``open``: straight; ``mean``: as in the hand's mean
    pre-grasp."""
    distance_m: float
    """How far the wrist is moved from the pre-grasp towards the hand's reset pose, m."""

    @property
    def changes_start(self) -> bool:
        """Whether episodes start elsewhere than without it."""
        return self.fingers != "keep" or self.distance_m > 0

    def check(self, source: str) -> None:
        """Check that it can be applied to starts of a source, ``pregrasp.source``.

        Raises:
            ConfigError: if a value is wrong, or there is no pre-grasp to take from.
        """
        if self.fingers not in FINGERS:
            raise UnknownNameError("ablation.fingers value", self.fingers, FINGERS)
        if self.distance_m < 0:
            raise ConfigError(f"ablation.distance_m is {self.distance_m}; it must be at least 0")
        if (self.name == "none") == self.changes_start:
            raise ConfigError(
                f"ablation.name is '{self.name}' with ablation.fingers '{self.fingers}' and "
                f"ablation.distance_m {self.distance_m}; 'none' is the name of fingers=keep and "
                "distance_m=0, and of nothing else"
            )
        if source == "none" and self.changes_start:
            raise ConfigError(
                f"ablation={self.name} changes the pre-grasp, but pregrasp=none starts without "
                "one: nothing is left to ablate; use ablation=none, or another pregrasp"
            )


def ablate(cfg: AblationCfg, start: StartState, scene: Scene, substeps: int) -> Ablated:
    """Return the start of an episode with something taken away from its pre-grasp.

    The wrist's orientation stays, and so do pose and velocity of the object; the hand stands
    still. The distance is counted along the line on which the base's slides lead to the reset
    pose, straight in the world, and beyond it where that is nearer; the line ends where a slide
    does. Where the hand would then be in something, deeper than the stored start or `OVERLAP_M`,
    either the wrist goes further, back, up or away from the object, or each finger stops where it
    meets something on its way from the pre-grasp; whichever deviates less. Stopped fingers are
    moved there in the simulation with the object free, as a proof that they get there without
    pushing it. Equal arguments give an equal result.

    Args:
        cfg: what to take away.
        start: the stored start, with its pre-grasp.
        scene: of the task.
        substeps: physics steps per control step.

    Raises:
        ConfigError: if the start is the reset pose, or the hand's mean has another length.
        SceneError: if no free pose is found up to where the slides end.
    """
    cfg.check(start.source)
    if cfg.changes_start and not start.qpos[: scene.model.nu].any():
        raise ConfigError(
            f"ablation={cfg.name} changes the pre-grasp, but the start '{start.source}' of task "
            f"'{scene.task.id}' is the hand's reset pose: nothing is left to ablate"
        )
    ablation = _Ablation(cfg, start, scene)
    if not cfg.changes_start:
        return ablation.found(start.qpos, 0.0)
    best = ablation.set_free()
    if cfg.fingers == "keep" or best.retreat_m == 0:
        return best
    stopped = ablation.stopped(best.deviation_m)
    if not stopped or ablation.starts_inside:
        return stopped[0] if stopped else best
    sim = SimBatch(scene, 2, 1, substeps)
    tried = (ablation.moved(sim, one) for one in stopped[:_TRIALS])
    return next((one for one in tried if one is not None), best)


class _Ablation:
    """One ablation of one start state."""

    def __init__(self, cfg: AblationCfg, start: StartState, scene: Scene) -> None:
        self._cfg, self._start, self._scene = cfg, start, scene
        self._contact = HandContact(scene)
        depths = self._contact.depths(start.qpos)  # m, of each finger and the rest
        self._allowed = np.minimum(depths, OVERLAP_M)
        self.starts_inside = float(depths.max()) > OBJECT_TOLERANCE_M
        """Whether the start cuts into something so far that a simulation would push it away."""
        self._fingers = slice(self._contact.first_finger_joint, scene.model.nu)
        self._goal = self._finger_goal()  # (J,) rad
        slides = start.qpos[:3]
        back = _unit(-slides)  # to the reset pose, where all slides are zero
        self._wrist = slides + min(cfg.distance_m, self._room(slides, back)) * back  # (3,) m
        self._ways = [back, *self._up_and_away()]

    def found(
        self, qpos: np.ndarray, retreat: float, pushed: float = 0.0, simulated: bool = False
    ) -> Ablated:
        """Return a pose as a result: the hand stands still, the objects move as they did."""
        start, nu = self._start, self._scene.model.nu
        if self._cfg.changes_start:
            qvel = start.qvel.copy()
            qvel[:nu] = 0.0
            start = replace(start, qpos=qpos, qvel=qvel, reach=None)  # no plan leads here
        way = float(np.linalg.norm(qpos[:3] - self._start.qpos[:3]))
        error = float(np.abs(qpos[self._fingers] - self._goal).max())
        depth = self._contact.depth(qpos)
        return Ablated(start, way, retreat, error, pushed, simulated, depth)

    def set_free(self) -> Ablated:
        """Return the pose as asked for, at the least retreat at which it cuts into nothing."""
        rooms = [self._room(self._wrist, way) for way in self._ways]
        for retreat in np.arange(0.0, max(rooms) + RETREAT_STEP_M, RETREAT_STEP_M):
            for way, room in zip(self._ways, rooms, strict=True):
                qpos = self._pose(retreat * way, self._goal)
                if retreat <= room and self._is_free(qpos):
                    return self.found(qpos, float(retreat))
        raise SceneError(
            f"task '{self._scene.task.id}', ablation '{self._cfg.name}': the hand cuts into "
            "something wherever its slides take it"
        )

    def stopped(self, limit: float) -> list[Ablated]:
        """Return free poses whose fingers stop on their way, least deviation below limit first."""
        poses: list[Ablated] = []
        for retreat in np.arange(0.0, limit, SLOW_STEP_M):
            for way in self._ways if retreat > 0 else self._ways[:1]:
                if retreat <= self._room(self._wrist, way):
                    qpos = self._advance(retreat * way)
                    if self._is_free(qpos):
                        poses.append(self.found(qpos, float(retreat)))
            poses = sorted(
                (p for p in poses if p.deviation_m < limit), key=attrgetter("deviation_m")
            )
            if poses and poses[0].deviation_m <= retreat + SLOW_STEP_M:
                break
        return poses

    def moved(self, sim: SimBatch, pose: Ablated) -> Ablated | None:
        """Return a pose once the simulation gets there, or None if it does not, or pushes.

        A stored object may not lie still: in the second simulation, with the hand at its reset
        pose, it goes where it goes by itself.
        """
        nu, goal = self._scene.model.nu, pose.start.qpos
        start, away = self._start.qpos[:nu], self._start.qpos[:nu].copy()
        away[:3] = goal[:3]
        alone = self._start.qpos.copy()
        alone[:nu] = 0.0
        sim.reset(np.array([0]), self._start.qpos, pose.start.qvel)
        sim.reset(np.array([1]), alone, pose.start.qvel)
        stored = sim.read().object_pos[0]
        low, high = self._scene.model.actuator_ctrlrange.T
        targets = [
            *np.linspace(start, away, _RETREAT_STEPS + 1)[1:],
            *np.linspace(away, goal[:nu], _FINGER_STEPS + 1)[1:],
            *[goal[:nu]] * _HOLD_STEPS,
        ]
        for target in targets:
            if sim.step(np.stack((target, alone[:nu])).clip(low, high)).any():
                return None
        state = sim.read()
        object_pos, by_itself = state.object_pos
        pushed = float(min((object_pos - stored).norm(), (object_pos - by_itself).norm()))
        off = np.abs(state.qpos[0].numpy() - goal)[self._fingers].max()
        if pushed > OBJECT_TOLERANCE_M or off > REACH_TOLERANCE_RAD:
            return None
        return self.found(goal, pose.retreat_m, pushed, simulated=True)

    def _advance(self, retreat: np.ndarray) -> np.ndarray:
        """Return qpos (nq,) after each finger went as far to its pose as nothing is met."""
        begin = self._start.qpos[self._fingers]
        fingers, done = begin.copy(), np.zeros(len(begin), bool)
        allowed = np.maximum(self._allowed, self._contact.depths(self._pose(retreat, begin)))
        for share in _FINGER_SHARES[1:]:
            next_ = np.where(done, fingers, begin + share * (self._goal - begin))
            depths = self._contact.depths(self._pose(retreat, next_))
            done |= (depths > allowed + _EXACT_M)[self._contact.finger_of_joint]
            fingers = np.where(done, fingers, next_)
        return self._pose(retreat, fingers)

    def _is_free(self, qpos: np.ndarray) -> bool:
        return bool((self._contact.depths(qpos) <= self._allowed + _EXACT_M).all())

    def _pose(self, retreat: np.ndarray, fingers: np.ndarray) -> np.ndarray:
        """Return qpos (nq,) with the wrist as far away as asked for, and retreat (3,) m from it."""
        qpos = self._start.qpos.copy()
        qpos[:3] = self._wrist + retreat
        qpos[self._fingers] = fingers
        return qpos

    def _room(self, slides: np.ndarray, way: np.ndarray) -> float:
        """Return how far the slides go from a place (3,) along a unit direction (3,), m."""
        low, high = self._scene.model.jnt_range[:3].T
        moving = np.abs(way) > 1e-9
        ends = (np.where(way > 0, high, low) - slides)[moving] / way[moving]
        return max(0.0, float(ends.min())) if moving.any() else 0.0

    def _up_and_away(self) -> list[np.ndarray]:
        """Return the slides' directions, (3,) each, up and from the object to the hand."""
        index = self._scene.index
        data = mujoco.MjData(self._scene.model)
        data.qpos[:] = self._start.qpos
        mujoco.mj_kinematics(self._scene.model, data)
        away = data.geom_xpos[index.point_geoms].mean(axis=0) - data.xipos[index.object_body]
        mount = np.empty(9)
        mujoco.mju_quat2Mat(mount, index.mount_quat)
        return [_unit(world @ mount.reshape(3, 3)) for world in (np.array([0.0, 0, 1]), away)]

    def _finger_goal(self) -> np.ndarray:
        """Return the finger joints (J,) asked for."""
        hand, ranges = self._scene.hand, self._scene.model.jnt_range[self._fingers]
        if self._cfg.fingers == "keep":
            return self._start.qpos[self._fingers]
        if self._cfg.fingers == "open":
            return np.zeros(len(ranges)).clip(*ranges.T)
        if len(hand.mean_fingers_rad) != len(ranges):
            raise ConfigError(
                f"hand.mean_fingers_rad has {len(hand.mean_fingers_rad)} numbers, but hand "
                f"'{hand.name}' has {len(ranges)} finger joints after hand.num_base_joints and "
                "hand.num_wrist_joints"
            )
        return np.array(hand.mean_fingers_rad).clip(*ranges.T)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-9)
