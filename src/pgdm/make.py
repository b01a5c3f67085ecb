"""Environments by task id, for Python, Gymnasium, TorchRL and Stable-Baselines3."""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from pgdm.config.groups import available
from pgdm.errors import ConfigError, check_interpreter
from pgdm.sim.gl import deferred

if TYPE_CHECKING:
    from pgdm.envs.batch_env import BatchEnv
    from pgdm.envs.gym import PgdmEnv
    from pgdm.envs.sb3 import PgdmVecEnv
    from pgdm.envs.torchrl import PgdmTorchRLEnv

_log = logging.getLogger(__name__)

_GROUPS = ("pregrasp", "obs", "action", "reference", "method", "ablation", "hand", "sim")


def make_batch(
    task: str,
    *,
    num_envs: int = 64,
    num_threads: int = 0,
    seed: int = 0,
    auto_reset: bool = True,
    offline: bool = False,
    overrides: Sequence[str] = (),
    **choices: str,
) -> BatchEnv:
    """Return N simulations of a task, stepped together on several threads.

    Args:
        task: task id, such as ``hammer-use1``.
        num_envs: N.
        num_threads: threads that step the simulations; 0 takes one per core available here.
        seed: seed of the randomisation at each reset, in tasks that have it.
        auto_reset: whether rows restart automatically when their episode ends.
        offline: whether missing assets are an error instead of being fetched.
        overrides: more settings, as on ``pgdm-run``'s command line. Rewards are those of training,
            including any shaping (``["+experiment=fast"]`` adds some).
        choices: settings groups and their options, such as ``pregrasp="planned"``,
            ``obs="released"``, ``action="absolute"``, ``method="pgdm"``, ``ablation="none"``.

    Returns:
        An env with ``reset() -> obs (N, D)`` and ``step(action (N, A)) -> obs, reward (N,),
        terminated (N,), truncated (N,), info``; see `pgdm.envs.batch_env.BatchEnv.step`.

    Raises:
        ConfigError: if a name or value is wrong, or the simulations do not fit into the memory.
        LibraryError: if the task's assets are missing and cannot be fetched.
    """
    for name in choices:
        if name not in _GROUPS:
            raise ConfigError(
                f"make_batch has no argument '{name}'; groups: {', '.join(_GROUPS)}, "
                "other settings go into overrides=['key=value']"
            )
    with deferred():  # these imports must not fail for lack of OpenGL
        from pgdm.config.compose import compose
        from pgdm.experiment import assets, env_builder

    chosen = [f"{group}={option}" for group, option in choices.items()]
    cfg = compose([f"task={task}", f"offline={str(offline).lower()}", *chosen, *overrides])
    builder = env_builder(cfg, assets(cfg, _log.warning))
    for note in builder.notes:
        _log.warning(note)
    return builder.make(num_envs, num_threads, seed, auto_reset=auto_reset)


def make_torchrl(task: str, *, num_envs: int = 64, **kwargs: Any) -> PgdmTorchRLEnv:
    """Return N simulations of a task as a TorchRL EnvBase.

    Arguments as `make_batch`, without ``auto_reset``: TorchRL requests resets itself.

    Raises:
        ConfigError: also if ``auto_reset`` is given.
    """
    _check_absent("make_torchrl", ("auto_reset",), kwargs, "TorchRL requests resets itself")
    check_interpreter()
    from pgdm.envs.torchrl import PgdmTorchRLEnv

    return PgdmTorchRLEnv(make_batch(task, num_envs=num_envs, auto_reset=False, **kwargs))


def make_sb3(task: str, *, num_envs: int = 64, **kwargs: Any) -> PgdmVecEnv:
    """Return N simulations of a task as a Stable-Baselines3 VecEnv.

    Arguments as `make_batch`; ``auto_reset`` must stay True.

    Raises:
        ConfigError: also if ``auto_reset`` is not True, or Stable-Baselines3 is not installed.
    """
    if (auto_reset := kwargs.get("auto_reset", True)) is not True:
        raise ConfigError(
            f"make_sb3: auto_reset is {auto_reset!r}; it must be True, because "
            "Stable-Baselines3 expects ended episodes to restart by themselves"
        )
    if find_spec("stable_baselines3") is None:
        raise ConfigError(
            "make_sb3 needs Stable-Baselines3: pip install -c constraints.txt -e '.[sb3]'"
        )
    from pgdm.envs.sb3 import PgdmVecEnv

    return PgdmVecEnv(make_batch(task, num_envs=num_envs, **kwargs))


def make_gym(task: str, *, render_mode: str | None = None, **kwargs: Any) -> PgdmEnv:
    """Return one simulation of a task as a Gymnasium env.

    Arguments as `make_batch`, without ``num_envs``, ``num_threads`` and ``auto_reset``. This is
    what ``gymnasium.make("pgdm/<task>-v0", ...)`` calls.

    Raises:
        ConfigError: also if one of these three is given.
    """
    fixed = ("num_envs", "num_threads", "auto_reset")
    reason = "a Gymnasium env is one simulation, which its user resets"
    _check_absent("make_gym", fixed, kwargs, reason)
    from pgdm.envs.gym import PgdmEnv

    batch = make_batch(task, num_envs=1, num_threads=1, auto_reset=False, **kwargs)
    return PgdmEnv(batch, render_mode)


def _check_absent(function: str, fixed: Sequence[str], given: Collection[str], reason: str) -> None:
    """Check that arguments which a function passes to `make_batch` itself were not given.

    Raises:
        ConfigError: if one was given; the message ends with the reason.
    """
    for name in fixed:
        if name in given:
            raise ConfigError(f"{function} has no argument '{name}'; leave it out: {reason}")


def register() -> None:
    """Register all tasks with Gymnasium, as ``pgdm/<task>-v0``."""
    import gymnasium

    try:
        tasks = available("task")
    except ConfigError as error:
        _log.warning("the tasks could not be registered with Gymnasium: %s", error)
        return
    for task in tasks:
        gymnasium.register(
            id=f"pgdm/{task}-v0", entry_point="pgdm.make:make_gym", kwargs={"task": task}
        )
