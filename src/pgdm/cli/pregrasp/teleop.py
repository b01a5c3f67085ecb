"""``pgdm pregrasp teleop``: cut a pre-grasp from a demonstration."""

from __future__ import annotations

from pathlib import Path

from pgdm.cli.console.screen import bars
from pgdm.cli.pregrasp.stored import planned, report_with_reach
from pgdm.cli.scenes import composed, open_scene
from pgdm.library.files import pregrasp as pregrasp_file
from pgdm.library.progress import counted
from pgdm.pregrasp.on_demand import store
from pgdm.pregrasp.sources import object_joints
from pgdm.pregrasp.teleop import cut as teleop
from pgdm.pregrasp.teleop import demonstrations


def run(
    task: str, file: Path, demo: int | None, reach: bool, image: Path | None, offline: bool
) -> None:
    """Cut and store a pre-grasp from a demonstration, and print what was found.

    Raises:
        PgdmError: the task or file is unknown or damaged, or no usable pre-grasp can be cut.
    """
    cfg = composed(task, None, offline=offline)
    teleop.layout_of(task)  # an unsupported task is reported before anything takes time
    opened = open_scene(cfg)
    motion, scene = opened.motion, opened.scene
    found = demonstrations.read(file)
    count = len(found)
    if demo is not None:
        found = [demonstrations.chosen(found, demo, str(file))]
    with bars() as progress:
        each = counted("demonstrations", found, progress)
        replays = [teleop.replay(scene, one) for one in each]
        taken = replays[0] if demo is not None else teleop.nearest(replays)
        pregrasp = teleop.cut(scene, taken, object_joints(motion, scene), file.name)
        pregrasp = planned(pregrasp, opened, reach, progress)
    path = pregrasp_file.path_of(task, scene.hand.name, "teleop")
    store(path, pregrasp)
    note = pregrasp.note
    print(
        f"demonstration {note['demonstration']} (of {count}): takes hold at step "
        f"{note['takes_hold_at']}, cut at step {note['step']}; its object was "
        f"{note['object_shift_mm']} mm from the task's; base slides would exceed their ranges by "
        f"{note['beyond_range_mm']} mm; palm error {note['palm_error_mm']} mm; penetration "
        f"{note['depth_mm']} mm"
    )
    report_with_reach(path, image, pregrasp, scene)
