"""Checks that a hand could carry an object along a motion, and corrections of the motion."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.spatial.transform import Rotation

from pgdm.errors import ConfigError, amount
from pgdm.library.checks.lowest import lowest
from pgdm.library.files.keyframes import continuous
from pgdm.library.files.poses import resampled
from pgdm.library.tasks import STEP_S

# The benchmark's 50 motions reach 2.2 m/s, 44 m/s2 (a bottle is shaken) and 16 rad/s, about the
# most that the hands' servos can follow.
MAX_SPEED_M_S, MAX_ACCELERATION_M_S2, MAX_TURN_RAD_S = 2.5, 50.0, 20.0
STEPS = (10, 500)
"""Smallest and largest number of poses of a motion: 0.4 s to 20 s."""
START_SPEED_M_S, START_TURN_RAD_S = 0.1, 1.0
"""Largest accepted speeds in the first step, as a motion must start at rest."""
SUNK_M = 0.003
"""Largest accepted depth of the object's lowest point below the table top."""
# A step over the speed limit is a jump if it is more than this many times as fast as the median of
# the three steps before and after it.
_JUMP = 4.0
_SMOOTH_STEPS, _EASE_STEPS = 2.0, 8  # filter's sigma, poses added at each end
_LIFT_STEPS = 6  # number of poses raised before and after a pose that is too low


@dataclass(frozen=True)
class Poses:
    """A motion of an object; positions are those of its centre of mass."""

    pos: np.ndarray  # (T, 3) m, world frame
    quat: np.ndarray  # (T, 4) wxyz, orientation of the object


def speeds(poses: Poses) -> tuple[np.ndarray, np.ndarray]:
    """Return speed (T-1,) m/s and angular speed (T-1,) rad/s of every step."""
    fast = np.linalg.norm(np.diff(poses.pos, axis=0), axis=1) / STEP_S
    orientations = Rotation.from_quat(poses.quat, scalar_first=True)
    return fast, (orientations[:-1].inv() * orientations[1:]).magnitude() / STEP_S


def check_motion(poses: Poses, label: str) -> None:
    """Check length, jumps, speeds, accelerations, and that the object starts at rest.

    Raises:
        ConfigError: a check fails; where possible, the message names the row and an option that
            helps.
    """
    steps = len(poses.pos)
    if not STEPS[0] <= steps <= STEPS[1]:
        raise ConfigError(
            f"{label}: {amount(steps, 'pose')} ({steps * STEP_S:.1f} s); valid: {STEPS[0]} to "
            f"{STEPS[1]}, one every {STEP_S:g} s"
        )
    fast, turning = speeds(poses)
    for values, limit, unit, verb in (
        (fast, MAX_SPEED_M_S, "m/s", "moves"),
        (turning, MAX_TURN_RAD_S, "rad/s", "turns"),
    ):
        row = int(values.argmax())
        if values[row] > limit:
            if values[row] > _JUMP * max(_around(values, row), 1e-9):
                jump = f"{values[row] * STEP_S:.3g} {unit.removesuffix('/s')}"
                raise ConfigError(
                    f"{label}: row {row + 1} jumps: it is {jump} from row {row}, and the steps "
                    "around it are small; repair the recording there"
                )
            raise ConfigError(
                f"{label}: {verb} at {values[row]:.3g} {unit} in row {row + 1}, a hand can follow "
                f"{limit:g} at most; slow it down (--slower FACTOR)"
            )
    push = np.linalg.norm(np.diff(poses.pos, 2, axis=0), axis=1) / STEP_S**2
    row = int(push.argmax())
    if push[row] > MAX_ACCELERATION_M_S2:
        raise ConfigError(
            f"{label}: accelerates at {push[row]:.3g} m/s2 in row {row + 1}, a hand can follow "
            f"{MAX_ACCELERATION_M_S2:g} at most; --smooth or --slower FACTOR help"
        )
    if fast[0] > START_SPEED_M_S or turning[0] > START_TURN_RAD_S:
        raise ConfigError(
            f"{label}: already moves in its first step, {fast[0]:.2g} m/s and "
            f"{turning[0]:.2g} rad/s; a motion must start at rest; --smooth adds a gradual start"
        )


