"""Shared by the commands that make a pre-grasp: plan its reach, print where it is stored."""

from __future__ import annotations

from pathlib import Path

from pgdm.cli.console.screen import notify
from pgdm.cli.scenes import Opened
from pgdm.experiment import threads
from pgdm.library.files.pregrasp import Pregrasp
from pgdm.library.progress import StepProgress
from pgdm.pregrasp.on_demand import with_plan
from pgdm.pregrasp.reach.plan import ReachPlan
from pgdm.sim.scene import Scene


def planned(pregrasp: Pregrasp, opened: Opened, reach: bool, progress: StepProgress) -> Pregrasp:
    """Return a pre-grasp; if ``reach`` is set, with its reach plan, unless that is rejected."""
    if not reach:
        return pregrasp
    count = threads(opened.cfg)
    return with_plan(pregrasp, opened.scene, opened.motion, notify, progress, count)


def outcome(plan: ReachPlan) -> str:
    """Return the errors of a plan that reaches its pre-grasp, in words."""
    return (
        f"reached in {len(plan.actions)} steps: base off by {1e3 * plan.base_error_m:.1f} mm, "
        f"fingers by {plan.finger_error_rad:.2f} rad, object moved "
        f"{1e3 * plan.object_moved_m:.1f} mm"
    )


def report(path: Path, scene: Scene) -> None:
    """Print where a pre-grasp is stored, and the command that uses it."""
    print(f"stored: {path}")
    hand, source = path.parent.name, path.stem
    print(f"to use it: pgdm-run task={scene.task.id} hand={hand} pregrasp={source}")


def report_with_reach(path: Path, image: Path | None, pregrasp: Pregrasp, scene: Scene) -> None:
    """Print a pre-grasp's reach and file; if ``image`` is given, draw its pose and plan's end."""
    reach = pregrasp.note.get("reach")
    if reach:
        print(
            f"reach plan: base off by {reach['base_error_mm']} mm and {reach['base_error_rad']} "
            f"rad, joints by {reach['finger_error_rad']} rad, object moved "
            f"{reach['object_moved_mm']} mm{'' if reach['plan_taken'] else '; not used'}"
        )
    report(path, scene)
    if image is None:
        return
    from pgdm.sim.sheet import Panel, write_sheet

    title, source = f"{scene.task.id}  {scene.hand.name}", path.stem
    panels = [Panel(pregrasp.pose.qpos, title, f"{source}: the pose")]
    if pregrasp.reached is not None:
        panels.append(Panel(pregrasp.reached.qpos, title, f"{source}: after the reach plan"))
    print(f"image: {write_sheet(scene, panels, image)}")
