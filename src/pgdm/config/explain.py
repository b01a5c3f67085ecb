"""Explain Hydra's and OmegaConf's errors to the user who typed the settings."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException
from yaml import YAMLError

from pgdm.config.groups import available, groups
from pgdm.config.suites import unknown_task
from pgdm.config.synonyms import meant
from pgdm.errors import ConfigError, UnknownNameError

COMPOSITION_ERRORS = (
    HydraException,
    OmegaConfBaseException,
    YAMLError,
    ValueError,
    RecursionError,
)
"""What Hydra and its YAML reader raise for wrong settings."""

Keys = Callable[[Sequence[str]], Sequence[str]]
"""Maps overrides to the dotted keys of the settings composed from them."""

# Groups whose options have different keys.
_DIFFERING = ("method", "algo")


def explain(
    error: Exception, overrides: Sequence[str], config_dir: str | None, keys: Keys
) -> ConfigError:
    """Return a ConfigError that explains an error of ``COMPOSITION_ERRORS`` in one line.

    Args:
        error: what Hydra, OmegaConf or the YAML reader raised.
        overrides: the user's overrides.
        config_dir: the user's own settings folder.
        keys: lists the keys that are valid with given overrides, to suggest the nearest.
    """
    text = " ".join(str(error).split())
    if isinstance(error, RecursionError):
        options = [o for o in overrides if o.lstrip("+").partition("=")[0] in groups(config_dir)]
        return ConfigError(
            f"a settings file refers to itself, from {' '.join(options)}: check the defaults lists "
            "and the ${...} of your own files"
        )
    if isinstance(error, MissingMandatoryValue):
        key = error.full_key
        return ConfigError(f"{key} has no value yet; give one, such as {key}=...")
    for tail in (" full_key:", " Config search path:", " object_type="):
        text = text.partition(tail)[0]
    if isinstance(error, MissingConfigException):
        return _explain_missing(error, text, config_dir)
    if isinstance(error, OverrideParseException):
        return ConfigError(f"cannot read '{error.override}'; write key=value, such as seed=3")
    if isinstance(error, YAMLError):
        return ConfigError(f"a settings file is not valid YAML: {text}")
    if isinstance(error, HydraException | OmegaConfBaseException):
        return _explain_text(text, overrides, config_dir, keys)
    for override in overrides:  # Hydra refuses an option that is a number without naming it
        group, _, option = override.lstrip("+").partition("=")
        if group in groups(config_dir) and option not in (known := available(group, config_dir)):
            return _unknown_option(group, option, known, config_dir)
    return ConfigError(f"cannot apply {' '.join(overrides)}: {text}")


def _explain_text(
    text: str, overrides: Sequence[str], config_dir: str | None, keys: Keys
) -> ConfigError:
    if text.startswith("Ambiguous value"):
        argument = text.partition("'")[2].partition("'")[0]
        return ConfigError(
            f"'{argument}' has several values; add -m to run each of them, or write a list as "
            f"{argument.partition('=')[0]}=[a,b]"
        )
    taken = re.search(r"An item is already at '([^']+)'", text)
    if taken:
        return ConfigError(f"'{taken[1]}' exists already; leave out the + before it")
    wrong = re.search(r"Could not (?:override|delete).*? '~?([^']+)'", text)
    if wrong and wrong[1] == "experiment":
        return ConfigError("an experiment is added with a plus: +experiment=NAME")
    if not wrong:
        return ConfigError(text)
    names = _known_names(overrides, config_dir, keys)
    if wrong[1] in names:
        section = wrong[1].rpartition(".")[0]
        return ConfigError(f"'{wrong[1]}' cannot be set, as {section} is null here")
    if having := _options_with(wrong[1], config_dir, keys):
        return ConfigError(f"'{wrong[1]}' is a setting of {' or '.join(having)} only")
    return UnknownNameError(
        "key", wrong[1], names, "(pgdm-run --help lists them)", meant(wrong[1], names)
    )


def _explain_missing(
    error: MissingConfigException, text: str, config_dir: str | None
) -> ConfigError:
    group, _, option = (error.missing_cfg_file or "").rpartition("/")
    if group and error.options:
        return _unknown_option(group, option, error.options, config_dir)
    return ConfigError(text)


def _unknown_option(
    group: str, option: str, options: Sequence[str], config_dir: str | None
) -> ConfigError:
    if group == "task":
        return unknown_task(option, config_dir)
    return UnknownNameError(group, option, [o for o in options if o[0] != "_"])


def _known_names(overrides: Sequence[str], config_dir: str | None, keys: Keys) -> list[str]:
    """Return all groups, and all dotted keys of the experiment that the overrides choose.

    Only overrides that can change the set of keys are considered: those of `_DIFFERING`, and named
    experiments.
    """
    options = [f"{group}={name}" for group in _DIFFERING for name in available(group, config_dir)]
    options += [f"+experiment={name}" for name in available("experiment", config_dir)]
    chosen = [override for override in overrides if override in options]
    return sorted({*keys(chosen), *groups(config_dir)})


def _options_with(key: str, config_dir: str | None, keys: Keys) -> list[str]:
    """Return the options of a key's group that have the key.

    They are formatted for a message: ``algo=ppo``, then bare names.
    """
    group = key.partition(".")[0]
    if group not in _DIFFERING:
        return []
    names = available(group, config_dir)
    having = [name for name in names if key in keys([f"{group}={name}"])]
    return [f"{group}={name}" if i == 0 else name for i, name in enumerate(having)]
