"""``pgdm pregrasp teleop``: a pre-grasp cut from a demonstration."""

from __future__ import annotations

from pathlib import Path

from pgdm.cli.assets import bars
from pgdm.cli.pregrasp_mocap import planned, stored
from pgdm.cli.pregrasp_scenes import composed
from pgdm.cli.train import notify
from pgdm.library import ensure, pregrasp_file
from pgdm.pregrasp import demonstrations, teleop
from pgdm.pregrasp.mocap import object_joints
from pgdm.pregrasp.provide import store
from pgdm.sim.scene import build_scene


def cut(
    task: str, file: Path, demo: int | None, reach: bool, image: Path | None, offline: bool
) -> None:
    """Cut and store a pre-grasp from a demonstration, and tell what was found.

    Raises:
        PgdmError: the task or file is unknown or damaged, or the hand never takes hold.
    """
    cfg = composed(task, None)
    teleop.layout_of(task)  # before anything takes time
    library = ensure(cfg.task.motion, offline, notify)
    motion = library.motion(cfg.task.motion)
    scene = build_scene(library, cfg.task, cfg.hand, cfg.sim)
    found = demonstrations.read(file)
    count = len(found)
    if demo is not None:
        found = [demonstrations.chosen(found, demo, str(file))]
    with bars() as progress:
        replays = []
        for i, one in enumerate(found):
            progress("demonstrations", i, len(found))
            replays.append(teleop.replay(scene, one))
        progress("demonstrations", len(found), len(found))
        taken = replays[0] if demo is not None else teleop.nearest(replays)
        pregrasp = teleop.cut(scene, taken, object_joints(motion, scene), file.name)
        pregrasp = planned(pregrasp, scene, motion, reach, cfg, progress)
    path = pregrasp_file.path_of(task, scene.hand.name, "teleop")
    store(path, pregrasp)
    note = pregrasp.note
    print(
        f"demonstration {note['demonstration']} (of {count}): takes hold at step "
        f"{note['takes_hold_at']}, cut at step {note['step']}; its object stood "
        f"{note['object_shift_mm']} mm from the task's; slides {note['beyond_range_mm']} mm beyond "
        f"their ranges; palm within {note['palm_error_mm']} mm; penetration {note['depth_mm']} mm"
    )
    stored(path, image, pregrasp, scene)
