"""The content of the library, and which library source serves each task."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterable, Iterator
from pathlib import Path

from pgdm import paths
from pgdm.errors import CorruptAssetError, LibraryError, UnknownNameError
from pgdm.library import manifest as manifests
from pgdm.library import staging
from pgdm.library.files import expert as expert_file
from pgdm.library.files import expert_index
from pgdm.library.files import motion as motion_file
from pgdm.library.files.expert import Expert
from pgdm.library.files.expert_index import ExpertEntry, ExpertIndex
from pgdm.library.files.motion import Motion
from pgdm.library.manifest import FileEntry, Manifest, TaskEntry, sha256_of

CURE = "Fill the library with 'pgdm assets fetch' or 'pgdm assets import PATH' (a TCDM checkout)."
"""Advice in errors about a missing asset."""

EXPERT_CURE = "Get the expert hand trajectories with 'pgdm assets fetch'."
"""Advice in errors about missing expert trajectories."""

_log = logging.getLogger(__name__)

_CURES = {staging.OWN: manifests.OWN_CURE}
_FILE_CURES = {
    staging.OWN: "Create it again with 'pgdm author', or restore it from a copy.",
    staging.ANIMATED: "Remove the library's folder 'animated'; pgdm makes it again on demand.",
    staging.EXPERTS: EXPERT_CURE,
}
_NAMES = {staging.OWN: "your own objects, hands and tasks"}
_PARTIAL = (staging.OWN, staging.ANIMATED)


class Library:
    """The assets under one root and the user's own assets, as listed when the library was opened.

    The source that serves a task provides its hand, objects, scene and motion. It is the first of
    ``own``, ``checkout``, ``registry``, ``animated`` that has the task; ``pgdm assets use`` chooses
    whether ``checkout`` or ``registry`` comes first. Exceptions: the user's objects and hands
    always come from ``own``. For a motion of ``own`` or ``animated``, all other hands and objects
    and the table come from ``checkout`` or ``registry``, by precedence. Each motion is read once:
    its arrays are shared, so copy them before changing any.

    Methods that look up a task, model or motion raise LibraryError if the library is empty. Those
    that return a file or its content also raise LibraryError if the file is missing, and
    CorruptAssetError if the file has changed since it was recorded.

    Args:
        root: the library's folder.
        sources: manifests by source name, in order of precedence.
        folders: folder of each source.
    """

    def __init__(self, root: Path, sources: dict[str, Manifest], folders: dict[str, Path]) -> None:
        self.root, self._sources, self._folders = root, sources, folders
        self._motions: dict[tuple[str, str], Motion] = {}
        self._experts: ExpertIndex | None = None
        self._unchanged: set[tuple[str, str]] = set()

    def sources(self) -> dict[str, Manifest]:
        """Return the manifest of each source that is present, in order of precedence."""
        return dict(self._sources)

    def promising(self, task: str, entry: TaskEntry) -> Library:
        """Return this library plus a task of ``own``; the task's files need not be written yet."""
        empty = Manifest(source=staging.OWN, origin="", imported_at="")
        own = self._sources.get(staging.OWN, empty)
        grown = dataclasses.replace(own, tasks={**own.tasks, task: entry})
        place = self._folders.get(staging.OWN, paths.user() / "library")
        folders = {**self._folders, staging.OWN: place}
        return Library(self.root, {**self._sources, staging.OWN: grown}, folders)

    def serving(self, origins: object) -> Library:
        """Return this library with ``checkout`` or ``registry`` moved to the front, after ``own``.

        Args:
            origins: sources as a run recorded them, such as ``own+checkout``; other names, missing
                sources and None have no effect.
        """
        present = [s for s in str(origins).split("+") if s in self._sources]
        first = [s for s in present if s in staging.SELF_CONTAINED]
        # The source ``own`` always stays first.
        own = [s for s in self._sources if s == staging.OWN]
        order = dict.fromkeys((*own, *first, *self._sources))
        return Library(self.root, {s: self._sources[s] for s in order}, self._folders)

    def folder(self, source: str) -> Path:
        """Return the folder of a source in this library."""
        return self._folders[source]

    def tasks(self) -> dict[str, str]:
        """Return the source that serves each task, by task id."""
        found: dict[str, str] = {}
        for source, manifest in self._sources.items():
            for task in manifest.tasks:
                found.setdefault(task, source)
        return dict(sorted(found.items()))

    def hands(self) -> list[str]:
        """Return the names of the hands."""
        return sorted({name for m in self._sources.values() for name in m.hands})

    def objects(self) -> list[str]:
        """Return the names of the objects."""
        return sorted({name for m in self._sources.values() for name in m.objects})

    def entry(self, task: str, source: str | None = None) -> TaskEntry:
        """Return a task's hand, objects, number of steps and stored starts.

        Raises:
            UnknownNameError: the task is not in the library (or not from that source).
        """
        return self._sources[self._source(task, source)].tasks[task]

    def source_of(self, task: str) -> str:
        """Return the source that serves a task.

        Raises:
            UnknownNameError: the task is not in the library.
        """
        return self._source(task, None)

    def origins(self, task: str, hand: str) -> str:
        """Return the sources that serve a task with a hand, such as ``own+checkout``.

        If the hand is the user's, ``own`` comes first; then the motion's source; then, for a motion
        of ``own`` or ``animated``, the source of the table and other models.

        Raises:
            UnknownNameError: the task is not in the library.
        """
        source = self._source(task, None)
        used = [source] if source not in _PARTIAL else [source, *self._whole()[:1]]
        return "+".join(dict.fromkeys(([staging.OWN] if self.is_own_hand(hand) else []) + used))

    def is_own_hand(self, hand: str) -> bool:
        """Return whether a hand is one of the user's."""
        own = self._sources.get(staging.OWN)
        return own is not None and hand in own.hands

    def motion(self, motion_id: str, source: str | None = None) -> Motion:
        """Return a task's motion; its file is read once.

        Raises:
            UnknownNameError: the task is not in the library (or not from that source).
            CorruptAssetError: the motion's file is damaged.
        """
        source = self._source(motion_id, source)
        if (key := (motion_id, source)) not in self._motions:
            path = self.motion_path(motion_id, source)
            self._motions[key] = motion_file.read(path, motion_id, source)
        return self._motions[key]

    def motion_path(self, motion_id: str, source: str | None = None) -> Path:
        """Return the file of a task's motion."""
        return self._existing(self._source(motion_id, source), f"motions/{motion_id}.npz")

    def experts(self) -> ExpertIndex:
        """Return the index of the expert hand trajectories; its file is read once.

        Raises:
            CorruptAssetError: the index is damaged.
        """
        if self._experts is None:
            folder = staging.folder_of(self.root, staging.EXPERTS)
            empty = ExpertIndex("", {}, {})
            self._experts = empty if folder is None else expert_index.read(folder)
        return self._experts

    def expert_entry(self, task: str) -> ExpertEntry:
        """Return provenance and quality of a task's expert hand trajectory.

        Raises:
            UnknownNameError: the task has no expert trajectory; the message lists the tasks that
                have one.
        """
        index = self.experts()
        if task not in index.experts:
            hint = "Only motion-capture tasks have one." if index.experts else EXPERT_CURE
            if task in index.left_out:
                hint = f"Left out: {index.left_out[task]}."
            raise UnknownNameError("expert hand trajectory", task, index.experts, hint)
        return index.experts[task]

    def expert(self, task: str) -> Expert:
        """Read a task's expert hand trajectory.

        Raises:
            UnknownNameError: the task has no expert trajectory; the message lists the tasks that
                have one.
            CorruptAssetError: the trajectory's file is damaged.
            LibraryError: the trajectory's length differs from the motion's.
        """
        self.expert_entry(task)
        folder = staging.folder_of(self.root, staging.EXPERTS)
        assert folder is not None
        expert = expert_file.read(folder / f"{task}.npz", task)
        steps = self.entry(task).steps
        if len(expert.qpos) != steps:
            raise LibraryError(
                f"the expert hand trajectory of '{task}' has {len(expert.qpos)} poses, its motion "
                f"{steps}: they come from different data. {EXPERT_CURE}"
            )
        return expert

    def files(self) -> Iterator[tuple[str, Path, FileEntry]]:
        """Yield name (for messages), path and entry of every recorded file, also of experts."""
        for source, manifest in self._sources.items():
            for name, entry in manifest.files.items():
                yield f"{source}/{name}", self._folders[source] / name, entry
        folder = staging.folder_of(self.root, staging.EXPERTS)
        if folder is not None:
            for task, expert in self.experts().experts.items():
                name = f"{task}.npz"
                yield f"{staging.EXPERTS}/{name}", folder / name, expert.file

    def hand_xml(self, hand: str, source: str | None = None) -> Path:
        """Return the MJCF file of a hand, which includes its actuators.

        Raises:
            UnknownNameError: the hand is not in the library (or not from that source).
        """
        relative = f"hands/{hand}/hand.xml"
        if self.is_own_hand(hand):
            return self._existing(staging.OWN, relative)
        have = {s: self._sources[s].hands for s in self._whole()}
        if have and not any(hand in names for names in have.values()):
            raise UnknownNameError(
                "hand", hand, self.hands(), "'pgdm author hand' makes one from MJCF or URDF"
            )
        return self._model("hand", hand, source, have, relative)

    def object_xml(self, object_name: str, source: str | None = None) -> Path:
        """Return the MJCF file of an object.

        Raises:
            UnknownNameError: the object is not in the library (or not from that source).
        """
        own, relative = self._sources.get(staging.OWN), f"objects/{object_name}/object.xml"
        if own is not None and object_name in own.objects:
            return self._existing(staging.OWN, relative)
        have = {s: self._sources[s].objects for s in self._whole()}
        return self._model("object", object_name, source, have, relative)

    def scene_xml(self, source: str | None = None) -> Path:
        """Return the MJCF file of the table scene.

        Raises:
            LibraryError: the library has neither ``checkout`` nor ``registry``.
        """
        have = {s: ["table"] for s in self._whole()}
        return self._model("scene", "table", source, have, "scene/table.xml")

    @property
    def is_filled(self) -> bool:
        """Whether a source with table and hands is present: ``checkout`` or ``registry``."""
        return bool(self._whole())

    def _whole(self) -> list[str]:
        """Return the sources with the benchmark's hands and the table, in order of precedence."""
        return [source for source in self._sources if source not in _PARTIAL]

    def _model(
        self, kind: str, name: str, source: str | None, have: dict[str, list[str]], relative: str
    ) -> Path:
        wanted = None if source in _PARTIAL else source
        return self._existing(self._first_with(kind, name, wanted, have), relative)

    def _source(self, task: str, source: str | None) -> str:
        have = {s: list(m.tasks) for s, m in self._sources.items()}
        return self._first_with("task", task, source, have)

    def _first_with(
        self, kind: str, name: str, source: str | None, have: dict[str, list[str]]
    ) -> str:
        if not have:
            raise LibraryError(f"the asset library in {self.root} is empty. {CURE}")
        if source is not None and source not in have:
            raise UnknownNameError("library source", source, have, CURE)
        asked: Iterable[str] = have if source is None else [source]
        for candidate in asked:
            if name in have[candidate]:
                return candidate
        valid = {n for s in asked for n in have[s]}
        raise UnknownNameError(kind, name, valid, CURE)

    def _existing(self, source: str, relative: str) -> Path:
        path = self._folders[source] / relative
        if not path.is_file():
            raise LibraryError(
                f"{path}: missing from the library, although its manifest lists it. "
                f"{file_cure(source)}"
            )
        self._check_unchanged(source, relative)
        return path

    def _check_unchanged(self, source: str, relative: str) -> None:
        """Check a file's hash against the manifest, once; for a model, all hashes in its folder."""
        if (source, relative) in self._unchanged:
            return
        model = f"{relative.rpartition('/')[0]}/" if relative.endswith(".xml") else relative
        for name, entry in self._sources[source].files.items():
            path = self._folders[source] / name
            if name.startswith(model) and path.is_file() and sha256_of(path) != entry.sha256:
                raise CorruptAssetError(
                    f"{path}: was changed after it came into the library: its SHA-256 differs from "
                    f"the recorded one. {file_cure(source)}"
                )
        self._unchanged.add((source, relative))


