"""Franka Panda with a hand at its flange: where it stands, and its inverse kinematics."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import mink
import mujoco
import numpy as np
from mink.exceptions import NoSolutionFound
from scipy.spatial.transform import Rotation

from pgdm.deploy.limits import POSITION_RAD
from pgdm.errors import ConfigError

_SOLVER = "daqp"
_POSTURE_COST = 1e-3  # resolves the redundancy; moves the flange by micrometres
_MOST_STEPS = 60
_SETTLED_RAD = 1e-7
_STARTS = 12
Floats = tuple[float, ...]
_COARSE = 8  # samples of a path on which start configurations are compared

MOUNTS = {
    # As in RoboHive's scene of this arm with this hand: the palm is 13 mm above the flange.
    "dmanus": (0.0, 0.0, -0.07825, 0.0, 0.0, -135.0),
    # Puts the rear end of the forearm's mesh, 0.213 m from its origin, on the flange.
    "adroit": (0.0, 0.0, -0.213, 0.0, 0.0, 0.0),
}
"""Default mount of each hand, see `Setup.mount`."""

PLACES = {"dmanus": (0.2, -0.75, 90.0), "adroit": (0.2, -1.0, 90.0)}
"""Default place of the arm for each hand, see `Setup.arm_at`; Adroit's long forearm needs more
room."""


@dataclass(frozen=True)
class Setup:
    """Where arm, hand and table are, in the task's world frame: z = 0 on the table top."""

    arm_at: Floats = PLACES["dmanus"]
    """Arm's base: x and y, m, and turn about the vertical, degrees."""
    table_height_m: float = 0.0
    """Height of the table top above the plane that the arm is bolted to, m."""
    mount: Floats = MOUNTS["dmanus"]
    """Hand's mount body in the flange's frame: x, y, z, m, and roll, pitch, yaw, degrees."""

    def arm_pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the arm's base in the world: position (3,) m, orientation (4,) wxyz."""
        x, y, turn = self.arm_at
        half = math.radians(turn) / 2
        orientation = np.array([math.cos(half), 0.0, 0.0, math.sin(half)])
        return np.array([x, y, -self.table_height_m]), orientation

    def mount_pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the hand's mount body in the flange's frame: (3,) m and (4,) wxyz."""
        turn = Rotation.from_euler("xyz", self.mount[3:], degrees=True)
        return np.array(self.mount[:3]), turn.as_quat(scalar_first=True)

    @classmethod
    def of(
        cls, hand: str, arm_at: Floats | None, table_height_m: float, mount: Floats | None
    ) -> Setup:
        """Return the setup of a hand; None for place or mount means the hand's default.

        Raises:
            ConfigError: if the hand has no defaults, or a number is not valid.
        """
        place, mount = arm_at or PLACES.get(hand), mount or MOUNTS.get(hand)
        if place is None or mount is None:
            known = " and ".join(MOUNTS)
            raise ConfigError(
                f"'{hand}' has no default place and mount (only {known} have): "
                "give --arm and --mount"
            )
        setup = cls(tuple(place), table_height_m, tuple(mount))
        setup.check()
        return setup

    def check(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: if a number is not finite, or a length is above 3 m.
        """
        lengths = (*self.arm_at[:2], self.table_height_m, *self.mount[:3])
        angles = (self.arm_at[2], *self.mount[3:])
        if not np.isfinite([*lengths, *angles]).all():
            raise ConfigError(f"the setup has a number that is not finite: {self}")
        if max(map(abs, lengths)) > 3.0:
            raise ConfigError(f"the setup has a length above 3 m: {self}")


@dataclass(frozen=True)
class ArmPath:
    """Arm joints along a path of the flange, and the flange's errors."""

    joints: np.ndarray  # (K, 7) rad
    position_error_m: np.ndarray  # (K,)
    rotation_error_rad: np.ndarray  # (K,)


