"""Expand overrides with several values into the settings of every job."""

from __future__ import annotations

import gc
import itertools
import math
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra.core.override_parser.types import Override

from pgdm.config.compose import Composer
from pgdm.config.suites import expand_tasks
from pgdm.errors import ConfigError
from pgdm.library.progress import StepProgress

Tasks = Callable[[Sequence[str]], Sequence[str]]
"""Maps words, each a task, a suite or a pattern, to the tasks that they name."""

Composed = tuple[tuple[str, ...], dict[str, Any]]
"""The overrides of a job, and the settings composed from them."""


def with_tasks_as_choices(overrides: Sequence[str]) -> list[str]:
    """Return the overrides with ``task=NAME`` rewritten as ``task=choice(NAME)``.

    Hydra composes single values before it expands a sweep, and would fail if NAME is a suite or a
    pattern, which are not options of the group ``task``.
    """
    plain = re.compile(r"task=(?!null$)([^,()]+)")
    return [plain.sub(r"task=choice(\1)", o) if plain.fullmatch(o) else o for o in overrides]


def grid(overrides: Sequence[Override], tasks: Tasks, most: int) -> list[tuple[str, ...]]:
    """Return the overrides of each job: all combinations of values, the last key varying fastest.

    Args:
        overrides: parsed overrides; a later override of the same key replaces an earlier one.
        tasks: expands the values given for ``task``.
        most: maximum number of jobs.

    Raises:
        ConfigError: if there is no value to try for a key, an interval is given instead of values,
            or there are too many jobs.
    """
    axes: dict[str, list[str]] = {}
    for override in overrides:
        key = override.get_key_element()
        # A key keeps the position of its first override, even if a later one replaces its values.
        axes[key] = [f"{key}={value}" for value in _values(override, tasks, most)]
        if (count := math.prod(map(len, axes.values()))) > most:
            raise ConfigError(
                f"{override.input_line} makes {count:,} jobs or more, above "
                f"sweep.most_jobs={most}; list fewer values, or type a greater sweep.most_jobs"
            )
    return list(itertools.product(*axes.values()))


def _values(override: Override, tasks: Tasks, most: int) -> Sequence[str]:
    if override.is_sweep_override():
        if not override.is_discrete_sweep():
            raise ConfigError(f"'{override.input_line}' is an interval; list the values to try")
        values = list(itertools.islice(override.sweep_string_iterator(), most + 1))
    else:
        values = [override.get_value_element_as_str()]
    if override.key_or_group == "task":
        values = list(tasks([value.strip("'\"") for value in values]))
    if not values:
        raise ConfigError(
            f"'{override.input_line}' leaves nothing to run; give at least one value that is not "
            "excluded again"
        )
    return values


def composed_jobs(
    composer: Composer,
    overrides: Sequence[str],
    config_dir: Path | None,
    progress: StepProgress,
    most: int,
) -> list[Composed]:
    """Return the settings of every job of a sweep.

    Args:
        composer: composes the settings.
        overrides: overrides of the sweep, each with one or several values.
        config_dir: the user's settings folder, searched for tasks and suites.
        progress: called with the number of jobs composed so far.
        most: maximum number of jobs.

    Raises:
        ConfigError: as for ``grid``, or if the settings of a job are wrong.
    """
    jobs = grid(composer.parse(overrides), lambda words: expand_tasks(words, config_dir), most)
    common = set(jobs[0]).intersection(*jobs)
    found: list[Composed] = []
    with _uncollected():
        for job in jobs:
            try:
                found.append((job, composer.plain(job)))
            except ConfigError as error:
                if own := " ".join(text for text in job if text not in common):
                    raise ConfigError(f"{error} (in the run {own}; none was started)") from error
                raise
            progress("composing the runs", len(found), len(jobs))
    return found


@contextmanager
def _uncollected() -> Iterator[None]:
    """Pause the garbage collector, which would scan the many objects that Hydra copies."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
