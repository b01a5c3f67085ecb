"""Find a checkpoint of a run, and load the policy in it."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from pgdm.errors import CheckpointError, ConfigError
from pgdm.rl.checkpoint import CheckpointFolder, State, read_checkpoint
from pgdm.rl.evaluate import policy_of
from pgdm.rl.trainer import check_state
from pgdm.runs.files import CHECKPOINTS
from pgdm.runs.folder import check_links, folder_of, located
from pgdm.seeding import torch_stream

Array = TypeVar("Array", np.ndarray, torch.Tensor)


def find_checkpoint(path: Path, best: bool) -> tuple[Path, Path, State]:
    """Return the run folder and checkpoint file that a path refers to, and the file's contents.

    Args:
        path: a run folder, or a checkpoint in one.
        best: for a run folder, whether to take the best checkpoint (of highest success with sampled
            actions or, among equals, of highest return) instead of the newest usable one. If there
            is no best checkpoint, the newest usable one is taken.

    Raises:
        RunError: if ``path`` is neither, or a link leads out of the run folder.
        CheckpointError: if the run has no checkpoint yet, or none that can be used.
    """
    path = located(path)
    folder = folder_of(path)
    check_links(folder)
    if path.is_file():
        return folder, path, _checked(path)
    checkpoints = CheckpointFolder(folder / CHECKPOINTS, keep_last=1)
    if best and checkpoints.best.is_file():
        return folder, checkpoints.best, _checked(checkpoints.best)

    def check(state: State) -> None:
        check_state(state)
        policy_of(state, path)

    newest = checkpoints.newest(check)
    if newest is None:
        raise CheckpointError(
            f"'{folder}' has no checkpoint yet; pgdm resume {folder} continues it"
        )
    return folder, *newest


def _checked(file: Path) -> State:
    state = read_checkpoint(file)
    try:
        check_state(state)
    except CheckpointError as error:
        raise CheckpointError(f"{file}: {error}") from error
    return state


class LoadedPolicy:
    """The policy of a run, with its observation statistics; see `load_policy`."""

    def __init__(self, checkpoint: Path, state: State, seed: int) -> None:
        self._model = policy_of(state, checkpoint)
        self._noise = torch_stream(seed, "policy")
        self.checkpoint = checkpoint
        """The file from which the policy was read."""
        self.frames = int(state["frames"])
        """Length of the training up to the checkpoint, frames."""
        self.obs_dim = self._model.cfg.obs_dim
        """D, the size of an observation."""
        self.action_dim = self._model.cfg.action_dim
        """A, the size of an action."""

    def act(self, obs: Array, deterministic: bool = True) -> Array:
        """Return actions for a batch of observations.

        Args:
            obs: (N, D), or (D,) for a single one, as the environment returns them; NumPy or torch.
            deterministic: return the policy's mean action instead of a sample.

        Returns:
            Actions (N, A) or (A,) float32, NumPy or torch as ``obs``.

        Raises:
            ConfigError: if ``obs`` has neither of these shapes, as when the environment's settings
                are not those of the run.
        """
        rows = torch.as_tensor(obs, dtype=torch.float32)
        if rows.ndim not in (1, 2) or rows.shape[-1] != self.obs_dim:
            raise ConfigError(
                f"observations have shape {tuple(rows.shape)}, this policy takes (N, "
                f"{self.obs_dim}); make the environment with the settings of the run"
            )
        actions = self._model.act(rows.reshape(-1, self.obs_dim), self._noise, deterministic)
        found: Any = actions.reshape(*rows.shape[:-1], self.action_dim)
        return found.numpy() if isinstance(obs, np.ndarray) else found


def load_policy(run: str | PathLike[str], *, best: bool = False, seed: int = 0) -> LoadedPolicy:
    """Return the policy of a run, to act on batches of observations.

    Args:
        run: a run folder, or a checkpoint in one.
        best: for a run folder, whether to take the best checkpoint (of highest success with sampled
            actions or, among equals, of highest return) instead of the newest usable one. If there
            is no best checkpoint, the newest usable one is taken.
        seed: seed of the noise of sampled actions.

    Raises:
        ConfigError: if ``run`` is not a path.
        RunError: if ``run`` is neither a run folder nor a checkpoint in one, or a link leads out of
            the folder.
        CheckpointError: if the run has no checkpoint yet, or none that can be used.
    """
    if not isinstance(run, str | PathLike):
        raise ConfigError(f"run is {run!r:.60}; it must be a run's folder, or a checkpoint in one")
    _, checkpoint, state = find_checkpoint(Path(run), best)
    return LoadedPolicy(checkpoint, state, seed)
