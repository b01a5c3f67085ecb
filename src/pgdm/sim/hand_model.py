"""Checks of what pgdm requires of a hand's model; docs/extending.md lists the requirements."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from pgdm.errors import SceneError, amount
from pgdm.library.couplings import Couplings

if TYPE_CHECKING:
    from pgdm.sim.scene import HandCfg

BASE = ("slide along x", "slide along y", "slide along z")
BASE += ("hinge about x", "hinge about y", "hinge about z")
"""The base joints, which move the hand as a whole: first in qpos, all on the mount body."""

RESET_KEY = "reset"
"""Keyframe of a hand's model with its reset pose; without it, the pose is all joints at zero."""

_COUPLED_RAD = 0.01  # tolerance by which a joint may be outside its range, rad or m
_SAMPLES = 101  # tested positions of a joint that another follows, spread over its range


def joint_actuators(model: mujoco.MjModel, hand: HandCfg) -> np.ndarray:
    """Check the model of a hand; return the id of the actuator of each of its joints, (n,).

    The id of a coupled joint is -1. The model's actuators may be in any order; elsewhere in pgdm
    they are in the order of their joints.

    Args:
        model: the compiled scene.
        hand: its hand.

    Raises:
        SceneError: if a joint, actuator or equality constraint violates the requirements.
    """
    count = _check_joints(model, hand)
    _check_base(model, hand)
    coupled = _check_couplings(model, hand, count)
    found = np.full(count, -1)
    for actuator in range(model.nu):
        _check_servo(model, hand, actuator)
        joint, name = int(model.actuator_trnid[actuator, 0]), model.actuator(actuator).name
        if joint >= count:
            raise _wrong(hand, f"actuator '{name}' drives '{_joint(model, joint)}', not the hand")
        if found[joint] >= 0:
            raise _wrong(hand, f"joint '{_joint(model, joint)}' has a second actuator '{name}'")
        if coupled[joint]:
            raise _wrong(
                hand,
                f"actuator '{name}' drives '{_joint(model, joint)}', which an equality constraint "
                "makes follow another joint: remove one of the two",
            )
        found[joint] = actuator
    if (passive := np.flatnonzero((found < 0) & ~coupled)).size:
        name = _joint(model, int(passive[0]))
        raise _wrong(
            hand,
            f"joint '{name}' has no actuator; each needs one position actuator, or an equality "
            "constraint that makes it follow another joint",
        )
    return found


def reset_joints(model: mujoco.MjModel, hand: HandCfg, count: int) -> np.ndarray:
    """Return the reset pose of a hand, (n,) m and rad: its keyframe ``RESET_KEY``, or all zero.

    Raises:
        SceneError: if the keyframe moves the base, or another joint beyond its range, by more than
            0.01 rad or m.
    """
    key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, f"{hand.name}/{RESET_KEY}")
    if key < 0:
        return np.zeros(count)
    reset = model.key_qpos[key, :count].copy()
    low, high = model.jnt_range[:count].T
    over = np.maximum(low - reset, reset - high)
    over[: len(BASE)] = np.abs(reset[: len(BASE)])
    worst = int(over.argmax())
    if over[worst] > _COUPLED_RAD:
        raise _wrong(
            hand,
            f"keyframe '{RESET_KEY}' has joint '{_joint(model, worst)}' at "
            f"{reset[worst]:.3f}; the base must be at 0, every other joint within its range",
        )
    return reset


def six_joints(model: mujoco.MjModel, body: int) -> bool:
    """Return whether a body has exactly the six joints of `BASE`, in that order."""
    first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
    return count == len(BASE) and all(_fits(model, first + i, i) for i in range(count))


def _fits(model: mujoco.MjModel, joint: int, number: int) -> bool:
    """Return whether a joint is a ``BASE[number]`` at its body's origin."""
    slides = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
    along = np.allclose(model.jnt_axis[joint], np.eye(3)[number % 3], atol=1e-6)
    return slides == (number < 3) and along and not model.jnt_pos[joint].any()


def _check_joints(model: mujoco.MjModel, hand: HandCfg) -> int:
    """Check the joints of the scene; return how many are the hand's, which come first."""
    single = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
    prefix = f"{hand.name}/"
    own = [model.body(body).name.startswith(prefix) for body in model.jnt_bodyid]
    count = sum(own)
    for joint in range(model.njnt):
        name, kind = _joint(model, joint), mujoco.mjtJoint(model.jnt_type[joint])
        if kind not in single:
            raise _wrong(
                hand,
                f"joint '{name}' is a {kind.name[6:].lower()} joint; every joint of a scene must "
                "be a slide or a hinge (six of them in place of a free joint)",
            )
        if own[joint] != (joint < count):
            raise _wrong(hand, f"joint '{name}' is not the hand's; the hand's must come first")
        if own[joint] and not model.jnt_limited[joint]:
            raise _wrong(hand, f"joint '{name}' has no range")
        if own[joint] and model.qpos0[joint]:
            raise _wrong(hand, f"joint '{name}' has ref {model.qpos0[joint]:g}; it must be 0")
    if count < hand.num_base_joints + hand.num_wrist_joints:
        raise _wrong(
            hand,
            f"it has {amount(count, 'joint')} '{prefix}...', fewer than hand.num_base_joints "
            f"{hand.num_base_joints} plus hand.num_wrist_joints {hand.num_wrist_joints}; the "
            f"prefix is the model's name (<mujoco model=...>), which must be '{hand.name}'",
        )
    return count


