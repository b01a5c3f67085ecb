"""Filling the library from a checkout of TCDM or from its data tree."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pgdm.errors import CorruptAssetError, LibraryError
from pgdm.library import figures, manifest, model_file, motion_file, names, safe_npz, staging
from pgdm.library.builder import SourceBuilder
from pgdm.library.motion_file import Start
from pgdm.library.report import Progress, Report, silent

_STARTS = {"motion_planned": "planned", "initialized": "mined", "learned": "learned"}
"""TCDM's names of the start states and ours."""

_GRAB_LICENCE = "MIT, motions derived from GRAB"
_GRAB_COPIES = frozenset(
    {
        "dhand-alarmclock",
        "dhand-binoculars",
        "dhand-cup",
        "dhand-elephant",
        "dhand-waterbottle",
        "dmanus-coffeecan",
    }
)
"""Tasks of other hands whose object moves as in a motion-capture task, or nearly so."""


@dataclass(frozen=True)
class Tree:
    """Where the parts of a checkout lie."""

    root: Path
    """Folder that holds both; names in messages are relative to it."""
    assets: Path
    """Folder with ``common.xml``, ``robots``, ``objects``."""
    trajectories: Path
    """Folder with the ``.npz`` files."""


def locate(path: Path) -> Tree:
    """Find the data in a checkout, in its ``tcdm`` package, or in its assets folder.

    Raises:
        LibraryError: it is no such folder; names what is missing.
    """
    path = Path(os.path.abspath(path.expanduser()))
    if not path.is_dir():
        raise LibraryError(f"{path}: no such folder; give the root of a TCDM checkout")
    inner = Path("envs", "assets")
    for up, assets in ((0, path / "tcdm" / inner), (1, path / inner), (3, path)):
        if not (assets / "common.xml").is_file():
            continue
        root = path.parents[up - 1] if up else path
        for trajectories in (root / "trajectories", path / "trajectories"):
            if any(trajectories.glob("*.npz")):
                return Tree(Path(os.path.commonpath([assets, trajectories])), assets, trajectories)
        raise LibraryError(f"{root}: has no trajectories/*.npz; is the checkout complete?")
    raise LibraryError(
        f"{path}: not a TCDM checkout, it has no tcdm/envs/assets/common.xml; give the folder "
        "that a clone of facebookresearch/TCDM with its submodules made"
    )


def import_tcdm(
    path: Path, root: Path, progress: Progress = silent, replace: bool = False
) -> Report:
    """Fill the library's ``checkout`` source from a TCDM checkout.

    Args:
        path: the checkout, its ``tcdm`` package or its assets folder.
        root: the library.
        progress: told about each file.
        replace: also when tasks that the library now has from a checkout would be lost.

    Raises:
        LibraryError: it is not such a folder, or the library cannot be written.
        CorruptAssetError: a file is damaged; the library stays as it was.
    """
    tree = locate(path)
    with staging.locked(root), staging.replacing(root, "checkout") as folder:
        origin = f"TCDM checkout '{tree.root.name}'"
        builder = SourceBuilder(folder, "checkout", origin, tree.root, _licence_of)
        _add_models(tree, builder, progress)
        _add_motions(tree, builder, progress)
        report = builder.finish()
        if not report.tasks:
            reasons = "; ".join(f"{k}: {v}" for k, v in list(report.left_out.items())[:3])
            raise LibraryError(f"{tree.root}: has no complete task ({reasons})")
        _refuse_loss(root, report, replace)
    return report


def _refuse_loss(root: Path, report: Report, replace: bool) -> None:
    present = staging.folder_of(root, "checkout")
    if present is None or replace:
        return
    try:
        lost = sorted(set(manifest.read(present).tasks) - set(report.tasks))
    except CorruptAssetError:
        return  # what is damaged may be replaced by anything sound
    if lost:
        raise LibraryError(
            f"{len(lost)} tasks now in the library are not in this folder ({', '.join(lost[:5])}"
            f"{', ...' if len(lost) > 5 else ''}); import a complete checkout, or add --replace"
        )


def _licence_of(origin: str) -> str:
    if origin.endswith(".npz"):
        task = names.task_id(Path(origin).stem)
        return _GRAB_LICENCE if task in figures.GRAB_TASKS or task in _GRAB_COPIES else "MIT"
    return "Apache-2.0" if "meshes/" in origin else "MIT"


