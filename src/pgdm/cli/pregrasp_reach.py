"""``pgdm pregrasp reach``: plan the way to pre-grasps on the simulator, and store the plans."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rich.table import Table

from pgdm.cli.errors import FAILED, INTERRUPTED
from pgdm.cli.pregrasp_scenes import Tell, composed, console, each, open_scene
from pgdm.config.suites import expand_tasks
from pgdm.errors import PgdmError, UnknownNameError
from pgdm.library import pregrasp_file
from pgdm.pregrasp import plans
from pgdm.pregrasp.reach import REACH, plan_reach
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
        code = FAILED if failed else 0
    except KeyboardInterrupt:
        print(
            "stopped; the plans in the table are stored, the same command goes on", file=sys.stderr
        )
        code = INTERRUPTED
    if table.row_count:
        console().print(table)
    for line in failed:
        print(f"failed: {line}", file=sys.stderr)
    return code


def _one(task: str, request: ReachRequest, tell: Tell) -> tuple[list[str], str]:
    """Return a task's cells, and why it failed if it did."""
    scene, motion = open_scene(task, request.hand, request.offline)
    target = plans.pose_of(request.source, motion, scene)
    kept = _kept(request, scene, target, plans.published(motion, scene) is not None)
    if kept:
        return [kept], ""

    def progress(done: int, total: int, cost: float) -> None:
        tell(done / total, f"round {done} of {total} at most, cost {cost:.1f}")

    plan = plan_reach(scene, target, motion.substeps, seed=request.seed, progress=progress)
    if not plan.reached:
        return ["not reached", *_figures(plan)], "; ".join(plan.failures)
    plans.store(scene, request.source, target, plan, {"reach_search": _search(request)})
    return ["stored", *_figures(plan)], ""


def _kept(request: ReachRequest, scene: Scene, target: np.ndarray, published: bool) -> str:
    """Return why nothing is to be planned, or nothing if something is.

    What this very search has found before is kept in any case, so that a stopped command goes on.
    """
    name = "planned" if request.source == "mined" else request.source
    own = pregrasp_file.find(scene.task.id, scene.hand.name, name)
    if own is not None and own.reached is not None and np.array_equal(own.pose.qpos, target):
        if own.note.get("reach_search") == _search(request):
            return "own plan kept (this search made it)"
        return "" if request.replace else "own plan kept (--replace makes it anew)"
    if request.source == "mined" and published and not request.replace:
        return "published plan kept (--replace makes one of your own)"
    return ""


def _search(request: ReachRequest) -> str:
    """Return what a plan depends on besides its target."""
    return f"seed {request.seed}, {REACH}"


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
