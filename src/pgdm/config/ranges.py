"""Checks of composed settings that need neither torch nor the simulator."""

from __future__ import annotations

from collections.abc import Mapping

from pgdm.config.strict import scalar
from pgdm.errors import ConfigError, check_above_zero, check_at_least

# Lowest value allowed.
_AT_LEAST: dict[str, int] = {
    "seed": 0,
    "total_frames": 1,
    "num_envs": 1,
    "num_threads": 0,
    "hand.num_base_joints": 0,
    "hand.num_wrist_joints": 0,
    "action.lead_steps": 0,
    "action.hold_steps": 0,
    "action.residual_scale": 0,
    "action.residual_power": 1,
    "algo.value_coef": 0,
    "algo.entropy_coef": 0,
    "algo.steps_per_env": 1,
    "algo.minibatch_size": 1,
    "algo.epochs": 1,
    "algo.log_std_init": -20,
    "algo.batch_size": 1,
    "algo.critics": 1,
    "algo.updates_per_step": 1,
    "algo.actor_interval": 1,
    "algo.warmup_steps": 1,
    "algo.target_entropy_frames": 1,
    "sim.solver_iterations": 1,
    "sim.noslip_iterations": 0,
    "eval.episodes": 1,
    "eval.interval_frames": 0,
    "checkpoint.keep_last": 1,
}
AT_MOST: dict[str, float] = {
    "num_threads": 1024,
    "task.timestep_s": 0.02,
    "action.lead_steps": 10_000,
    "action.hold_steps": 10_000,
    "algo.log_std_init": 5,
    "algo.epochs": 10_000,
    "algo.updates_per_step": 10_000,
    "sim.solver_iterations": 10_000,
    "sim.noslip_iterations": 10_000,
}
"""Highest value allowed: beyond it the physics diverges, or nothing finishes."""
_ABOVE_ZERO = (
    "time_limit_min",
    "task.timestep_s",
    "algo.learning_rate",
    "algo.adam_eps",
    "algo.clip",
    "algo.max_grad_norm",
    "algo.observation_clip",
    "algo.reward_scale",
    "algo.temperature_init",
    "algo.pre_tanh_limit",
    "checkpoint.interval_s",
)
_SHARES = (
    "algo.gamma",
    "algo.gae_lambda",
    "algo.target_rate",
    "algo.noise_correlation",
    "algo.average_rate",
)


def check_ranges(flat: Mapping[str, object]) -> None:
    """Check the range of each number.

    Args:
        flat: settings by their dotted keys; keys that the learner does not have are skipped.

    Raises:
        ConfigError: at the first number out of its range.
    """
    numbers = {k: v for k, v in flat.items() if isinstance(v, int | float)}
    for key, low in _AT_LEAST.items():
        check_at_least(key, numbers.get(key, low), low)
    for key, high in AT_MOST.items():
        if numbers.get(key, high) > high:
            raise ConfigError(f"{key} is {numbers[key]}; it must be at most {high}")
    for key in _ABOVE_ZERO:
        check_above_zero(key, numbers.get(key, 1))
    for key in _SHARES:
        if not 0 <= numbers.get(key, 0) <= 1:
            raise ConfigError(f"{key} is {numbers[key]}; it must be between 0 and 1")
    hidden = flat.get("algo.hidden")
    if isinstance(hidden, list) and any(isinstance(width, int) and width < 1 for width in hidden):
        raise ConfigError(f"algo.hidden is {hidden}; every width must be at least 1")


def check_early(flat: Mapping[str, object], before: Mapping[str, object]) -> None:
    """Check types and ranges as far as possible without importing the schema.

    Args:
        flat: settings by their dotted keys.
        before: the same settings before keys were overridden.

    Raises:
        ConfigError: if a number or truth value was replaced by something else, or a number is out
            of range.
    """
    checked = dict(flat)
    for key, value in flat.items():
        kind = type(before.get(key))
        if kind is int and isinstance(value, float):
            # May be valid: the key may be a float key with a whole default, or the value 1e6.
            continue
        if kind in (bool, int, float) and isinstance(value, str | int | float):
            checked[key] = scalar(kind, value, key)
    check_ranges(checked)
