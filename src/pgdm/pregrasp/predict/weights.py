"""A predictor's file: plain tensors, numbers and names, read without running code from it."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import torch

from pgdm import paths
from pgdm.errors import ConfigError, CorruptAssetError
from pgdm.pregrasp.predict.encoding import BASIS_POINTS
from pgdm.pregrasp.predict.predictor import Predictor

FORMAT = "pgdm-predictor-1"
"""Changes when the encoding or the vectors do."""

_ARRAYS = ("anchor_m", "code_mean", "slope", "mean", "factor")
_NUMBERS = ("penalty", "error_m", "mean_hand_error_m")
_NAMES = ("tasks", "objects", "left_out")


def path_of(hand: str) -> Path:
    """Return where the user's predictor of a hand lies, or would lie."""
    return paths.user() / "predictors" / f"{hand}.pt"


def write(path: Path, predictor: Predictor) -> None:
    """Write a predictor, whole or not at all.

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
        ConfigError: there is none, or it is of another hand.
        CorruptAssetError: the file is damaged, or of another format.
    """
    cure = f"'pgdm pregrasp train --hand {hand}' makes it"
    if not path.is_file():
        raise ConfigError(f"{path}: there is no predictor for hand '{hand}'; {cure}")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError, EOFError, KeyError, pickle.UnpicklingError) as error:
        reason = str(error).partition("\n")[0]
        raise CorruptAssetError(f"{path}: damaged ({reason}); {cure} anew") from error
    found = content.get("format") if isinstance(content, dict) else None
    if not isinstance(content, dict) or found != FORMAT:
        raise CorruptAssetError(f"{path}: is of format '{found}', not '{FORMAT}'; {cure} anew")
    if content.get("hand") != hand:
        raise ConfigError(f"{path}: is for hand '{content.get('hand')}', not '{hand}'; {cure}")
    try:
        arrays = {name: _array(content, name) for name in _ARRAYS}
        penalty, error, mean_hand_error = (float(content[name]) for name in _NUMBERS)
        tasks, objects, left_out = (tuple(map(str, content[name])) for name in _NAMES)
    except (KeyError, TypeError, ValueError) as problem:
        raise CorruptAssetError(f"{path}: lacks or spoils {problem}; {cure} anew") from problem
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
                f"{path}: '{name}' has shape {arrays[name].shape}, not {shape}; {cure} anew"
            )
    return Predictor(
        hand=hand,
        **arrays,
        penalty=penalty,
        tasks=tasks,
        objects=objects,
        left_out=left_out,
        error_m=error,
        mean_hand_error_m=mean_hand_error,
    )


def _array(content: dict[str, object], name: str) -> np.ndarray:
    value = content[name]
    if not isinstance(value, torch.Tensor) or not torch.isfinite(value).all():
        raise ValueError(f"'{name}', which is not finite numbers")
    return value.to(torch.float64).numpy()
