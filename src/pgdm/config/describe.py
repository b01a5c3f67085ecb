"""Read what the files in ``conf/`` document: their keys, values, and the comment on each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import yaml

from pgdm import files

_PACKAGE_LINE = "# @package"


@dataclass(frozen=True)
class Key:
    """One key of a file."""

    name: str
    """Dotted name inside the file."""
    value: str
    """Its value as written, on one line."""
    comment: str
    """The comment above it."""


@dataclass(frozen=True)
class Description:
    """One file."""

    title: str
    """The comment at its top."""
    defaults: dict[str, str]
    """Its defaults list: group to option; an entry that is a file maps to an empty string."""
    keys: list[Key]
    """Its keys, in order."""


def describe(file: Path) -> Description:
    """Read a file of settings.

    Raises:
        ValueError: if it is not valid YAML.
        OSError: if it cannot be read.
    """
    text = files.read_text(file)
    plain = files.parse_yaml(text)  # first, since it enforces limits
    lines = text.splitlines()
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    first = 1 if lines and lines[0].startswith(_PACKAGE_LINE) else 0
    keys = [] if root is None else list(_keys(root, lines, ""))
    title = _comment(lines[first:], _end_of_comment(lines[first:]))
    return Description(title, _defaults(plain if isinstance(plain, dict) else {}), keys)


def _keys(node: yaml.Node, lines: list[str], path: str) -> Iterator[Key]:
    if not isinstance(node, yaml.MappingNode):
        return
    for key, value in node.value:
        name = f"{path}.{key.value}" if path else key.value
        if name in ("defaults", "hydra"):
            continue
        if isinstance(value, yaml.MappingNode):
            yield from _keys(value, lines, name)
        else:
            yield Key(name, _shown(value), _comment(lines, key.start_mark.line))


def _shown(node: yaml.Node) -> str:
    if isinstance(node, yaml.SequenceNode):
        return f"[{', '.join(_shown(item) for item in node.value)}]"
    if isinstance(node, yaml.MappingNode):
        return f"{{{', '.join(f'{k.value}: {_shown(v)}' for k, v in node.value)}}}"
    return str(node.value)


def _comment(lines: list[str], end: int) -> str:
    """Return the comment lines that end just before line ``end``, joined."""
    start = end
    while start > 0 and lines[start - 1].lstrip().startswith("#"):
        start -= 1
    return " ".join(line.lstrip("# ").rstrip() for line in lines[start:end])


def _end_of_comment(lines: list[str]) -> int:
    return next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))


def _defaults(plain: dict[str, object]) -> dict[str, str]:
    entries = plain.get("defaults")
    found: dict[str, str] = {}
    for entry in entries if isinstance(entries, list) else []:
        if isinstance(entry, dict):
            found.update({str(key): str(option) for key, option in entry.items()})
        elif entry != "_self_":
            found[str(entry)] = ""
    return found
