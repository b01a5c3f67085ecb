"""Read and write ``config.yaml``, a run's settings, as plain data.

`pgdm.config.saved` turns that into an `ExperimentCfg`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

import yaml

from pgdm import files, paths
from pgdm.errors import RunError
from pgdm.runs.files import CONFIG

FORMAT = 1
"""Version of the file's layout, under the key ``format``."""

_HEADER = "# All settings of this run. pgdm-run compares them when the run is resumed.\n"


def write_config(run_dir: Path, settings: Mapping[str, Any]) -> Path:
    """Write settings into a run folder, atomically; return the file.

    Raises:
        OSError: if the folder cannot be written.
    """
    file = run_dir / CONFIG
    text = _HEADER + yaml.safe_dump({"format": FORMAT, **settings}, sort_keys=False, width=100)
    run_dir.mkdir(parents=True, exist_ok=True)
    with paths.replacing(file) as temp:
        temp.write_text(text, encoding="utf-8")
    return file


def read_config(run_dir: Path) -> dict[str, Any]:
    """Return the settings in a run folder, ``format`` included.

    Raises:
        RunError: if ``config.yaml`` is missing or unreadable, is not valid YAML or holds no
            mapping.
    """
    file = run_dir / CONFIG
    try:
        found = files.read_yaml(file)
    except OSError as error:
        raise RunError(f"cannot read {file}: {files.reason(error)}") from error
    except ValueError as error:
        raise RunError(f"cannot read {file}: it is damaged ({files.reason(error)})") from error
    if not isinstance(found, dict):
        raise RunError(f"cannot read {file}: it is damaged (no mapping of settings)")
    return found


def dotted(settings: Any, prefix: str = "") -> dict[str, Any]:
    """Return nested mappings or dataclasses as one dict with dotted keys; lists stay whole."""
    flat: dict[str, Any] = {}
    for key, value in _items(settings):
        name = f"{prefix}{key}"
        if value and (isinstance(value, Mapping) or is_dataclass(value)):
            flat |= dotted(value, f"{name}.")
        elif isinstance(value, list):
            flat[name] = [asdict(v) if is_dataclass(v) else v for v in value]  # type: ignore
        else:
            flat[name] = value
    return flat


def _items(settings: Any) -> Iterable[tuple[Any, Any]]:
    if isinstance(settings, Mapping):
        return settings.items()
    return ((field.name, getattr(settings, field.name)) for field in fields(settings))


def as_text(value: Any) -> str:
    """Return a setting as text: strings as they are, other values as JSON."""
    if value is None or isinstance(value, bool | list | dict):
        return json.dumps(value)
    return str(value)
