"""From names to a typed ExperimentCfg: the only place where Hydra's DictConfig becomes one."""

from __future__ import annotations

import dataclasses
import os
import re
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException
from yaml import YAMLError

from pgdm.config.groups import available, check_own, conf_dir, folders, groups, own_folders
from pgdm.config.strict import build, flatten
from pgdm.config.suites import suite, suites
from pgdm.errors import ConfigError, UnknownNameError

if TYPE_CHECKING:
    from pgdm.config.schema import ExperimentCfg

__all__ = [
    "COMPOSITION_ERRORS",
    "available",
    "check_overrides",
    "compose",
    "compose_plain",
    "conf_dir",
    "explain",
    "from_dict_config",
    "groups",
    "search_path",
]

COMPOSITION_ERRORS = (HydraException, OmegaConfBaseException, YAMLError, ValueError)
"""What Hydra and its YAML reader raise at wrong settings; ``explain`` makes a ConfigError of it."""

PAPER_FRAMES = 50_000_000
"""Environment steps behind each of the paper's figures."""

# Groups whose options have different keys.
_DIFFERING = ("method", "algo")

# Hydra keeps the current application in process-wide state, which two threads must not swap.
_LOCK = threading.RLock()


def from_dict_config(composed: DictConfig) -> ExperimentCfg:
    """Turn what Hydra composed into a checked ExperimentCfg.

    Raises:
        ConfigError: if a key is unknown or missing, or a value is wrong.
    """
    # The schema loads the simulator and torch: a wrong name should be answered before that.
    from pgdm.config.identity import default_run_dir
    from pgdm.config.schema import ExperimentCfg, check_device

    try:
        plain = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        raise explain(error) from error
    assert isinstance(plain, dict)
    data = {str(key): value for key, value in plain.items()}
    chosen = data.get("run_dir")
    given = {"run_dir": "." if chosen is None else chosen}
    if data.get("budget") == "paper":
        given["budget"] = _budget(data.get("total_frames"))
    data.pop("sweep", None)  # of the command, not of a run
    cfg = build(ExperimentCfg, data | given)
    cfg.validate()
    check_device(cfg.device)
    return cfg if chosen is not None else dataclasses.replace(cfg, run_dir=default_run_dir(cfg))


def _budget(total_frames: object) -> str:
    """Return the true label: a shorter run is not to be set beside the paper's."""
    whole = isinstance(total_frames, int) and total_frames >= PAPER_FRAMES
    return "paper" if whole else "reduced"


def compose(
    overrides: Sequence[str] = (), config_dir: str | os.PathLike[str] | None = None
) -> ExperimentCfg:
    """Compose an experiment as ``pgdm-run`` would, with or without a Hydra app around.

    Args:
        overrides: as on the command line, such as ``["task=cup-pour1", "seed=3"]``.
        config_dir: a folder of your own settings, searched after pgdm's.

    Raises:
        ConfigError: if a key, an option or a value is wrong, or a file of yours has the name of
            one of pgdm's.
    """
    folder = None if config_dir is None else str(Path(config_dir).expanduser().absolute())
    if folder is not None and not Path(folder).is_dir():
        raise ConfigError(f"config_dir '{folder}' is not a folder")
    return _typed(tuple(overrides), folder, _stamp(folder))


