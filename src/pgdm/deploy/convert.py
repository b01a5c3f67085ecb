"""From a rollout to a playback: commands are smoothed, the arm's joints replace the base's."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from pgdm.deploy.arm import ArmIk, ArmPath, Setup
from pgdm.deploy.limits import CONTROL_HZ, JOINTS, Usage, usage
from pgdm.deploy.names import REACHED, check_base
from pgdm.deploy.playback import Playback
from pgdm.deploy.rollout import Rollout
from pgdm.errors import ConfigError, check_above_zero, check_at_least
from pgdm.library.files.keyframes import continuous
from pgdm.sim.scene import Scene

REACH_M, REACH_RAD = 1e-3, 1e-2
"""Largest errors of the inverse kinematics that count as reached."""

_LEAD = 4.0  # rest before the first command, in standard deviations of the smoothing


@dataclass(frozen=True)
class ConvertCfg:
    """How a rollout becomes a playback."""

    base: str = REACHED
    """``reached``: where the hand's base was at each step; ``commanded``: its targets (the paper).
    The base follows its targets like a soft spring, the arm follows closely. A policy may
    exaggerate targets to overcome the spring's lag; the arm would then move too far."""
    smooth_s: float = 0.04
    """Standard deviation of the Gaussian that smooths commands, in the rollout's time, s."""
    hold_s: float = 1.0
    """How long the last command is held, s."""
    rate_hz: float = 100.0
    """Samples per second of the playback; rounded, so that 1 kHz is a whole multiple of it."""
    speed: float = 1.0
    """1: as fast as in simulation; 0.5: half as fast."""

    def check(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: if one is outside its range, NaN or infinite.
        """
        check_base(self.base)
        for name in ("smooth_s", "hold_s", "rate_hz", "speed"):
            option, value = f"--{name.partition('_')[0]}", getattr(self, name)
            if not math.isfinite(value):
                raise ConfigError(f"{option} is {value}; it must be a finite number")
            if name == "hold_s":
                check_at_least(option, value, 0)
            else:
                check_above_zero(option, value)


@dataclass(frozen=True)
class Converted:
    """A playback, and how well the arm can follow it."""

    playback: Playback
    path: ArmPath
    usage: Usage

    @property
    def possible(self) -> bool:
        """Whether the arm can follow the hand's base everywhere, within the arm's limits."""
        return not self.usage.violations and self.unreached is None

    @property
    def unreached(self) -> str | None:
        """Where the arm cannot follow the hand, as a sentence; None if it can everywhere."""
        miss, turn = self.path.position_error_m, self.path.rotation_error_rad
        bad = (miss > REACH_M) | (turn > REACH_RAD)
        if not bad.any():
            return None
        time_s = self.playback.time_s
        worst = int(np.argmax(miss + 0.1 * turn))
        return (
            f"the arm cannot reach the hand's base in {100 * bad.mean():.0f}% of the time, first "
            f"at {time_s[int(bad.argmax())]:.2f} s; worst at {time_s[worst]:.2f} s: "
            f"{1e3 * miss[worst]:.0f} mm and {turn[worst]:.2f} rad away"
        )


def convert(
    rollout: Rollout, scene: Scene, arm: ArmIk, setup: Setup, cfg: ConvertCfg, facts: dict[str, Any]
) -> Converted:
    """Convert a rollout.

    The simulation holds a command for a control step. The playback has a smooth curve instead: the
    piecewise constant commands, preceded by the hand's start pose and followed by the last command,
    are convolved with a Gaussian of standard deviation ``cfg.smooth_s``. If ``cfg.base`` is
    ``reached``, the positions that the base reached take the place of its commands.

    Args:
        rollout: the rollout.
        scene: the task's scene.
        arm: inverse kinematics of the arm.
        setup: where the arm stands.
        cfg: settings of the conversion.
        facts: plain values to store with the playback.

    Raises:
        ConfigError: if a number of the settings is outside its range.
    """
    cfg.check()
    base, driven = scene.index.num_base_joints, scene.index.driven
    commands = _curve(rollout, rollout.commands, rollout.qpos[0, driven], cfg)
    if cfg.base == REACHED:
        commands[:, :base] = _curve(rollout, rollout.qpos[1:, :base], rollout.qpos[0, :base], cfg)
    time_s = np.arange(len(commands)) * _stride(cfg) / CONTROL_HZ
    pos, quat = mount_pose(scene, commands[:, :base])
    path = arm.follow(pos, quat)
    played = Playback(
        time_s,
        path.joints,
        commands[:, base:],
        pos,
        quat,
        *_object(rollout, time_s, cfg),
        JOINTS,
        tuple(scene.model.joint(i).name.rpartition("/")[2] for i in driven[base:]),
        facts | {"setup": asdict(setup), "convert": asdict(cfg)},
    )
    return Converted(played, path, usage(time_s, path.joints))


def mount_pose(scene: Scene, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mount body's poses in the world, (K, 3) m and (K, 4) wxyz, at joints (K, 6)."""
    mount = Rotation.from_quat(scene.index.mount_quat, scalar_first=True)
    pos = scene.index.mount_pos + mount.apply(joints[:, :3])
    turn = (mount * Rotation.from_euler("XYZ", joints[:, 3:6])).as_quat(scalar_first=True)
    return pos, continuous(turn)


def _curve(rollout: Rollout, values: np.ndarray, start: np.ndarray, cfg: ConvertCfg) -> np.ndarray:
    """Return values (T, n), each held for a control step, as a smooth curve (K, n)."""
    lead = _LEAD * cfg.smooth_s
    played = (len(values) * rollout.dt_s + 2 * lead) / cfg.speed + cfg.hold_s
    times = np.arange(round(played * CONTROL_HZ) + 1) / CONTROL_HZ * cfg.speed - lead
    steps = np.floor(times / rollout.dt_s + 1e-9).astype(int) + 1
    held = np.concatenate((start[None], values))[steps.clip(0, len(values))]
    width = cfg.smooth_s * CONTROL_HZ / cfg.speed
    smooth = gaussian_filter1d(held, width, axis=0, mode="nearest", truncate=_LEAD)
    return smooth[:: _stride(cfg)]


def _stride(cfg: ConvertCfg) -> int:
    """Return the number of the arm's control cycles between two samples."""
    return max(1, round(CONTROL_HZ / cfg.rate_hz))


def _object(rollout: Rollout, time_s: np.ndarray, cfg: ConvertCfg) -> tuple[np.ndarray, np.ndarray]:
    known = np.arange(len(rollout.object_pos)) * rollout.dt_s
    at = time_s * cfg.speed - _LEAD * cfg.smooth_s
    pos = np.stack([np.interp(at, known, column) for column in rollout.object_pos.T], 1)
    quats = continuous(rollout.object_quat).T
    quat = np.stack([np.interp(at, known, column) for column in quats], 1)
    return pos, quat / np.linalg.norm(quat, axis=1, keepdims=True)
