"""``pgdm pregrasp reach``: plan the way to pre-grasps on the simulator, and store the plans."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rich.table import Table

from pgdm.cli.errors import FAILED
from pgdm.cli.pregrasp_scenes import Tell, composed, console, each, open_scene
from pgdm.config.suites import expand_tasks
from pgdm.errors import PgdmError, UnknownNameError
from pgdm.library import pregrasp_file
from pgdm.pregrasp import plans
from pgdm.pregrasp.reach import plan_reach
from pgdm.pregrasp.reach_plan import ReachPlan
from pgdm.sim.scene import Scene

_HEADS = ("task", "result", "base mm", "rad", "fingers rad", "object mm", "deep mm", "steps", "s")


@dataclass(frozen=True)
class ReachRequest:
    """What is asked for."""

    words: Sequence[str]
    hand: str | None
    source: str
    replace: bool
    seed: int
    offline: bool


def plan_reaches(request: ReachRequest) -> int:
    """Plan, store and print; return the exit code: that of a failure if any task failed.

    Raises:
        PgdmError: if a name is unknown; what fails for one task only is in the table.
    """
    if request.source not in plans.TARGETS:
        raise UnknownNameError("--source", request.source, plans.TARGETS)
    tasks = expand_tasks(request.words)
    composed(tasks[0], request.hand)  # a wrong hand is no failure of each task
    table = Table(*_HEADS[:2], box=None, pad_edge=False)
    for head in _HEADS[2:]:
        table.add_column(head, justify="right")
    failed: list[str] = []
    try:
        with each(tasks) as rest:
            for task, tell in rest:
                try:
                    cells, reason = _one(task, request, tell)
                except PgdmError as error:
                    cells, reason = ["failed"], str(error)
                table.add_row(task, *cells)
                failed += [f"{task}: {reason}"] if reason else []
    finally:  # also after Ctrl-C: what is in the table is stored
        if table.row_count:
            console().print(table)
    for line in failed:
        print(f"failed: {line}", file=sys.stderr)
    return FAILED if failed else 0


def _one(task: str, request: ReachRequest, tell: Tell) -> tuple[list[str], str]:
    """Return a task's cells, and why it failed if it did."""
    scene, motion = open_scene(task, request.hand, request.offline)
    target = plans.pose_of(request.source, motion, scene)
    if not request.replace:
        if request.source == "mined" and plans.published(motion, scene) is not None:
            return ["published plan kept (--replace makes one of your own)"], ""
        if _is_planned(scene, request.source, target):
            return ["own plan kept (--replace makes it anew)"], ""

    def progress(done: int, total: int, cost: float) -> None:
        tell(done / total, f"round {done} of {total} at most, cost {cost:.1f}")

    plan = plan_reach(scene, target, motion.substeps, seed=request.seed, progress=progress)
    if not plan.reached:
        return ["not reached", *_figures(plan)], "; ".join(plan.failures)
    plans.store(scene, request.source, target, plan)
    return ["stored", *_figures(plan)], ""


def _is_planned(scene: Scene, source: str, target: np.ndarray) -> bool:
    """Return whether a plan to this pre-grasp is there, so that a stopped command goes on."""
    name = "planned" if source == "mined" else source
    own = pregrasp_file.find(scene.task.id, scene.hand.name, name)
    return own is not None and own.reached is not None and np.array_equal(own.pose.qpos, target)


def _figures(plan: ReachPlan) -> list[str]:
    return [
        f"{1e3 * plan.base_error_m:.1f}",
        f"{plan.base_error_rad:.3f}",
        f"{plan.finger_error_rad:.3f}",
        f"{1e3 * plan.object_moved_m:.1f}",
        f"{1e3 * plan.depth_m:.1f}",
        str(len(plan.actions)),
        f"{plan.seconds:.0f}",
    ]