def _add_models(tree: Tree, builder: SourceBuilder, progress: Progress) -> None:
    parts = [("scene", "table", tree.assets / "environments" / "table.xml")]
    parts += [("hands", h, tree.assets / "robots" / h / "base.xml") for h in names.HANDS]
    parts += [("objects", p.stem, p) for p in sorted((tree.assets / "objects").glob("*.xml"))]
    for i, (kind, name, file) in enumerate(parts):
        progress(f"{kind} {name}", i, len(parts))
        if not file.is_file():
            builder.left_out[f"{kind}/{name}"] = f"{_label(tree, file)} is missing"
            continue
        model = model_file.parse(file, builder.defects, tree.root)
        if kind == "hands":
            _add_actuators(model, file.parent / "actuators.xml", builder, tree)
        missing = model_file.missing_files(model)
        if missing:
            builder.left_out[f"{kind}/{name}"] = f"{_label(tree, Path(missing[0]))} is missing" + (
                f", and {len(missing) - 1} more" if len(missing) > 1 else ""
            )
            continue
        builder.add_model(kind, name, model, file)
    progress("models", len(parts), len(parts))
    if not builder.has("scene", "table"):
        raise LibraryError(f"{tree.root}: {builder.left_out['scene/table']}, every task needs it")
    for licence in sorted((tree.assets / "meshes").glob("*/LICENSE")):
        builder.add_file(f"licences/{licence.parent.name}.txt", licence)
    if (tree.root / "LICENSE.md").is_file():
        builder.add_file("licences/tcdm.txt", tree.root / "LICENSE.md")


def _add_actuators(model: ET.Element, file: Path, builder: SourceBuilder, tree: Tree) -> None:
    actuators = model_file.parse(file, builder.defects, tree.root)
    model.extend(actuators.findall("actuator"))


def _add_motions(tree: Tree, builder: SourceBuilder, progress: Progress) -> None:
    files = sorted(tree.trajectories.glob("*.npz"))
    for i, file in enumerate(files):
        task = names.task_id(file.stem)
        progress(f"task {task}", i, len(files))
        # Read before asking what is missing: a damaged file is refused in any case.
        arrays = normalised(safe_npz.read_npz(file), _label(tree, file))
        lacking = builder.lacking(task)
        if lacking:
            builder.left_out[task] = f"needs {' and '.join(lacking)}"
            continue
        builder.add_motion(task, arrays, file)
    progress("tasks", len(files), len(files))


def normalised(arrays: Mapping[str, Any], label: str) -> dict[str, np.ndarray]:
    """Bring the arrays of a TCDM trajectory to the library's form.

    Three released files hold more poses than their ``length``; the released environment reads
    ``length`` of them, so do we.

    Raises:
        CorruptAssetError: something is missing, of a wrong shape, or not finite.
    """
    rows = motion_file.numbers(arrays, "object_translation", label, (None, 3))
    turns = motion_file.numbers(arrays, "object_orientation", label, (len(rows), 4))
    length = float(motion_file.numbers(arrays, "length", label, ()))
    if length != int(length) or not 2 <= length <= len(rows):
        raise CorruptAssetError(
            f"{label}: 'length' is {length:g}, but there are {len(rows)} object poses"
        )
    steps = int(length)
    data_substeps = float(motion_file.numbers(arrays, "DATA_SUBSTEPS", label, ()))
    if data_substeps != 1:
        raise CorruptAssetError(
            f"{label}: DATA_SUBSTEPS is {data_substeps:g}; only 1 pose a control step can be read"
        )
    substeps = int(motion_file.numbers(arrays, "SIM_SUBSTEPS", label, ()))
    return motion_file.pack(rows[:steps], turns[:steps], substeps, _starts(arrays, label))


def _starts(arrays: Mapping[str, Any], label: str) -> dict[str, Start]:
    stored = arrays.get("s_0")
    if not isinstance(stored, Mapping):
        raise CorruptAssetError(f"{label}: 's_0' is not a table of start states")
    starts = {}
    for name, ours in _STARTS.items():
        if name not in stored:
            continue
        state, inner = stored[name], f"{label}: s_0 {name}"
        if not isinstance(state, Mapping):
            raise CorruptAssetError(f"{inner} is not a table")
        qpos = motion_file.numbers(state, "position", inner, (None,))
        qvel = motion_file.numbers(state, "velocity", inner, (len(qpos),))
        actions = None
        if "actions" in state:
            actions = motion_file.numbers(state, "actions", inner, (None, None))
        starts[ours] = Start(qpos, qvel, actions)
    if not starts:
        raise CorruptAssetError(f"{label}: 's_0' has none of {', '.join(_STARTS)}")
    return starts


def _label(tree: Tree, path: Path) -> str:
    return path.relative_to(tree.root).as_posix() if path.is_relative_to(tree.root) else path.name
