"""Policies of Stable-Baselines3's PPO, read from its zip files without running code from them.

``policy.pth`` is read with torch's ``weights_only``. Of ``data``, a JSON text, only the plain
values are used: its pickled values are never decoded. A ``VecNormalize`` file is a pickle: it is
read with stand-ins for all of its classes (`pgdm.library.files.pickles`), so that
Stable-Baselines3 need not be installed.
"""

from __future__ import annotations

import io
import re
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pgdm import files
from pgdm.config.compose import compose
from pgdm.errors import CheckpointError, CorruptAssetError
from pgdm.export.trained import TrainedPolicy, checked
from pgdm.library.files import pickles
from pgdm.rl.evaluate import network_of
from pgdm.rl.networks import ActorCritic, SquashedPolicy
from pgdm.rl.normalizer import EPS

MOST_BYTES = 1 << 26
"""Largest member of a zip that is read, bytes; a policy of the paper's architecture has 0.4 MB."""
_PACKAGES = ("stable_baselines3", "gymnasium", "gym", "numpy", "collections")
"""Packages whose objects a ``VecNormalize`` file may hold."""
_LAYER = re.compile(r"mlp_extractor\.policy_net\.(\d+)\.weight")
_TANH = "<class 'torch.nn.modules.activation.Tanh'>"


def read(
    path: Path, task: str, overrides: Sequence[str] = (), vecnormalize: Path | None = None
) -> TrainedPolicy:
    """Return the policy of a zip file.

    Args:
        path: file written by ``PPO.save``.
        task: task that the policy was trained on.
        overrides: settings of that training which differ from the paper's.
        vecnormalize: file written by ``VecNormalize.save``, if observations were standardised.

    Raises:
        ConfigError: if a setting is wrong.
        CheckpointError: if a file is damaged, or the policy is not of the form of the released
            ones: separate tanh networks and a state-independent standard deviation.
    """
    cfg = compose([f"task={task}", *overrides])
    data, weights = _members(path)
    _check_form(data, path)
    network = _network(weights, vecnormalize, path)
    frames = data.get("num_timesteps")
    return TrainedPolicy(
        str(path),
        cfg,
        checked(network, str(path)),
        frames if isinstance(frames, int) else 0,
        {},
        Path(f"{path.stem}.mp4"),
    )


