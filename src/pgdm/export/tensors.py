"""Policies as safetensors files, which cannot run code: weights, and a JSON description."""

from __future__ import annotations

import json
import lzma
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from pgdm import files, paths
from pgdm.config.saved import typed
from pgdm.errors import CheckpointError, ConfigError
from pgdm.export.description import FORMAT
from pgdm.export.graph import KEY
from pgdm.export.trained import TrainedPolicy, checked
from pgdm.rl.evaluate import network_of
from pgdm.rl.networks import ActorCritic, SquashedPolicy

MOST_BYTES = 1 << 26
"""Largest file that is read, and largest content of a compressed file, bytes."""
_COMMANDS = "wrist.commands"
_NETWORK = "network."
# Tuned for float16 weights, whose bytes resemble the bytes two positions before.
_FILTERS = [{"id": lzma.FILTER_LZMA2, "preset": 6, "lc": 0, "lp": 1, "pb": 1}]


def pack(
    policy: TrainedPolicy,
    commands: np.ndarray | None,
    about: Mapping[str, Any],
    half: bool = False,
) -> bytes:
    """Return a policy as safetensors.

    Args:
        policy: the policy.
        commands: base commands of the wrist plan, (T-1, 6) m and rad, or None.
        about: the policy's description.
        half: whether to round float32 weights to float16; observation statistics stay float64.
    """
    tensors = {}
    for name, value in policy.network.state_dict().items():
        value = value.contiguous()
        tensors[_NETWORK + name] = value.half() if half and value.dtype == torch.float32 else value
    if commands is not None:
        tensors[_COMMANDS] = torch.from_numpy(commands)
    return save(tensors, {KEY: json.dumps(about)})


def write(path: Path, content: bytes) -> None:
    """Write a packed policy atomically; compressed if the name ends in ``.xz``.

    Raises:
        OSError: if it cannot be written.
    """
    with paths.replacing(path) as temp:
        temp.write_bytes(compressed(content) if path.suffix == ".xz" else content)


def compressed(content: bytes) -> bytes:
    """Return a packed policy as ``.xz``; equal content gives equal bytes."""
    return lzma.compress(content, filters=_FILTERS)


def read(path: Path) -> TrainedPolicy:
    """Read a policy from a ``.safetensors`` or ``.safetensors.xz``; nothing in it is executed.

    Raises:
        CheckpointError: if the file is missing, is damaged or holds no policy of pgdm.
        ConfigError: if its settings are damaged, or of another task.
    """
    try:
        raw = files.read_bytes(path, MOST_BYTES)
    except OSError as error:
        raise CheckpointError(f"cannot read '{path}': {files.reason(error)}") from error
    return parse(raw, str(path), Path(path.name.partition(".")[0] + ".mp4"))


def parse(raw: bytes, where: str, video: Path) -> TrainedPolicy:
    """Return the policy in the content of a file; see `read`.

    Args:
        raw: the content.
        where: source of the content, for messages.
        video: path for a video of the policy.
    """
    raw = unpacked(raw, where)
    about = _about(raw, where)
    try:
        tensors = load(raw)
    except (SafetensorError, ValueError, KeyError, RuntimeError) as error:
        raise CheckpointError(f"{where} is damaged ({files.reason(error)})") from error
    commands = tensors.pop(_COMMANDS, None)
    if commands is not None and not bool(torch.isfinite(commands).all()):
        raise CheckpointError(f"{where}: '{_COMMANDS}' has values that are not finite numbers")
    cfg = typed(about["settings"], where, str(paths.runs() / paths.as_name(video.stem)))
    if cfg.task.id != about["task"]:
        raise ConfigError(
            f"{where} is of task '{about['task']}', but its settings are of '{cfg.task.id}'"
        )
    policy = TrainedPolicy(
        where,
        cfg,
        checked(_network(about["network"], tensors, where), where),
        about["frames"],
        about["facts"],
        video,
        None if commands is None else commands.double().numpy(),
        about["evaluation"],
    )
    if cfg.action.plans_wrist and commands is None and "wrist_sha256" in policy.facts:
        raise CheckpointError(f"{where} lacks '{_COMMANDS}', on which its policy was trained")
    stated = about.get("policy_sha256")
    if stated != policy.sha256():
        raise CheckpointError(f"{where}: its weights do not match their SHA-256, {stated!s:.12}...")
    return policy


