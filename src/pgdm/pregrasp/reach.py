"""The reach: from the reset pose to a pre-grasp, planned on the simulator (SPEC 2).

A cross-entropy search over a path's waypoints, its timing and its last targets. It knows no mesh:
the cost is made of the states that the simulation ends in.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pgdm import seeding
from pgdm.cem import CemCfg, CrossEntropy
from pgdm.errors import ConfigError, SceneError
from pgdm.pregrasp.reach_plan import (
    DEPTH_TOLERANCE_M,
    OBJECT_TOLERANCE_M,
    Goal,
    ReachPlan,
    measure,
)
from pgdm.pregrasp.rollout import Ends, Rollouts, play, reset_pose, to_actions
from pgdm.pregrasp.waypoints import Waypoints
from pgdm.sim.scene import Scene

__all__ = ["REACH", "ReachCfg", "ReachPlan", "measure", "plan_reach", "play", "reset_pose"]

STEPS, SLOW_STEPS, SLOW_S = 40, 60, 0.3
"""Length of the plans in R, for quick bases and for those whose servos lag behind by more than
the last number: D'Manus."""

_END_STD = 0.003, 0.02, 0.03
"""Deviation of the last targets of slides, m, hinges and fingers, rad, in the first round."""
_END_LIMIT = 5.0  # tolerances that the last targets may be away from the goal
_SETTLE_GAIN = 0.6  # share of an error that a step in the air adds to the targets
_SHIFT = 0.7  # share of the tolerance by which the aim gives way to what servos cannot help
_SLACK = 0.4  # share of the tolerance within which a remaining error is not corrected
_SPEED_WEIGHT_S = 0.05  # of the joints' mean final speed, in tolerances a second
_CHECKED = 4  # candidates of a round that are looked at for penetration
_IMPROVED = 0.9  # of the cost that was best: more is no progress


@dataclass(frozen=True)
class ReachCfg:
    """How a reach is searched."""

    steps: int | None
    """Control steps of the plan; None takes 40, or 60 where the base's servos are slow (R)."""
    hold_steps: int
    """Of them, steps at the end in which the last target stays."""
    cem: CemCfg
    """How candidates follow those that went well."""
    rounds: int
    """Rounds at most."""
    correction: float
    """Share of the elites' remaining error that a round adds to the last targets (0..1): servos
    hang behind."""
    margin: float
    """The search ends once every error is below this share of what is allowed (0..1)."""
    patience: int
    """It ends as well once all is as it must be and this many rounds brought nothing better."""

    def check(self) -> None:
        """Check that there is time to move, and someone to learn from.

        Raises:
            ConfigError: if not.
        """
        if self.steps is not None and self.steps <= self.hold_steps:
            raise ConfigError(
                f"a reach of {self.steps} steps has no time to move while the last "
                f"{self.hold_steps} hold; give it more steps"
            )
        if not 1 <= self.cem.elites < self.cem.population:
            raise ConfigError(
                f"a search with {self.cem.elites} elites of {self.cem.population} candidates "
                "learns nothing; take at least 1, and fewer than there are"
            )


REACH = ReachCfg(None, 8, CemCfg(48, 8, 0.3, least=0.1), 40, 0.5, 0.6, 2)
"""The search as it is done for every task."""


Progress = Callable[[int, int, float], None]
"""Told rounds done, rounds at most, and the best candidate's cost."""


def plan_reach(
    scene: Scene,
    target_qpos: np.ndarray,
    substeps: int,
    cfg: ReachCfg = REACH,
    seed: int = 0,
    num_threads: int = 0,
    progress: Progress | None = None,
) -> ReachPlan:
    """Plan the way from the reset pose to a pre-grasp, the objects where the pre-grasp has them.

    Equal arguments give an equal plan, whatever the number of threads.

    Args:
        scene: of the task.
        target_qpos: whole scene (nq,) with the hand at its pre-grasp.
        substeps: physics steps per control step.
        cfg: how to search.
        seed: of the search.
        num_threads: 0 takes one per core.
        progress: told how far the search is.

    Raises:
        SceneError: if the target does not fit the scene, or the simulation always diverges.
        ConfigError: if the search has no time to move.
    """
    began = time.monotonic()
    search = _Search(scene, np.asarray(target_qpos, float), substeps, cfg, seed, num_threads)
    for rounds in range(1, cfg.rounds + 1):
        done = search.round()
        if progress is not None:
            progress(rounds, cfg.rounds, search.best.cost)
        if done:
            break
    return search.plan(time.monotonic() - began)


