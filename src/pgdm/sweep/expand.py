"""From overrides with several values to the settings of every job, by Hydra's own parser."""

from __future__ import annotations

import copy
import itertools
import re
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, open_dict

from pgdm.config.suites import expand_tasks
from pgdm.errors import ConfigError

Tasks = Callable[[Sequence[str]], Sequence[str]]
"""From words, each a task, a suite or a pattern, to the tasks that they name."""


def with_tasks_as_choices(overrides: Sequence[str]) -> list[str]:
    """Return the overrides with a single value for ``task`` written as one of several.

    Hydra composes single values before any sweeper sees them, and no option has a suite's name.
    """
    plain = re.compile(r"task=([^,()]+)")
    return [plain.sub(r"task=choice(\1)", o) if plain.fullmatch(o) else o for o in overrides]


def grid(overrides: Sequence[Override], tasks: Tasks) -> list[tuple[str, ...]]:
    """Return the overrides of each job: every combination of the values, the last key fastest.

    Args:
        overrides: as parsed; of two for the same key the later one counts.
        tasks: what the words given for ``task`` mean.

    Raises:
        ConfigError: if a key has no value to try, or an interval of numbers.
    """
    axes: dict[str, list[str]] = {}
    for override in overrides:
        key = override.get_key_element()
        # An earlier one may have stood elsewhere; the order of first mention stays.
        axes[key] = [f"{key}={value}" for value in _values(override, tasks)]
    return list(itertools.product(*axes.values()))


def _values(override: Override, tasks: Tasks) -> Sequence[str]:
    if override.is_sweep_override():
        if not override.is_discrete_sweep():
            raise ConfigError(f"'{override.input_line}' has no end of values; list those to try")
        values = list(override.sweep_string_iterator())
    else:
        values = [override.get_value_element_as_str()]
    if override.key_or_group == "task":
        values = list(tasks([value.strip("'\"") for value in values]))
    if not values:
        raise ConfigError(f"'{override.input_line}' leaves nothing to run")
    return values


def composed_jobs(
    loader: ConfigLoader, config: DictConfig, arguments: Sequence[str]
) -> Iterator[tuple[tuple[str, ...], DictConfig]]:
    """Yield the overrides of each job, and its settings without Hydra's own.

    Args:
        loader: the running application's.
        config: what Hydra composed for the sweep as a whole.
        arguments: overrides of the sweep.

    Raises:
        ConfigError: if a value is not what ``grid`` takes.
        HydraException: if the settings of a job are wrong.
    """
    parser = OverridesParser.create(config_loader=loader)

    def tasks(words: Sequence[str]) -> Sequence[str]:
        return expand_tasks(words, _own_folder(config))

    # Composing takes Hydra tens of milliseconds. Jobs that differ in single keys, such as seed,
    # therefore share it: the keys are set afterwards, which is Hydra's own order too.
    parse = cache(lambda text: parser.parse_override(text))
    is_choice = cache(lambda key: bool(loader.get_group_options(key)))
    compose = cache(lambda *chosen: _without_hydra(loader.load_sweep_config(config, list(chosen))))
    for job in grid(parser.parse_overrides(list(arguments)), tasks):
        parts = {text: parse(text) for text in job}
        settings = copy.deepcopy(
            compose(*(text for text, part in parts.items() if is_choice(part.key_or_group)))
        )
        rest = [part for part in parts.values() if not is_choice(part.key_or_group)]
        ConfigLoaderImpl._apply_overrides_to_config(rest, settings)
        yield job, settings


def _without_hydra(settings: DictConfig) -> DictConfig:
    with open_dict(settings):
        del settings["hydra"]
    return settings


def _own_folder(config: DictConfig) -> Path | None:
    """Return the folder that --config-dir named, if any."""
    sources = config.hydra.runtime.config_sources
    return next((Path(s.path) for s in sources if s.provider == "command-line"), None)
