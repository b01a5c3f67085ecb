"""What a method is made of, for people: its terms, and under which names they are recorded."""

from __future__ import annotations

from rich.table import Table

from pgdm.config.schema import ExperimentCfg
from pgdm.methods import recipe

RECORDED_AS = """\
recorded under train/, eval_sampled/ and eval_deterministic/: a reward summed over the episode as
raw/NAME and, weighted, term/NAME; an end as end/NAME; a measure, mean over the episode, as NAME.
A weight with a schedule: train/weight/NAME."""
"""Under which names."""


def term_table(cfg: ExperimentCfg) -> Table:
    """Return the table of the terms that are active in an experiment."""
    title = f"{cfg.method.name}: {cfg.task.id}, pregrasp {cfg.pregrasp.source}"
    table = Table(box=None, title=title, title_justify="left")
    for head in ("kind", "name", "weight"):
        table.add_column(head, no_wrap=True)
    for row in recipe(cfg.method).table():
        table.add_row(*row)
    return table


def term_line(cfg: ExperimentCfg) -> str:
    """Return the same in a sentence, measures left out."""
    rows = recipe(cfg.method).table()
    rewards = ", ".join(f"{name} {weight}" for kind, name, weight in rows if kind == "reward")
    ends = ", ".join(name for kind, name, _ in rows if kind == "end")
    return f"method {cfg.method.name}: rewards {rewards}; ends {ends}"