def default_steps(scene: Scene) -> int:
    """Return the length of the plans in R."""
    model, n = scene.model, scene.index.num_base_joints
    lag = model.dof_damping[:n] / model.actuator_gainprm[:n, 0]
    return SLOW_STEPS if n and lag.max() > SLOW_S else STEPS


@dataclass(frozen=True)
class _Candidate:
    """A candidate as it went."""

    vector: np.ndarray  # (D,)
    plan: ReachPlan
    cost: float
    worst: float  # largest error as a share of what is allowed

    def beats(self, other: _Candidate | None, margin: float) -> bool:
        """Return whether this one is better: within what is allowed, within the margin, by cost."""
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
        # An error that servos cannot help is not corrected again.
        self._slack = nearest
        self._slack[base:] = np.where(shift != 0, farthest[base:], nearest[base:])
        self._cem = CrossEntropy(mean, std, cfg.cem, seeding.numpy_stream(seed, "reach"))
        self._best: _Candidate | None = None
        self._rounds = self._idle = 0

    @property
    def best(self) -> _Candidate:
        """The best candidate so far.

        Raises:
            SceneError: if the simulation diverged with each.
        """
        if self._best is None:
            raise SceneError(
                f"task '{self._scene.task.id}': the simulation diverged with every plan that was "
                "tried; the pre-grasp may lie deep inside something"
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
        self._rounds += 1
        for row in elites[:_CHECKED].tolist():
            plan = self._goal.plan(actions[row], ends, row)
            depth = plan.depth_m / max(plan.target_depth_m, DEPTH_TOLERANCE_M)
            # An object may turn where it is, such as a sphere; the cost alone is against it.
            worst = max(float(shares[row, :-1].max()), depth)
            one = _Candidate(vectors[row], plan, float(cost[row]), worst)
            self._best = one if one.beats(self._best, cfg.margin) else self._best
        best = self.best
        improved = before is None or best.cost < _IMPROVED * before.cost
        self._idle = 0 if improved else self._idle + 1
        return best.worst <= cfg.margin or (best.plan.reached and self._idle >= cfg.patience)

    def plan(self, seconds: float) -> ReachPlan:
        """Return the best candidate's plan."""
        return replace(self.best.plan, rounds=self._rounds, seconds=seconds)

    def _cost(self, shares: np.ndarray, ends: Ends) -> np.ndarray:
        """Return what plans cost, (N,), infinite where the simulation diverged."""
        goal, nu = self._goal, len(self._goal.joints)
        error = (ends.qpos[:, :nu] - goal.joints) / goal.tolerance
        speed = np.abs(ends.qvel[:, :nu]) / goal.tolerance
        cost = shares.sum(1) + np.sqrt((error**2).mean(1)) + ends.peak_m / OBJECT_TOLERANCE_M
        return np.where(ends.diverged, np.inf, cost + _SPEED_WEIGHT_S * speed.mean(1))

    def _correct(self, qpos: np.ndarray) -> None:
        """Move the last targets by what the elites (E, nq) lack, as far as it is not tolerated."""
        if not len(qpos):
            return
        goal, tolerance = self._goal.joints, self._goal.tolerance
        error = (goal - qpos[:, : len(goal)]).mean(0)
        error = np.sign(error) * (np.abs(error) - self._slack).clip(0.0)
        at, limit = self._paths.layout.ends, _END_LIMIT * tolerance
        ends = self._cem.mean[at] + self._cfg.correction * error
        # Beyond the servos' ranges a correction changes nothing, and would have to be undone.
        index = self._scene.index
        ends = ends.clip(index.ctrl_low - goal, index.ctrl_high - goal)
        self._cem.mean[at] = ends.clip(-limit, limit)
