"""Pre-grasps to reach and the plans that lead there: what is stored, and storing one's own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pgdm.errors import ConfigError
from pgdm.library import Motion, Start, pregrasp_file
from pgdm.library.pregrasp_file import Pregrasp
from pgdm.pregrasp.reach_plan import ReachPlan
from pgdm.sim.scene import Scene

TARGETS = ("mined", *(source for source in pregrasp_file.SOURCES if source != "planned"))
"""Sources whose pre-grasps a reach can lead to."""


def pose_of(source: str, motion: Motion, scene: Scene) -> np.ndarray:
    """Return a source's pre-grasp as it was asked for, before any reach: whole scene (nq,).

    The user's own goes before one that is stored with the motion.

    Raises:
        ConfigError: if there is none for this task and hand.
    """
    task, hand, nq = scene.task.id, scene.hand.name, scene.model.nq
    own = pregrasp_file.find(task, hand, source) if source in pregrasp_file.SOURCES else None
    stored = motion.starts.get(source) if own is None else own.pose
    if stored is not None and stored.qpos.shape == (nq,):
        if stored.is_reset_pose(scene.model.nu):
            raise ConfigError(
                f"task '{task}' has no pre-grasp yet, it starts from the hand's reset pose; pose "
                f"one with 'pgdm pregrasp label {task}', then reach it with --source labeled"
            )
        return np.array(stored.qpos)
    fitting = [name for name, start in motion.starts.items() if start.qpos.shape == (nq,)]
    have = sorted({*fitting, *pregrasp_file.own(task, hand)})
    raise ConfigError(
        f"task '{task}' has no pre-grasp '{source}' for hand '{hand}'; it has: "
        f"{', '.join(have) or 'none'} (--source). 'pgdm pregrasp --help' lists how to make one"
    )


def published(motion: Motion, scene: Scene) -> Start | None:
    """Return the plan that is stored with the motion, or None if there is none for this hand."""
    start = motion.starts.get("planned")
    if start is None or start.actions is None or start.qpos.shape != (scene.model.nq,):
        return None
    return start


def store(
    scene: Scene,
    source: str,
    target: np.ndarray,
    plan: ReachPlan,
    note: Mapping[str, Any] | None = None,
) -> Path:
    """Write a plan to the user's own pre-grasps, and return the file.

    A plan that leads to the mined pre-grasp becomes the user's ``planned``; one that leads to a
    pre-grasp of the user's own is written beside it.

    Args:
        scene: of the task.
        source: of the pre-grasp, of :data:`TARGETS`.
        target: whole scene (nq,) with the hand at its pre-grasp.
        plan: that leads there.
        note: what else to write down, plain JSON.

    Raises:
        OSError: if it cannot be written.
    """
    task, hand = scene.task.id, scene.hand.name
    name = "planned" if source == "mined" else source
    own = None if source == "mined" else pregrasp_file.find(task, hand, source)
    if own is None:
        pose = Start(target, np.zeros(scene.model.nv), None)
        own = Pregrasp(pose, None, {"made_by": "reach plan", "source": source})
    path = pregrasp_file.path_of(task, hand, name)
    whole = {**own.note, **(note or {}), "reach": figures(plan)}
    pregrasp_file.write(path, replace(own, reached=plan.state, note=whole))
    return path


def figures(plan: ReachPlan) -> Mapping[str, Any]:
    """Return a plan's figures as plain JSON; not its time, so that equal plans give equal files."""
    return {
        "reached": plan.reached,
        "steps": len(plan.actions),
        "base_error_m": plan.base_error_m,
        "base_error_rad": plan.base_error_rad,
        "finger_error_rad": plan.finger_error_rad,
        "object_moved_m": plan.object_moved_m,
        "object_turned_rad": plan.object_turned_rad,
        "depth_m": plan.depth_m,
        "target_depth_m": plan.target_depth_m,
        "beyond_m": plan.beyond_m,
        "beyond_rad": plan.beyond_rad,
        "rounds": plan.rounds,
    }
