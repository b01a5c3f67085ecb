"""From overrides with several values to the settings of every job, by Hydra's own parser."""

from __future__ import annotations

import copy
import itertools
import re
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.defaults_list import create_defaults_list
from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf

from pgdm.config.suites import expand_tasks
from pgdm.errors import ConfigError

Tasks = Callable[[Sequence[str]], Sequence[str]]
"""From words, each a task, a suite or a pattern, to the tasks that they name."""


def with_tasks_as_choices(overrides: Sequence[str]) -> list[str]:
    """Return the overrides with a single value for ``task`` written as one of several.

    Hydra composes single values before any sweeper sees them, and no option has a suite's name.
    """
    plain = re.compile(r"task=(?!null$)([^,()]+)")
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
) -> list[tuple[tuple[str, ...], DictConfig]]:
    """Return the overrides of each job, and its settings without Hydra's own.

    ``load_sweep_config`` would do, but reads every file anew for every job, those of Hydra itself
    included. These are its steps; the files are read once, and jobs that differ in single keys,
    such as seed, share what their choices of files give.

    Args:
        loader: the running application's.
        config: what Hydra composed for the sweep as a whole.
        arguments: overrides of the sweep.

    Raises:
        ConfigError: if a value is not what ``grid`` takes.
        HydraException: if the settings of a job are wrong.
    """
    assert isinstance(loader, ConfigLoaderImpl)
    name = config.hydra.job.config_name
    searched = [*config.hydra.overrides.hydra, *arguments]  # hydra.searchpath may be among them
    _, repository = loader._parse_overrides_and_create_caching_repo(name, searched)
    parser = OverridesParser.create(config_loader=loader)
    parse = cache(parser.parse_override)

    @cache
    def chosen(*texts: str) -> DictConfig:
        found = create_defaults_list(
            repo=repository,
            config_name=name,
            overrides_list=[parse(text) for text in texts],
            prepend_hydra=True,
            skip_missing=False,
        )
        own = [default for default in found.defaults if not _is_hydras(default.config_path)]
        settings = loader._compose_config_from_defaults_list(defaults=own, repo=repository)
        del settings["hydra"]
        OmegaConf.set_struct(settings, True)
        return settings

    def tasks(words: Sequence[str]) -> Sequence[str]:
        return expand_tasks(words, _own_folder(config))

    jobs = []
    for job in grid(parser.parse_overrides(list(arguments)), tasks):
        choices = [text for text in job if repository.group_exists(parse(text).key_or_group)]
        settings = copy.deepcopy(chosen(*choices))
        keys = [parse(text) for text in job if text not in choices]
        ConfigLoaderImpl._apply_overrides_to_config(keys, settings)
        jobs.append((job, settings))
    return jobs


def _is_hydras(path: str | None) -> bool:
    return path is not None and path.startswith("hydra/")


def _own_folder(config: DictConfig) -> Path | None:
    """Return the folder that --config-dir named, if any."""
    sources = config.hydra.runtime.config_sources
    return next((Path(s.path) for s in sources if s.provider == "command-line"), None)
