"""``pgdm pregrasp predict``: predict a pre-grasp from an object's shape, and store it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.table import Table

from pgdm.cli.console.screen import bars, console, notify
from pgdm.cli.pregrasp.stored import outcome, report
from pgdm.cli.scenes import composed, open_scene
from pgdm.experiment import threads
from pgdm.library.files import pregrasp as pregrasp_file
from pgdm.pregrasp.on_demand import store
from pgdm.pregrasp.predict import weights
from pgdm.pregrasp.predict.candidates import Candidate
from pgdm.pregrasp.predict.predicted import PredictCfg, predict
from pgdm.sim.scene import Scene


def run(
    task: str,
    hand: str | None,
    how: PredictCfg,
    file: Path | None,
    image: Path | None,
    offline: bool,
) -> None:
    """Predict a pre-grasp, store it, and print the candidates.

    Raises:
        PgdmError: task, hand or weights are unknown, damaged or do not fit each other, or no
            candidate can be moved out of contact.
    """
    cfg = composed(task, hand, offline=offline)
    predictor = weights.read(file or weights.path_of(cfg.hand.name), cfg.hand.name)
    _, _, motion, scene = open_scene(cfg)
    with bars() as progress:
        made = predict(predictor, scene, motion, how, notify, progress, threads(cfg))
    path = pregrasp_file.path_of(scene.task.id, scene.hand.name, "learned")
    store(path, made.pregrasp)
    _print_candidates(made.candidates, made.chosen)
    if how.reach:
        result = "not reached; episodes start at the predicted pose itself"
        result = result if made.plan is None else outcome(made.plan)
        print(f"reach: candidate {made.chosen + 1}, {result}")
    if image is not None:
        print(f"image: {_draw(scene, made.candidates, made.chosen, image)}")
    report(path, scene)


def _print_candidates(found: Sequence[Candidate], chosen: int) -> None:
    """Print the candidates, best first."""
    table = Table(box=None, header_style="bold")
    for name in ("candidate", "lift rate", "fingertip distance", "palm", "moved by", ""):
        table.add_column(name, justify="right" if name else "left")
    for i, one in enumerate(found):
        q = one.quality
        table.add_row(
            f"{i + 1}", f"{q.lift_rate:.0%}", f"{1e3 * q.fingertip_distance_m:.0f} mm",
            f"{q.palm_angle_rad:.2f} rad", f"{1e3 * one.moved_m:.0f} mm",
            "chosen" if i == chosen else "",
        )  # fmt: skip
    console().print(table)


def _draw(scene: Scene, found: Sequence[Candidate], chosen: int, path: Path) -> Path:
    """Write the contact sheet of the candidates."""
    from pgdm.sim.sheet import Panel, write_sheet

    panels = []
    for i, one in enumerate(found):
        q = one.quality
        title = f"{scene.task.id}  {i + 1}{'  chosen' if i == chosen else ''}"
        text = f"lift rate {q.lift_rate:.0%}, fingertips {1e3 * q.fingertip_distance_m:.0f} mm away"
        panels.append(Panel(one.qpos, title, text))
    return write_sheet(scene, panels, path)
