"""Plans the reach from the reset pose to a pre-grasp in simulation (paper, App. B).

A cross-entropy search over the waypoints of a path, its timing and its final targets. The cost of a
plan uses only the final state and the object's largest displacement on the way:

    cost = sum_i e_i + sqrt(mean_j r_j^2) + peak / 5 mm + 0.05 s mean_j |qdot_j| / tol_j

with e_i the shares of :meth:`pgdm.pregrasp.reach.plan.Goal.shares` (errors divided by tolerances),
r_j the error of joint j divided by its tolerance tol_j, qdot_j its final velocity, and peak the
object's largest displacement. After each round the mean of the final targets is also shifted by a
share of the remaining error, because servos do not fully reach their targets.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from pgdm import seeding
from pgdm.cem import CemCfg, CrossEntropy
from pgdm.errors import ConfigError, SceneError
from pgdm.library.progress import StepProgress, silent
from pgdm.pregrasp.reach.plan import DEPTH_TOLERANCE_M, OBJECT_TOLERANCE_M, Goal, ReachPlan
from pgdm.pregrasp.reach.rollout import Ends, Rollouts, to_actions
from pgdm.pregrasp.reach.waypoints import Waypoints
from pgdm.pregrasp.sources import reset_pose
from pgdm.sim.scene import Scene

STEPS, SLOW_STEPS, SLOW_S = 40, 60, 0.3
"""``STEPS``: length of the released plans, control steps. ``SLOW_STEPS``: the same for hands whose
base has slow servos (D'Manus). ``SLOW_S``: servo lag, s, above which a base counts as slow."""

_END_STD = 0.003, 0.02, 0.03
"""First standard deviation of final targets: slides m, hinges rad, joints after the base rad."""
_END_LIMIT = 5.0  # largest distance of the mean final targets from the goal, in tolerances
_SETTLE_GAIN = 0.6  # of the integrator that finds the servos' steady-state offsets without contact
_SHIFT = 0.7  # largest shift of the goal where servos cannot remove an error, in tolerances
_SLACK = 0.4  # error that is not corrected, in tolerances
_SPEED_WEIGHT_S = 0.05  # weight of the joints' mean final speed, in tolerances per second
_CHECKED = 4  # best candidates of a round that are checked for penetration
_IMPROVED = 0.9  # a round is an improvement if the best cost falls below this share of its value


@dataclass(frozen=True)
class ReachCfg:
    """Settings of the search for a reach."""

    steps: int | None
    """Control steps of the plan; None means as many as in the released plans: 40, or 60 if the
    base has slow servos."""
    hold_steps: int
    """Control steps at the end of the plan in which the final targets are held."""
    cem: CemCfg
    """Settings of the cross-entropy method."""
    rounds: int
    """Largest number of rounds."""
    correction: float
    """Share of the elites' remaining error that a round adds to the final targets (0..1)."""
    margin: float
    """The search stops once penetration and every error, except the object's rotation, are at most
    this share of their tolerances (0..1)."""
    patience: int
    """The search also stops after this many rounds without improvement, if the pre-grasp is
    reached."""

    def check(self) -> None:
        """Check that the plan has time to move, and that there are fewer elites than candidates.

        Raises:
            ConfigError: ``steps`` or ``cem.elites`` has a wrong value.
        """
        if self.steps is not None and self.steps <= self.hold_steps:
            raise ConfigError(
                f"a reach of {self.steps} steps has no time to move: during the last "
                f"{self.hold_steps} it holds its final targets; give it more steps"
            )
        if not 1 <= self.cem.elites < self.cem.population:
            raise ConfigError(
                f"a search with {self.cem.elites} elites of {self.cem.population} candidates "
                "learns nothing; take at least one elite, and fewer elites than candidates"
            )


REACH = ReachCfg(None, 8, CemCfg(48, 8, 0.3, least=0.1), 40, 0.5, 0.6, 2)
"""The settings used for every task."""


def plan_reach(
    scene: Scene,
    target_qpos: np.ndarray,
    substeps: int,
    cfg: ReachCfg = REACH,
    seed: int = 0,
    num_threads: int = 0,
    progress: StepProgress = silent,
) -> ReachPlan:
    """Plan the reach to a pre-grasp, with the objects where the pre-grasp has them.

    Equal arguments give an equal plan, whatever the number of threads.

    Args:
        scene: scene of the task.
        target_qpos: whole scene (nq,) with the hand at its pre-grasp.
        substeps: physics steps per control step.
        cfg: settings of the search.
        seed: seed of the search.
        num_threads: number of threads of the simulations; 0 takes one per core.
        progress: called at the start and after each round; its total is the largest number of
            rounds.

    Raises:
        SceneError: the target does not fit the scene, or every simulation diverges.
        ConfigError: ``cfg`` has a wrong value, see :meth:`ReachCfg.check`.
    """
    began = time.monotonic()
    search = _Search(scene, np.asarray(target_qpos, float), substeps, cfg, seed, num_threads)
    rounds = 0
    progress("reach plan", 0, cfg.rounds)
    for rounds in range(1, cfg.rounds + 1):
        done = search.round()
        progress("reach plan", rounds, cfg.rounds)
        if done:
            break
    return replace(search.best.plan, rounds=rounds, seconds=time.monotonic() - began)


def default_steps(scene: Scene) -> int:
    """Return the length of the released plans for the scene's hand, in control steps."""
    model, n = scene.model, scene.index.num_base_joints
    lag = model.dof_damping[:n] / model.actuator_gainprm[scene.index.actuators[:n], 0]
    return SLOW_STEPS if n and lag.max() > SLOW_S else STEPS


@dataclass(frozen=True)
class _Candidate:
    """A simulated candidate."""

    vector: np.ndarray  # (D,)
    plan: ReachPlan
    cost: float
    worst: float  # largest error or penetration, in tolerances; without the object's rotation

    def beats(self, other: _Candidate | None, margin: float) -> bool:
        """Return whether this candidate is better than another, or there is no other.

        A candidate that reaches the goal wins, then one within the margin, then the lower cost.
        """
        return other is None or self._rank(margin) < other._rank(margin)

    def _rank(self, margin: float) -> tuple[bool, bool, float]:
        return not self.plan.reached, self.worst > margin, self.cost


class _Search:
    """State of one search."""

    def __init__(
        self,
        scene: Scene,
        target: np.ndarray,
        substeps: int,
        cfg: ReachCfg,
        seed: int,
        num_threads: int,
    ) -> None:
        cfg.check()
        self._scene, self._cfg, self._goal = scene, cfg, Goal(scene, target)
        steps, population = cfg.steps or default_steps(scene), cfg.cem.population
        home = reset_pose(scene, self._goal.qpos)
        self._rollouts = Rollouts(scene, home, population, substeps, num_threads)
        self._alone = self._rollouts.undisturbed(steps)
        dt = self._rollouts.control_dt_s
        self._paths = Waypoints(
            scene, self._goal.joints, self._goal.qpos, steps, cfg.hold_steps, dt
        )
        mean, std = self._paths.prior(_END_STD)
        tolerance, base = self._goal.tolerance, scene.index.num_base_joints
        above = self._paths.above
        nearest, farthest = _SLACK * tolerance, _SHIFT * tolerance
        aim, extra = self._rollouts.settled(above, nearest, farthest, _SETTLE_GAIN)
        shift, limit = (aim - above)[base:], _END_LIMIT * tolerance
        mean[self._paths.layout.ends][base:] = shift + extra.clip(-limit, limit)[base:]
        # Where the goal was shifted, errors up to the largest shift are not corrected again.
        self._slack = nearest
        self._slack[base:] = np.where(shift != 0, farthest[base:], nearest[base:])
        self._cem = CrossEntropy(mean, std, cfg.cem, seeding.numpy_stream(seed, "reach"))
        self._best: _Candidate | None = None
        self._idle = 0

    @property
    def best(self) -> _Candidate:
        """The best candidate so far.

        Raises:
            SceneError: the simulation diverged with every candidate.
        """
        if self._best is None:
            raise SceneError(
                f"task '{self._scene.task.id}': the simulation diverged with every plan that was "
                "tried; the pre-grasp may be deep inside something"
            )
        return self._best

    def round(self) -> bool:
        """Try one population; return whether the search is over."""
        before, cfg = self._best, self._cfg
        vectors = self._cem.ask()
        vectors[0] = self._cem.mean
        if before is not None:
            vectors[1] = before.vector
        actions = to_actions(self._scene.index, self._paths.targets(vectors))
        ends = self._rollouts.run(actions, self._alone)
        shares = self._goal.shares(ends)
        cost = self._cost(shares, ends)
        elites = self._cem.tell(vectors, cost)
        self._correct(ends.qpos[elites])
        for row in elites[:_CHECKED].tolist():
            plan = self._goal.plan(actions[row], ends, row)
            depth = plan.depth_m / max(plan.target_depth_m, DEPTH_TOLERANCE_M)
            # The object's rotation counts in the cost only: a sphere may turn on the spot.
            worst = max(float(shares[row, :-1].max()), depth)
            one = _Candidate(vectors[row], plan, float(cost[row]), worst)
            self._best = one if one.beats(self._best, cfg.margin) else self._best
        best = self.best
        improved = before is None or best.cost < _IMPROVED * before.cost
        self._idle = 0 if improved else self._idle + 1
        return best.worst <= cfg.margin or (best.plan.reached and self._idle >= cfg.patience)

    def _cost(self, shares: np.ndarray, ends: Ends) -> np.ndarray:
        """Return the costs of plans (N,), infinite where the simulation diverged."""
        goal, n = self._goal, len(self._goal.joints)
        error = (ends.qpos[:, :n] - goal.joints) / goal.tolerance
        speed = np.abs(ends.qvel[:, :n]) / goal.tolerance
        cost = shares.sum(1) + np.sqrt((error**2).mean(1)) + ends.peak_m / OBJECT_TOLERANCE_M
        return np.where(ends.diverged, np.inf, cost + _SPEED_WEIGHT_S * speed.mean(1))

    def _correct(self, qpos: np.ndarray) -> None:
        """Shift the mean of the final targets by a share of the elites' mean error, less the slack.

        ``qpos`` are the final states of the elites (E, nq).
        """
        if not len(qpos):
            return
        goal, tolerance = self._goal.joints, self._goal.tolerance
        error = (goal - qpos[:, : len(goal)]).mean(0)
        error = np.sign(error) * (np.abs(error) - self._slack).clip(0.0)
        at, limit = self._paths.layout.ends, _END_LIMIT * tolerance
        ends = self._cem.mean[at] + self._cfg.correction * error
        # Anti-windup, as in Rollouts.settled.
        index = self._scene.index
        ends = ends.clip(index.joint_low - goal, index.joint_high - goal)
        self._cem.mean[at] = ends.clip(-limit, limit)
