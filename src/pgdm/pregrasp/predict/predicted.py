"""From a predictor to a start: candidates, the best one that can be reached, and the way there."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pgdm.errors import ConfigError
from pgdm.library import Motion, Start
from pgdm.library.pregrasp_file import Pregrasp
from pgdm.library.report import Progress
from pgdm.pregrasp import plans
from pgdm.pregrasp.predict.candidates import Candidate, propose, ranked
from pgdm.pregrasp.predict.predictor import Predictor, object_of
from pgdm.pregrasp.quality import LiftTest
from pgdm.pregrasp.reach import plan_reach
from pgdm.pregrasp.reach_plan import ReachPlan
from pgdm.sim.scene import Scene

_TRIES = 3  # candidates to which a way is planned before the best one is taken without


@dataclass(frozen=True)
class PredictCfg:
    """How a start is predicted."""

    samples: int = 8
    """Candidates that are lift-tested."""
    seed: int = 0
    """Of samples, lift test and reach plan."""
    reach: bool = True
    """Whether a way there is planned."""


@dataclass(frozen=True)
class Predicted:
    """What was predicted for a task."""

    candidates: list[Candidate]
    """Best first."""
    chosen: int
    """Number of the one that is taken."""
    plan: ReachPlan | None
    """That leads there, if one does."""
    pregrasp: Pregrasp
    """The one that is taken, with its plan and a note of how it was made."""


def predict(
    predictor: Predictor,
    scene: Scene,
    motion: Motion,
    cfg: PredictCfg,
    notify: Callable[[str], None],
    progress: Progress,
    num_threads: int = 0,
) -> Predicted:
    """Predict a pre-grasp; equal arguments give an equal one, whatever the number of threads.

    Args:
        predictor: of the scene's hand.
        scene: of the task.
        motion: of the task.
        cfg: how.
        notify: told in a sentence what people should know.
        progress: told how far it is.
        num_threads: 0 takes one per core.

    Raises:
        ConfigError: the predictor is of another hand, the object hangs on something, or the motion
            does not store where objects start.
        SceneError: no candidate can be made free of contact.
    """
    held_out = _say_training(predictor, scene, notify)
    found = propose(
        predictor, scene, _lying(motion, scene), cfg.samples, cfg.seed,
        lambda i, n: progress("samples", i, n),
    )  # fmt: skip
    lift = LiftTest(scene, motion.substeps, seed=cfg.seed, num_threads=num_threads)
    found = ranked(found, lift, lambda i, n: progress("lift tests", i, n))
    chosen, plan = 0, None
    for i, candidate in enumerate(found[:_TRIES] if cfg.reach else ()):
        tried = plan_reach(
            scene, candidate.qpos, motion.substeps, seed=cfg.seed, num_threads=num_threads,
            progress=lambda done, most, _, i=i: progress(f"plan {i + 1}", done, most),
        )  # fmt: skip
        if tried.reached:
            chosen, plan = i, tried
            break
        notify(f"candidate {i + 1} is not reached: {', '.join(tried.failures)}")
    best = found[chosen]
    note = {
        "made_by": "prediction",
        "held_out": held_out,
        "trained_on": list(predictor.tasks),
        "seed": cfg.seed,
        "rank": chosen + 1,
        "lift_rate": None if math.isnan(best.quality.lift_rate) else best.quality.lift_rate,
        "fingertip_distance_m": best.quality.fingertip_distance_m,
        "moved_m": best.moved_m,
    }
    if plan is not None:
        note["reach"] = plans.figures(plan)
    pose = Start(best.qpos, np.zeros(scene.model.nv), None)
    pregrasp = Pregrasp(pose, None if plan is None else plan.state, note)
    return Predicted(found, chosen, plan, pregrasp)


def _say_training(predictor: Predictor, scene: Scene, notify: Callable[[str], None]) -> bool:
    """Tell whether the predictor has seen the object, and return whether it has not."""
    name = object_of(scene)
    if name not in predictor.objects:
        notify(f"object '{name}' is held out: the predictor has seen no pre-grasp of it")
        return True
    notify(
        f"object '{name}' was in the training set: this is no prediction for an unseen object. "
        f"For one: pgdm pregrasp train --hand {predictor.hand} --leave-out {name}"
    )
    return False


def _lying(motion: Motion, scene: Scene) -> np.ndarray:
    """Return a state (nq,) with the hand at its reset pose and the objects where episodes start."""
    if "mined" not in motion.starts:
        raise ConfigError(f"motion '{motion.id}' does not store where its objects start")
    stored, model = motion.starts["mined"].qpos, scene.model
    return np.concatenate((np.zeros(model.nu), stored[len(stored) - (model.nq - model.nu) :]))
