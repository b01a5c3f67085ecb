"""``pgdm pregrasp predict``: candidates from an object's shape, ranked, reached and stored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from pgdm.cli.assets import bars
from pgdm.cli.train import notify
from pgdm.config.store import compose
from pgdm.errors import ConfigError
from pgdm.experiment import threads
from pgdm.library import Motion, Start, ensure, pregrasp_file
from pgdm.library.pregrasp_file import Pregrasp
from pgdm.library.report import Progress
from pgdm.pregrasp import plans
from pgdm.pregrasp.predict import weights
from pgdm.pregrasp.predict.candidates import Candidate, propose, ranked
from pgdm.pregrasp.predict.predictor import Predictor
from pgdm.pregrasp.quality import LiftTest
from pgdm.pregrasp.reach import plan_reach
from pgdm.pregrasp.reach_plan import ReachPlan
from pgdm.sim.scene import Scene, build_scene

_SOURCE = "learned"
_TRIES = 3  # candidates to which a way is planned before the best one is taken without


@dataclass(frozen=True)
class Request:
    """What is asked for."""

    task: str
    hand: str | None
    samples: int
    seed: int
    weights: Path | None
    reach: bool
    image: Path | None
    offline: bool


def predict_pregrasp(request: Request) -> None:
    """Predict, store and tell.

    Raises:
        PgdmError: task, hand or weights are unknown, damaged or do not fit each other, or no
            candidate can be made free of contact.
    """
    if request.image is not None and request.image.suffix.lower() != ".png":
        raise ConfigError(f"--image '{request.image}' is no PNG; give a name that ends in .png")
    overrides = [f"task={request.task}", *([f"hand={request.hand}"] if request.hand else [])]
    cfg = compose(overrides)
    hand = cfg.hand.name
    predictor = weights.read(request.weights or weights.path_of(hand), hand)
    library = ensure(cfg.task.motion, request.offline, notify)
    motion = library.motion(cfg.task.motion)
    scene = build_scene(library, cfg.task, cfg.hand, cfg.sim)
    held_out = say_training(predictor, scene)
    num_threads = threads(cfg)
    with bars() as progress:
        found = propose(
            predictor, scene, lying(motion, scene), request.samples, request.seed,
            lambda i, n: progress("samples", i, n),
        )  # fmt: skip
        lift = LiftTest(scene, motion.substeps, seed=request.seed, num_threads=num_threads)
        found = ranked(found, lift, lambda i, n: progress("lift tests", i, n))
        chosen, plan = 0, None
        if request.reach:
            chosen, plan = reach(scene, found, motion.substeps, request.seed, num_threads, progress)
    best = found[chosen]
    note = {
        "held_out": held_out,
        "trained_on": list(predictor.tasks),
        "seed": request.seed,
        "rank": chosen + 1,
        "lift_rate": None if np.isnan(best.quality.lift_rate) else best.quality.lift_rate,
        "fingertip_distance_m": best.quality.fingertip_distance_m,
        "moved_m": best.moved_m,
    }
    path = pregrasp_file.path_of(scene.task.id, hand, _SOURCE)
    pose = Start(best.qpos, np.zeros(scene.model.nv), None)
    pregrasp_file.write(path, Pregrasp(pose, None, note))
    if plan is not None:
        plans.store(scene, _SOURCE, best.qpos, plan)
    show(found, chosen)
    if request.reach:
        print(f"reach: candidate {chosen + 1}, {outcome(plan)}")
    if request.image is not None:
        print(f"image: {draw(scene, found, chosen, request.image)}")
    print(f"stored: {path}")
    print(f"to use it: pgdm-run task={scene.task.id} hand={hand} pregrasp={_SOURCE}")


def say_training(predictor: Predictor, scene: Scene) -> bool:
    """Tell whether the predictor has seen the object, and return whether it has not."""
    name = scene.task.tracked_body.partition("/")[0]
    if name not in predictor.objects:
        notify(f"object '{name}' is held out: the predictor has seen no pre-grasp of it")
        return True
    notify(
        f"object '{name}' was in the training set: this is no prediction for an unseen object. "
        f"For one: pgdm pregrasp train --hand {predictor.hand} --leave-out {name}"
    )
    return False


def lying(motion: Motion, scene: Scene) -> np.ndarray:
    """Return a state (nq,) with the hand at its reset pose and the objects where episodes start.

    Raises:
        ConfigError: the motion does not store where they start.
    """
    if "mined" not in motion.starts:
        raise ConfigError(f"motion '{motion.id}' does not store where its objects start")
    stored, model = motion.starts["mined"].qpos, scene.model
    return np.concatenate((np.zeros(model.nu), stored[len(stored) - (model.nq - model.nu) :]))


def reach(
    scene: Scene,
    found: Sequence[Candidate],
    substeps: int,
    seed: int,
    num_threads: int,
    progress: Progress,
) -> tuple[int, ReachPlan | None]:
    """Return the best candidate that can be reached, and the way; if none, the best without."""
    for i, candidate in enumerate(found[:_TRIES]):
        plan = plan_reach(
            scene, candidate.qpos, substeps, seed=seed, num_threads=num_threads,
            progress=lambda done, most, _, i=i: progress(f"plan {i + 1}", done, most),
        )  # fmt: skip
        if plan.reached:
            return i, plan
        notify(f"candidate {i + 1} is not reached: {', '.join(plan.failures)}")
    return 0, None


def outcome(plan: ReachPlan | None) -> str:
    """Return how a reach ended, in words."""
    if plan is None:
        return "not reached; episodes start at the predicted pose itself"
    return (
        f"reached in {len(plan.actions)} steps: base off by {1e3 * plan.base_error_m:.1f} mm, "
        f"fingers by {plan.finger_error_rad:.2f} rad, object moved "
        f"{1e3 * plan.object_moved_m:.1f} mm"
    )


def show(found: Sequence[Candidate], chosen: int) -> None:
    """Print the candidates, best first."""
    table = Table(box=None, header_style="bold")
    for name in ("candidate", "lift rate", "fingertips off", "palm", "freed by", ""):
        table.add_column(name, justify="right" if name else "left")
    for i, one in enumerate(found):
        q = one.quality
        table.add_row(
            f"{i + 1}", f"{q.lift_rate:.0%}", f"{1e3 * q.fingertip_distance_m:.0f} mm",
            f"{q.palm_angle_rad:.2f} rad", f"{1e3 * one.moved_m:.0f} mm",
            "chosen" if i == chosen else "",
        )  # fmt: skip
    Console().print(table)


def draw(scene: Scene, found: Sequence[Candidate], chosen: int, path: Path) -> Path:
    """Write the contact sheet of the candidates."""
    from pgdm.sim.sheet import Panel, write_sheet

    panels = []
    for i, one in enumerate(found):
        q = one.quality
        title = f"{scene.task.id}  {i + 1}{'  chosen' if i == chosen else ''}"
        text = f"lift rate {q.lift_rate:.0%}, fingertips {1e3 * q.fingertip_distance_m:.0f} mm off"
        panels.append(Panel(one.qpos, title, text))
    return write_sheet(scene, panels, path)