def _around(values: np.ndarray, row: int) -> float:
    near = np.concatenate((values[max(0, row - 3) : row], values[row + 1 : row + 4]))
    return float(np.median(near)) if len(near) else 0.0


def smoothed(poses: Poses) -> Poses:
    """Return the motion low-pass filtered, with 8 poses added at each end so that the ends rest."""
    rows = np.concatenate((poses.pos, continuous(poses.quat)), axis=1)
    padded = np.pad(rows, ((_EASE_STEPS, _EASE_STEPS), (0, 0)), mode="edge")
    filtered = gaussian_filter1d(padded, _SMOOTH_STEPS, axis=0, mode="nearest")
    quat = filtered[:, 3:] / np.linalg.norm(filtered[:, 3:], axis=1, keepdims=True)
    return Poses(filtered[:, :3], quat)


def slower(poses: Poses, factor: float) -> Poses:
    """Return the motion slowed down by a factor from 1 to 20.

    Raises:
        ConfigError: the factor is out of range.
    """
    if not 1.0 <= factor <= 20.0:
        raise ConfigError(f"--slower is {factor:g}; valid: 1 to 20")
    rows = np.concatenate((poses.pos, poses.quat), axis=1)
    found = resampled(rows, STEP_S * factor * np.arange(len(rows)), "motion")
    return Poses(found.pos, found.quat)


class TableCheck:
    """Measures how far an object sinks below the table top (z = 0) along a motion.

    Args:
        model: a scene with the object.
        body: id of the object's body, whose six joints are the last in qpos.
    """

    def __init__(self, model: mujoco.MjModel, body: int) -> None:
        self._model, self._body = model, body
        self._data = mujoco.MjData(model)

    def depths(self, poses: Poses) -> np.ndarray:
        """Return how far the object sinks below the table top at each pose, (T,) m, at least 0."""
        joints = object_joints(self._model, self._body, poses)
        depths = np.zeros(len(joints))
        for i, qpos in enumerate(joints):
            self._data.qpos[-6:] = qpos
            depths[i] = max(0.0, -lowest(self._model, self._data, self._body))
        return depths

    def check(self, poses: Poses, label: str) -> None:
        """Check that the object never sinks below the table top by more than `SUNK_M`.

        Raises:
            ConfigError: it does; the message names the row of greatest depth.
        """
        depths = self.depths(poses)
        row = int(depths.argmax())
        if depths[row] > SUNK_M:
            raise ConfigError(
                f"{label}: the object's lowest point is {1e3 * depths[row]:.0f} mm below the table "
                f"in row {row} (rows that are too low: {(depths > SUNK_M).sum()}); "
                "--lift-above-table raises them"
            )

    def lifted(self, poses: Poses) -> Poses:
        """Return the motion, raised smoothly around poses that sink below the table top."""
        depths = self.depths(poses)
        around = maximum_filter1d(depths, 2 * _LIFT_STEPS + 1, mode="nearest")
        raised = np.maximum(gaussian_filter1d(around, _LIFT_STEPS / 3, mode="nearest"), depths)
        return Poses(poses.pos + np.outer(raised, [0.0, 0.0, 1.0]), poses.quat)


def object_joints(model: mujoco.MjModel, body: int, poses: Poses) -> np.ndarray:
    """Return joint positions (T, 6), m and rad, at which the object's centre of mass has the poses.

    Args:
        model: a scene.
        body: id of the object's body, which has three slides, then three hinges (intrinsic X-Y-Z).
        poses: the motion.
    """
    base = Rotation.from_quat(model.body_quat[body], scalar_first=True)
    orientations = Rotation.from_quat(poses.quat, scalar_first=True)
    origin = poses.pos - orientations.apply(model.body_ipos[body])
    slides = base.inv().apply(origin - model.body_pos[body])
    hinges = np.unwrap((base.inv() * orientations).as_euler("XYZ"), axis=0)
    return np.concatenate((slides, hinges), axis=1)
