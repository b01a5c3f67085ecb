"""A trial of a pose in simulation: plan the reach to the pose, then grasp and lift."""

from __future__ import annotations

import logging
import math
import os
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pgdm.errors import PgdmError
from pgdm.library.files.motion import Start
from pgdm.pregrasp.quality import LiftTest, quality
from pgdm.pregrasp.reach.plan import ReachPlan
from pgdm.pregrasp.reach.planner import plan_reach
from pgdm.pregrasp.reach.rollout import play
from pgdm.pregrasp.sources import reset_pose
from pgdm.sim.scene import Scene

PLAN_SHARE = 0.7
"""Share of a trial's time that the reach planner takes, for the progress bar."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Outcome:
    """Result of a trial."""

    reached: Start | None
    """State in which the planned reach ends; None if it fails to reach the pose."""
    note: Mapping[str, Any]
    """Metrics as plain JSON, for the note of the pre-grasp's file."""


class _CancelError(Exception):
    """The user has cancelled the trial."""


class Trial:
    """Tries a pose in a thread of its own.

    Args:
        scene: scene of the task with the hand.
        qpos: the pose to try (nq,).
        substeps: physics steps per control step.
        on_progress: receives the progress (0..1) and its description.
        on_state: receives states (nq,) of the planned reach in real time; returns False to stop.
        on_end: receives the outcome (None if cancelled or failed) and its description.
    """

    def __init__(
        self,
        scene: Scene,
        qpos: np.ndarray,
        substeps: int,
        on_progress: Callable[[float, str], None],
        on_state: Callable[[np.ndarray], bool],
        on_end: Callable[[Outcome | None, str], None],
    ) -> None:
        self._scene, self._qpos, self._substeps = scene, qpos, substeps
        self._on_progress, self._on_state, self._on_end = on_progress, on_state, on_end
        self._cancelled = threading.Event()
        self._threads = max(1, len(os.sched_getaffinity(0)) - 1)  # leaves a core to the page
        self._thread = threading.Thread(target=self._run, name="labeler-trial", daemon=True)
        self._thread.start()

    def cancel(self) -> None:
        """Stop the trial soon: without an outcome, unless the plan is already being played."""
        self._cancelled.set()

    def _run(self) -> None:
        outcome, text = None, "cancelled"
        try:
            outcome, text = self._tried()
        except _CancelError:
            pass
        except PgdmError as error:
            text = f"trial failed: {error}"
        except Exception as error:  # noqa: BLE001 a bug must not leave the page waiting
            _log.exception("the trial failed")
            text = f"trial failed, bug in pgdm: {type(error).__name__}: {error}"
        self._on_end(outcome, text)

    def _tried(self) -> tuple[Outcome, str]:
        began = time.monotonic()
        self._on_progress(0.0, "planning the reach")

        def progress(step: str, done: int, total: int) -> None:
            self._check()
            if not done:  # the time left is unknown before the first round
                return
            left = (time.monotonic() - began) / done * (total - done)
            text = f"planning the reach: round {done} of at most {total}, {left:.0f} s left"
            self._on_progress(PLAN_SHARE * done / total, text)

        scene = self._scene
        plan = plan_reach(
            scene, self._qpos, self._substeps, num_threads=self._threads, progress=progress
        )
        self._on_progress(PLAN_SHARE, "grasping and lifting")
        start = plan.state if plan.reached else Start(self._qpos, np.zeros(scene.model.nv), None)
        lift = LiftTest(scene, self._substeps, num_threads=self._threads)(start)
        self._check()
        palm = quality(scene, self._qpos, self._substeps, None).palm_angle_rad
        note = {"reached": plan.reached, **_metrics(plan, lift, palm)}
        text = f"{_reach_text(plan)}; {_lift_text(lift)}"
        self._on_progress(1.0, text)
        self._play(plan)
        return Outcome(plan.state if plan.reached else None, note), text

    def _play(self, plan: ReachPlan) -> None:
        dt = self._scene.model.opt.timestep * self._substeps
        home = reset_pose(self._scene, self._qpos)
        for qpos in play(self._scene, plan.actions, home, self._substeps).qpos:
            if self._cancelled.is_set() or not self._on_state(qpos):
                return
            time.sleep(dt)

    def _check(self) -> None:
        if self._cancelled.is_set():
            raise _CancelError


def _metrics(plan: ReachPlan, lift: float, palm_angle_rad: float) -> dict[str, float]:
    names = ("base_error_m", "base_error_rad", "finger_error_rad", "object_moved_m", "seconds")
    metrics = {f"reach_{name}": float(getattr(plan, name)) for name in names}
    metrics["palm_angle_rad"] = palm_angle_rad
    return metrics if math.isnan(lift) else metrics | {"lift_rate": lift}  # JSON has no NaN


def _reach_text(plan: ReachPlan) -> str:
    if not plan.reached:
        return f"the hand does not reach the pose: {', '.join(plan.failures)}"
    missed = max(plan.base_error_rad, plan.finger_error_rad)
    return (
        f"the hand reaches the pose within {1e3 * plan.base_error_m:.1f} mm and {missed:.2f} rad, "
        f"and moves the object by {1e3 * plan.object_moved_m:.1f} mm"
    )


def _lift_text(lift: float) -> str:
    if math.isnan(lift):
        return "the object cannot be lifted"
    return f"{lift:.0%} of random closing policies lift the object"
