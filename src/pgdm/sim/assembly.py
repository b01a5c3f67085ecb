"""The uncompiled scene of a task, put together from the library's models."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np

from pgdm.errors import SceneError
from pgdm.library import Library
from pgdm.library.published_masses import RATIOS

if TYPE_CHECKING:
    from pgdm.sim.scene import HandCfg, PlacementCfg, SimCfg, TaskCfg

# Contact priority by which the randomised geom's friction overrides that of whatever it touches
# (released code).
RANDOMIZED_PRIORITY = 10


class Assembly(NamedTuple):
    """An uncompiled scene."""

    spec: mujoco.MjSpec
    folders: dict[str, Path]
    """For table, hand and objects: prefix of the part's names -> folder of its meshes, textures."""
    randomized: str | None
    """Name of the randomised geom."""


def assemble(library: Library, task: TaskCfg, hand: HandCfg, sim: SimCfg) -> Assembly:
    """Put the scene of a task together.

    Raises:
        SceneError: if a file is damaged, or a body or geom is missing.
        LibraryError: if the library lacks an asset.
    """
    source = library.source_of(task.motion)
    scene = library.scene_xml(source)
    spec, folders = load(scene), {"": scene.parent}
    spec.option.timestep = task.timestep_s
    spec.option.iterations = sim.solver_iterations
    spec.option.noslip_iterations = sim.noslip_iterations
    file = library.hand_xml(hand.name, source)
    part = load(file)
    prefix = f"{part.modelname}/"
    spec.attach(part, frame=spec.worldbody.add_frame(), prefix=prefix)
    folders[prefix] = file.parent
    added, randomized = add_objects(spec, library, task, sim)
    return Assembly(spec, folders | added, randomized)


def add_objects(
    spec: mujoco.MjSpec, library: Library, task: TaskCfg, sim: SimCfg
) -> tuple[dict[str, Path], str | None]:
    """Attach the objects of a task to an uncompiled scene and apply the task's placements.

    Returns:
        Prefix of each object's names -> the folder of its files, and the randomised geom's name.

    Raises:
        SceneError: if a file is damaged, or a body or geom is missing.
        LibraryError: if the library lacks an asset.
    """
    folders = {}
    for name in task.objects:
        file = library.object_xml(name, library.source_of(task.motion))
        part = load(file)
        if sim.object_mass == "published":
            scale_mass(part, RATIOS.get(name, 1.0))
        prefix = f"{part.modelname}/"
        spec.attach(part, frame=spec.worldbody.add_frame(), prefix=prefix)
        folders[prefix] = file.parent
    for placement in task.placements:
        place(spec, placement)
    return folders, randomized_geom(spec, task) if task.randomize else None


def scale_mass(spec: mujoco.MjSpec, ratio: float) -> None:
    """Scale mass and inertia of all bodies of an uncompiled model, in place.

    Scaling a compiled model would not do: ``mj_setConst`` does not update ``stat.meaninertia``, on
    which the solver's tolerance depends.
    """
    for geom in spec.geoms:
        if np.isnan(geom.mass):
            geom.density *= ratio
        else:
            geom.mass *= ratio
    for body in spec.bodies:
        if body.explicitinertial:
            body.mass *= ratio
            body.inertia = ratio * body.inertia
            body.fullinertia = ratio * body.fullinertia


def load(file: Path) -> mujoco.MjSpec:
    """Read a model of the library.

    Raises:
        SceneError: if it is damaged; the message says how to replace it.
    """
    try:
        return mujoco.MjSpec.from_file(str(file))
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise SceneError(
            f"{file} is damaged ({reason}); 'pgdm assets verify' lists all damaged files, and how "
            "to replace them"
        ) from error


def place(spec: mujoco.MjSpec, placement: PlacementCfg) -> None:
    """Place a body of an uncompiled scene.

    Raises:
        SceneError: if there is no such body.
    """
    body = spec.body(placement.body)
    if body is None:
        names = ", ".join(sorted(b.name for b in spec.bodies if b.name))
        raise SceneError(f"no body '{placement.body}' to place; the scene has: {names}")
    if placement.pos_m is not None:
        body.pos = placement.pos_m
    if placement.quat is not None:
        body.quat = placement.quat


def randomized_geom(spec: mujoco.MjSpec, task: TaskCfg) -> str:
    """Return the name of the tracked body's contact geom, and raise its contact priority.

    Raises:
        SceneError: if the body does not have exactly one contact geom.
    """
    body = spec.body(task.tracked_body)
    geoms = [] if body is None else [g for g in body.geoms if g.contype or g.conaffinity]
    if len(geoms) != 1:
        raise SceneError(
            f"task '{task.id}': task.randomize needs exactly one contact geom on the "
            f"tracked body, found {len(geoms)}"
        )
    geoms[0].priority = RANDOMIZED_PRIORITY
    return geoms[0].name
