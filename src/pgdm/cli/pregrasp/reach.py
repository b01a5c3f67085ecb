"""``pgdm pregrasp reach``: plan reaches to pre-grasps in simulation, and store the plans."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rich.table import Table

from pgdm.cli.console.errors import FAILED, INTERRUPTED
from pgdm.cli.console.screen import each, tables
from pgdm.cli.scenes import composed, open_scene
from pgdm.config.suites import expand_tasks
from pgdm.errors import PgdmError
from pgdm.library.files import pregrasp as pregrasp_file
from pgdm.library.progress import StepProgress
from pgdm.pregrasp.reach import stored as plans
from pgdm.pregrasp.reach.plan import ReachPlan
from pgdm.pregrasp.reach.planner import REACH, plan_reach
from pgdm.sim.scene import Scene

_HEADS = ("task", "result", "base mm", "rad", "fingers rad", "object mm", "depth mm", "steps", "s")


@dataclass(frozen=True)
class Request:
    """What to plan, and how."""

    words: Sequence[str]
    hand: str | None
    source: str
    replace: bool
    seed: int
    offline: bool


def run(request: Request) -> int:
    """Plan and store reaches and print a table; return the exit code.

    The code is 1 if any task failed, 130 after Ctrl-C.

    Raises:
        PgdmError: if a name is unknown; failures of single tasks are only printed.
    """
    tasks = expand_tasks(request.words)
    composed(tasks[0], request.hand)  # a wrong hand is reported once, not for each task
    table = Table(*_HEADS[:2], box=None, pad_edge=False)
    for head in _HEADS[2:]:
        table.add_column(head, justify="right")
    failed: list[str] = []
    try:
        with each(tasks) as rest:
            for task, progress in rest:
                try:
                    cells, reason = _plan(task, request, progress)
                except PgdmError as error:
                    cells, reason = ["failed"], str(error)
                table.add_row(task, *cells)
                failed += [f"{task}: {reason}"] if reason else []
        code = FAILED if failed else 0
    except KeyboardInterrupt:
        print(
            "stopped; plans that the table shows as stored are kept; the same command plans the "
            "rest",
            file=sys.stderr,
        )
        code = INTERRUPTED
    if table.row_count:
        tables().print(table)
    for line in failed:
        print(f"failed: {line}", file=sys.stderr)
    return code


def _plan(task: str, request: Request, progress: StepProgress) -> tuple[list[str], str]:
    """Return a task's cells of the table, and why it failed; empty if it did not."""
    cfg = composed(task, request.hand, offline=request.offline)
    _, _, motion, scene = open_scene(cfg, progress)
    target = plans.pose_of(request.source, motion, scene)
    kept = _kept(request, scene, target, plans.published(motion, scene) is not None)
    if kept:
        return [kept], ""
    plan = plan_reach(scene, target, motion.substeps, seed=request.seed, progress=progress)
    if not plan.reached:
        return ["not reached", *_values(plan)], "; ".join(plan.failures)
    plans.store(scene, request.source, target, plan, {"reach_search": _search(request)})
    return ["stored", *_values(plan)], ""


def _kept(request: Request, scene: Scene, target: np.ndarray, published: bool) -> str:
    """Return why the existing plan is kept; empty if a reach is to be planned.

    A plan that the same search made is kept even with ``--replace``, so that a stopped command can
    be repeated.
    """
    name = "planned" if request.source == "mined" else request.source
    own = pregrasp_file.find(scene.task.id, scene.hand.name, name)
    if own is not None and own.reached is not None and np.array_equal(own.pose.qpos, target):
        if own.note.get("reach_search") == _search(request):
            return "own plan kept (this search made it)"
        return "" if request.replace else "own plan kept (--replace plans it again)"
    if request.source == "mined" and published and not request.replace:
        return "published plan kept (--replace makes your own)"
    return ""


def _search(request: Request) -> str:
    """Return what a plan depends on besides its target."""
    return f"seed {request.seed}, {REACH}"


def _values(plan: ReachPlan) -> list[str]:
    return [
        f"{1e3 * plan.base_error_m:.1f}",
        f"{plan.base_error_rad:.3f}",
        f"{plan.finger_error_rad:.3f}",
        f"{1e3 * plan.object_moved_m:.1f}",
        f"{1e3 * plan.depth_m:.1f}",
        str(len(plan.actions)),
        f"{plan.seconds:.0f}",
    ]
