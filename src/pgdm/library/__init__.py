"""The asset library: hands, objects, scenes and motions in one format, with their provenance."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from pgdm.library.catalog import Library, open_library
from pgdm.library.files.expert import Expert
from pgdm.library.files.motion import Motion, Start

if TYPE_CHECKING:
    from pgdm.library.builder import ImportSummary
    from pgdm.library.fetch import fetch_registry
    from pgdm.library.provide import ensure, ensure_expert
    from pgdm.library.tcdm import import_tcdm

__all__ = [
    "Expert",
    "ImportSummary",
    "Library",
    "Motion",
    "Start",
    "ensure",
    "ensure_expert",
    "fetch_registry",
    "import_tcdm",
    "open_library",
]

# Filling the library needs MuJoCo and SciPy, which take a second to import. Reading it needs
# neither.
_LATE = {
    "ImportSummary": "builder",
    "ensure": "provide",
    "ensure_expert": "provide",
    "fetch_registry": "fetch",
    "import_tcdm": "tcdm",
}


def __getattr__(name: str) -> object:
    if name in _LATE:
        return getattr(importlib.import_module(f"{__name__}.{_LATE[name]}"), name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
