"""Predicts a start state: candidates, the best one that can be reached, and its reach plan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pgdm.errors import SceneError
from pgdm.library import Motion, Start
from pgdm.library.files.pregrasp import Pregrasp
from pgdm.library.progress import Notify, StepProgress
from pgdm.pregrasp.predict.candidates import Candidate, propose, ranked
from pgdm.pregrasp.predict.predictor import Predictor, object_of
from pgdm.pregrasp.quality import LiftTest
from pgdm.pregrasp.reach.plan import ReachPlan
from pgdm.pregrasp.reach.planner import plan_reach
from pgdm.pregrasp.sources import reset_state
from pgdm.sim.scene import Scene

_TRIES = 3  # plan a reach for at most this many candidates; if all fail, use the best one


@dataclass(frozen=True)
class PredictCfg:
    """Settings of a prediction."""

    samples: int = 8
    """Largest number of candidates that are lift-tested."""
    seed: int = 0
    """Seed of the samples, the search that frees them, the lift test and the reach plan."""
    reach: bool = True
    """Whether to plan the reach."""


@dataclass(frozen=True)
class Predicted:
    """The prediction for a task."""

    candidates: list[Candidate]
    """Best first."""
    chosen: int
    """Index of the chosen candidate."""
    plan: ReachPlan | None
    """Reach plan that ends at the chosen candidate; None if none was asked for or succeeded."""
    pregrasp: Pregrasp
    """The chosen candidate, with the final state of its plan, if any, and a note on its origin."""


def predict(
    predictor: Predictor,
    scene: Scene,
    motion: Motion,
    cfg: PredictCfg,
    notify: Notify,
    progress: StepProgress,
    num_threads: int = 0,
) -> Predicted:
    """Predict a pre-grasp; equal arguments give an equal result, whatever the number of threads.

    Args:
        predictor: predictor of the scene's hand.
        scene: scene of the task.
        motion: motion of the task.
        cfg: settings of the prediction.
        notify: receives messages for the user.
        progress: receives the progress.
        num_threads: number of threads of the simulations; 0 takes one per core.

    Raises:
        ConfigError: the predictor is for another hand, the object is attached to something, or
            the motion does not store where objects start.
        SceneError: no candidate can be freed from contact, or the object's shape cannot be encoded.
    """
    held_out = _is_held_out(predictor, scene, notify)
    objects = reset_state(motion, scene)
    found = propose(predictor, scene, objects, cfg.samples, cfg.seed, progress)
    lift = LiftTest(scene, motion.substeps, seed=cfg.seed, num_threads=num_threads)
    found = ranked(found, lift, progress)
    tries = found[:_TRIES] if cfg.reach else []
    chosen, plan = _first_reached(
        scene, tries, motion.substeps, cfg.seed, notify, progress, num_threads
    )
    best = found[chosen]
    rate = best.quality.lift_rate
    note = {
        "made_by": "prediction",
        "held_out": held_out,
        "trained_on": list(predictor.tasks),
        "seed": cfg.seed,
        "rank": chosen + 1,
        "lift_rate": None if math.isnan(rate) else rate,
        "fingertip_distance_m": best.quality.fingertip_distance_m,
        "moved_m": best.moved_m,
    }
    if plan is not None:
        note["reach"] = plan.metrics()
    pose = Start(best.qpos, np.zeros(scene.model.nv), None)
    pregrasp = Pregrasp(pose, None if plan is None else plan.state, note)
    return Predicted(found, chosen, plan, pregrasp)


def _first_reached(
    scene: Scene,
    candidates: Sequence[Candidate],
    substeps: int,
    seed: int,
    notify: Notify,
    progress: StepProgress,
    num_threads: int,
) -> tuple[int, ReachPlan | None]:
    """Return index and reach plan of the first candidate that is reached; if none is, 0 and None.

    Why a candidate is not reached is passed to ``notify``.
    """
    for i, candidate in enumerate(candidates):
        try:
            plan = plan_reach(
                scene, candidate.qpos, substeps, seed=seed, num_threads=num_threads,
                progress=lambda step, done, total, i=i: progress(f"plan {i + 1}", done, total),
            )  # fmt: skip
        except SceneError as error:  # every simulation diverges
            notify(f"candidate {i + 1} is not reached: {error}")
            continue
        if plan.reached:
            return i, plan
        notify(f"candidate {i + 1} is not reached: {', '.join(plan.failures)}")
    return 0, None


def _is_held_out(predictor: Predictor, scene: Scene, notify: Notify) -> bool:
    """Return whether the predictor was fitted without the scene's object, and tell the user."""
    name = object_of(scene)
    if name not in predictor.objects:
        notify(f"object '{name}' is held out: the predictor was trained without it")
        return True
    notify(
        f"object '{name}' was in the training set: this is not a prediction for an unseen object. "
        f"To hold it out: pgdm pregrasp train --hand {predictor.hand} --leave-out {name}"
    )
    return False
