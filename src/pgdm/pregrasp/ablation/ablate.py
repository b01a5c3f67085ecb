"""Ablated start states: the pre-grasp without its finger pose, or without its proximity."""

from __future__ import annotations

from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from pgdm.errors import ConfigError, SceneError, check_at_least, check_name
from pgdm.pregrasp.hand_geometry import mean_fingers, mount_rotation, object_to_hand, unit
from pgdm.pregrasp.sources import StartState, is_reset_pose, reset_pose
from pgdm.sim.batch import SimBatch
from pgdm.sim.contact import HandContact
from pgdm.sim.scene import Scene

FINGERS = ("keep", "open", "mean")

OBJECT_TOLERANCE_M = 0.005
"""How far the fingers may displace the object while they move to their pose."""
OVERLAP_M = 0.0015
"""Largest penetration allowed in an ablated start. Each finger, and the rest of the hand, may
penetrate by at most this, and no deeper than in the stored start. Not zero, because contacts are
soft: a hand at rest on an object sinks in a little."""
REACH_TOLERANCE_RAD = 0.2
"""Largest error of a finger joint at the end of the simulated motion: Adroit's weak servos lag by
0.1 rad where tendons couple two joints."""
RETREAT_STEP_M, SLOW_STEP_M = 0.001, 0.005
"""Step sizes of the search over retreats. ``RETREAT_STEP_M`` is for fingers in the requested pose,
``SLOW_STEP_M`` for fingers that stop early."""
FINGER_LENGTH_M = 0.1
"""Converts a joint error to a fingertip error, to compare it with a retreat of the hand."""
_SHORT_M = 0.001  # a distance is reported as too short if it falls short by more
# Shares of the way to the requested pose at which fingers may stop.
_FINGER_FRACTIONS = np.linspace(0.0, 1.0, 51)
_RETREAT_STEPS, _FINGER_STEPS, _HOLD_STEPS = 8, 25, 10  # control steps of 0.04 s
_EXACT_M = 1e-9
_TRIALS = 3  # largest number of poses that are tried in simulation


@dataclass(frozen=True)
class AblationCfg:
    """What the ablation removes from the pre-grasp."""

    name: str
    """Name of the ablation; ``none`` removes nothing."""
    fingers: str
    """``keep``: as in the pre-grasp; ``open``: straight; ``mean``: as in the hand's mean
    pre-grasp."""
    distance_m: float
    """How far the hand moves from the pre-grasp towards its reset pose, m."""

    @property
    def changes_start(self) -> bool:
        """Whether the ablation changes the start state."""
        return self.fingers != "keep" or self.distance_m > 0

    def check(self, source: str) -> None:
        """Check that the ablation can be applied to a pre-grasp source, ``pregrasp.source``.

        Raises:
            ConfigError: a value is wrong, or there is no pre-grasp to ablate.
        """
        check_name("ablation.fingers value", self.fingers, FINGERS)
        check_at_least("ablation.distance_m", self.distance_m, 0)
        if (self.name == "none") == self.changes_start:
            raise ConfigError(
                f"ablation.name is '{self.name}' with ablation.fingers '{self.fingers}' and "
                f"ablation.distance_m {self.distance_m}; use the name 'none' if fingers=keep and "
                "distance_m=0, and another name otherwise"
            )
        if source == "none" and self.changes_start:
            raise ConfigError(
                f"ablation={self.name} changes the pre-grasp, but pregrasp=none starts without "
                "a pre-grasp: nothing is left to ablate; use ablation=none, or another pregrasp"
            )


@dataclass(frozen=True)
class Ablated:
    """An ablated start, and how far it deviates from the requested ablation."""

    start: StartState
    distance_m: float
    """Distance of the mount body from its position in the pre-grasp."""
    retreat_m: float
    """Further retreat that the hand needed to be free of penetration."""
    finger_error_rad: float
    """Largest error of a finger joint."""
    object_moved_m: float
    """How far the fingers pushed the object in simulation; in the start it is back in place."""
    simulated: bool
    """Whether the fingers moved to the pose in simulation; else it is only set kinematically."""
    depth_m: float
    """Deepest penetration between the hand and anything else."""

    @property
    def deviation_m(self) -> float:
        """``retreat_m`` plus the fingertip error that corresponds to ``finger_error_rad``."""
        return self.retreat_m + FINGER_LENGTH_M * self.finger_error_rad

    def facts(self) -> dict[str, str]:
        """Return what a run records about its ablation."""
        return {
            "ablation_distance_mm": f"{1e3 * self.distance_m:.1f}",
            "ablation_retreat_mm": f"{1e3 * self.retreat_m:.1f}",
            "ablation_finger_error_rad": f"{self.finger_error_rad:.3f}",
            "ablation_depth_mm": f"{1e3 * self.depth_m:.1f}",
            "ablation_reached_by": "simulation" if self.simulated else "setting",
        }

    def compromises(self, asked_m: float) -> str:
        """Return in words how the start deviates from the requested ablation; empty if it does not.

        Args:
            asked_m: the requested distance, ``ablation.distance_m``.
        """
        parts = []
        if self.retreat_m > 0:
            parts.append(f"the hand retreats {1e2 * self.retreat_m:.1f} cm to touch nothing")
        if self.finger_error_rad > 0:
            parts.append(f"fingers stop {self.finger_error_rad:.2f} rad short of their pose")
        if self.distance_m < asked_m - _SHORT_M:
            parts.append(
                f"a slide reaches its limit at {1e2 * self.distance_m:.1f} cm instead of "
                f"{1e2 * asked_m:.1f}"
            )
        return ", ".join(parts)


