"""What a policy expects and what its actions mean, as plain values stored with its weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import torch

from pgdm.envs.build import EnvBuilder
from pgdm.export.trained import TrainedPolicy
from pgdm.mdp.observations import NEAR_M, RELATIVE_AHEAD

FORMAT = "pgdm-policy-1"
"""Version of the description's layout, under the key ``format``."""


def card(policy: TrainedPolicy) -> dict[str, Any]:
    """Return what identifies a policy: task, settings, hashes."""
    return {
        "format": FORMAT,
        "task": policy.cfg.task.id,
        "frames": policy.frames,
        "policy_sha256": policy.sha256(),
        "network": asdict(policy.network.cfg),
        "settings": policy.settings(),
        "facts": dict(policy.facts),
    }


def description(policy: TrainedPolicy, builder: EnvBuilder) -> dict[str, Any]:
    """Return a policy's `card`, and everything needed to run it without pgdm.

    Positions are in the world frame; m, rad, s; quaternions wxyz. ``T`` is the number of poses of
    the exemplar motion, ``t`` the control steps since reset.

    - ``observation``: its parts in order, each with ``name``, ``first``, ``size``, ``unit`` and
      ``of`` (the joints, geoms or bodies that the part describes);
    - ``observation_by_step``: (T, K) the last K numbers of the observation at each t;
    - ``points``, ``object``: geoms of the hand's points, and the tracked body;
    - ``action``: for the hand's driven ``joints``, first clipped to [-1, 1]; then
      ``target = middle + half * action`` (m, rad). If there is a ``wrist``, the targets of the
      first ``len(low)`` joints are instead
      ``clip(path[min(t + lead_steps, T-1)] + largest * sign(action) * abs(action) ** power, low,
      high)``;
    - ``actuators``: names, in the order of MuJoCo's ``ctrl``;
    - ``control``: ``timestep_s`` of a physics step, and ``substeps`` per control step. At the start
      of a control step, copy the first ``compensated_joints`` entries of ``qfrc_bias`` to
      ``qfrc_applied``, where they stay for all substeps;
    - ``start``: the start state; ``episode``: the exemplar motion, the object errors up to
      which a step is a success and from which the object is lost, and the terminations' names.
    """
    scene, mdp = builder.scene, builder.mdp
    index, model = scene.index, scene.model
    joints = [model.joint(i).name for i in range(model.njnt)]
    targets = torch.cat((mdp.reference.pos, mdp.reference.quat), -1)
    parts = _parts(policy.cfg.obs.layout, builder, joints)
    by_step = _by_step(policy.cfg.obs.layout, builder)
    return {
        **card(policy),
        "hand": scene.hand.name,
        "observation": _placed(parts),
        "observation_by_step": by_step.tolist(),
        "points": [model.geom(i).name for i in index.point_geoms],
        "object": model.body(index.object_body).name,
        "action": _action(builder, joints),
        "actuators": [model.actuator(i).name for i in range(model.nu)],
        "control": {
            "timestep_s": float(model.opt.timestep),
            "substeps": builder.motion.substeps,
            "compensated_joints": index.num_compensated,
        },
        "start": {
            "source": mdp.start.source,
            "qpos": mdp.start.qpos.tolist(),
            "qvel": mdp.start.qvel.tolist(),
        },
        "episode": {
            "target_pos": targets[:, :3].tolist(),
            "target_quat": targets[:, 3:].tolist(),
            "success_threshold_m": mdp.recipe.metrics.success_threshold_m,
            "lost_at_m": policy.cfg.method.termination.max_object_error_m,
            "ends": [end.name for end in mdp.recipe.ends],
        },
    }


_Part = tuple[str, int, str, Sequence[str]]