def about(raw: bytes, where: str) -> dict[str, Any]:
    """Return the description in the content of a file; arguments and errors as for `parse`."""
    return _about(unpacked(raw, where), where)


def unpacked(raw: bytes, where: str) -> bytes:
    """Return the content of an ``.xz``; other content as it is.

    Raises:
        CheckpointError: if it is damaged or cut off, or would exceed `MOST_BYTES`.
    """
    if not raw.startswith(b"\xfd7zXZ\x00"):
        return raw
    try:
        unpacker = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=MOST_BYTES)
        content = unpacker.decompress(raw, MOST_BYTES + 1)
    except lzma.LZMAError as error:
        raise CheckpointError(f"{where} is damaged ({files.reason(error)})") from error
    if len(content) > MOST_BYTES:
        raise CheckpointError(f"{where} would unpack to more than {MOST_BYTES:,} bytes")
    if not unpacker.eof:
        raise CheckpointError(f"{where} is cut off")
    return content


_KINDS = {"task": str, "frames": int, "network": dict, "settings": dict, "facts": dict}


def _about(raw: bytes, where: str) -> dict[str, Any]:
    """Return the description in a safetensors header: 8 bytes with its length, then JSON."""
    size = int.from_bytes(raw[:8], "little")
    if len(raw) < 8 or size > len(raw) - 8:
        raise CheckpointError(
            f"{where} is not a safetensors file, or is cut off ({len(raw)} bytes)"
        )
    try:
        header = files.parse_json(raw[8 : 8 + size])
        about = files.parse_json(header["__metadata__"][KEY].encode())
        found = about["format"]
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise CheckpointError(
            f"{where} holds no policy of pgdm ({files.reason(error)}); "
            "'pgdm export RUN --format safetensors' writes one"
        ) from error
    if found != FORMAT:
        raise CheckpointError(f"{where} has format {found!r:.40}; this pgdm reads '{FORMAT}'")
    for key, kind in _KINDS.items():
        if not isinstance(about.get(key), kind):
            raise CheckpointError(f"{where} is damaged: '{key}' is {about.get(key)!r:.40}")
    evaluation = about.setdefault("evaluation", {})
    numbers = evaluation.values() if isinstance(evaluation, dict) else (None,)
    if not all(isinstance(number, int | float) for number in numbers):
        raise CheckpointError(f"{where} is damaged: 'evaluation' is {evaluation!r:.40}")
    if not isinstance(about["facts"].get("versions", {}), dict):
        raise CheckpointError(f"{where} is damaged: its versions are not a mapping")
    return about


def _network(
    settings: dict[str, Any], tensors: Mapping[str, torch.Tensor], where: str
) -> ActorCritic | SquashedPolicy:
    state = {n.removeprefix(_NETWORK): t for n, t in tensors.items() if n.startswith(_NETWORK)}
    try:
        return network_of(settings, state)
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        reason = f"{type(error).__name__}: {files.reason(error):.200}"
        raise CheckpointError(
            f"{where} holds no policy that this pgdm can read ({reason})"
        ) from error


def halved(policy: TrainedPolicy) -> TrainedPolicy:
    """Return a policy with its weights rounded to float16; it still computes in float32."""
    rounded = {
        name: value.half() if value.dtype == torch.float32 else value
        for name, value in policy.network.state_dict().items()
    }
    return replace(policy, network=network_of(vars(policy.network.cfg), rounded))
