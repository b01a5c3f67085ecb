"""A trained policy and all that its evaluation needs, wherever it is stored."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pgdm.config.saved import load_config
from pgdm.config.schema import ExperimentCfg
from pgdm.envs.build import EnvBuilder
from pgdm.errors import CheckpointError
from pgdm.experiment import assets, check_assets, env_builder
from pgdm.library.progress import Notify, StepProgress
from pgdm.rl.evaluate import policy_of
from pgdm.rl.networks import ActorCritic, SquashedPolicy
from pgdm.runs.checkpoints import find_checkpoint
from pgdm.runs.config_file import FORMAT
from pgdm.runs.files import VIDEOS


@dataclasses.dataclass(frozen=True)
class TrainedPolicy:
    """A policy, the settings it was trained with, and what was recorded about it."""

    name: str
    """Source of the policy, such as a file, for messages."""
    cfg: ExperimentCfg
    """Settings of its training."""
    network: ActorCritic | SquashedPolicy
    """The policy network, with its observation statistics."""
    frames: int
    """Length of the training, environment steps."""
    facts: Mapping[str, Any]
    """Sources and hashes of the assets, and versions, used in training; empty if unknown."""
    video: Path
    """Path for a video of the policy."""
    commands: np.ndarray | None = None
    """Base commands of the wrist plan, (T-1, 6) m and rad; None: those of the run or library."""
    evaluation: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Metrics stored with the policy."""

    def sha256(self) -> str:
        """Return a hash of names, shapes and values of its weights and statistics."""
        digest = hashlib.sha256()
        for name, tensor in sorted(self.network.state_dict().items()):
            digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
            digest.update(tensor.contiguous().numpy().tobytes())
        return digest.hexdigest()

    def settings(self) -> dict[str, Any]:
        """Return the settings as plain containers, without those that depend on the machine."""
        tracking = dataclasses.replace(self.cfg.tracking, kind="none", uri=None)
        cfg = dataclasses.replace(self.cfg, tracking=tracking, num_threads=0, device="cpu")
        settings = dataclasses.asdict(cfg)
        del settings["run_dir"]
        return {"format": FORMAT, **settings}

    def builder(self, notify: Notify, progress: StepProgress | None = None) -> EnvBuilder:
        """Compile the policy's task, and check that its assets are those used in training.

        Raises:
            PgdmError: if an asset is missing and cannot be made.
            RunError: if the assets differ from those used in training.
            CheckpointError: if observations or actions have other sizes.
        """
        library = assets(self.cfg, notify, progress).serving(self.facts.get("asset_source"))
        if progress is not None:
            progress("compiling the scene", 0, 1)
        builder = env_builder(self.cfg, library, notify, progress, commands=self.commands)
        for note in builder.notes:
            notify(note)
        if self.facts:
            check_assets(self.facts, builder, Path(self.name), notify)
        own, env = self.network.cfg, builder.probe
        if (own.obs_dim, own.action_dim) != (env.obs_dim, env.action_dim):
            raise CheckpointError(
                f"{self.name} is of a policy with {own.obs_dim} observations and "
                f"{own.action_dim} actions, task '{self.cfg.task.id}' has {env.obs_dim} and "
                f"{env.action_dim}: it belongs to another task, or to other settings"
            )
        return builder


def of_run(path: Path, best: bool = False) -> TrainedPolicy:
    """Return the policy of a run.

    Args:
        path: a run's folder, or a checkpoint in one.
        best: whether to take a run's best checkpoint, if it has one, instead of its last.

    Raises:
        RunError: if ``path`` is neither.
        CheckpointError: if the run has no checkpoint yet, or the checkpoint is damaged.
        ConfigError: if the run's settings are damaged.
    """
    run_dir, checkpoint, state = find_checkpoint(path, best)
    cfg = load_config(run_dir)
    return TrainedPolicy(
        str(checkpoint),
        cfg,
        checked(policy_of(state, checkpoint), str(checkpoint)),
        state["frames"],
        state["metadata"],
        run_dir / VIDEOS / f"eval_{checkpoint.stem}.mp4",
    )


def checked(network: ActorCritic | SquashedPolicy, where: str) -> ActorCritic | SquashedPolicy:
    """Check a network's weights and statistics, and return it.

    Raises:
        CheckpointError: if a value is not finite, or a variance is negative.
    """
    for name, tensor in network.state_dict().items():
        if not bool(torch.isfinite(tensor).all()):
            raise CheckpointError(f"{where}: '{name}' has values that are not finite numbers")
        if name == "normalizer.var" and bool((tensor < 0).any()):
            raise CheckpointError(f"{where}: '{name}' has negative values")
    return network
