"""A task's scene for plain MuJoCo: the exact compiled model, and MJCF with its meshes."""

from __future__ import annotations

import shutil
import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco

from pgdm import files, paths
from pgdm.config.schema import ExperimentCfg
from pgdm.errors import ConfigError, SceneError
from pgdm.library import Library
from pgdm.library.checks.compiled import compile_tracked
from pgdm.sim.assembly import assemble

BINARY, XML, ASSETS = "scene.mjb", "scene.xml", "assets"


def write_scene(library: Library, cfg: ExperimentCfg, folder: Path) -> None:
    """Write ``scene.mjb``, and ``scene.xml`` with its meshes and textures in ``assets``.

    ``scene.mjb`` is the model that pgdm steps, to the bit, and can be read by the same version of
    MuJoCo only. The numbers of ``scene.xml`` are rounded to about seven digits.

    Args:
        library: the library of the task's assets.
        cfg: the experiment.
        folder: a new or empty folder; written completely or not at all.

    Raises:
        ConfigError: if the folder is not empty, or cannot be written.
        SceneError: if the scene does not compile.
    """
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise ConfigError(f"'{folder}' is not an empty folder; name a new one for the scene")
    temp = folder.with_name(f"{paths.TEMPORARY}{folder.name}")
    try:
        shutil.rmtree(temp, ignore_errors=True)
        (temp / ASSETS).mkdir(parents=True)
        _fill(library, cfg, temp)
        temp.replace(folder)
    except OSError as error:
        raise ConfigError(f"cannot write '{folder}': {files.reason(error)}") from error
    finally:
        shutil.rmtree(temp, ignore_errors=True)


def _fill(library: Library, cfg: ExperimentCfg, folder: Path) -> None:
    spec, origins, _ = assemble(library, cfg.task, cfg.hand, cfg.sim)
    try:
        model = compile_tracked(spec, cfg.task.tracked_body)
    except ValueError as error:
        raise SceneError(f"the scene of '{cfg.task.id}' does not compile: {error}") from error
    mujoco.mj_saveModel(model, str(folder / BINARY))
    root = ET.fromstring(spec.to_xml())
    for element in root.iter():
        if (file := element.get("file")) is None:
            continue
        prefix = max((p for p in origins if element.get("name", "").startswith(p)), key=len)
        copy = f"{prefix.rstrip('/') or 'table'}-{Path(file).name}"
        shutil.copyfile(origins[prefix] / file, folder / ASSETS / copy)
        element.set("file", f"{ASSETS}/{copy}")
    ET.ElementTree(root).write(folder / XML, encoding="utf-8")