def _members(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return ``data`` and ``policy.pth``."""
    try:
        content = files.read_bytes(path)
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            data, weights = (_member(archive, name, path) for name in ("data", "policy.pth"))
        found, tensors = files.parse_json(data), files.parse_tensors(_flat(weights, path))
    except (
        OSError,
        ValueError,
        LookupError,
        zipfile.BadZipFile,
        zlib.error,
        NotImplementedError,
        RuntimeError,
        EOFError,
    ) as error:
        raise CheckpointError(
            f"'{path}' is not a zip of Stable-Baselines3's PPO ({files.reason(error)})"
        ) from error
    if not isinstance(found, dict):
        raise CheckpointError(f"'{path}': its data is not a mapping")
    if not isinstance(tensors, Mapping) or not all(
        isinstance(value, Tensor) for value in tensors.values()
    ):
        raise CheckpointError(f"'{path}': its policy.pth is not a mapping of tensors")
    return found, dict(tensors)


def _member(archive: zipfile.ZipFile, name: str, path: Path) -> bytes:
    info = archive.getinfo(name)
    if info.file_size > MOST_BYTES:
        raise CheckpointError(
            f"'{path}': {name} would unpack to {info.file_size:,} bytes, more than the "
            f"{MOST_BYTES:,} allowed"
        )
    return archive.read(info)


def _flat(weights: bytes, path: Path) -> bytes:
    """Check the unpacked size of a ``.pth``, a zip itself; return its content unchanged."""
    with zipfile.ZipFile(io.BytesIO(weights)) as archive:
        size = sum(info.file_size for info in archive.infolist())
    if size > MOST_BYTES:
        raise CheckpointError(
            f"'{path}': policy.pth would unpack to {size:,} bytes, more than the {MOST_BYTES:,} "
            "allowed"
        )
    return weights


def _check_form(data: Mapping[str, Any], path: Path) -> None:
    settings = data.get("policy_kwargs")
    settings = settings if isinstance(settings, Mapping) else {}
    activation = settings.get("activation_fn", _TANH)
    if activation != _TANH:
        raise CheckpointError(
            f"'{path}': its networks use {activation!s:.60}; pgdm reads policies with tanh"
        )
    if data.get("use_sde", False) is not False:
        raise CheckpointError(
            f"'{path}' explores with gSDE; pgdm reads policies with Gaussian noise"
        )


def _network(
    weights: dict[str, Tensor], vecnormalize: Path | None, path: Path
) -> ActorCritic | SquashedPolicy:
    layers = sorted(int(m[1]) for name in weights if (m := _LAYER.fullmatch(name)))
    state: dict[str, Tensor] = {}
    try:
        for place, layer in enumerate(layers):
            for part in ("weight", "bias"):
                key = f"mlp_extractor.policy_net.{layer}.{part}"
                state[f"policy.{2 * place}.{part}"] = weights[key]
        for part in ("weight", "bias"):
            state[f"policy.{2 * len(layers)}.{part}"] = weights[f"action_net.{part}"]
        state["log_std"] = weights["log_std"]
        hidden = [len(weights[f"mlp_extractor.policy_net.{i}.weight"]) for i in layers]
        size = int(state["policy.0.weight"].shape[1])
        # Evaluating a policy needs no value function: the critic is zero.
        critic = {n.replace("policy", "critic"): torch.zeros_like(w) for n, w in state.items()}
        last = f"critic.{2 * len(layers)}"
        critic |= {f"{last}.weight": torch.zeros(1, hidden[-1]), f"{last}.bias": torch.zeros(1)}
        del critic["log_std"]
        statistics, clip = _statistics(vecnormalize, size)
        settings = {
            "obs_dim": size,
            "action_dim": len(state["log_std"]),
            "hidden": hidden,
            "log_std_init": 0.0,
            "normalize_observations": bool(statistics),
            "observation_clip": clip,
        }
        return network_of(settings, state | critic | statistics)
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        raise CheckpointError(
            f"'{path}' holds no policy of the released form, separate networks and one standard "
            f"deviation ({type(error).__name__}: {files.reason(error):.120})"
        ) from error


def _statistics(path: Path | None, size: int) -> tuple[dict[str, Tensor], float]:
    """Return a ``VecNormalize`` file's statistics as those of a `Normalizer`, and its clip."""
    if path is None:
        return {}, 10.0
    try:
        found = pickles.loads(pickles.read_bytes(path), str(path), _PACKAGES)
    except CorruptAssetError as error:
        raise CheckpointError(f"{error}") from error
    try:
        if not found["norm_obs"]:
            return {}, 10.0
        mean, var = (np.asarray(found["obs_rms"][key], np.float64) for key in ("mean", "var"))
        count, eps = float(found["obs_rms"]["count"]), float(found["epsilon"])
        clip = float(found["clip_obs"])
    except (LookupError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"'{path}' holds no statistics of VecNormalize ({type(error).__name__}: "
            f"{files.reason(error):.60})"
        ) from error
    if mean.shape != (size,) or var.shape != (size,):
        raise CheckpointError(
            f"'{path}' has statistics of {mean.shape} observations, the policy takes {(size,)}: it "
            "belongs to another policy"
        )
    if not clip > 0 or not eps >= 0:
        raise CheckpointError(
            f"'{path}' clips at {clip:g} with epsilon {eps:g}; valid: a clip above 0, an epsilon "
            "of 0 or more"
        )
    values = {"mean": mean, "var": np.maximum(var + eps - EPS, 0.0), "count": np.array(count)}
    return {f"normalizer.{name}": torch.from_numpy(v) for name, v in values.items()}, clip
