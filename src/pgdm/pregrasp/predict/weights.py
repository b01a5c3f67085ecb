"""The file of a predictor: tensors, numbers and names; reading it never runs code from it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from pgdm import files, paths
from pgdm.errors import ConfigError, CorruptAssetError
from pgdm.pregrasp.predict.encoding import BASIS_POINTS
from pgdm.pregrasp.predict.predictor import Predictor

FORMAT = "pgdm-predictor-1"
"""Format of the file; to be changed whenever the encoding or the grasp vectors change."""

_ARRAYS = ("anchor_m", "code_mean", "slope", "mean", "factor")
_NUMBERS = ("penalty", "error_m", "mean_hand_error_m")
_NAMES = ("tasks", "objects", "left_out")


def path_of(hand: str) -> Path:
    """Return the path of the user's predictor of a hand; the file may not exist."""
    return paths.inside(paths.user() / "predictors", hand, kind="hand", suffix=".pt")


def write(path: Path, predictor: Predictor) -> None:
    """Write a predictor atomically.

    Raises:
        OSError: it cannot be written.
    """
    content: dict[str, object] = {"format": FORMAT, "hand": predictor.hand}
    for name in _ARRAYS:
        content[name] = torch.from_numpy(np.ascontiguousarray(getattr(predictor, name)))
    content |= {name: float(getattr(predictor, name)) for name in _NUMBERS}
    content |= {name: list(getattr(predictor, name)) for name in _NAMES}
    path.parent.mkdir(parents=True, exist_ok=True)
    with paths.replacing(path) as temp:
        torch.save(content, temp)


def read(path: Path, hand: str) -> Predictor:
    """Read the predictor of a hand.

    Raises:
        ConfigError: the file is missing, or for another hand.
        CorruptAssetError: the file is damaged, or has another format.
    """
    cure = f"train one with 'pgdm pregrasp train --hand {hand}'"
    if not path.is_file():
        raise ConfigError(f"{path}: there is no predictor for hand '{hand}'; {cure}")
    try:
        content = files.parse_tensors(files.read_bytes(path))
    except (OSError, ValueError) as error:
        raise CorruptAssetError(f"{path}: damaged ({error}); {cure}") from error
    found = content.get("format") if isinstance(content, dict) else None
    if not isinstance(content, dict) or found != FORMAT:
        raise CorruptAssetError(f"{path}: is of format '{found}', not '{FORMAT}'; {cure}")
    if content.get("hand") != hand:
        raise ConfigError(f"{path}: is for hand '{content.get('hand')}', not '{hand}'; {cure}")
    try:
        arrays: dict[str, Any] = {name: _array(content, name) for name in _ARRAYS}
        values: dict[str, Any] = {name: float(content[name]) for name in _NUMBERS}
        values |= {name: tuple(map(str, content[name])) for name in _NAMES}
    except (KeyError, TypeError, ValueError, OverflowError) as problem:
        raise CorruptAssetError(f"{path}: missing or invalid: {problem}; {cure}") from problem
    size = arrays["mean"].size
    wanted = {
        "mean": (size,),
        "anchor_m": (3,),
        "code_mean": (BASIS_POINTS,),
        "slope": (BASIS_POINTS, size),
        "factor": (*arrays["factor"].shape[:1], size),
    }
    for name, shape in wanted.items():
        if arrays[name].shape != shape:
            raise CorruptAssetError(
                f"{path}: '{name}' has shape {arrays[name].shape}, not {shape}; {cure}"
            )
    return Predictor(hand=hand, **values, **arrays)


def _array(content: dict[str, object], name: str) -> np.ndarray:
    value = content[name]
    if not isinstance(value, torch.Tensor) or not torch.isfinite(value).all():
        raise ValueError(f"'{name}', which is not finite numbers")
    return value.to(torch.float64).numpy()
