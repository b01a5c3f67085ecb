"""Whether a hand could carry an object along a motion, and what may be changed so that it can."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.spatial.transform import Rotation

from pgdm.errors import ConfigError
from pgdm.library.animate import STEP_S, continuous
from pgdm.library.lowest import lowest
from pgdm.library.pose_file import resampled

# The fastest of the benchmark's 50 motions have 2.2 m/s, 44 m/s2 (a bottle that is shaken) and
# 16 rad/s: what the hands' servos can follow at all.
MAX_SPEED_M_S, MAX_ACCELERATION_M_S2, MAX_TURN_RAD_S = 2.5, 50.0, 20.0
STEPS = (10, 500)
"""Poses that a motion may have: 0.4 s to 20 s."""
START_SPEED_M_S, START_TURN_RAD_S = 0.1, 1.0
"""Speed at the first step; recorded motions are cut where the object begins to move."""
SUNK_M = 0.003
"""How deep the object may be in the table."""
_JUMP = 4.0  # times the speed of the steps around it: not fast, but torn
_SMOOTH_STEPS, _EASE_STEPS = 2.0, 8  # width of the filter, and poses of rest put in front
_LIFT_STEPS = 6  # around a pose that is raised, those that are raised with it


@dataclass(frozen=True)
class Poses:
    """A motion of the object's centre of mass."""

    pos: np.ndarray  # (T, 3) m, world frame
    quat: np.ndarray  # (T, 4) wxyz


def speeds(poses: Poses) -> tuple[np.ndarray, np.ndarray]:
    """Return speed (T-1,) m/s and turning speed (T-1,) rad/s of every step."""
    fast = np.linalg.norm(np.diff(poses.pos, axis=0), axis=1) / STEP_S
    turns = Rotation.from_quat(poses.quat, scalar_first=True)
    return fast, (turns[:-1].inv() * turns[1:]).magnitude() / STEP_S


def check_motion(poses: Poses, label: str) -> None:
    """Check length, jumps, speeds and that the object starts at rest.

    Raises:
        ConfigError: one is beyond what a hand can do; names the row and the option that helps.
    """
    steps = len(poses.pos)
    if not STEPS[0] <= steps <= STEPS[1]:
        raise ConfigError(
            f"{label}: {steps} poses ({steps * STEP_S:.1f} s); valid: {STEPS[0]} to {STEPS[1]}, "
            f"one each {STEP_S:g} s"
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
                    f"{label}: row {row + 1} jumps: it lies {jump} from row {row}, and the steps "
                    "around it are small; mend the recording there"
                )
            raise ConfigError(
                f"{label}: {verb} at {values[row]:.3g} {unit} in row {row + 1}, a hand follows "
                f"{limit:g} at most; slow it down (--slower FACTOR)"
            )
    push = np.linalg.norm(np.diff(poses.pos, 2, axis=0), axis=1) / STEP_S**2
    row = int(push.argmax())
    if push[row] > MAX_ACCELERATION_M_S2:
        raise ConfigError(
            f"{label}: accelerates by {push[row]:.3g} m/s2 in row {row + 1}, a hand follows "
            f"{MAX_ACCELERATION_M_S2:g} at most; --smooth or --slower FACTOR help"
        )
    if fast[0] > START_SPEED_M_S or turning[0] > START_TURN_RAD_S:
        raise ConfigError(
            f"{label}: moves in its first step already, {fast[0]:.2g} m/s and "
            f"{turning[0]:.2g} rad/s; a motion starts at rest: --smooth adds a beginning"
        )


def _around(values: np.ndarray, row: int) -> float:
    near = np.concatenate((values[max(0, row - 3) : row], values[row + 1 : row + 4]))
    return float(np.median(near)) if len(near) else 0.0


def smoothed(poses: Poses) -> Poses:
    """Return a motion that starts and ends at rest, and whose shaking is filtered out."""
    rows = np.concatenate((poses.pos, continuous(poses.quat)), axis=1)
    ends = (_EASE_STEPS, _EASE_STEPS)
    padded = np.pad(rows, (ends, (0, 0)), mode="edge")
    filtered = gaussian_filter1d(padded, _SMOOTH_STEPS, axis=0, mode="nearest")
    quat = filtered[:, 3:] / np.linalg.norm(filtered[:, 3:], axis=1, keepdims=True)
    return Poses(filtered[:, :3], quat)


def slower(poses: Poses, factor: float) -> Poses:
    """Return the motion played slower.

    Raises:
        ConfigError: the factor is no slowing.
    """
    if not 1.0 <= factor <= 20.0:
        raise ConfigError(f"--slower is {factor:g}; valid: 1 to 20")
    rows = np.concatenate((poses.pos, poses.quat), axis=1)
    found = resampled(rows, STEP_S * factor * np.arange(len(rows)), "motion")
    return Poses(found.pos, found.quat)


class TableCheck:
    """Tells how deep an object is in the table along a motion.

    Args:
        model: a scene with it.
        body: id of its body, whose six joints are the last in qpos.
    """

    def __init__(self, model: mujoco.MjModel, body: int) -> None:
        self._model, self._body = model, body
        self._data = mujoco.MjData(model)

    def depths(self, poses: Poses) -> np.ndarray:
        """Return by how much each pose is too low, (T,) m, 0 where none of it is."""
        joints = object_joints(self._model, self._body, poses)
        depths = np.zeros(len(joints))
        for i, qpos in enumerate(joints):
            self._data.qpos[-6:] = qpos
            depths[i] = max(0.0, -lowest(self._model, self._data, self._body))
        return depths

    def check(self, poses: Poses, label: str) -> None:
        """Check that no pose is in the table.

        Raises:
            ConfigError: one is; names the deepest.
        """
        depths = self.depths(poses)
        row = int(depths.argmax())
        if depths[row] > SUNK_M:
            raise ConfigError(
                f"{label}: the object's lowest point is {1e3 * depths[row]:.0f} mm below the table "
                f"in row {row} ({(depths > SUNK_M).sum()} such rows); --lift-above-table raises "
                "them"
            )

    def lifted(self, poses: Poses) -> Poses:
        """Return the motion raised, softly, where it is in the table."""
        depths = self.depths(poses)
        around = maximum_filter1d(depths, 2 * _LIFT_STEPS + 1, mode="nearest")
        raised = np.maximum(gaussian_filter1d(around, _LIFT_STEPS / 3, mode="nearest"), depths)
        return Poses(poses.pos + np.outer(raised, [0.0, 0.0, 1.0]), poses.quat)


def object_joints(model: mujoco.MjModel, body: int, poses: Poses) -> np.ndarray:
    """Return the object's joints (T, 6), m and rad, at which its centre of mass has the poses.

    Args:
        model: a scene.
        body: id of the object's body: three slides, then three hinges, intrinsic X-Y-Z.
        poses: the motion.
    """
    base = Rotation.from_quat(model.body_quat[body], scalar_first=True)
    turns = Rotation.from_quat(poses.quat, scalar_first=True)
    origin = poses.pos - turns.apply(model.body_ipos[body])
    slides = base.inv().apply(origin - model.body_pos[body])
    hinges = np.unwrap((base.inv() * turns).as_euler("XYZ"), axis=0)
    return np.concatenate((slides, hinges), axis=1)