def ablate(cfg: AblationCfg, start: StartState, scene: Scene, substeps: int) -> Ablated:
    """Return the start state after the ablation.

    The hand is at rest and keeps its orientation; the object keeps its pose and velocity. The hand
    moves by ``cfg.distance_m`` along the straight line towards its reset position, if need be past
    it, up to the limit of a slide. If the hand then penetrates something deeper than
    :data:`OVERLAP_M`, or deeper than in the stored start, one of two compromises is made, whichever
    deviates less:

    - the hand retreats further: back, up or away from the object
    - if the ablation changes the finger pose: each finger stops at the first contact on its way
      from the pre-grasp, and the hand may retreat as well

    Poses with stopped fingers are checked in simulation: the fingers must come near their pose
    without pushing the object. If the three best of these poses fail, the hand retreats instead. If
    the stored start already penetrates deeply, the simulation is skipped.

    Equal arguments give an equal result. An ablation that removes nothing returns the stored start.

    Args:
        cfg: the ablation.
        start: the stored start state.
        scene: scene of the task.
        substeps: physics steps per control step.

    Raises:
        ConfigError: a setting is wrong, the start is the reset pose, or ``hand.mean_fingers_rad``
            has a wrong length.
        SceneError: the hand still penetrates something after any retreat within the slides' limits.
    """
    cfg.check(start.source)
    if cfg.changes_start and is_reset_pose(scene, start.qpos):
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
        depths = self._contact.depths(start.qpos)  # m, of each finger and the rest of the hand
        self._allowed = np.minimum(depths, OVERLAP_M)
        self.starts_inside = float(depths.max()) > OBJECT_TOLERANCE_M
        """Whether the start penetrates so deeply that a simulation would push the object away."""
        self._fingers = slice(self._contact.first_finger_joint, scene.index.num_joints)
        self._goal = self._finger_goal()  # (J,) rad
        slides = start.qpos[:3]
        back = unit(-slides)  # to the reset pose, where all slides are zero for every hand
        self._slides = slides + min(cfg.distance_m, self._room(slides, back)) * back  # (3,) m
        mount = mount_rotation(scene)
        up, away = np.array([0.0, 0.0, 1.0]), object_to_hand(scene, start.qpos)
        self._retreats = [back, unit(up @ mount), unit(away @ mount)]  # directions of the slides

    def found(
        self, qpos: np.ndarray, retreat: float, pushed: float = 0.0, simulated: bool = False
    ) -> Ablated:
        """Return the result for a pose: hand at rest, objects with their stored velocities."""
        start, n = self._start, self._scene.index.num_joints
        if self._cfg.changes_start:
            qvel = start.qvel.copy()
            qvel[:n] = 0.0
            start = replace(start, qpos=qpos, qvel=qvel, reach=None)  # no plan ends here
        distance = float(np.linalg.norm(qpos[:3] - self._start.qpos[:3]))
        error = float(np.abs(qpos[self._fingers] - self._goal).max())
        depth = self._contact.depth(qpos)
        return Ablated(start, distance, retreat, error, pushed, simulated, depth)

    def set_free(self) -> Ablated:
        """Return the requested pose with the smallest retreat that frees it from penetration."""
        rooms = [self._room(self._slides, direction) for direction in self._retreats]
        for retreat in np.arange(0.0, max(rooms) + RETREAT_STEP_M, RETREAT_STEP_M):
            for direction, room in zip(self._retreats, rooms, strict=True):
                qpos = self._pose(retreat * direction, self._goal)
                if retreat <= room and self._is_free(qpos):
                    return self.found(qpos, float(retreat))
        raise SceneError(
            f"task '{self._scene.task.id}', ablation '{self._cfg.name}': the hand penetrates "
            "something however far it retreats back, up or away from the object"
        )

    def stopped(self, limit: float) -> list[Ablated]:
        """Return free poses with fingers that stop early, best first.

        Only poses that deviate by less than ``limit``, m, are returned.
        """
        poses: list[Ablated] = []
        for retreat in np.arange(0.0, limit, SLOW_STEP_M):
            for direction in self._retreats if retreat > 0 else self._retreats[:1]:
                if retreat <= self._room(self._slides, direction):
                    qpos = self._advance(retreat * direction)
                    if self._is_free(qpos):
                        poses.append(self.found(qpos, float(retreat)))
            poses = sorted(
                (p for p in poses if p.deviation_m < limit), key=attrgetter("deviation_m")
            )
            if poses and poses[0].deviation_m <= retreat + SLOW_STEP_M:
                break
        return poses

    def moved(self, sim: SimBatch, pose: Ablated) -> Ablated | None:
        """Return a pose if the hand gets there in simulation without pushing the object, else None.

        The object may be moving at the start: a second simulation, with the hand in its reset pose,
        shows the object's undisturbed motion.
        """
        index, goal = self._scene.index, pose.start.qpos
        n, driven = index.num_joints, index.driven
        start, away = self._start.qpos[:n], self._start.qpos[:n].copy()
        away[:3] = goal[:3]
        alone = reset_pose(self._scene, self._start.qpos)
        sim.reset(np.array([0]), self._start.qpos, pose.start.qvel)
        sim.reset(np.array([1]), alone, pose.start.qvel)
        stored = sim.read().object_pos[0]
        targets = [
            *np.linspace(start, away, _RETREAT_STEPS + 1)[1:],
            *np.linspace(away, goal[:n], _FINGER_STEPS + 1)[1:],
            *[goal[:n]] * _HOLD_STEPS,
        ]
        for target in targets:
            both = np.stack((target, alone[:n]))[:, driven]
            if sim.step(both.clip(index.ctrl_low, index.ctrl_high)).any():
                return None
        state = sim.read()
        object_pos, undisturbed = state.object_pos
        pushed = float(min((object_pos - stored).norm(), (object_pos - undisturbed).norm()))
        off = np.abs(state.qpos[0].numpy() - goal)[self._fingers].max()
        if pushed > OBJECT_TOLERANCE_M or off > REACH_TOLERANCE_RAD:
            return None
        return self.found(goal, pose.retreat_m, pushed, simulated=True)

    def _advance(self, retreat: np.ndarray) -> np.ndarray:
        """Return qpos (nq,) with each finger moved towards its pose until it touches something."""
        begin = self._start.qpos[self._fingers]
        fingers, done = begin.copy(), np.zeros(len(begin), bool)
        allowed = np.maximum(self._allowed, self._contact.depths(self._pose(retreat, begin)))
        for fraction in _FINGER_FRACTIONS[1:]:
            next_ = np.where(done, fingers, begin + fraction * (self._goal - begin))
            depths = self._contact.depths(self._pose(retreat, next_))
            done |= (depths > allowed + _EXACT_M)[self._contact.finger_of_joint]
            fingers = np.where(done, fingers, next_)
        return self._pose(retreat, fingers)

    def _is_free(self, qpos: np.ndarray) -> bool:
        return bool((self._contact.depths(qpos) <= self._allowed + _EXACT_M).all())

    def _pose(self, retreat: np.ndarray, fingers: np.ndarray) -> np.ndarray:
        """Return qpos (nq,) with the slides at the ablation's distance plus a retreat (3,) m."""
        qpos = self._start.qpos.copy()
        qpos[:3] = self._slides + retreat
        qpos[self._fingers] = fingers
        return self._scene.index.couplings.apply(qpos)

    def _room(self, slides: np.ndarray, direction: np.ndarray) -> float:
        """Return how far the slides can move from a position (3,) along a unit vector (3,), m."""
        low, high = self._scene.model.jnt_range[:3].T
        moving = np.abs(direction) > 1e-9
        ends = (np.where(direction > 0, high, low) - slides)[moving] / direction[moving]
        return max(0.0, float(ends.min())) if moving.any() else 0.0

    def _finger_goal(self) -> np.ndarray:
        """Return the requested finger joint positions (J,) rad."""
        ranges = self._scene.model.jnt_range[self._fingers]
        if self._cfg.fingers == "keep":
            return self._start.qpos[self._fingers]
        if self._cfg.fingers == "open":
            return np.zeros(len(ranges)).clip(*ranges.T)
        return mean_fingers(self._scene).clip(*ranges.T)
