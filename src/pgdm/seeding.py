"""Named, independent random streams derived from one integer."""

from __future__ import annotations

import zlib

import numpy as np
import torch


def _sequence(seed: int, name: str) -> np.random.SeedSequence:
    # crc32 is stable across processes and Python versions; hash() is not.
    return np.random.SeedSequence([seed, zlib.crc32(name.encode())])


def torch_stream(seed: int, name: str) -> torch.Generator:
    """Return the torch generator of stream ``name`` of ``seed``."""
    state = int(_sequence(seed, name).generate_state(1, np.uint64)[0]) >> 1
    return torch.Generator().manual_seed(state)


def numpy_stream(seed: int, name: str) -> np.random.Generator:
    """Return the NumPy generator of stream ``name`` of ``seed``."""
    return np.random.Generator(np.random.PCG64(_sequence(seed, name)))
