"""Reading an MJCF model with its includes, and writing it as one self-contained file."""

from __future__ import annotations

import os
import re
import shutil
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable
from pathlib import Path

from pgdm import files
from pgdm.errors import CorruptAssetError
from pgdm.paths import leaves

_DECLARATION = re.compile(rb"<\?xml[^>]*\?>")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_NUMERIC_NAMES = (
    "pos quat euler axisangle xyaxes zaxis axis range size fromto mass diaginertia fullinertia "
    "damping armature frictionloss stiffness margin gap friction density scale rgba ctrlrange kp "
    "forcerange gear solref solimp condim contype conaffinity coef"
)
_NUMERIC = frozenset(_NUMERIC_NAMES.split())
_DROPPED_NAMES = "njmax nconmax nstack apirate collision mpr_iterations mpr_tolerance"
_DROPPED = frozenset(_DROPPED_NAMES.split())
"""Attributes of ``size`` and ``option`` that MuJoCo no longer accepts. Dropping them changes no
trajectory: ``njmax``, ``nconmax`` and ``nstack`` only limited memory."""


def parse(path: Path, defects: list[str], root: Path, includes: Path | None = None) -> ET.Element:
    """Parse an MJCF file and insert its includes.

    File attributes become absolute paths. Numbers followed by stray characters are read as older
    versions of MuJoCo read them; each such repair is reported in ``defects``.

    Args:
        path: the file.
        defects: messages about repairs are appended.
        root: folder that must contain all files of the model; messages name files relative to it.
        includes: folder of the included files, by default that of the including file.

    Raises:
        CorruptAssetError: a file is missing or damaged, includes itself, or refers to a file
            outside of ``root``.
    """
    return _parse(Path(os.path.abspath(path)), defects, Path(os.path.abspath(root)), includes, ())


def _parse(
    path: Path, defects: list[str], root: Path, includes: Path | None, parents: tuple[Path, ...]
) -> ET.Element:
    label = name_in(path, root)
    if path in parents:
        raise CorruptAssetError(f"{label}: includes itself")
    check_stays(path, root)
    try:
        # Some files have a comment before the XML declaration, which XML does not allow.
        text = files.read_bytes(path, files.MOST_TEXT_BYTES)
        element: ET.Element = ET.fromstring(_DECLARATION.sub(b"", text))
        _check_depth(element)
    except (ET.ParseError, ValueError) as error:
        raise CorruptAssetError(f"{label}: not well-formed XML ({error})") from error
    except OSError as error:
        by = f", included by {name_in(parents[-1], root)}" if parents else ""
        raise CorruptAssetError(f"{label}{by}: cannot be read ({files.reason(error)})") from error
    for item in element.iter():
        _repair(item, label, defects)
        reference = item.get("file")
        if reference is not None:
            item.set("file", str(_inside(path.parent / reference, root, label)))

    def load(target: str) -> ET.Element:
        file = Path(target) if includes is None else includes / Path(target).name
        return _parse(file, defects, root, includes, (*parents, path))

    _include(element, load)
    return element


def _check_depth(element: ET.Element) -> None:
    """Raise ValueError if elements are nested so deeply that recursion fails."""
    level, depth = [element], 0
    while level := [child for item in level for child in item]:
        depth += 1
        if depth > files.MOST_DEPTH:
            raise ValueError(f"nested more than {files.MOST_DEPTH} deep")


def name_in(path: Path, root: Path) -> str:
    """Return a file's name for messages: relative to ``root`` if inside, else without folder."""
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name


def _inside(path: Path, root: Path, label: str) -> Path:
    path = Path(os.path.normpath(path))
    if not path.is_relative_to(root):
        raise CorruptAssetError(
            f"{label}: refers to '{path}', which is outside the imported folder"
        )
    check_stays(path, root)
    return path


def check_stays(path: Path, root: Path) -> None:
    """Check that a path in third-party data is not a link that leads out of ``root``.

    Raises:
        CorruptAssetError: it is such a link; the message names the file and its target.
    """
    if leaves(path, root):
        raise CorruptAssetError(
            f"{name_in(path, root)}: leads to {path.resolve()}, outside of {root}; if you trust "
            "it, put a copy in its place"
        )


def _include(element: ET.Element, load: Callable[[str], ET.Element]) -> None:
    children: list[ET.Element] = []
    for child in element:
        if child.tag == "include":
            children.extend(load(child.get("file", "")))
        else:
            _include(child, load)
            children.append(child)
    element[:] = children


def _repair(item: ET.Element, label: str, defects: list[str]) -> None:
    if item.tag in ("size", "option"):
        for key in _DROPPED & set(item.attrib):
            del item.attrib[key]
    for key in _NUMERIC & set(item.attrib):
        tokens = item.attrib[key].split()
        read = [_number(token) for token in tokens]
        if all(token == number for token, number in zip(tokens, read, strict=True)):
            continue
        if any(number is None for number in read):
            raise CorruptAssetError(
                f'{label}: {item.tag} {key}="{item.attrib[key]}" is not numeric'
            )
        fixed = " ".join(str(number) for number in read)
        defects.append(f'{label}: {item.tag} {key}="{item.attrib[key]}" read as "{fixed}"')
        item.set(key, fixed)


def _number(token: str) -> str | None:
    if token.lower() in ("true", "false", "auto"):
        return token
    match = _NUMBER.match(token)
    return match.group() if match else None


def write(model: ET.Element, path: Path, note: str) -> list[tuple[Path, Path]]:
    """Write a model, with its meshes and textures in ``meshes/`` and ``textures/`` next to it.

    Args:
        model: as from :func:`parse`; changed in place.
        path: the file to write.
        note: line about the model's origin, written as a comment.

    Returns:
        Pairs (written file, file it was copied from) of the meshes and textures.

    Raises:
        CorruptAssetError: a mesh or texture is missing.
    """
    _one_compiler(model)
    path.parent.mkdir(parents=True, exist_ok=True)
    copied: dict[Path, Path] = {}
    for item in _with_files(model):
        origin = Path(item.attrib["file"])
        folder = "textures" if item.tag == "texture" else "meshes"
        target = path.parent / folder / origin.name
        if item.get("name") is None:
            item.set("name", origin.stem)
        if copied.get(target, origin) != origin:
            target = target.with_name(f"{origin.parent.name}_{origin.name}")
        while copied.get(target, origin) != origin:
            target = target.with_name(f"_{target.name}")
        if target not in copied:
            if not origin.is_file():
                raise CorruptAssetError(f"{path.name}: its file '{origin.name}' is missing")
            target.parent.mkdir(exist_ok=True)
            shutil.copyfile(origin, target)
            copied[target] = origin
        item.set("file", target.relative_to(path.parent).as_posix())
    ET.indent(model)
    text = ET.tostring(model, encoding="unicode")
    path.write_text(f"<!-- {note.replace('--', '- -')} -->\n{text}\n", encoding="utf-8")
    return list(copied.items())


def missing_files(model: ET.Element) -> list[str]:
    """Return the names of files that a parsed model refers to but that do not exist."""
    return [i.attrib["file"] for i in _with_files(model) if not Path(i.attrib["file"]).is_file()]


def _with_files(model: ET.Element) -> Iterable[ET.Element]:
    return (i for i in model.iter() if i.tag in ("mesh", "texture", "hfield") and i.get("file"))


def _one_compiler(model: ET.Element) -> None:
    for old in model.findall("compiler"):
        model.remove(old)
    model.insert(0, ET.Element("compiler", angle="radian"))
