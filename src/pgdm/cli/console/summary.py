"""A finished run in one table: results before and after training, and the paper's values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rich.markup import escape
from rich.table import Table

from pgdm.config.compose import PAPER_FRAMES, compose
from pgdm.config.groups import GROUPS
from pgdm.config.identity import difference
from pgdm.errors import amount
from pgdm.runs.config_file import dotted

if TYPE_CHECKING:
    from pgdm.config.schema import ExperimentCfg
    from pgdm.experiment import RunResult

PAPER_START = "planned"
# Settings that the caption does not list as deviations: shown elsewhere, or irrelevant here.
_NOT_PAPER = ("seed", "pregrasp", "eval.episodes")
_SHOWN_CHANGES = 5


@dataclass(frozen=True)
class _Row:
    name: str
    label: str
    form: str
    paper: str = ""  # attribute of the task with the paper's value


@dataclass(frozen=True)
class _Column:
    head: str
    metrics: Mapping[str, float]
    prefix: str


_ROWS = (
    _Row("success", "success, within 1 cm", ".1%", "paper_success"),
    _Row("com_error_released", "COM error, released [m]", ".2e", "paper_com_error"),
    _Row("com_error", "COM error, mean [m]", ".4f"),
    _Row("ori_error", "rotation error [rad]", ".3f"),
    _Row("lifted", "lifted", ".1%"),
    _Row("dropped", "dropped", ".1%"),
    _Row("length", "episode length [steps]", ".1f"),
    _Row("return", "return", ".1f"),
)


def summary_table(cfg: ExperimentCfg, result: RunResult) -> Table:
    """Return the table of a run: its first evaluation, its last, and the paper's values."""
    frames, start = result.frames, result.pregrasp_used
    columns = [
        _Column("before", result.before, "eval_sampled/"),
        _Column(f"after\n{frames:,} frames", result.after, "eval_sampled/"),
        _Column("the same,\nno noise", result.after, "eval_deterministic/"),
    ]
    return _table(cfg, columns, _caption(cfg, frames, start))


def metrics_table(
    cfg: ExperimentCfg,
    metrics: Mapping[str, float],
    frames: int,
    kinds: Sequence[str],
    start: str,
) -> Table:
    """Return the table of one evaluation.

    Args:
        cfg: settings of the run.
        metrics: as returned by ``Evaluator``.
        frames: length of the training before the evaluation.
        kinds: ``sampled``, ``deterministic`` or both.
        start: source of the start state that was used.
    """
    columns = [_Column(kind, metrics, f"eval_{kind}/") for kind in kinds]
    return _table(cfg, columns, _caption(cfg, frames, start))


def _table(cfg: ExperimentCfg, columns: Sequence[_Column], caption: str) -> Table:
    table = Table(title=_title(cfg), caption=caption)
    table.add_column("metric", no_wrap=True)
    for head in [*(column.head for column in columns), f"paper\n{PAPER_FRAMES / 1e6:.0f}M frames"]:
        table.add_column(head, justify="right", no_wrap=True)
    for row in _ROWS:
        paper = getattr(cfg.task, row.paper) if row.paper else None
        table.add_row(
            escape(row.label),
            *(_shown(column.metrics, f"{column.prefix}{row.name}", row.form) for column in columns),
            "" if paper is None else format(paper, row.form),
        )
    return table


def _shown(metrics: Mapping[str, float], name: str, form: str) -> str:
    value = metrics.get(name, math.nan)
    return format(value, form) if math.isfinite(value) else "-"


def _title(cfg: ExperimentCfg) -> str:
    parts = f"{cfg.method.name}, {cfg.action.kind} action, {cfg.algo.name}"
    return f"{cfg.task.id} ({parts}, seed {cfg.seed})"


def _caption(cfg: ExperimentCfg, frames: int, start: str) -> str:
    """Return the caption: whether the run is comparable with the paper's values, and why not."""
    if cfg.task.paper_success is None:
        return f"budget '{cfg.budget}'; the paper reports no value for this task"
    differs = [f"{frames:,} of {PAPER_FRAMES:,} frames"] if frames < PAPER_FRAMES else []
    if start != PAPER_START:
        differs.append(f"pregrasp={start}")
    changed = _changes(cfg)
    differs += changed[:_SHOWN_CHANGES]
    if len(changed) > _SHOWN_CHANGES:
        differs.append(amount(len(changed) - _SHOWN_CHANGES, "more setting"))
    if not differs:
        return "the paper's settings; the paper's values are means of 3 seeds, this run is one seed"
    return f"budget '{cfg.budget}', not comparable with the paper's values: {', '.join(differs)}"


def _changes(cfg: ExperimentCfg) -> list[str]:
    """Return the settings that differ from the paper's configuration of this task."""
    paper = compose([f"task={cfg.task.id}"])
    mine, papers = _options(cfg), _options(paper)
    found: dict[str, None] = {}
    for text in difference(paper, cfg):
        key, _, values = text.partition(": ")
        if key.startswith(_NOT_PAPER):
            continue
        group = key.partition(".")[0]
        whole = mine.get(group) != papers.get(group)
        found[f"{group}={mine[group]}" if whole else f"{key}={values.rpartition(' -> ')[2]}"] = None
    return list(found)


def _options(cfg: ExperimentCfg) -> dict[str, str]:
    flat = dotted(cfg)
    return {group: flat[key] for group, key in GROUPS.items()}
