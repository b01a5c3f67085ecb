"""The asset library: hands, objects, scenes and motions, normalised, with their provenance."""

from __future__ import annotations

from pgdm.library.catalog import Library, open_library
from pgdm.library.expert_file import Expert
from pgdm.library.motion_file import Motion, Start
from pgdm.library.provide import ensure, ensure_expert
from pgdm.library.registry import fetch_registry
from pgdm.library.report import Report
from pgdm.library.tcdm import import_tcdm

__all__ = [
    "Expert",
    "Library",
    "Motion",
    "Report",
    "Start",
    "ensure",
    "ensure_expert",
    "fetch_registry",
    "import_tcdm",
    "open_library",
]
