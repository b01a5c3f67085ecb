"""Where things are kept."""

from __future__ import annotations

import os
from pathlib import Path


def home() -> Path:
    """Return ``PGDM_HOME``, by default ``pgdm`` in the user's cache directory."""
    chosen = os.environ.get("PGDM_HOME")
    if chosen:
        return Path(chosen).expanduser().absolute()
    cache = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(cache).expanduser().absolute() / "pgdm"


def library() -> Path:
    """Return the folder of the normalised asset library."""
    return home() / "library"


def downloads() -> Path:
    """Return the folder where downloaded packages are kept."""
    return home() / "downloads"


def runs() -> Path:
    """Return the default folder of runs: ``runs`` under the working directory."""
    return Path.cwd() / "runs"
