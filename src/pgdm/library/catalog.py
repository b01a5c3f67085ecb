"""What the library holds and which source serves it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from pathlib import Path

from pgdm import paths
from pgdm.errors import LibraryError, UnknownNameError
from pgdm.library import expert_file, expert_index, motion_file, staging
from pgdm.library import manifest as manifests
from pgdm.library.expert_file import Expert
from pgdm.library.expert_index import ExpertEntry, ExpertIndex
from pgdm.library.manifest import FileEntry, Manifest, TaskEntry
from pgdm.library.motion_file import Motion

CURE = "Fill the library with 'pgdm assets fetch' or 'pgdm assets import PATH' (a TCDM checkout)."
"""What to do when the library lacks something."""

EXPERT_CURE = "Get the expert hand trajectories with 'pgdm assets fetch'."
"""What to do when there are none."""


_PARTIAL = (staging.OWN, staging.ANIMATED)


class Library:
    """The assets under one root, and the user's own; a checkout wins, task by task.

    A task takes hand, objects, scene and motion all from the source that serves it. What that one
    has none of comes from elsewhere: objects that the user made from ``own``; hands, table and
    other objects for a motion of ``own`` or ``animated`` from the best source that is whole.

    Args:
        root: the library's folder.
        sources: manifests by source name, the winning source first.
        folders: folder of each source.
    """

    def __init__(self, root: Path, sources: dict[str, Manifest], folders: dict[str, Path]) -> None:
        self.root, self._sources, self._folders = root, sources, folders

    def sources(self) -> dict[str, Manifest]:
        """Return the manifest of each source that is present, the winning one first."""
        return dict(self._sources)

    def promising(self, task: str, entry: TaskEntry) -> Library:
        """Return this library as it is once a task of the user's is in it, to build its scene."""
        empty = Manifest(source=staging.OWN, origin="", imported_at="")
        own = self._sources.get(staging.OWN, empty)
        grown = dataclasses.replace(own, tasks={**own.tasks, task: entry})
        place = self._folders.get(staging.OWN, paths.user() / "library")
        folders = {**self._folders, staging.OWN: place}
        return Library(self.root, {**self._sources, staging.OWN: grown}, folders)

    def folder(self, source: str) -> Path:
        """Return the folder of a source that is present."""
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
        """Return hand, objects, length and stored starts of a task.

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

    def origins(self, task: str) -> str:
        """Return the sources that serve a task, its motion's first, such as ``own+checkout``.

        Raises:
            UnknownNameError: the task is not in the library.
        """
        source = self._source(task, None)
        return source if source not in _PARTIAL else "+".join((source, *self._whole()[:1]))

    def motion(self, motion_id: str, source: str | None = None) -> Motion:
        """Read a task's motion.

        Raises:
            UnknownNameError: the task is not in the library (or not from that source).
            CorruptAssetError: its file is damaged.
        """
        source = self._source(motion_id, source)
        return motion_file.read(self.motion_path(motion_id, source), motion_id, source)

    def motion_path(self, motion_id: str, source: str | None = None) -> Path:
        """Return the file of a task's motion."""
        source = self._source(motion_id, source)
        return self._existing(source, f"motions/{motion_id}.npz")

    def experts(self) -> ExpertIndex:
        """Return which tasks have an expert hand trajectory, with provenance and quality.

        Raises:
            CorruptAssetError: their index is damaged.
        """
        folder = staging.folder_of(self.root, staging.EXPERTS)
        return ExpertIndex("", {}, {}) if folder is None else expert_index.read(folder)

    def expert_entry(self, task: str) -> ExpertEntry:
        """Return provenance and quality of a task's expert hand trajectory.

        Raises:
            UnknownNameError: the task has none; names those that have one.
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
            UnknownNameError: the task has none; names those that have one.
            CorruptAssetError: its file is damaged.
            LibraryError: it was made for a motion of another length.
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
        """Yield every file that the manifests list: its name for messages, path and entry."""
        for source, manifest in self._sources.items():
            for name, entry in manifest.files.items():
                yield f"{source}/{name}", self._folders[source] / name, entry
        folder = staging.folder_of(self.root, staging.EXPERTS)
        if folder is not None:
            for task, expert in self.experts().experts.items():
                name = f"{task}.npz"
                yield f"{staging.EXPERTS}/{name}", folder / name, expert.file

    def hand_xml(self, hand: str, source: str | None = None) -> Path:
        """Return the MJCF file of a hand with its actuators.

        Raises:
            UnknownNameError: the hand is not in the library (or not from that source).
        """
        have = {s: self._sources[s].hands for s in self._whole()}
        found = self._serving("hand", hand, self._whole_of(source), have)
        return self._existing(found, f"hands/{hand}/hand.xml")

    def object_xml(self, object_name: str, source: str | None = None) -> Path:
        """Return the MJCF file of an object.

        Raises:
            UnknownNameError: the object is not in the library (or not from that source).
        """
        own = self._sources.get(staging.OWN)
        if own is not None and object_name in own.objects:
            return self._existing(staging.OWN, f"objects/{object_name}/object.xml")
        have = {s: self._sources[s].objects for s in self._whole()}
        found = self._serving("object", object_name, self._whole_of(source), have)
        return self._existing(found, f"objects/{object_name}/object.xml")

    def scene_xml(self, source: str | None = None) -> Path:
        """Return the MJCF file of the table scene.

        Raises:
            LibraryError: the library is empty.
        """
        have = {s: ["table"] for s in self._whole()}
        found = self._serving("scene", "table", self._whole_of(source), have)
        return self._existing(found, "scene/table.xml")

    def _whole(self) -> list[str]:
        """Return the sources that have hands and a table, the winning one first."""
        return [source for source in self._sources if source not in _PARTIAL]

    @staticmethod
    def _whole_of(source: str | None) -> str | None:
        """Return the source that is asked for hands and table, None for the best one."""
        return None if source in _PARTIAL else source

    def _source(self, task: str, source: str | None) -> str:
        have = {s: list(m.tasks) for s, m in self._sources.items()}
        return self._serving("task", task, source, have)

    def _serving(self, kind: str, name: str, source: str | None, have: dict[str, list[str]]) -> str:
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
                f"{path}: missing from the library, though its manifest lists it. {CURE}"
            )
        return path


def open_library(root: Path | None = None) -> Library:
    """Open the library; reads its manifests only.

    Args:
        root: its folder, by default the one under ``PGDM_HOME``.

    Raises:
        CorruptAssetError: a manifest is damaged.
    """
    root = paths.library() if root is None else Path(root)
    folders: dict[str, Path] = {}
    for source in staging.SOURCES:
        folder = staging.folder_of(*_place(root, source))
        if folder is not None:
            folders[source] = folder
    return Library(root, {s: manifests.read(f) for s, f in folders.items()}, folders)


def _place(root: Path, source: str) -> tuple[Path, str]:
    """Return the folder in which a source's folder lies, and the latter's name."""
    return (paths.user(), "library") if source == staging.OWN else (root, source)
