"""Position servos of a hand's joints, and joint ranges that keep coupled joints within limits."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from pgdm.errors import ConfigError
from pgdm.library.couplings import Couplings

KP = 3.0
"""Gain of a servo if neither the file nor the user states it, N m/rad."""
_DAMPING_S = 0.05  # damping of a joint that has none, as a share of its servo's gain
_SINGLE = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
_OUT_RAD = 1e-3  # by how much a coupled joint may leave its range
_SAMPLES = 2001  # positions tried in the range of a leader (joint that others follow)


@dataclass(frozen=True)
class Servo:
    """Position servo of one joint."""

    kp: float
    """Gain, N m/rad; N/m for a slide."""
    damping: float
    """Damping of the joint, N m s/rad; N s/m for a slide."""
    low: float
    high: float
    """Range of its targets, rad or m."""
    given: bool
    """Whether the gain is the file's."""


def servos(
    model: mujoco.MjModel, kp: float | None, drop_tendons: bool, label: str
) -> tuple[dict[str, Servo], list[str]]:
    """Return the servo of each joint that follows no other, and what was changed.

    Only the first actuator of a joint counts. If it is a position actuator with gear 1, the servo
    takes over the actuator's range, clipped to the joint's, and unless ``kp`` is given, its gain.
    Any other joint gets a servo over the joint's range, of gain ``kp`` or :data:`KP`.

    Args:
        model: the hand as read.
        kp: gain of all servos, N m/rad; None: the file's, or :data:`KP`.
        drop_tendons: whether to leave out tendons with actuators instead of raising an error.
        label: the hand's file, for messages.

    Raises:
        ConfigError: an actuator drives a tendon, without ``drop_tendons``; a joint is neither hinge
            nor slide, has no range, or has a ``ref``; an equality constraint does not couple two
            joints; or a joint follows a joint that itself follows another.
    """
    couplings = Couplings(model, model.njnt)
    _check_equalities(model, couplings, label)
    notes, found, driven = [], {}, {}
    for actuator in range(model.nu):
        name, kind = model.actuator(actuator).name, model.actuator_trntype[actuator]
        if kind == mujoco.mjtTrn.mjTRN_TENDON:
            tendon = model.tendon(model.actuator_trnid[actuator, 0]).name
            if not drop_tendons:
                raise ConfigError(
                    f"{label}: actuator '{name}' pulls tendon '{tendon}'; pgdm commands joints. "
                    "--drop-tendons leaves such tendons out and gives each joint a servo"
                )
            notes.append(f"tendon '{tendon}' and its actuator '{name}' were left out")
        elif kind != mujoco.mjtTrn.mjTRN_JOINT:
            notes.append(f"actuator '{name}' does not drive a joint directly and was left out")
        else:
            driven.setdefault(int(model.actuator_trnid[actuator, 0]), []).append(actuator)
    for joint in range(model.njnt):
        name = model.joint(joint).name
        if mujoco.mjtJoint(model.jnt_type[joint]) not in _SINGLE:
            raise ConfigError(
                f"{label}: joint '{name}' is not a hinge or slide; replace it with hinges"
            )
        if (
            not model.jnt_limited[joint]
            or not model.jnt_range[joint, 0] < model.jnt_range[joint, 1]
        ):
            raise ConfigError(
                f"{label}: joint '{name}' has no limits or an empty range; give it a range"
            )
        if model.qpos0[joint]:
            raise ConfigError(
                f"{label}: joint '{name}' has ref {model.qpos0[joint]:g}; pgdm needs 0: subtract "
                "ref from its range, and rotate its body instead"
            )
        if joint in couplings.followers:
            if joint in driven:
                notes.append(
                    f"the actuator of '{name}' was left out: this joint follows another joint"
                )
            continue
        found[name] = _servo(model, joint, driven.get(joint, []), kp, notes)
    return found, notes


def _servo(
    model: mujoco.MjModel, joint: int, actuators: list[int], kp: float | None, notes: list[str]
) -> Servo:
    low, high = model.jnt_range[joint].tolist()
    damping, gain = float(model.dof_damping[joint]), None
    for actuator in actuators[:1]:
        gains, bias = model.actuator_gainprm[actuator], model.actuator_biasprm[actuator]
        gear = float(model.actuator_gear[actuator, 0])
        if gains[0] > 0 and bias[1] == -gains[0] and bias[0] == 0 and gear == 1:
            gain, damping = float(gains[0]), damping - float(bias[2])
            if model.actuator_ctrllimited[actuator]:
                within = np.clip(model.actuator_ctrlrange[actuator], low, high)
                low, high = within if within[0] < within[1] else (low, high)
        else:
            name = model.joint(joint).name
            notes.append(
                f"the actuator of '{name}' is not a position servo with gear 1 and was "
                "replaced by one"
            )
    given = gain is not None and kp is None
    gain = gain if given and gain is not None else (KP if kp is None else kp)
    return Servo(
        gain, damping if damping > 0 else _DAMPING_S * gain, float(low), float(high), given
    )


def _check_equalities(model: mujoco.MjModel, couplings: Couplings, label: str) -> None:
    for number in range(model.neq):
        if number not in couplings.rows:
            kind = mujoco.mjtEq(model.eq_type[number]).name[5:].lower()
            raise ConfigError(
                f"{label}: has an equality constraint of kind '{kind}'; only those by which a "
                "joint follows another are supported, not closed kinematic loops"
            )
    for follower, leader in zip(couplings.followers, couplings.leaders, strict=True):
        if leader in couplings.followers:
            raise ConfigError(
                f"{label}: joint '{model.joint(int(follower)).name}' follows "
                f"'{model.joint(int(leader)).name}', which itself follows another joint; make "
                "both follow that joint"
            )


def narrowed(model: mujoco.MjModel) -> tuple[dict[str, tuple[float, float]], list[str]]:
    """Return narrower ranges for joints that would take a coupled joint beyond its own range.

    Also returns a note on each.

    Raises:
        ConfigError: no position of a joint keeps those that follow it within their ranges.
    """
    couplings, found, notes = Couplings(model, model.njnt), {}, []
    for leader in dict.fromkeys(couplings.leaders.tolist()):
        mine = couplings.leaders == leader
        low, high = model.jnt_range[leader]
        swept = np.linspace(low, high, _SAMPLES)
        positions = couplings.of(np.repeat(swept[:, None], len(mine), 1))[:, mine]
        least, most = model.jnt_range[couplings.followers[mine]].T
        inside = ((positions >= least - _OUT_RAD) & (positions <= most + _OUT_RAD)).all(1)
        name = model.joint(leader).name
        if not inside.any():
            raise ConfigError(
                f"joint '{name}' has no position at which the joints that follow it are within "
                "their ranges; correct the coupling (<mimic> in URDF), or the ranges"
            )
        if inside.all():
            continue
        first = int(np.argmax(inside))
        last = first + int(np.argmin(np.append(inside[first:], False))) - 1
        found[name] = float(swept[first]), float(swept[last])
        notes.append(
            f"joint '{name}' goes from {found[name][0]:.2f} to {found[name][1]:.2f} instead of "
            f"{low:.2f} to {high:.2f}: otherwise, a joint that follows it would leave its own range"
        )
    return found, notes
