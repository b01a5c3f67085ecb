"""Open the policy that a command names, from a run, a checkpoint, a file or the zoo."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pgdm.cli.options import POLICY_FILES, known_run
from pgdm.errors import ConfigError
from pgdm.export import sb3, tensors
from pgdm.export.trained import TrainedPolicy, of_run
from pgdm.zoo import Zoo
from pgdm.zoo.place import PREFIX
from pgdm.zoo.policy import open_entry


@dataclass(frozen=True)
class PolicyRequest:
    """The policy that a command names."""

    text: str
    """A run's folder, a checkpoint, a file with a suffix in ``POLICY_FILES``, or ``zoo:NAME``."""
    best: bool = False
    """Whether to take the best checkpoint of a run folder instead of the last."""
    task: str | None = None
    """Only ``.zip``: the task that the policy was trained on."""
    settings: tuple[str, ...] = ()
    """Only ``.zip``: settings of the training that differ from the paper's."""
    vecnormalize: Path | None = None
    """Only ``.zip``: file written by ``VecNormalize.save``."""
    zoo: Zoo | None = None
    """Only ``zoo:``: which zoo; None: the default."""


def open_policy(request: PolicyRequest) -> TrainedPolicy:
    """Return the requested policy.

    Raises:
        PgdmError: if the policy is missing or cannot be read, or an option is missing or does not
            apply to this kind of policy.
    """
    if request.text.startswith(PREFIX):
        if request.best or request.task or request.settings or request.vecnormalize:
            raise ConfigError("a policy of the zoo takes no --best, --task, --set, --vecnormalize")
        return open_entry(request.zoo or Zoo(), request.text.removeprefix(PREFIX))
    path = Path(request.text)
    kind = path.suffix.lower() if path.is_file() or path.suffix.lower() in POLICY_FILES else ""
    is_zip = kind == ".zip"
    if not is_zip and (request.task or request.settings or request.vecnormalize):
        raise ConfigError(
            "--task, --set and --vecnormalize are for .zip files of Stable-Baselines3"
        )
    if kind not in POLICY_FILES:
        return of_run(known_run(path), request.best)
    if request.best:
        raise ConfigError("--best is for the folder of a run")
    if not is_zip:
        return tensors.read(path)
    if request.task is None:
        raise ConfigError(f"'{path}' does not name its task; add --task TASK")
    return sb3.read(path, request.task, request.settings, request.vecnormalize)
