"""The files of a run folder: their names, and how its JSON files are read and written."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pgdm import files, paths

CONFIG = "config.yaml"
LOG = "metrics.jsonl"
RESULT = "result.json"
LINK = "mlflow.json"
"""File that names the MLflow run that mirrors this one. Once MLflow is reached, the file also
has the values of `pgdm.runs.folder.FACTS`, which ``result.json`` has only at the end."""
LOCK = ".lock"
"""Held by the process that trains in the folder."""
CHECKPOINTS, VIDEOS = "checkpoints", "videos"
REPLAY = "replay"
"""Folder with the replay buffer of an off-policy learner."""
DIVERGED = "diverged"
"""Folder with the last states and targets of simulations that diverged."""


def read_json(path: Path) -> dict[str, Any]:
    """Return the JSON object in a file; {} if the file is missing, damaged or holds no object."""
    try:
        found = files.read_json(path)
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


Kinds = Mapping[str, tuple[type, ...]]
"""Dotted key to the types that its value may have."""

_NUMBER, _TEXT, _NONE = (int, float), (str,), (type(None),)
CONFIG_KINDS: Kinds = {
    "seed": (int,),
    "total_frames": (int,),
    "num_envs": (int,),
    **dict.fromkeys(("task.id", "hand.name", "method.name", "ablation.name"), _TEXT),
    **dict.fromkeys(("pregrasp.source", "algo.name", "action.kind", "obs.layout"), _TEXT),
    **dict.fromkeys(("budget", "device", "tracking.experiment"), _TEXT),
    "tracking.uri": (*_TEXT, *_NONE),
    "time_limit_min": (*_NUMBER, *_NONE),
}
"""Settings in a run's ``config.yaml`` that other code reads, with their types."""
RESULT_KINDS: Kinds = {
    "status": _TEXT,
    "frames": (int,),
    "total_frames": (int,),
    "metrics": (dict,),
    "versions": (dict,),
    **dict.fromkeys(("wall_time_s", "steps_per_s", "wrist_bound"), _NUMBER),
    **dict.fromkeys(("error", "ended_by", "pregrasp_used", "asset_source"), _TEXT),
    **dict.fromkeys(("video", "git", "task", "budget"), (*_TEXT, *_NONE)),
}
LINK_KINDS: Kinds = {"attempts": (int,), "run_id": _TEXT, "uri": _TEXT, "parent": (dict,)}


_MISSING = object()


def _at(content: Any, key: str) -> Any:
    for part in key.split("."):
        if not isinstance(content, Mapping) or part not in content:
            return _MISSING
        content = content[part]
    return content


def fault(content: Mapping[str, Any], kinds: Kinds) -> str | None:
    """Return which value in a file's content has a wrong type, or None; keys may be missing."""
    for key, allowed in kinds.items():
        value = _at(content, key)
        if value is not _MISSING and (not isinstance(value, allowed) or isinstance(value, bool)):
            return f"{key} is {value!r:.40}"
    metrics = content.get("metrics")
    for name, value in metrics.items() if isinstance(metrics, Mapping) else ():
        if not isinstance(value, _NUMBER):
            return f"metrics.{name} is {value!r:.40}"
    return None


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON object atomically."""
    with paths.replacing(path) as temp:
        temp.write_text(json.dumps(content, indent=1) + "\n")
