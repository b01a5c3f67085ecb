"""Playing a playback on a Franka arm over its control interface; an optional extra.

The arm follows with the joint impedance controller of franky, a PD controller with Franka's gravity
compensation, as in the paper. Only the arm is commanded: a hand needs its own driver.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pgdm.deploy.limits import JOINTS, smooth, usage
from pgdm.deploy.playback import Playback
from pgdm.errors import ConfigError, PgdmError

MOST_LAG_RAD = 0.2
"""The arm is stopped if a joint is farther than this from its command."""
STIFFNESS = np.array([600.0, 600.0, 600.0, 600.0, 250.0, 150.0, 50.0])  # N m/rad, Franka's example

_PERIOD_S = 0.004
_POLL_S = 0.05
_APPROACH = 0.1  # share of the arm's speed, acceleration and jerk on the way to the start
_NEAR_RAD = 0.1  # largest distance of a joint from the start at which the playback may begin


class RobotError(PgdmError):
    """The arm cannot be reached, refuses to move, or was stopped."""


@dataclass(frozen=True)
class Played:
    """What the arm did."""

    time_s: float
    """Time of the playback that was reached, s."""
    lag_rad: np.ndarray  # (7,) largest distance between command and joint
    whole: bool
    """Whether the playback was played to its end."""


def check_playable(playback: Playback) -> None:
    """Check a playback against the limits of the arm.

    Raises:
        ConfigError: if it exceeds a limit; the message names one violation.
    """
    used = usage(playback.time_s, playback.arm_joints_rad)
    if used.violations:
        raise ConfigError(
            f"the arm cannot play this: {used.violations[0].described}; 'pgdm deploy check' lists "
            "each joint's worst violation of each limit; 'pgdm deploy export --speed 0.5' "
            "makes a slower playback"
        )


class Player:
    """A connection to one arm.

    Args:
        host: name or address of the arm's control unit.
        realtime: whether to require a real-time kernel on this computer.

    Raises:
        ConfigError: if franky is not installed.
        RobotError: if the arm cannot be reached.
    """

    def __init__(self, host: str, realtime: bool = True) -> None:
        try:
            import franky
        except ImportError as error:
            raise ConfigError(
                f"playing needs franky ({error}): pip install -c constraints.txt -e '.[hardware]'"
            ) from error
        self._franky = franky
        wanted = franky.RealtimeConfig.Enforce if realtime else franky.RealtimeConfig.Ignore
        try:
            self._robot = franky.Robot(host, realtime_config=wanted)
        except Exception as error:  # franky's exceptions have no common base class
            raise RobotError(f"no arm answers at '{host}': {_line(error)}") from error

    @property
    def joints(self) -> np.ndarray:
        """The arm's current joint positions, (7,) rad."""
        return np.array([float(q) for q in self._robot.current_joint_state.position])

    def approach(self, playback: Playback, stop: Callable[[], bool] = lambda: False) -> bool:
        """Move slowly to the start of a playback, in a straight line in joint space.

        Args:
            playback: the playback.
            stop: polled every 50 ms; True brings the arm to rest.

        Returns:
            Whether the arm is at the start.

        Raises:
            RobotError: if the arm refuses, or stops elsewhere.
        """
        franky, robot = self._franky, self._robot
        target = franky.JointWaypoint(playback.arm_joints_rad[0].tolist())
        motion = franky.JointWaypointMotion([target], relative_dynamics_factor=_APPROACH)

        def follow() -> bool:
            robot.move(motion, asynchronous=True)
            while not robot.join_motion(_POLL_S):
                if stop():
                    robot.move(franky.JointStopMotion())
                    return False
            return True

        if not self._guarded(follow):
            return False
        away = np.abs(self.joints - playback.arm_joints_rad[0])
        if away.max() > _NEAR_RAD:
            joint = JOINTS[int(away.argmax())]
            raise RobotError(f"{joint} stopped {away.max():.2f} rad away from the playback's start")
        return True

    def play(
        self,
        playback: Playback,
        stop: Callable[[], bool] = lambda: False,
        progress: Callable[[int, int], object] = lambda done, total: None,
    ) -> Played:
        """Play a playback in real time; the arm must be at its start.

        Args:
            playback: the playback.
            stop: polled every 4 ms; True brings the arm to rest.
            progress: called with the hundredths of a second played, and the total.

        Raises:
            ConfigError: if the playback exceeds the arm's limits.
            RobotError: if the arm refuses, or lags behind by more than ``MOST_LAG_RAD``; the arm is
                then brought to rest.
        """
        check_playable(playback)
        path = smooth(playback.time_s, playback.arm_joints_rad)
        speed, lag, at = path.derivative(), np.zeros(len(JOINTS)), 0.0

        def follow() -> bool:
            nonlocal at
            tracker = self._franky.JointImpedanceTracker(
                self._robot, stiffness=STIFFNESS, period=_PERIOD_S
            )
            with tracker:
                begun = time.perf_counter()
                while tracker.tick() and not stop():
                    at = min(time.perf_counter() - begun, playback.duration_s)
                    command = path(at)
                    away = np.abs(np.asarray(tracker.current_joint_state.position) - command)
                    np.maximum(lag, away.astype(float), out=lag)
                    if lag.max() > MOST_LAG_RAD:
                        joint = JOINTS[int(lag.argmax())]
                        raise RobotError(
                            f"{joint} was {lag.max():.2f} rad from its command at {at:.2f} s, more "
                            f"than {MOST_LAG_RAD} rad: the arm was stopped"
                        )
                    tracker.set_target(command, speed(at))
                    progress(round(100 * at), round(100 * playback.duration_s))
                    if at >= playback.duration_s:
                        return True
            return False

        whole = self._guarded(follow)
        if not whole and not stop():
            raise RobotError(f"the arm ended the motion at {at:.2f} s")
        return Played(at, lag, whole)

    def _guarded(self, work: Callable[[], Any]) -> Any:
        try:
            return work()
        except PgdmError:
            raise
        except Exception as error:  # franky's exceptions have no common base class
            raise RobotError(f"the arm refused: {_line(error)}") from error


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
