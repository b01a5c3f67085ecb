"""What makes two experiments the same, and whether a run may resume with new settings."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pgdm.errors import RunError
from pgdm.paths import inside
from pgdm.runs.config_file import dotted

if TYPE_CHECKING:  # the schema loads the simulator and torch
    from pgdm.config.schema import ExperimentCfg

# Keys that change where, when and how a run is done or displayed, but not what it computes.
_BESIDE = (
    "run_dir",
    "resume",
    "keep_replay",
    "offline",
    "budget",
    "num_threads",  # simulations do not depend on it
    "device",  # a run may move between machines
    "time_limit_min",
    "total_frames",  # a longer run can resume a shorter one
    "tracking",
    "checkpoint",
    "eval.interval_frames",
    "eval.video",
    "eval.video_every_eval",
    # Facts about the task without an effect on it.
    "task.pregrasp_source",
    "task.trajectory_source",
    "task.tcdm30",
    "task.paper_success",
    "task.paper_com_error",
)

# Keys that were added after the first runs, with the values that those runs correspond to.
ADDED_LATER: dict[str, Any] = {
    "action.wrist_path": "carried",
    "action.hold_steps": 0,
    "action.carry_load": False,
    "action.residual_power": 1.0,
    "algo.average_rate": 0.0,
    "algo.learner": "ppo",
    "algo.noise_correlation": 0.0,
    "algo.pre_tanh_limit": None,
    "keep_replay": False,
    "shaping.name": "none",
    "shaping.kernel_weight": 0.0,
    "shaping.kernel_scale": 10.0,
    "shaping.grasp_weight": 0.0,
    "shaping.grasp_scale": 20.0,
    "shaping.soft_end_m": None,
    "shaping.beyond_plan": False,
    "sim.engine": "mujoco",
    "sim.object_mass": "volume",
    "time_limit_min": None,
}

# PPO has no such keys.
_ONLY_SAC = ("algo.average_rate", "algo.noise_correlation", "algo.pre_tanh_limit")

# Keys that have an effect only if the wrist is planned.
_ONLY_PLANNED = ("action.hold_steps", "action.carry_load", "shaping.beyond_plan")


def with_added_keys(plain: Mapping[str, Any]) -> dict[str, Any]:
    """Return a stored configuration, completed with the keys that were added since."""
    result = dict(plain)
    for key, value in ADDED_LATER.items():
        group, _, name = key.rpartition(".")
        if not group:
            result.setdefault(name, value)
        elif isinstance(inner := result.get(group, {}), Mapping) and (
            key not in _ONLY_SAC or inner.get("learner") == "sac"
        ):
            result[group] = {name: value} | dict(inner)
    return result


def identity(cfg: ExperimentCfg) -> dict[str, Any]:
    """Return the keys (dotted) and values that change the result of an experiment.

    A key of ``ADDED_LATER`` is left out if it has the value listed there, so that an experiment
    keeps the hash, folder and sweep job that it had before the key existed. Keys of
    ``_ONLY_PLANNED`` are left out if the wrist is not planned.
    """
    idle = () if cfg.action.plans_wrist else _ONLY_PLANNED
    return {
        k: v
        for k, v in dotted(cfg).items()
        if changes_result(k) and k not in idle and not (k in ADDED_LATER and v == ADDED_LATER[k])
    }


@cache
def changes_result(key: str) -> bool:
    """Return whether a setting, by its dotted key, affects what an experiment computes."""
    return not any(key == part or key.startswith(f"{part}.") for part in _BESIDE)


def identity_hash(cfg: ExperimentCfg) -> str:
    """Return 8 hex digits, equal for two experiments with the same identity."""
    text = json.dumps(identity(cfg), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def default_run_dir(cfg: ExperimentCfg) -> str:
    """Return the default run folder of an experiment, relative to the working directory."""
    start = f"{cfg.pregrasp.source}-{cfg.action.kind}-{cfg.algo.name}"
    name = f"{start}-s{cfg.seed}-{identity_hash(cfg)}"
    # A user's method is named module:attribute; not every file system allows the colon.
    method = cfg.method.name.replace(":", ".")
    return str(inside(Path("runs"), cfg.task.id, method, name))


def difference(old: ExperimentCfg, new: ExperimentCfg) -> list[str]:
    """Return the changes of the identity, each as ``key: old -> new``."""
    before, after = ADDED_LATER | identity(old), ADDED_LATER | identity(new)
    return [
        f"{key}: {before.get(key)} -> {after.get(key)}"
        for key in sorted(before.keys() | after.keys())
        if before.get(key) != after.get(key)
    ]


def check_continues(old: ExperimentCfg, new: ExperimentCfg) -> None:
    """Check that ``new`` may resume in the run folder that ``old`` was saved in.

    Raises:
        RunError: if ``new`` is another or a shorter experiment; the message lists the differences.
    """
    changes = difference(old, new)
    if new.total_frames < old.total_frames:
        changes.append(f"total_frames: {old.total_frames} -> {new.total_frames} (it may only grow)")
    if changes:
        raise RunError(
            f"run folder '{new.run_dir}' holds another experiment ({'; '.join(changes)}); "
            "choose another run_dir, or the settings of that run"
        )
