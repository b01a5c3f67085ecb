"""Trying a pose: the hand is brought there in the simulation, and then grasps and lifts."""

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
from pgdm.library.motion_file import Start
from pgdm.pregrasp.quality import LiftTest, quality
from pgdm.pregrasp.reach import ReachPlan, plan_reach, play, reset_pose
from pgdm.sim.scene import Scene

PLAN_SHARE = 0.7
"""Of a trial's time that the planner takes, for the progress bar."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Outcome:
    """What a trial found of a pose."""

    reached: Start | None
    """Where the plan ends, with the plan; None if it does not get there."""
    note: Mapping[str, Any]
    """Figures, plain JSON."""


class _CancelError(Exception):
    """Somebody does not want to know any more."""


class Trial:
    """Tries a pose in a thread of its own.

    Args:
        scene: the task's, with the hand.
        qpos: the pose to try, (nq,).
        substeps: physics steps per control step.
        told: told how far it is (0..1), and in words.
        played: told the states of the plan, (nq,) each, at their speed; false ends the play.
        ended: told what was found, None if nothing, and in words.
    """

    def __init__(
        self,
        scene: Scene,
        qpos: np.ndarray,
        substeps: int,
        told: Callable[[float, str], None],
        played: Callable[[np.ndarray], bool],
        ended: Callable[[Outcome | None, str], None],
    ) -> None:
        self._scene, self._qpos, self._substeps = scene, qpos, substeps
        self._told, self._played, self._ended = told, played, ended
        self._cancelled = threading.Event()
        # One core is left to the page.
        self._threads = max(1, len(os.sched_getaffinity(0)) - 1)
        self._thread = threading.Thread(target=self._run, name="labeler-trial", daemon=True)
        self._thread.start()

    def cancel(self) -> None:
        """Have it end soon, with nothing found."""
        self._cancelled.set()

    def _run(self) -> None:
        outcome, text = None, "cancelled"
        try:
            outcome, text = self._tried()
        except _CancelError:
            pass
        except PgdmError as error:
            text = f"not tried: {error}"
        except Exception as error:  # noqa: BLE001 a defect must not leave the page waiting
            _log.exception("the trial failed")
            text = f"not tried, a defect of pgdm: {type(error).__name__}: {error}"
        self._ended(outcome, text)

    def _tried(self) -> tuple[Outcome, str]:
        began = time.monotonic()
        self._told(0.0, "planning the way there")

        def progress(done: int, rounds: int, cost: float) -> None:
            self._check()
            left = (time.monotonic() - began) / done * (rounds - done)
            text = f"planning the way there: round {done} of at most {rounds}, {left:.0f} s left"
            self._told(PLAN_SHARE * done / rounds, text)

        scene = self._scene
        plan = plan_reach(
            scene, self._qpos, self._substeps, num_threads=self._threads, progress=progress
        )
        self._told(PLAN_SHARE, "grasping and lifting")
        start = plan.state if plan.reached else Start(self._qpos, np.zeros(scene.model.nv), None)
        lift = LiftTest(scene, self._substeps, num_threads=self._threads)(start)
        self._check()
        words = [_reach_words(plan), _lift_words(lift)]
        note = {"reached": plan.reached, **_figures(plan, lift, self._palm_angle())}
        text = "; ".join(words)
        self._told(1.0, text)
        self._play(plan)
        return Outcome(plan.state if plan.reached else None, note), text

    def _play(self, plan: ReachPlan) -> None:
        dt = self._scene.model.opt.timestep * self._substeps
        home = reset_pose(self._scene, self._qpos)
        for qpos in play(self._scene, plan.actions, home, self._substeps).qpos:
            if self._cancelled.is_set() or not self._played(qpos):
                return
            time.sleep(dt)

    def _palm_angle(self) -> float:
        return quality(self._scene, self._qpos, self._substeps, None).palm_angle_rad

    def _check(self) -> None:
        if self._cancelled.is_set():
            raise _CancelError


def _figures(plan: ReachPlan, lift: float, palm_angle_rad: float) -> dict[str, float]:
    names = ("base_error_m", "base_error_rad", "finger_error_rad", "object_moved_m", "seconds")
    figures = {f"reach_{name}": float(getattr(plan, name)) for name in names}
    figures["palm_angle_rad"] = palm_angle_rad
    # A door has no lift rate, and JSON no NaN.
    return figures if math.isnan(lift) else figures | {"lift_rate": lift}


def _reach_words(plan: ReachPlan) -> str:
    if not plan.reached:
        return f"the hand does not get there: {', '.join(plan.failures)}"
    missed = max(plan.base_error_rad, plan.finger_error_rad)
    return (
        f"the hand gets there, to {1e3 * plan.base_error_m:.1f} mm and {missed:.2f} rad, and moves "
        f"the object by {1e3 * plan.object_moved_m:.1f} mm"
    )


def _lift_words(lift: float) -> str:
    if math.isnan(lift):
        return "the object cannot be lifted"
    return f"{lift:.0%} of random closing policies lift it"