def file_cure(source: str) -> str:
    """Return advice for a missing or changed file of a library source."""
    return _FILE_CURES.get(source, CURE)


def open_library(root: Path | None = None) -> Library:
    """Open the library; only its manifests are read.

    Args:
        root: the library's folder, by default the one under ``PGDM_HOME``.

    Raises:
        CorruptAssetError: the manifest of ``checkout`` or ``registry`` is damaged, and neither can
            be read; any other damaged source is left out with a warning.
    """
    root = paths.library() if root is None else Path(root)
    folders = present(root)
    found: dict[str, Manifest] = {}
    damaged: dict[str, CorruptAssetError] = {}
    for source, folder in folders.items():
        try:
            found[source] = manifests.read(folder, _CURES.get(source, manifests.CURE))
        except CorruptAssetError as error:
            damaged[source] = error
    for source, error in damaged.items():
        if source in staging.SELF_CONTAINED and not set(found) & set(staging.SELF_CONTAINED):
            raise error  # no other source has the benchmark's hands
        _log.warning("%s; continuing without %s", error, _NAMES.get(source, f"source '{source}'"))
    return Library(root, found, folders).serving(staging.preferred(root))


def present(root: Path) -> dict[str, Path]:
    """Return the folder of each existing source, damaged or not, in default order of precedence."""
    found = {source: staging.folder_of(*_place(root, source)) for source in staging.SOURCES}
    return {source: folder for source, folder in found.items() if folder is not None}


def _place(root: Path, source: str) -> tuple[Path, str]:
    """Return the parent of a source's folder, and the folder's name."""
    return (paths.user(), "library") if source == staging.OWN else (root, source)
