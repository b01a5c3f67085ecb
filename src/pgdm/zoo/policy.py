"""Read the policies of a zoo, and add those of finished runs."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from scipy import stats

from pgdm import paths
from pgdm.envs.build import EnvBuilder
from pgdm.errors import RunError, ZooError
from pgdm.export import tensors
from pgdm.export.description import card
from pgdm.export.measure import measure
from pgdm.export.trained import TrainedPolicy, of_run
from pgdm.library.progress import Notify, StepProgress
from pgdm.runs.folder import RunFolder
from pgdm.runs.provenance import versions
from pgdm.zoo.place import ENDING, FORMAT, INDEX, PREFIX, Entry, Zoo

_LEVEL = 0.95
_SAMPLED, _DETERMINISTIC = "eval_sampled/", "eval_deterministic/"
_RECORDED = ("frames", "total_frames", "wall_time_s", "git", "ended_by", "budget", "wrist_bound")


def open_entry(zoo: Zoo, name: str) -> TrainedPolicy:
    """Return a policy of a zoo.

    Raises:
        UnknownNameError: if there is no entry of this name.
        ZooError: if the zoo is damaged.
        CheckpointError: if the policy's file is damaged.
    """
    video = Path(f"{name}.mp4")
    policy = tensors.parse(zoo.content(name), f"{PREFIX}{name}", video)
    entry = zoo.entry(name)
    if policy.cfg.task.id != entry.task:
        raise ZooError(f"{PREFIX}{name} is of task '{policy.cfg.task.id}', not '{entry.task}'")
    return policy


def add_run(
    run: RunFolder,
    name: str,
    zoo: Path,
    notify: Notify,
    progress: StepProgress,
    stop: Callable[[], bool] = lambda: False,
) -> Entry | None:
    """Add the last policy of a finished run to a zoo, in half precision if that is accurate enough.

    Rounding may change the success and the error of the sampled policy, each by up to half the
    width of its 95% interval in the run's own evaluation (Student's t over episodes). If that is
    less, success may change by one control step's share, and the error by as much as 1 mm at every
    step adds up to. The stored evaluation is that of the stored weights.

    Args:
        run: folder of the run.
        name: name of the entry; an existing entry is replaced.
        zoo: folder of the zoo, created if missing.
        notify: called with notes on assets and on the changes due to rounding.
        progress: called with the progress of the evaluation.
        stop: polled during the evaluation; True ends it, and no entry is made.

    Returns:
        The entry, or None if the evaluation was stopped.

    Raises:
        RunError: if the run is not finished.
        PgdmError: if the run cannot be read or evaluated.
    """
    if run.status() != "finished":
        raise RunError(f"'{run.path}' is not finished but {run.status()}")
    policy = of_run(run.path)
    builder = policy.builder(notify, progress)
    rounded, precision = tensors.halved(policy), "float16"
    metrics = measure(rounded, builder, progress, stop)
    if metrics is None:
        return None
    recorded = run.result["metrics"]
    changes = _changes(recorded, metrics, builder, policy.cfg.eval.episodes)
    notify(f"{name}: rounded to float16, {'; '.join(text for text, _ in changes)}")
    if not all(within for _, within in changes):
        rounded, precision = policy, "float32"
        if (metrics := measure(policy, builder, progress, stop)) is None:
            return None
    about = {
        **card(rounded),
        "precision": precision,
        "evaluation": {key: value for key, value in metrics.items() if not math.isnan(value)},
        "evaluated_with": versions(),
        "run": {key: run.result[key] for key in _RECORDED if key in run.result}
        | {"name": run.path.name, "metrics": recorded},
    }
    commands = None if builder.wrist is None else builder.wrist.commands
    content = tensors.compressed(
        tensors.pack(rounded, commands, about, half=precision == "float16")
    )
    entry = _entry(policy, metrics, precision, content)
    _store(zoo, name, content, entry)
    return entry


def _entry(
    policy: TrainedPolicy, metrics: Mapping[str, float], precision: str, content: bytes
) -> Entry:
    cfg = policy.cfg
    return Entry(
        cfg.task.id,
        cfg.hand.name,
        cfg.method.name,
        cfg.algo.name,
        cfg.action.kind,
        cfg.seed,
        policy.frames,
        metrics[f"{_SAMPLED}success"],
        metrics[f"{_DETERMINISTIC}success"],
        metrics[f"{_SAMPLED}com_error_released"],
        precision,
        len(content),
        hashlib.sha256(content).hexdigest(),
    )


def _changes(
    before: Mapping[str, float], after: Mapping[str, float], builder: EnvBuilder, episodes: int
) -> list[tuple[str, bool]]:
    """Return each change due to rounding as text, and whether it is small enough."""
    steps = len(builder.mdp.reference) - 1
    one_step = {"success": 1 / steps, "com_error_released": 1e-3 / math.sqrt(steps)}
    found = []
    for metric, least in one_step.items():
        key = f"{_SAMPLED}{metric}"
        spread = before.get(f"{key}_std", 0.0)
        width = stats.t.ppf(0.5 + _LEVEL / 2, max(episodes - 1, 1)) * spread / math.sqrt(episodes)
        change = after[key] - before[key]
        text = f"{metric} {before[key]:.4g} -> {after[key]:.4g} (interval +-{width:.2g})"
        found.append((text, abs(change) <= max(width, least)))
    return found


def _store(zoo: Path, name: str, content: bytes, entry: Entry) -> None:
    """Write an entry's file, then the index, each atomically."""
    zoo.mkdir(parents=True, exist_ok=True)
    entries = Zoo(str(zoo)).entries if (zoo / INDEX).is_file() else {}
    with paths.replacing(paths.inside(zoo, name, kind="name of an entry", suffix=ENDING)) as temp:
        temp.write_bytes(content)
    known = {n: asdict(e) for n, e in sorted((entries | {name: entry}).items())}
    index: dict[str, Any] = {"format": FORMAT, "entries": known}
    with paths.replacing(zoo / INDEX) as temp:
        temp.write_text(json.dumps(index, indent=1) + "\n")
