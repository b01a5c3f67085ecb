"""Metrics of finished episodes (SPEC 1, Metrics)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pgdm import rotations
from pgdm.motion.reference import ObjectReference


@dataclass(frozen=True)
class MetricsCfg:
    """What counts as success."""

    success_threshold_m: float
    """Largest distance from the target at which a step counts as a success, m."""
    lift_height_m: float
    """Height above the start at which object and target count as lifted, m."""


@dataclass(frozen=True)
class Episodes:
    """Object poses of k episodes; rows after an episode's end are not read."""

    pos: Tensor  # (k, T, 3) m; row 0 is the pose at reset
    quat: Tensor  # (k, T, 4) wxyz
    length: Tensor  # (k,) int64, steps taken, 1..T-1


def episode_metrics(
    episodes: Episodes, reference: ObjectReference, cfg: MetricsCfg
) -> dict[str, Tensor]:
    """Return the metrics of k finished episodes, each (k,) float64.

    Targets are x_1..x_{T-1}; an episode that ended early keeps its last pose for the rest, and
    its unreached steps count as not lifted. ``success`` and ``lifted`` are shares (0..1),
    ``com_error`` is in m, ``ori_error`` in rad, ``com_error_released`` is the Frobenius norm of
    the (T-1, 3) difference over T-1, in m: the error column of the paper's tables.
    """
    steps = torch.arange(1, len(reference))
    held = torch.minimum(steps[None], episodes.length[:, None])  # (k, T-1)
    row = torch.arange(len(episodes.length))[:, None]
    pos, quat = episodes.pos[row, held], episodes.quat[row, held]
    delta = pos - reference.pos[None, 1:]
    error = torch.linalg.vector_norm(delta, dim=-1)
    angle = rotations.angle(quat, reference.quat[None, 1:].expand_as(quat))
    level = episodes.pos[:, 0, 2, None] + cfg.lift_height_m
    wanted = reference.pos[None, 1:, 2] >= level
    reached = steps[None] <= episodes.length[:, None]
    up = wanted & reached & (pos[..., 2] >= level)
    was_up = up.cumsum(1) > 0
    dropped = (was_up & wanted & reached & (pos[..., 2] < level)).any(1)
    count = wanted.sum(1)
    return {
        "success": (error <= cfg.success_threshold_m).double().mean(1),
        "com_error": error.mean(1),
        "com_error_released": torch.linalg.matrix_norm(delta) / (len(reference) - 1),
        "ori_error": angle.mean(1),
        # A motion that never leaves the table has nothing to lift.
        "lifted": torch.where(count > 0, up.sum(1) / count.clamp(min=1), torch.nan).double(),
        "dropped": dropped.double(),
        "length": episodes.length.double(),
    }
