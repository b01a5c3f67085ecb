"""Episodes of a policy as a Minari dataset, such as for offline learning."""

from __future__ import annotations

import os
import shutil
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces

from pgdm import files, paths
from pgdm.envs.batch_env import BatchEnv
from pgdm.envs.build import EnvBuilder
from pgdm.errors import ConfigError
from pgdm.export.trained import TrainedPolicy
from pgdm.library.progress import StepProgress
from pgdm.rl.torch_state import torch_threads
from pgdm.seeding import torch_stream

_FOLDER = "MINARI_DATASETS_PATH"


@dataclass(frozen=True)
class EpisodesRequest:
    """Which episodes to write."""

    episodes: int
    """Number of episodes."""
    deterministic: bool
    """Whether to take the policy's mean action instead of samples."""
    seed: int
    """Seed of the action noise and of the object's randomisation."""


def dataset_id(policy: TrainedPolicy) -> str:
    """Return the name of a policy's dataset, such as ``pgdm/hammer-use1/sac-s1-v0``."""
    name = f"{policy.cfg.algo.name}-s{policy.cfg.seed}".replace(".", "-")
    return f"pgdm/{policy.cfg.task.id}/{name}-v0"


def write_episodes(
    policy: TrainedPolicy,
    builder: EnvBuilder,
    request: EpisodesRequest,
    folder: Path,
    progress: StepProgress,
    stop: Callable[[], bool],
) -> str | None:
    """Run episodes and write them as a Minari dataset; return its name, or None if stopped.

    An episode of L steps has observations (L+1, D) and clipped actions (L, A), both float32, and
    the task's rewards without shaping. ``infos`` hold ``object_error_m`` and ``success``. The
    dataset appears complete or not at all.

    Args:
        policy: the policy.
        builder: builder of the policy's task.
        request: which episodes.
        folder: folder of datasets; set ``MINARI_DATASETS_PATH`` to it to load them.
        progress: called with the episodes finished.
        stop: polled before each step; True ends without a dataset.

    Raises:
        ConfigError: if the folder has this dataset already or cannot be written.
    """
    name = dataset_id(policy)
    place = folder / name
    if place.exists():
        raise ConfigError(f"'{place}' exists; remove it, or name another folder with --out")
    env = builder.make(1, 1, request.seed, "eval", auto_reset=False)
    noise = None if request.deterministic else torch_stream(request.seed, "eval")
    buffers = []
    with torch_threads(1):
        for number in range(request.episodes):
            progress("episodes", number, request.episodes)
            buffer = _episode(env, policy, noise, number, stop)
            if buffer is None:
                return None
            buffers.append(buffer)
    progress("writing", 0, 1)
    try:
        _store(buffers, policy, env, name, folder)
    except OSError as error:
        raise ConfigError(f"cannot write '{place}': {files.reason(error)}") from error
    return name


def _episode(
    env: BatchEnv,
    policy: TrainedPolicy,
    noise: torch.Generator | None,
    number: int,
    stop: Callable[[], bool],
) -> Any:
    from minari.data_collector.episode_buffer import EpisodeBuffer

    seen, actions, rewards, ends, cuts = [env.reset()[0].numpy().copy()], [], [], [], []
    # Minari stores one info per observation.
    infos: dict[str, list[Any]] = {
        "object_error_m": [float(env.object_error()[0])],
        "success": [False],
    }
    while not (ends and (ends[-1] or cuts[-1])):
        if stop():
            return None
        action = policy.network.act(
            torch.from_numpy(seen[-1])[None], noise, deterministic=noise is None
        )
        obs, reward, terminated, truncated, info = env.step(action)
        seen.append(obs[0].numpy().copy())
        actions.append(action[0].clamp(-1.0, 1.0).numpy())
        rewards.append(float(reward[0]))
        ends.append(bool(terminated[0]))
        cuts.append(bool(truncated[0]))
        infos["object_error_m"].append(float(info["object_error_m"][0]))
        infos["success"].append(bool(info["success"][0]))
    return EpisodeBuffer(
        id=number,
        observations=np.stack(seen),  # type: ignore[arg-type] (Minari declares lists)
        actions=np.stack(actions),  # type: ignore[arg-type]
        rewards=rewards,
        terminations=ends,
        truncations=cuts,
        infos={key: np.array(values) for key, values in infos.items()},
    )


def _store(
    buffers: list[Any], policy: TrainedPolicy, env: BatchEnv, name: str, folder: Path
) -> None:
    """Write a dataset to a temporary folder, then move it to its place."""
    import minari

    folder.mkdir(parents=True, exist_ok=True)
    # Minari cannot store in a relative folder.
    temp, before = folder.absolute() / f"{paths.TEMPORARY}{os.getpid()}", os.environ.get(_FOLDER)
    os.environ[_FOLDER] = str(temp)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about empty fields of the metadata
            minari.create_dataset_from_buffers(
                name,
                buffers,
                action_space=spaces.Box(-1.0, 1.0, (env.action_dim,), np.float32),
                observation_space=spaces.Box(-np.inf, np.inf, (env.obs_dim,), np.float32),
                algorithm_name=policy.cfg.algo.name,
                description=_described(policy),
                data_format="hdf5",
            )
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (temp / name).replace(folder / name)
    finally:
        shutil.rmtree(temp, ignore_errors=True)
        if before is None:
            os.environ.pop(_FOLDER)
        else:
            os.environ[_FOLDER] = before


def _described(policy: TrainedPolicy) -> str:
    return (
        f"{policy.cfg.task.id}: policy {policy.sha256()[:16]} after {policy.frames:,} frames of "
        f"{policy.cfg.method.name} with {policy.cfg.algo.name}, {policy.cfg.action.kind} action"
    )