def _parts(layout: str, builder: EnvBuilder, joints: list[str]) -> list[_Part]:
    """Return name, size, unit, and the joints, geoms or bodies of each part of an observation."""
    index, model = builder.scene.index, builder.scene.model
    tracked = model.body(index.object_body).name
    points = [model.geom(i).name for i in index.point_geoms]
    time = ("time", 8, "first sin, then cos, of 1, 4, 6 and 8 times t/T", ())
    if layout == "paper":
        tips = [points[i] for i in index.fingertips]
        return [
            ("joint_positions", index.num_joints, "m, rad", joints[: index.num_joints]),
            ("fingertip_positions", 3 * len(tips), "m", tips),
            ("object_position", 3, "m, centre of mass", [tracked]),
            ("object_orientation", 4, "quaternion wxyz", [tracked]),
            time,
        ]
    of = [*points, tracked]
    relative = _relative_parts(builder, tracked, points) if layout == "relative" else []
    ahead = (
        "targets_ahead",
        21,
        "for k = 1, 5, 10: target of step t+k, quaternion wxyz, then m",
        (),
    )
    return [
        *relative,
        ("joint_positions", model.nq, "m, rad", joints),
        ("positions", 3 * len(of), "m, geom centres, then the object's centre of mass", of),
        ("orientations", 4 * len(of), "quaternion wxyz, of the bodies", of),
        ("joint_velocities", model.nv, "m/s, rad/s", joints),
        ("velocities", 6 * len(of), "linear m/s, then angular rad/s, at the positions", of),
        ahead,
        time,
    ]


def _relative_parts(builder: EnvBuilder, tracked: str, points: list[str]) -> list[_Part]:
    tips = [points[i] for i in builder.scene.index.fingertips]
    steps = ", ".join(f"t+{k}" if k else "t" for k in RELATIVE_AHEAD)
    in_hand = [tracked, points[0]]
    hand_frame = "in the frame of the second's body"
    return [
        (
            "offsets_to_targets",
            3 * len(RELATIVE_AHEAD),
            f"m, from the object's centre of mass to its targets of steps {steps}, at most T-1",
            [tracked],
        ),
        ("offset_saturated", 3, f"tanh of the first offset / {NEAR_M:g} m", [tracked]),
        (
            "rotation_to_target",
            3,
            "rad, twice the vector part of target(t) object^-1, scalar part >= 0",
            [tracked],
        ),
        ("position_in_hand", 3, f"m, of the first relative to the second, {hand_frame}", in_hand),
        ("orientation_in_hand", 4, f"quaternion wxyz, scalar part >= 0, {hand_frame}", in_hand),
        (
            "velocity_in_hand",
            3,
            f"m/s, linear, of the first minus the second, {hand_frame}",
            in_hand,
        ),
        (
            "fingertips_from_object",
            3 * len(tips),
            "m, relative to the object's centre of mass, in the object's frame",
            tips,
        ),
    ]


def _placed(parts: list[_Part]) -> list[dict[str, Any]]:
    placed, first = [], 0
    for name, size, unit, of in parts:
        placed.append({"name": name, "first": first, "size": size, "unit": unit, "of": list(of)})
        first += size
    return placed


def _by_step(layout: str, builder: EnvBuilder) -> torch.Tensor:
    reference = builder.mdp.reference
    time = reference.time_encoding()
    return time if layout == "paper" else torch.cat((reference.ahead(), time), -1)


def _action(builder: EnvBuilder, joints: list[str]) -> dict[str, Any]:
    actions, driven = builder.mdp.actions, builder.scene.index.driven
    found: dict[str, Any] = {
        "joints": [joints[i] for i in driven],
        "middle": actions.middle.tolist(),
        "half": actions.half.tolist(),
        "wrist": None,
    }
    if (wrist := actions.wrist) is not None:
        found["wrist"] = {
            "path": wrist.path.tolist(),
            "lead_steps": wrist.lead_steps,
            "largest": wrist.largest.tolist(),
            "power": wrist.power,
            "low": wrist.low.tolist(),
            "high": wrist.high.tolist(),
        }
    return found
