"""``pgdm pregrasp predict``: candidates from an object's shape, ranked, reached and stored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from pgdm.cli.assets import bars
from pgdm.cli.pregrasp_scenes import composed
from pgdm.cli.train import notify
from pgdm.errors import ConfigError
from pgdm.experiment import threads
from pgdm.library import ensure, pregrasp_file
from pgdm.pregrasp.predict import weights
from pgdm.pregrasp.predict.candidates import Candidate
from pgdm.pregrasp.predict.predicted import PredictCfg, predict
from pgdm.pregrasp.provide import store
from pgdm.pregrasp.reach_plan import ReachPlan
from pgdm.sim.scene import Scene, build_scene

_SOURCE = "learned"


@dataclass(frozen=True)
class Request:
    """What is asked for."""

    task: str
    hand: str | None
    how: PredictCfg
    weights: Path | None
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
    cfg = composed(request.task, request.hand)
    hand = cfg.hand.name
    predictor = weights.read(request.weights or weights.path_of(hand), hand)
    library = ensure(cfg.task.motion, request.offline, notify)
    motion = library.motion(cfg.task.motion)
    scene = build_scene(library, cfg.task, cfg.hand, cfg.sim)
    with bars() as progress:
        made = predict(predictor, scene, motion, request.how, notify, progress, threads(cfg))
    path = pregrasp_file.path_of(scene.task.id, hand, _SOURCE)
    store(path, made.pregrasp)
    show(made.candidates, made.chosen)
    if request.how.reach:
        print(f"reach: candidate {made.chosen + 1}, {outcome(made.plan)}")
    if request.image is not None:
        print(f"image: {draw(scene, made.candidates, made.chosen, request.image)}")
    print(f"stored: {path}")
    print(f"to use it: pgdm-run task={scene.task.id} hand={hand} pregrasp={_SOURCE}")


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
