"""``pgdm view TASK --ablations``: the start of an episode under each ablation, side by side."""

from __future__ import annotations

from pathlib import Path

from pgdm.cli.pregrasp_scenes import composed
from pgdm.cli.train import notify
from pgdm.config.groups import available
from pgdm.config.store import compose
from pgdm.errors import ConfigError
from pgdm.experiment import assets, env_builder
from pgdm.pregrasp.ablate import FINGERS, ablate
from pgdm.pregrasp.ablated import Ablated
from pgdm.pregrasp.sources import start_state


def view_ablations(
    task: str, hand: str | None, image: Path | None, pregrasp: str, offline: bool
) -> None:
    """Write the contact sheet of a task's ablated starts.

    Raises:
        PgdmError: if the task is unknown, its assets are missing, or nothing can be drawn.
    """
    if image is None or image.suffix.lower() != ".png":
        given = f"not '{image}'" if image else "and none is given"
        raise ConfigError(f"--ablations needs --image FILE that ends in .png, {given}")
    cfg = composed(task, hand, f"pregrasp={pregrasp}", f"offline={str(offline).lower()}")
    if cfg.pregrasp.source == "none":
        raise ConfigError("--ablations with pregrasp none: without a pre-grasp nothing is ablated")
    builder = env_builder(cfg, assets(cfg, notify))
    for note in builder.notes:
        notify(note)
    scene, motion = builder.scene, builder.motion
    from pgdm.sim.sheet import Panel, write_sheet

    stored = start_state(cfg.pregrasp, motion, scene)
    found = [compose([f"ablation={name}"]).ablation for name in available("ablation")]
    found.sort(key=lambda a: (a.changes_start, a.distance_m, FINGERS.index(a.fingers)))
    panels = []
    for ablation in found:
        ablated = ablate(ablation, stored, scene, motion.substeps)
        title = f"{task}  {ablation.name}" if ablation.changes_start else f"{task}  {stored.source}"
        text = _figures(ablated, ablation.distance_m)
        panels.append(Panel(ablated.start.qpos, title, text))
        print(f"{ablation.name:16}{text}")
    print(f"image: {write_sheet(scene, panels, image)}")


def _figures(ablated: Ablated, asked_m: float) -> str:
    parts = [f"penetration {1e3 * ablated.depth_m:.1f} mm"]
    if ablated.distance_m > ablated.retreat_m:
        parts.append(f"wrist {1e2 * ablated.distance_m:.1f} cm off")
    return ", ".join(filter(None, (*parts, ablated.compromises(asked_m))))