def _check_base(model: mujoco.MjModel, hand: HandCfg) -> None:
    if hand.num_base_joints != len(BASE):
        raise _wrong(hand, f"hand.num_base_joints is {hand.num_base_joints}; it must be 6")
    mount = f"{hand.name}/{hand.mount_body}"
    for joint, wanted in enumerate(BASE):
        body = model.body(int(model.jnt_bodyid[joint]))
        if not _fits(model, joint, joint) or body.name != mount or body.parentid[0]:
            raise _wrong(
                hand,
                f"joint number {joint + 1} is '{_joint(model, joint)}'; that joint must be a "
                f"{wanted} at the origin of the mount body '{mount}', a child of the world",
            )


def _check_couplings(model: mujoco.MjModel, hand: HandCfg, count: int) -> np.ndarray:
    """Check equality constraints of the hand; return which of its joints follow another, (n,)."""
    kinds = {
        mujoco.mjtEq.mjEQ_JOINT: mujoco.mjtObj.mjOBJ_JOINT,
        mujoco.mjtEq.mjEQ_TENDON: mujoco.mjtObj.mjOBJ_TENDON,
    }
    couplings, coupled = Couplings(model, count), np.zeros(count, bool)
    for number in range(model.neq):
        kind = kinds.get(mujoco.mjtEq(model.eq_type[number]), model.eq_objtype[number])
        for one in (model.eq_obj1id[number], model.eq_obj2id[number]):
            name = mujoco.mj_id2name(model, kind, one) if one >= 0 else None
            if (name or "").startswith(f"{hand.name}/") and number not in couplings.rows:
                raise _wrong(
                    hand,
                    f"an equality constraint acts on '{name}'; the only supported kind makes one "
                    "joint of the hand follow another: remove the constraint",
                )
    coupled[couplings.followers] = True
    for row, follower, leader in zip(
        couplings.rows, couplings.followers, couplings.leaders, strict=True
    ):
        pair = f"joint '{_joint(model, follower)}' follows '{_joint(model, leader)}'"
        if not model.eq_active0[row]:
            raise _wrong(hand, f"{pair}, but the constraint is not active")
        if min(follower, leader) < len(BASE) or leader >= count or coupled[leader]:
            raise _wrong(
                hand,
                f"{pair}; neither may be a base joint, and the latter must be a joint of the hand "
                "that follows no other",
            )
    if len(set(couplings.followers.tolist())) < len(couplings.rows):
        raise _wrong(hand, "a joint follows two others")
    start, end = model.jnt_range[couplings.leaders].T
    swept = np.linspace(start, end, _SAMPLES)  # (samples, C)
    low, high = model.jnt_range[couplings.followers].T
    over = np.maximum(low - couplings.of(swept), couplings.of(swept) - high).max(0, initial=0.0)
    if (over > _COUPLED_RAD).any():
        one = int(over.argmax())
        raise _wrong(
            hand,
            f"joint '{_joint(model, couplings.followers[one])}' leaves its range by "
            f"{over[one]:.3f} when '{_joint(model, couplings.leaders[one])}' moves over "
            "its range: narrow the range of the latter",
        )
    return coupled


def _check_servo(model: mujoco.MjModel, hand: HandCfg, actuator: int) -> None:
    name = model.actuator(actuator).name
    if model.actuator_trntype[actuator] != mujoco.mjtTrn.mjTRN_JOINT:
        kind = mujoco.mjtTrn(model.actuator_trntype[actuator]).name[6:].lower()
        raise _wrong(hand, f"actuator '{name}' drives a {kind}; it must drive a joint")
    gain, bias = model.actuator_gainprm[actuator], model.actuator_biasprm[actuator]
    is_servo = (
        model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE
        and model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_NONE
        and gain[0] > 0
        and bias[0] == 0
        and bias[1] == -gain[0]
        and model.actuator_gear[actuator, 0] == 1
    )
    if not is_servo:
        raise _wrong(
            hand,
            f"actuator '{name}' is not a position servo; use <position kp=...> with gear 1: "
            "actions are joint positions",
        )
    low, high = model.actuator_ctrlrange[actuator]
    if not (model.actuator_ctrllimited[actuator] and low < high):
        raise _wrong(
            hand, f"actuator '{name}' has no ctrlrange, or an empty one; give it that of its joint"
        )


def _joint(model: mujoco.MjModel, joint: int | np.integer) -> str:
    return model.joint(int(joint)).name


def _wrong(hand: HandCfg, what: str) -> SceneError:
    return SceneError(f"hand '{hand.name}': {what} (docs/extending.md: what a hand must be)")
