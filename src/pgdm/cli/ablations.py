"""``pgdm view TASK --ablations``: the start of an episode under each ablation, side by side."""

from __future__ import annotations

from pathlib import Path

from pgdm.cli.view import View
from pgdm.config.compose import compose
from pgdm.config.groups import available
from pgdm.errors import ConfigError
from pgdm.pregrasp.ablation.ablate import FINGERS, Ablated, ablate


def view_ablations(view: View, image: Path | None) -> None:
    """Write the contact sheet of a task's ablated starts.

    Raises:
        PgdmError: if ``image`` is None, there is no pre-grasp to ablate, assets are missing, or
            nothing can be drawn.
    """
    if image is None:
        raise ConfigError("--ablations needs --image FILE that ends in .png")
    if view.pregrasp == "none":
        raise ConfigError("--ablations needs a pre-grasp to ablate, not --pregrasp none")
    builder = view.open_at_start()
    scene, start, task = builder.scene, builder.mdp.start, view.task
    from pgdm.sim.sheet import Panel, write_sheet

    found = [compose([f"ablation={name}"]).ablation for name in available("ablation")]
    found.sort(key=lambda a: (a.changes_start, a.distance_m, FINGERS.index(a.fingers)))
    panels = []
    for ablation in found:
        ablated = ablate(ablation, start, scene, builder.motion.substeps)
        title = f"{task}  {ablation.name}" if ablation.changes_start else f"{task}  {start.source}"
        text = _described(ablated, ablation.distance_m)
        panels.append(Panel(ablated.start.qpos, title, text))
        print(f"{ablation.name:16}{text}")
    print(f"image: {write_sheet(scene, panels, image)}")


def _described(ablated: Ablated, wanted_m: float) -> str:
    parts = [f"penetration {1e3 * ablated.depth_m:.1f} mm"]
    if ablated.distance_m > ablated.retreat_m:
        parts.append(f"hand {1e2 * ablated.distance_m:.1f} cm away")
    return ", ".join(filter(None, (*parts, ablated.compromises(wanted_m))))
