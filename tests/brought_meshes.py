"""Meshes as a user would have them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

SIDES = np.array([0.04, 0.06, 0.08])  # m
VOLUME, MASS = 192e-6, 0.24  # m3, and kg at 1250 kg/m3


def box() -> trimesh.Trimesh:
    return trimesh.creation.box(SIDES)


def saved(mesh: trimesh.Trimesh, name: str = "it.stl") -> Path:
    mesh.export(name)
    return Path(name).absolute()
