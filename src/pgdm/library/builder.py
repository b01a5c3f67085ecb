"""Writing one library source into a staging folder, with its manifest."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pgdm import limited
from pgdm.errors import CorruptAssetError, LimitError
from pgdm.files import read_bytes
from pgdm.library import manifest as manifests
from pgdm.library.checks.compiled import counts
from pgdm.library.files import model as model_file
from pgdm.library.files import motion as motion_file
from pgdm.library.manifest import FileEntry, Manifest, TaskEntry
from pgdm.library.tasks import hand_of, objects_of
from pgdm.paths import check_path_part


@dataclass(frozen=True)
class ImportSummary:
    """Result of filling the library from one source."""

    source: str
    """``checkout`` or ``registry``."""
    tasks: list[str]
    """Task ids that the library now has from this source."""
    defects: list[str]
    """Errors in the source's files, and how each was interpreted."""
    left_out: dict[str, str]
    """Tasks and models that were left out, with the reason."""


class SourceBuilder:
    """Writes the models and motions of one library source, and checks each of them.

    Args:
        folder: the staging folder to write into.
        source: ``checkout``, ``registry`` or ``arms``.
        origin: what the source is made from, for the manifest.
        root: folder of the imported data; origins of files in the manifest are relative to it.
        licence_of: returns the licence of a file, given its path relative to ``root``.
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
        self._models: dict[str, tuple[Path, str]] = {}
        self._joints: dict[str, int] = {}
        self._actuators: dict[str, int] = {}

    def add_model(self, kind: str, name: str, model: ET.Element, origin: Path) -> None:
        """Write a model with its meshes and textures.

        Args:
            kind: ``hands``, ``objects``, ``arms`` or ``scene``.
            name: library name.
            model: parsed MJCF.
            origin: the file from which it was derived.

        Raises:
            CorruptAssetError: a mesh or texture is missing.
            ConfigError: the name is not valid.
        """
        relative = {
            "hands": f"hands/{name}/hand.xml",
            "objects": f"objects/{name}/object.xml",
            "arms": f"{name}/arm.xml",
            "scene": "scene/table.xml",
        }[kind]
        check_path_part(f"the name of {origin}", name)
        path = self.folder / relative
        label = model_file.name_in(origin, self._root)
        note = f"Made by pgdm from {label} ({self._licence_of(label)}); do not edit."
        for written, source in [(path, origin), *model_file.write(model, path, note)]:
            self._record(written, source)
        self._models[f"{kind}/{name}"] = path, label

    def compile_models(self) -> None:
        """Compile all models in a child process, because they come from third parties.

        Raises:
            CorruptAssetError: MuJoCo cannot compile a model, or not within the limits of time and
                memory.
        """
        answers = limited.each(counts, list(self._models.values()))
        for (key, (_, label)), answer in zip(self._models.items(), answers, strict=False):
            if isinstance(answer, LimitError):
                raise CorruptAssetError(f"{label}: MuJoCo cannot compile it ({answer})")
            if isinstance(answer, Exception):
                raise answer
            self._joints[key], self._actuators[key] = answer

    def add_motion(self, task: str, arrays: Mapping[str, np.ndarray], origin: Path) -> None:
        """Check a task's motion against its scene's joints and actuators, and write it.

        Call :meth:`compile_models` first.

        Raises:
            CorruptAssetError: an array is damaged or does not fit the scene, or ``origin`` is a
                link that leads out of ``root``.
            ConfigError: the task's id is not valid.
        """
        label = model_file.name_in(origin, self._root)
        model_file.check_stays(origin, self._root)
        check_path_part(f"the task of {label}", task)
        hand, objects = hand_of(task), objects_of(task)
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
                    f"{label}: start '{name}' has {start.actions.shape[1]} actions per step, but "
                    f"{hand} has {actuators} actuators"
                )
        path = self.folder / "motions" / f"{task}.npz"
        motion_file.write(path, arrays)
        self._record(path, origin)
        self._tasks[task] = TaskEntry(hand, list(objects), len(translation), list(starts))

    def add_file(self, relative: str, origin: Path) -> None:
        """Copy a file unchanged, such as a licence.

        Raises:
            CorruptAssetError: the file is a link that leads out of ``root``.
        """
        path = self.folder / relative
        model_file.check_stays(origin, self._root)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(read_bytes(origin))
        self._record(path, origin)

    def has(self, kind: str, name: str) -> bool:
        """Return whether a model of this kind and name was added."""
        return f"{kind}/{name}" in self._models

    def lacking(self, task: str) -> list[str]:
        """Return which of a task's hand and objects were not added, such as ``object 'cup'``."""
        hand = hand_of(task)
        result = [] if self.has("hands", hand) else [f"hand '{hand}'"]
        return result + [f"object '{o}'" for o in objects_of(task) if not self.has("objects", o)]

    def finish(self) -> ImportSummary:
        """Write the manifest and return a summary."""
        manifests.write(
            self.folder,
            Manifest(
                source=self._source,
                origin=self._origin,
                imported_at=manifests.now(),
                defects=self.defects,
                files=self._files,
                tasks=self._tasks,
                hands=self._names("hands"),
                objects=self._names("objects"),
                left_out=self.left_out,
                notes=self.notes,
            ),
        )
        return ImportSummary(self._source, sorted(self._tasks), self.defects, self.left_out)

    def _names(self, kind: str) -> list[str]:
        return sorted(k.split("/", 1)[1] for k in self._models if k.startswith(f"{kind}/"))

    def _record(self, path: Path, origin: Path) -> None:
        name = model_file.name_in(origin, self._root)
        relative = path.relative_to(self.folder).as_posix()
        self._files[relative] = FileEntry.of(path, name, self._licence_of(name))
