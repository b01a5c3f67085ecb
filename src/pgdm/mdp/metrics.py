"""Metrics of finished episodes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pgdm import rotations
from pgdm.motion.reference import ObjectReference


@dataclass(frozen=True)
class MetricsCfg:
    """Thresholds of the metrics."""

    success_threshold_m: float
    """Largest object error at which a step counts as a success, m."""
    lift_height_m: float
    """Height above the start at which object and target count as lifted, m."""


@dataclass(frozen=True)
class Episodes:
    """Object poses of k episodes; rows after an episode's last step are not read."""

    pos: Tensor  # (k, T, 3) m; row 0 is the pose at reset
    quat: Tensor  # (k, T, 4) wxyz
    length: Tensor  # (k,) int64, steps taken, 1..T-1


def episode_metrics(
    episodes: Episodes, reference: ObjectReference, cfg: MetricsCfg
) -> dict[str, Tensor]:
    """Return the metrics of k finished episodes, each (k,) float64.

    With targets x_t, object positions o_t, e_t = |x_t - o_t| and the angle phi_t between object and
    target, over t = 1..T-1 (an episode that stopped early keeps its last pose for the rest):

    - ``success``: mean of [e_t <= success_threshold_m] (paper and released code);
    - ``com_error``: mean of e_t, m (the paper's definition);
    - ``com_error_released``: sqrt(sum of e_t^2) / (T-1), m (released code; the error column of the
      paper's tables);
    - ``ori_error``: mean of phi_t, rad;
    - ``lifted``: of the steps whose target is at least lift_height_m above the object's start, the
      fraction in which the object is too (never after an early stop); NaN without such steps;
    - ``dropped``: 1 if the object was lifted and later below that height while its target was
      above, else 0;
    - ``length``: steps taken.

    The last three are pgdm's own.
    """
    device = episodes.length.device
    steps = torch.arange(1, len(reference), device=device)
    held = torch.minimum(steps[None], episodes.length[:, None])  # (k, T-1)
    row = torch.arange(len(episodes.length), device=device)[:, None]
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
        "lifted": torch.where(count > 0, up.sum(1) / count.clamp(min=1), torch.nan).double(),
        "dropped": dropped.double(),
        "length": episodes.length.double(),
    }