class ArmIk:
    """Inverse kinematics of the arm.

    Args:
        file: MJCF of the arm, from `pgdm.library.arms.ensure_panda`.
        setup: where the arm stands, and how the hand is mounted.
    """

    def __init__(self, file: Path, setup: Setup) -> None:
        setup.check()
        self._model = mujoco.MjModel.from_xml_path(str(file))
        pos, quat = setup.arm_pose()
        self._arm = mink.SE3(np.concatenate((quat, pos)))
        pos, quat = setup.mount_pose()
        self._mount = mink.SE3(np.concatenate((quat, pos)))
        self._limits = [mink.ConfigurationLimit(self._model, gain=1.0)]

    def mount_pose(self, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the hand's mount body in the world for joints (7,): (3,) m, (4,) wxyz."""
        configuration = mink.Configuration(self._model, joints)
        flange = configuration.get_transform_frame_to_world("flange", "site")
        pose = self._arm @ flange @ self._mount
        return pose.translation(), pose.rotation().wxyz

    def follow(self, pos: np.ndarray, quat: np.ndarray, seed: int = 0) -> ArmPath:
        """Return joints within the limits along a path of the hand's mount body.

        The redundant arm can start in many configurations. Several are compared on samples
        of the whole path: the smallest error wins; among equals (to 1 mm), distance from the limits
        and absence of jumps decide. Where a pose cannot be reached, the flange comes as close to it
        as possible.

        Args:
            pos: positions (K, 3) m, world frame.
            quat: orientations (K, 4) wxyz, world frame.
            seed: seed of the random start configurations.
        """
        targets = [self._flange(p, q) for p, q in zip(pos, quat, strict=True)]
        coarse = targets[:: max(1, len(targets) // _COARSE)]
        rng = np.random.default_rng(seed)
        low, high = POSITION_RAD.T
        home = (low + high) / 2
        starts = [home, *rng.uniform(low, high, (_STARTS, 7))]
        found = [self._settled(start, home, coarse[0]) for start in starts]
        best = max(found, key=lambda posture: self._merit(self._along(posture, coarse)))
        return self._along(best, targets)

    def _flange(self, pos: np.ndarray, quat: np.ndarray) -> mink.SE3:
        mount = mink.SE3(np.concatenate((quat, pos)))
        return self._arm.inverse() @ mount @ self._mount.inverse()

    def _merit(self, path: ArmPath) -> tuple[float, float]:
        """Return a path's merit, a pair compared in order.

        The first number is the path's largest error in m, rounded to 1 mm and negated; an error of
        1 rad counts as 0.1 m. The second is the least distance from a limit, at most 0.3 rad, minus
        the amount by which the largest jump exceeds 0.3 rad.
        """
        low, high = POSITION_RAD.T
        room = float(np.minimum(path.joints - low, high - path.joints).min())
        miss = max(path.position_error_m.max(), 0.1 * path.rotation_error_rad.max())
        jump = float(np.abs(np.diff(path.joints, axis=0)).max()) if len(path.joints) > 1 else 0.0
        return -float(np.round(miss, 3)), min(room, 0.3) - max(0.0, jump - 0.3)

    def _along(self, posture: np.ndarray, targets: Iterable[mink.SE3]) -> ArmPath:
        joints, errors, at = [], [], posture
        for target in targets:
            at = self._settled(at, posture, target)
            joints.append(at)
            errors.append(self._error(at, target))
        away = np.array(errors)
        return ArmPath(np.array(joints), away[:, 0], away[:, 1])

    def _settled(self, start: np.ndarray, posture: np.ndarray, target: mink.SE3) -> np.ndarray:
        """Return joints (7,) at which the flange is as close as possible to a target."""
        low, high = POSITION_RAD.T
        configuration = mink.Configuration(self._model, start.clip(low, high))
        frame = mink.FrameTask("flange", "site", 1.0, 0.3, lm_damping=1e-6)
        frame.set_target(target)
        rest = mink.PostureTask(self._model, _POSTURE_COST)
        rest.set_target(posture)
        for _ in range(_MOST_STEPS):
            try:
                move = mink.solve_ik(
                    configuration, [frame, rest], 1.0, _SOLVER, 1e-10, limits=self._limits
                )
            except NoSolutionFound:
                break
            largest = float(np.abs(move).max())
            configuration.integrate_inplace(move * min(1.0, 0.5 / max(largest, 1e-12)), 1.0)
            if largest < _SETTLED_RAD:
                break
        return configuration.q.clip(low, high)

    def _error(self, joints: np.ndarray, target: mink.SE3) -> tuple[float, float]:
        configuration = mink.Configuration(self._model, joints)
        at = configuration.get_transform_frame_to_world("flange", "site")
        turn = (at.rotation().inverse() @ target.rotation()).log()
        return (
            float(np.linalg.norm(at.translation() - target.translation())),
            float(np.linalg.norm(turn)),
        )
