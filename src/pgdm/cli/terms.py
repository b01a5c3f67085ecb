"""The terms of a method, and the names under which they are recorded."""

from __future__ import annotations

from rich.table import Table

from pgdm.config.schema import ExperimentCfg
from pgdm.mdp.shaping import shaped
from pgdm.methods import recipe

RECORDED_AS = """\
recorded under train/, eval_sampled/ and eval_deterministic/: each reward, summed over the episode,
as raw/NAME and, weighted, as term/NAME; each termination as end/NAME; each measure, averaged over
the episode, as NAME. Weights that follow a schedule are recorded as train/weight/NAME."""


def term_table(cfg: ExperimentCfg) -> Table:
    """Return the table of an experiment's active terms."""
    table = Table(box=None)
    for head in ("kind", "name", "weight"):
        table.add_column(head, no_wrap=True)
    for row in shaped(recipe(cfg.method), cfg.used_shaping).table():
        table.add_row(*row)
    return table


def setting_line(cfg: ExperimentCfg) -> str:
    """Return task, method, start and learner of a run on one line."""
    start = cfg.pregrasp.source
    if cfg.ablation.changes_start:
        start += f", ablation {cfg.ablation.name}"
    learner = f"{cfg.algo.name}, {cfg.action.kind} actions, seed {cfg.seed}"
    parts = f"method {cfg.method.name}, hand {cfg.hand.name}, pregrasp {start}"
    return f"{cfg.task.id}: {parts}, {learner}"


def term_line(cfg: ExperimentCfg) -> str:
    """Return a run's rewards (without those of shaping) and terminations on one line."""
    rows = recipe(cfg.method).table()
    rewards = ", ".join(f"{name} {weight}" for kind, name, weight in rows if kind == "reward")
    ends = ", ".join(name for kind, name, _ in rows if kind == "termination")
    return f"rewards {rewards}; terminations {ends}"
