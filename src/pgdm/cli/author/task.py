"""``pgdm author task``: make a task from an object, a hand and a motion; print and draw it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from pgdm.author import AuthoredTask, TaskRequest, author_task
from pgdm.cli.console.screen import bars, notify
from pgdm.cli.pregrasp.stored import outcome
from pgdm.errors import RenderError
from pgdm.library import Library, ensure, open_library
from pgdm.library.progress import StepProgress
from pgdm.library.tasks import MOCAP_TASKS
from pgdm.motion.reference import ObjectReference
from pgdm.sim.motion_states import motion_qpos
from pgdm.sim.sheet import Panel, write_sheet
from pgdm.wrist.path import carried_path

_PANELS = 6
_PICTURE = "drawing"
_STEPS = ("pre-grasp search", "lift tests", "reach plan", _PICTURE)


def run(request: TaskRequest, offline: bool) -> None:
    """Make a task, print what was changed and stored, and draw it.

    Raises:
        PgdmError: a name or the motion is wrong, or the task cannot be stored.
    """
    with bars() as progress:
        for step in _STEPS:  # so that the display lists all steps from the start
            progress(step, 0, 1)
        made = author_task(request, _with_hands(offline, progress), progress)
        progress(_PICTURE, 0, 1)
        drawn = _draw(made, made.motion_path.with_suffix(".png"))
    for note in [*made.motion.notes, *made.pregrasp.notes]:
        print(f"note: {note}")
    steps = len(made.motion.poses.pos)
    print(f"task:    {made.id}, {steps} poses, {0.04 * (steps - 1):.1f} s")
    print(f"motion:  {made.motion_path}")
    print(f"file:    {made.task_path}")
    print(drawn)
    if made.plan is None:
        print(f"next:    pgdm pregrasp label {made.id}")
        return
    if made.plan.reached:
        print(f"reach:   {outcome(made.plan)}")
    else:
        print(
            f"reach:   the pre-grasp is not reached ({'; '.join(made.plan.failures)}); episodes "
            "start at the pre-grasp itself"
        )
    print(f"next:    pgdm-run +experiment=fast task={made.id}")


def _with_hands(offline: bool, progress: StepProgress) -> Library:
    """Open the library, which provides hands and table; if it is empty, fill it first."""
    library = open_library()
    if library.is_filled:
        return library
    return ensure(MOCAP_TASKS[0], offline, notify, progress=progress)


def _draw(made: AuthoredTask, path: Path) -> str:
    """Draw a task, and return a line about its picture."""
    poses = made.motion.poses
    try:
        write_sheet(made.scene, film_panels(made), path)
    except RenderError as error:
        return f"picture: none ({error})"
    rise = 100 * float(np.ptp(poses.pos[:, 2]))
    return f"picture: {path} (the object rises by {rise:.0f} cm)"


def film_panels(made: AuthoredTask) -> list[Panel]:
    """Return pictures of the motion; the hand moves rigidly with the object (zero residuals)."""
    poses, scene = made.motion.poses, made.scene
    reference = ObjectReference(torch.from_numpy(poses.pos), torch.from_numpy(poses.quat))
    qpos = motion_qpos(scene, made.pregrasp.qpos, reference)
    base = scene.index.num_base_joints
    path = carried_path(scene.index, reference, torch.from_numpy(made.pregrasp.qpos)).numpy()
    qpos[:, :base] = path.clip(*scene.model.jnt_range[:base].T)
    moments = np.linspace(0, len(qpos) - 1, _PANELS).round().astype(int)
    return [Panel(qpos[t], f"{made.id}  {0.04 * t:.1f} s", "") for t in moments]
