"""``pgdm export``: a policy, or episodes of it, for other tools."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from pgdm import files
from pgdm.cli.console.screen import bars, notify
from pgdm.cli.policies import PolicyRequest, open_policy
from pgdm.envs.build import EnvBuilder
from pgdm.errors import ConfigError, amount
from pgdm.export.extras import check_installed
from pgdm.export.scene import write_scene
from pgdm.export.trained import TrainedPolicy
from pgdm.library import open_library
from pgdm.library.progress import StepProgress
from pgdm.stop import StopRequest

_ENDINGS = {"torchscript": ".pt", "onnx": ".onnx", "safetensors": ".safetensors"}
_PACKAGES = {"onnx": ("onnx", "onnxscript"), "minari": ("minari",)}


@dataclass(frozen=True)
class ExportRequest:
    """What to write, and where."""

    policy: PolicyRequest
    """Which policy."""
    form: str
    """``torchscript``, ``onnx``, ``safetensors`` or ``minari``."""
    out: Path | None
    """File to write; None: a file named after the task. For ``minari``: folder of datasets; None:
    ``datasets``."""
    scene: Path | None
    """Folder to write the scene to; None: the scene is not written."""
    episodes: int
    """Only ``minari``: number of episodes."""
    deterministic: bool
    """Only ``minari``: whether to take the policy's mean action."""
    seed: int | None
    """Only ``minari``: seed of action noise and task randomisation; None: the run's."""
    offline: bool
    """Whether missing assets are an error instead of being fetched."""


def export(request: ExportRequest) -> int:
    """Write a policy or its episodes, and the scene if asked to; return the exit code.

    Raises:
        PgdmError: if a package or an asset is missing, the policy cannot be read, its task does not
            compile, or a file cannot be written.
    """
    check_installed(f"--format {request.form}", *_PACKAGES.get(request.form, ()))
    policy = open_policy(request.policy)
    cfg = policy.cfg
    policy = replace(policy, cfg=replace(cfg, offline=request.offline or cfg.offline))
    path = None if request.form == "minari" else _file(request, policy)
    with bars() as progress:
        builder = policy.builder(notify, progress)
    with StopRequest() as stop, bars() as progress:
        if request.scene is not None:
            progress("writing the scene", 0, 1)
            library = open_library().serving(policy.facts.get("asset_source"))
            write_scene(library, policy.cfg, request.scene)
        if path is None:
            code = _episodes(request, policy, builder, progress, stop)
        else:
            progress("writing the policy", 0, 1)
            code = _policy(request.form, policy, builder, path)
    if request.scene is not None:
        print(f"scene:  {request.scene}")
    return code


def _file(request: ExportRequest, policy: TrainedPolicy) -> Path:
    """Return the file to write.

    Raises:
        ConfigError: if its name does not fit the format.
    """
    ending = _ENDINGS[request.form]
    path = request.out or Path(policy.cfg.task.id + ending)
    if path.suffix != ending:
        raise ConfigError(
            f"--out '{path}' does not fit {request.form}; give a name that ends in {ending}"
        )
    return path


def _policy(form: str, policy: TrainedPolicy, builder: EnvBuilder, path: Path) -> int:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _write(form, policy, builder, path)
    except OSError as error:
        raise ConfigError(f"cannot write '{path}': {files.reason(error)}") from error
    print(f"policy: {path} ({path.stat().st_size / 1e6:.1f} MB)")
    return 0


def _write(form: str, policy: TrainedPolicy, builder: EnvBuilder, path: Path) -> None:
    if form == "safetensors":
        from pgdm.export import tensors  # an optional dependency
        from pgdm.export.description import description

        commands = None if builder.wrist is None else builder.wrist.commands
        tensors.write(path, tensors.pack(policy, commands, description(policy, builder)))
        return
    from pgdm.export.graph import write_onnx, write_torchscript

    (write_onnx if form == "onnx" else write_torchscript)(policy, builder, path)


def _episodes(
    request: ExportRequest,
    policy: TrainedPolicy,
    builder: EnvBuilder,
    progress: StepProgress,
    stop: StopRequest,
) -> int:
    from pgdm.export.episodes import EpisodesRequest, write_episodes  # an optional dependency

    folder = request.out or Path("datasets")
    seed = policy.cfg.seed if request.seed is None else request.seed
    wanted = EpisodesRequest(request.episodes, request.deterministic, seed)
    name = write_episodes(policy, builder, wanted, folder, progress, stop)
    if name is None:
        return stop.exit_code
    print(f"dataset: {folder / name} ({amount(request.episodes, 'episode')})")
    print(f"to load: MINARI_DATASETS_PATH={folder.absolute()} and minari.load_dataset('{name}')")
    return 0
