"""Filling the library from a checkout of TCDM, the paper authors' repository, or a part of it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pgdm import paths
from pgdm.errors import CorruptAssetError, LibraryError
from pgdm.library import manifest, staging, tasks
from pgdm.library.builder import ImportSummary, SourceBuilder
from pgdm.library.files import model as model_file
from pgdm.library.files import motion as motion_file
from pgdm.library.files import npz
from pgdm.library.files.motion import Start
from pgdm.library.progress import StepProgress, silent

_STARTS = {"motion_planned": "planned", "initialized": "mined", "learned": "learned"}
"""TCDM's name of each start state, and pgdm's."""

_GRAB_LICENCE = "MIT, motions derived from GRAB"


@dataclass(frozen=True)
class Tree:
    """Folders of a checkout."""

    root: Path
    """Common parent of the two folders below; messages name files relative to it."""
    assets: Path
    """Folder that contains ``common.xml``, ``robots`` and ``objects``."""
    trajectories: Path
    """Folder of the motions' ``.npz`` files."""


def locate(path: Path) -> Tree:
    """Find the data in a checkout, in its ``tcdm`` package, or in its assets folder.

    Raises:
        LibraryError: the folder is none of these; the message names what is missing.
    """
    path = Path(os.path.abspath(paths.expanded(path)))
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
        "of a clone of facebookresearch/TCDM with its submodules"
    )


def import_tcdm(
    path: Path, root: Path, progress: StepProgress = silent, replace: bool = False
) -> ImportSummary:
    """Fill the library source ``checkout`` from a TCDM checkout.

    Args:
        path: the checkout, its ``tcdm`` package or its assets folder.
        root: the library.
        progress: receives the steps: models, their compilation, and tasks.
        replace: import even if that removes tasks that an earlier checkout provided.

    Raises:
        LibraryError: the folder is not a checkout, or has no table scene or no complete task; tasks
            would be removed, and ``replace`` is False; or the library cannot be written.
        CorruptAssetError: a file is damaged; the library remains unchanged.
    """
    tree = locate(path)
    with staging.locked(root), staging.replacing_folder(root, "checkout") as folder:
        origin = f"TCDM checkout '{tree.root.name}'"
        builder = SourceBuilder(folder, "checkout", origin, tree.root, _licence_of)
        _add_models(tree, builder, progress)
        progress("compiling the models", 0, 1)
        builder.compile_models()
        _add_motions(tree, builder, progress)
        summary = builder.finish()
        if not summary.tasks:
            reasons = "; ".join(f"{k}: {v}" for k, v in list(summary.left_out.items())[:3])
            raise LibraryError(f"{tree.root}: has no complete task ({reasons})")
        _refuse_loss(root, summary, replace)
    return summary


def _refuse_loss(root: Path, summary: ImportSummary, replace: bool) -> None:
    present = staging.folder_of(root, "checkout")
    if present is None or replace:
        return
    try:
        lost = sorted(set(manifest.read(present).tasks) - set(summary.tasks))
    except CorruptAssetError:
        return  # an intact checkout may always replace a damaged source
    if lost:
        raise LibraryError(
            f"tasks in the library that this folder lacks: {len(lost)} ({', '.join(lost[:5])}"
            f"{', ...' if len(lost) > 5 else ''}); import a complete checkout, or add --replace"
        )


def _licence_of(origin: str) -> str:
    if origin.endswith(".npz"):
        derived = (*tasks.MOCAP_TASKS, *tasks.GRAB_COPIES)
        return _GRAB_LICENCE if tasks.task_id(Path(origin).stem) in derived else "MIT"
    return "Apache-2.0" if "meshes/" in origin else "MIT"


def _add_models(tree: Tree, builder: SourceBuilder, progress: StepProgress) -> None:
    parts = [("scene", "table", tree.assets / "environments" / "table.xml")]
    parts += [("hands", h, tree.assets / "robots" / h / "base.xml") for h in tasks.HANDS]
    parts += [("objects", p.stem, p) for p in sorted((tree.assets / "objects").glob("*.xml"))]
    for i, (kind, name, file) in enumerate(parts):
        progress(f"{kind} {name}", i, len(parts))
        if not file.is_file():
            builder.left_out[f"{kind}/{name}"] = f"{model_file.name_in(file, tree.root)} is missing"
            continue
        model = model_file.parse(file, builder.defects, tree.root)
        if kind == "hands":
            motors = model_file.parse(file.with_name("actuators.xml"), builder.defects, tree.root)
            model.extend(motors.findall("actuator"))
        missing = model_file.missing_files(model)
        if missing:
            builder.left_out[f"{kind}/{name}"] = (
                f"{model_file.name_in(Path(missing[0]), tree.root)} is missing"
                + (f", and {len(missing) - 1} more" if len(missing) > 1 else "")
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


def _add_motions(tree: Tree, builder: SourceBuilder, progress: StepProgress) -> None:
    files = sorted(tree.trajectories.glob("*.npz"))
    for i, file in enumerate(files):
        task = tasks.task_id(file.stem)
        progress(f"task {task}", i, len(files))
        # Read even if the task's models are missing: a damaged file is always refused.
        model_file.check_stays(file, tree.root)
        arrays = normalised(npz.read_npz(file), model_file.name_in(file, tree.root))
        lacking = builder.lacking(task)
        if lacking:
            builder.left_out[task] = f"needs {' and '.join(lacking)}"
            continue
        builder.add_motion(task, arrays, file)
    progress("tasks", len(files), len(files))


def normalised(arrays: Mapping[str, Any], label: str) -> dict[str, np.ndarray]:
    """Convert the arrays of a TCDM trajectory to the library's form.

    Three released files have more poses than their ``length``; only the first ``length`` poses are
    used, as in the released code.

    Raises:
        CorruptAssetError: an array is missing, of a wrong shape, or not finite; ``length`` is not
            a possible number of poses; there is not one pose per control step; or there is no
            start state.
    """
    rows = motion_file.numbers(arrays, "object_translation", label, (None, 3))
    orientations = motion_file.numbers(arrays, "object_orientation", label, (len(rows), 4))
    length = float(motion_file.numbers(arrays, "length", label, ()))
    if length != int(length) or not 2 <= length <= len(rows):
        raise CorruptAssetError(
            f"{label}: 'length' is {length:g}; valid: a whole number from 2 to {len(rows)}, the "
            "number of poses"
        )
    steps = int(length)
    data_substeps = float(motion_file.numbers(arrays, "DATA_SUBSTEPS", label, ()))
    if data_substeps != 1:
        raise CorruptAssetError(
            f"{label}: DATA_SUBSTEPS is {data_substeps:g}; valid: 1 (one pose per control step)"
        )
    substeps = int(motion_file.numbers(arrays, "SIM_SUBSTEPS", label, ()))
    return motion_file.pack(rows[:steps], orientations[:steps], substeps, _starts(arrays, label))


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
