"""Finds stored pre-grasps and published reach plans, and stores new plans."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pgdm.errors import ConfigError
from pgdm.library import Motion, Start
from pgdm.library.files import pregrasp as pregrasp_file
from pgdm.library.files.pregrasp import Pregrasp
from pgdm.pregrasp.reach.plan import ReachPlan
from pgdm.pregrasp.sources import is_reset_pose
from pgdm.sim.scene import Scene

TARGETS = ("mined", *(source for source in pregrasp_file.SOURCES if source != "planned"))
"""Pre-grasp sources that a reach can be planned for."""


def pose_of(source: str, motion: Motion, scene: Scene) -> np.ndarray:
    """Return the whole scene (nq,) at the pre-grasp of a source.

    It is the pre-grasp itself, not the state in which a reach to it ends. The user's own pre-grasp
    takes precedence over the one stored with the motion.

    Raises:
        ConfigError: no pre-grasp of this source is stored for the task and hand, or it is only the
            reset pose.
    """
    task, hand, nq = scene.task.id, scene.hand.name, scene.model.nq
    own = pregrasp_file.find(task, hand, source) if source in pregrasp_file.SOURCES else None
    stored = motion.starts.get(source) if own is None else own.pose
    if stored is not None and stored.qpos.shape == (nq,):
        if is_reset_pose(scene, stored.qpos):
            raise ConfigError(
                f"task '{task}' has no pre-grasp yet, it starts from the hand's reset pose; pose "
                f"one with 'pgdm pregrasp label {task}', then plan its reach with --source labeled"
            )
        return np.array(stored.qpos)
    fitting = [name for name, start in motion.starts.items() if start.qpos.shape == (nq,)]
    have = sorted({*fitting, *pregrasp_file.own(task, hand)})
    raise ConfigError(
        f"task '{task}' has no pre-grasp '{source}' for hand '{hand}'; it has: "
        f"{', '.join(have) or 'none'} (--source). 'pgdm pregrasp --help' lists how to create one"
    )


def published(motion: Motion, scene: Scene) -> Start | None:
    """Return the final state and actions of the motion's reach plan; None if none fits the hand."""
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
    """Store a reach plan in the user's folder, and return the path of the file.

    A plan to the mined pre-grasp is stored as the user's ``planned`` pre-grasp; a plan to one of
    the user's own pre-grasps is added to the file of that pre-grasp. In all other cases a new file
    gets both the pre-grasp and the plan, as the user's own pre-grasp of that source.

    Args:
        scene: scene of the task.
        source: source of the pre-grasp, one of :data:`TARGETS`.
        target: whole scene (nq,) with the hand at its pre-grasp.
        plan: the plan to this pre-grasp.
        note: further entries of the file's note, plain JSON.

    Raises:
        OSError: the file cannot be written.
    """
    task, hand = scene.task.id, scene.hand.name
    name = "planned" if source == "mined" else source
    own = None if source == "mined" else pregrasp_file.find(task, hand, source)
    if own is None:
        pose = Start(target, np.zeros(scene.model.nv), None)
        own = Pregrasp(pose, None, {"made_by": "reach plan", "source": source})
    path = pregrasp_file.path_of(task, hand, name)
    whole = {**own.note, **(note or {}), "reach": plan.metrics()}
    pregrasp_file.write(path, replace(own, reached=plan.state, note=whole))
    return path