def compose_plain(overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Compose as ``compose`` does, but to plain containers, unchecked, and in a tenth of its time.

    Raises:
        ConfigError: if a key or an option is wrong.
    """
    plain: Any = OmegaConf.to_container(_composed(overrides), resolve=True)
    return plain


def _stamp(folder: str | None) -> int:
    """Return when the settings last changed, so that an edited file is read anew."""
    files = [path for one in folders(folder) for path in one.rglob("*.yaml")]
    return hash(tuple((str(path), path.stat().st_mtime_ns) for path in files))


@lru_cache(maxsize=256)
def _typed(overrides: tuple[str, ...], folder: str | None, _stamp: int) -> ExperimentCfg:
    return from_dict_config(_composed(overrides, folder))


def _composed(overrides: Sequence[str], folder: str | None = None) -> DictConfig:
    check_overrides(overrides)
    check_own(folder)
    search = search_path(own_folders(folder))
    try:
        with _LOCK, _own_hydra(), hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
            return hydra.compose("config", overrides=[*search, *overrides])
    except COMPOSITION_ERRORS as error:
        raise explain(error, overrides, folder) from error


def check_overrides(overrides: Sequence[str]) -> None:
    """Refuse what Hydra would take without a word, or answer without a name.

    Raises:
        ConfigError: if an override has no key, or gives a group several options.
    """
    for override in overrides:
        key, _, value = override.partition("=")
        if not key.strip("+~"):
            raise ConfigError(f"cannot read '{override}'; write key=value, such as seed=3")
        if key == "suite":
            raise ConfigError(f"a suite is named by its tasks: pgdm-run -m task={value}")
        if value.startswith("[") and key in groups():
            # Hydra would merge the options, so that the last one wins.
            raise ConfigError(
                f"{key} takes one option, not the list {value}; to run one after the other: "
                f"-m {key}={value.strip('[]')}"
            )


@contextmanager
def _own_hydra() -> Iterator[None]:
    """Set the running Hydra application aside, if there is one."""
    running = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        yield
    finally:
        GlobalHydra.instance().hydra = running


def search_path(folders: Sequence[Path]) -> list[str]:
    """Return the override that has Hydra look into folders after its own; none for no folders."""
    places = ",".join(_quoted(f"file://{folder}") for folder in folders)
    return [f"hydra.searchpath=[{places}]"] if folders else []


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace("'", "\\'")
    return f"'{escaped}'"


def explain(
    error: Exception, overrides: Sequence[str] = (), config_dir: str | None = None
) -> ConfigError:
    """Return what an error of COMPOSITION_ERRORS means for a user, as one line.

    Args:
        error: what Hydra, OmegaConf or the YAML reader raised.
        overrides: what the user gave.
        config_dir: the user's own settings folder.
    """
    text = " ".join(str(error).split())
    if isinstance(error, MissingMandatoryValue):
        key = error.full_key
        return ConfigError(f"{key} has no value yet (???); give one, such as {key}=...")
    for tail in (" full_key:", " Config search path:", " object_type="):
        text = text.partition(tail)[0]
    if isinstance(error, MissingConfigException):
        return _explain_missing(error, text, config_dir)
    if isinstance(error, OverrideParseException):
        return ConfigError(f"cannot read '{error.override}'; write key=value, such as seed=3")
    if isinstance(error, YAMLError):
        return ConfigError(f"a settings file is not valid YAML: {text}")
    if isinstance(error, HydraException | OmegaConfBaseException):
        return _explain_text(text, overrides, config_dir)
    return ConfigError(f"cannot apply {' '.join(overrides)}: {text}")


def _explain_text(text: str, overrides: Sequence[str], config_dir: str | None) -> ConfigError:
    if text.startswith("Ambiguous value"):
        argument = text.partition("'")[2].partition("'")[0]
        return ConfigError(
            f"'{argument}' has several values; add -m to run one after the other, or write a list "
            f"as {argument.partition('=')[0]}=[a,b]"
        )
    taken = re.search(r"An item is already at '([^']+)'", text)
    if taken:
        return ConfigError(f"'{taken[1]}' exists already; leave out the + before it")
    wrong = re.search(r"Could not (?:override|delete).*? '~?([^']+)'", text)
    if wrong and wrong[1] == "experiment":
        return ConfigError("an experiment is added with a plus: +experiment=NAME")
    if wrong:
        names = _known_names(overrides, config_dir)
        if wrong[1] in names:
            section = wrong[1].rpartition(".")[0]
            return ConfigError(f"'{wrong[1]}' cannot be set, as {section} is null here")
        if having := _options_with(wrong[1], config_dir):
            return ConfigError(f"'{wrong[1]}' is a setting of {' or '.join(having)} only")
        return UnknownNameError("key", wrong[1], names, "(pgdm-run --help lists them)")
    return ConfigError(text)


def _explain_missing(
    error: MissingConfigException, text: str, config_dir: str | None
) -> ConfigError:
    group, _, option = (error.missing_cfg_file or "").rpartition("/")
    if group == "task" and error.options:
        return _explain_task(option, error.options, config_dir)
    if group and error.options:
        return UnknownNameError(group, option, [o for o in error.options if o[0] != "_"])
    return ConfigError(text)


def _explain_task(name: str, tasks: Sequence[str], config_dir: str | None) -> ConfigError:
    if name in suites(config_dir):
        size = len(suite(name, config_dir))
        return ConfigError(
            f"{name} is a suite of {size} tasks; to run them all: pgdm-run -m task={name}"
        )
    if "*" in name:
        return ConfigError(f"several tasks are a sweep; to run them all: pgdm-run -m task={name}")
    known = [task for task in tasks if task[0] != "_"]
    return UnknownNameError("task", name, [*known, *suites(config_dir)])


def _known_names(overrides: Sequence[str], config_dir: str | None) -> list[str]:
    """Return all keys of the experiment with the options that were chosen, dotted, and all groups.

    Only of groups whose options have different keys, which named experiments may choose too.
    """
    options = [f"{group}={name}" for group in _DIFFERING for name in available(group, config_dir)]
    options += [f"+experiment={name}" for name in available("experiment", config_dir)]
    chosen = [override for override in overrides if override in options]
    return sorted({*_keys(chosen, config_dir), *groups(config_dir)})


def _options_with(key: str, config_dir: str | None) -> list[str]:
    """Return the options that have a key, of its group: the first with the group's name."""
    group = key.partition(".")[0]
    if group not in _DIFFERING:
        return []
    names = available(group, config_dir)
    having = [name for name in names if key in _keys([f"{group}={name}"], config_dir)]
    return [f"{group}={name}" if i == 0 else name for i, name in enumerate(having)]


def _keys(overrides: Sequence[str], config_dir: str | None) -> list[str]:
    plain: Any = OmegaConf.to_container(_composed(overrides, config_dir), resolve=False)
    return list(flatten(plain))
