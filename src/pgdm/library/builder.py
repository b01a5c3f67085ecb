"""Writing one source of the library into a staging folder and keeping its manifest."""

from __future__ import annotations

import datetime
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from pgdm.errors import CorruptAssetError
from pgdm.library import manifest as manifests
from pgdm.library import model_file, motion_file, names
from pgdm.library.check import compiled
from pgdm.library.manifest import FileEntry, Manifest, TaskEntry
from pgdm.library.report import Report


class SourceBuilder:
    """Collects models and motions of one source, each checked as it comes.

    Args:
        folder: the staging folder to write into.
        source: ``checkout`` or ``registry``.
        origin: where the source came from, for the manifest.
        root: folder to which origins in the manifest are relative.
        licence_of: SPDX licence of a path relative to ``root``.
    """

    def __init__(
        self, folder: Path, source: str, origin: str, root: Path, licence_of: Callable[[str], str]
    ) -> None:
        self.folder = folder
        self.defects: list[str] = []
        self.left_out: dict[str, str] = {}
        self.notes: dict[str, list[str]] = {}
        self._source, self._origin, self._root = source, origin, root
        self._licence_of = licence_of
        self._files: dict[str, FileEntry] = {}
        self._tasks: dict[str, TaskEntry] = {}
        self._joints: dict[str, int] = {}
        self._actuators: dict[str, int] = {}

    def add_model(self, kind: str, name: str, model: ET.Element, origin: Path) -> None:
        """Write a model, copy its files, and compile it.

        Args:
            kind: ``hands``, ``objects`` or ``scene``.
            name: library name.
            model: parsed MJCF.
            origin: the file it was made from.

        Raises:
            CorruptAssetError: a file of it is missing or MuJoCo refuses it.
        """
        relative = {
            "hands": f"hands/{name}/hand.xml",
            "objects": f"objects/{name}/object.xml",
            "scene": "scene/table.xml",
        }[kind]
        path = self.folder / relative
        label = self._origin_name(origin)
        note = f"Made by pgdm from {label} ({self._licence_of(label)}); do not edit."
        self._record(path, origin)
        for written, source in model_file.write(model, path, note):
            self._record(written, source)
        result = compiled(path, label)
        self._joints[f"{kind}/{name}"] = result.nq
        self._actuators[f"{kind}/{name}"] = result.nu

    def add_motion(self, task: str, arrays: Mapping[str, np.ndarray], origin: Path) -> None:
        """Write a task's motion, checked against its scene's numbers of joints and actuators.

        Raises:
            CorruptAssetError: an array is damaged or does not fit the scene.
        """
        label = self._origin_name(origin)
        hand, objects = names.hand_of(task), names.objects_of(task)
        translation, _, _, starts = motion_file.check(arrays, label)
        joints = self._joints[f"hands/{hand}"] + sum(self._joints[f"objects/{o}"] for o in objects)
        actuators = self._actuators[f"hands/{hand}"]
        for name, start in starts.items():
            if len(start.qpos) != joints:
                raise CorruptAssetError(
                    f"{label}: start '{name}' has {len(start.qpos)} joint positions, but {hand} "
                    f"with {' and '.join(objects)} has {joints}"
                )
            if start.actions is not None and start.actions.shape[1] != actuators:
                raise CorruptAssetError(
                    f"{label}: start '{name}' has {start.actions.shape[1]} actions a step, but "
                    f"{hand} has {actuators} actuators"
                )
        path = self.folder / "motions" / f"{task}.npz"
        motion_file.write(path, arrays)
        self._record(path, origin)
        self._tasks[task] = TaskEntry(hand, list(objects), len(translation), list(starts))

    def add_file(self, relative: str, origin: Path) -> None:
        """Copy a file as it is, such as a licence."""
        path = self.folder / relative
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(origin.read_bytes())
        self._record(path, origin)

    def has(self, kind: str, name: str) -> bool:
        """Return whether a hand or object was added."""
        return f"{kind}/{name}" in self._joints

    def lacking(self, task: str) -> list[str]:
        """Return what a task needs that was not added, such as ``object 'cup'``."""
        hand = names.hand_of(task)
        result = [] if self.has("hands", hand) else [f"hand '{hand}'"]
        return result + [
            f"object '{o}'" for o in names.objects_of(task) if not self.has("objects", o)
        ]

    def finish(self) -> Report:
        """Hash all files, write the manifest, and return the report."""
        files = {}
        for relative, entry in sorted(self._files.items()):
            path = self.folder / relative
            files[relative] = FileEntry(
                manifests.sha256_of(path), path.stat().st_size, entry.origin, entry.licence
            )
        manifests.write(
            self.folder,
            Manifest(
                source=self._source,
                origin=self._origin,
                imported_at=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
                defects=self.defects,
                files=files,
                tasks=dict(sorted(self._tasks.items())),
                hands=self._names("hands"),
                objects=self._names("objects"),
                left_out=self.left_out,
                notes=self.notes,
            ),
        )
        return Report(self._source, sorted(self._tasks), self.defects, self.left_out)

    def _names(self, kind: str) -> list[str]:
        return sorted(k.split("/", 1)[1] for k in self._joints if k.startswith(f"{kind}/"))

    def _record(self, path: Path, origin: Path) -> None:
        name = self._origin_name(origin)
        relative = path.relative_to(self.folder).as_posix()
        self._files[relative] = FileEntry("", 0, name, self._licence_of(name))

    def _origin_name(self, origin: Path) -> str:
        if origin.is_relative_to(self._root):
            return origin.relative_to(self._root).as_posix()
        return origin.name
