"""What a method is made of, for people: its terms, and under which names they are recorded."""

from __future__ import annotations

from rich.table import Table

from pgdm.config.schema import ExperimentCfg
from pgdm.mdp.shaping import shaped
from pgdm.methods import recipe

RECORDED_AS = """\
recorded under train/, eval_sampled/ and eval_deterministic/: a reward summed over the episode as
raw/NAME and, weighted, term/NAME; an end as end/NAME; a measure, mean over the episode, as NAME.
A weight with a schedule: train/weight/NAME."""
"""Under which names."""


def term_table(cfg: ExperimentCfg) -> Table:
    """Return the table of the terms that are active in an experiment."""
    table = Table(box=None)
    for head in ("kind", "name", "weight"):
        table.add_column(head, no_wrap=True)
    for row in shaped(recipe(cfg.method), cfg.shaping).table():
        table.add_row(*row)
    return table


def setting_line(cfg: ExperimentCfg) -> str:
    """Return what a run is of, on one line."""
    start = cfg.pregrasp.source
    if cfg.ablation.changes_start:
        start += f", ablation {cfg.ablation.name}"
    learner = f"{cfg.algo.name}, {cfg.action.kind} actions, seed {cfg.seed}"
    made = f"method {cfg.method.name}, hand {cfg.hand.name}, pregrasp {start}"
    return f"{cfg.task.id}: {made}, {learner}"


def term_line(cfg: ExperimentCfg) -> str:
    """Return the same in a sentence, measures left out."""
    rows = recipe(cfg.method).table()
    rewards = ", ".join(f"{name} {weight}" for kind, name, weight in rows if kind == "reward")
    ends = ", ".join(name for kind, name, _ in rows if kind == "end")
    return f"rewards {rewards}; ends {ends}"
