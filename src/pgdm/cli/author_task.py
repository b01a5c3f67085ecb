"""``pgdm author task``: what it prints and draws."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from pgdm.author import AuthoredTask, TaskRequest, author_task
from pgdm.cli.assets import bars
from pgdm.cli.pregrasp_predict import outcome
from pgdm.cli.train import notify
from pgdm.errors import RenderError
from pgdm.library import Library, ensure, figures, open_library
from pgdm.motion.reference import ObjectReference
from pgdm.sim.replay import motion_qpos
from pgdm.sim.sheet import Panel, write_sheet
from pgdm.wrist.path import carried_path

_PANELS = 6


def print_task(request: TaskRequest, offline: bool) -> None:
    """Make a task, say what was found and done, and draw it.

    Raises:
        PgdmError: a name or the motion is wrong, or the task cannot be kept.
    """
    library = _with_hands(offline)
    with bars() as progress:
        made = author_task(request, library, progress)
    for note in [*made.motion.notes, *made.pregrasp.notes]:
        print(f"note: {note}")
    steps = len(made.motion.poses.pos)
    print(f"task:    {made.id}, {steps} poses, {0.04 * (steps - 1):.1f} s")
    print(f"motion:  {made.motion_path}")
    print(f"file:    {made.task_path}")
    _draw(made, made.motion_path.with_suffix(".png"))
    if made.plan is None:
        print(f"next:    pgdm pregrasp label {made.id}")
        return
    if made.plan.reached:
        print(f"reach:   {outcome(made.plan)}")
    else:
        print(
            f"reach:   the pre-grasp is not reached ({'; '.join(made.plan.failures)}): episodes "
            "start at the pose itself"
        )
    print(f"next:    pgdm-run task={made.id} action=residual algo=ppo_fast")


def _with_hands(offline: bool) -> Library:
    """Open the library; an empty one is filled first, as the hands and the table come with it."""
    library = open_library()
    return library if library.hands() else ensure(figures.GRAB_TASKS[0], offline, notify)


def _draw(made: AuthoredTask, path: Path) -> None:
    poses = made.motion.poses
    try:
        write_sheet(made.scene, film_panels(made), path)
    except RenderError as error:
        notify(f"no picture: {error}")
        return
    rise = 100 * float(np.ptp(poses.pos[:, 2]))
    print(f"picture: {path} (the object rises by {rise:.0f} cm)")


def film_panels(made: AuthoredTask) -> list[Panel]:
    """Return moments of the motion, the hand carried along rigidly as a residual policy's is."""
    poses, scene = made.motion.poses, made.scene
    reference = ObjectReference(torch.from_numpy(poses.pos), torch.from_numpy(poses.quat))
    qpos = motion_qpos(scene, made.pregrasp.qpos, reference)
    base = scene.index.num_base_joints
    path = carried_path(scene.index, reference, torch.from_numpy(made.pregrasp.qpos)).numpy()
    qpos[:, :base] = path.clip(*scene.model.jnt_range[:base].T)
    moments = np.linspace(0, len(qpos) - 1, _PANELS).round().astype(int)
    return [Panel(qpos[t], f"{made.id}  {0.04 * t:.1f} s", "") for t in moments]
