"""Compose overrides into settings, and settings into a checked experiment."""

from __future__ import annotations

import copy
import dataclasses
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.override_parser.types import Override, OverrideType
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pgdm import paths
from pgdm.config.explain import COMPOSITION_ERRORS, explain
from pgdm.config.foreign import check_composed, check_settings
from pgdm.config.groups import check_own, conf_dir, folders, groups, own_folders
from pgdm.config.hydra_private import Loader
from pgdm.config.ranges import check_early
from pgdm.config.strict import build
from pgdm.errors import ConfigError
from pgdm.runs.config_file import dotted

if TYPE_CHECKING:
    from pgdm.config.schema import ExperimentCfg

PAPER_FRAMES = 50_000_000
"""Length of each run in the paper, frames."""

_SEARCH_PATH = "hydra.searchpath="
_KEY = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*")
_REFERENCE = re.compile(r"\$\{([\w.\[\]]*\w[\w.\[\]]*)\}")
"""The plain form ``${key}``; neither nested nor with a resolver."""


class Composer:
    """Composes many experiments; reads each file, and composes each choice of options, only once.

    Args:
        config_dir: a folder of the user's own settings, searched after pgdm's and before the user's
            permanent folder.
        overrides: as typed; only ``hydra.searchpath`` is read here.

    Raises:
        ConfigError: from the constructor and every method, if a key, option or value is wrong.
    """

    def __init__(self, config_dir: str | None = None, overrides: Sequence[str] = ()) -> None:
        check_overrides(overrides)
        check_own(config_dir)
        self._config_dir = config_dir
        self._choices: dict[tuple[str, ...], _Choice] = {}
        self._parsed: dict[str, tuple[Override, bool]] = {}
        search = [text for text in overrides if text.startswith(_SEARCH_PATH)]
        own = own_folders(config_dir)
        if any("://" in text.replace("file://", "") for text in search):
            raise ConfigError(f"{search[0]} is refused: only folders are searched, no packages")
        if search:  # it replaces the user's permanent folder
            own = own[:1] if config_dir is not None else []
        with self.explaining(overrides):
            self._loader = Loader(conf_dir(), [folder.absolute() for folder in own], search)

    def whole(
        self, overrides: Sequence[str], multirun: bool = False, typed: Sequence[str] | None = None
    ) -> DictConfig:
        """Return the settings with Hydra's own, such as the launcher's, under ``hydra``.

        Args:
            overrides: all overrides.
            multirun: whether overrides may have several values.
            typed: the part of ``overrides`` that the user has typed; None: all.
        """
        with self.explaining(overrides):
            found = self._loader.whole(overrides, multirun)
            check_composed(found.hydra, overrides if typed is None else typed)
            return found

    def parse(self, overrides: Sequence[str]) -> list[Override]:
        """Return overrides as Hydra parses them."""
        with self.explaining(overrides):
            return self._loader.parse(overrides)

    def plain(self, overrides: Sequence[str]) -> dict[str, Any]:
        """Return an experiment's settings as plain containers, with references resolved.

        They are what Hydra composes, unchecked. The containers may be shared with other results.
        """
        with self.explaining(overrides):
            choice, keys = self._divided(overrides)
            found = choice.changed(keys)
            if found is not None:
                return found
            settings = copy.deepcopy(choice.settings)
            self._loader.apply(keys, settings)
            return _plain(settings)

    def check(self, overrides: Sequence[str], settings: Mapping[str, Any]) -> None:
        """Check composed settings as far as possible without the schema, which is slow to import.

        Args:
            overrides: the overrides from which they were composed.
            settings: as returned by ``plain``.
        """
        check_early(dotted(settings), self._divided(overrides)[0].flat)

    def _divided(self, overrides: Sequence[str]) -> tuple[_Choice, list[Override]]:
        """Return the settings for the options that overrides choose, and the overrides of keys."""
        check_overrides(overrides)
        for text in overrides:
            if text not in self._parsed:
                (override,) = self._loader.parse([text])
                self._parsed[text] = override, self._loader.is_choice(override)
        parsed = [self._parsed[text] for text in overrides]
        self._loader.check_single([override for override, _ in parsed])
        if any(override.is_hydra_override() for override, _ in parsed):
            self._loader.whole(overrides, multirun=False)  # raises if one is wrong
        parsed = [(o, is_choice) for o, is_choice in parsed if not o.is_hydra_override()]
        choices = [override for override, is_choice in parsed if is_choice]
        names = tuple(str(override.input_line) for override in choices)
        if names not in self._choices:
            self._choices[names] = _Choice(self._loader.chosen(choices))
        return self._choices[names], [o for o, is_choice in parsed if not is_choice]

    @contextmanager
    def explaining(self, overrides: Sequence[str]) -> Iterator[None]:
        """Turn ``COMPOSITION_ERRORS`` into a ConfigError for the user who typed the overrides."""
        try:
            yield
        except COMPOSITION_ERRORS as error:
            raise explain(error, overrides, self._config_dir, self._keys) from error

    def _keys(self, choices: Sequence[str]) -> list[str]:
        return list(self._divided(choices)[0].flat)


class _Choice:
    """The settings for a combination of options, before keys are overridden."""

    def __init__(self, settings: DictConfig) -> None:
        self.settings = settings
        self._referred: set[str] = set()  # names that references mention
        self._plain: dict[str, Any] | None = None
        raw: Any = OmegaConf.to_container(settings, resolve=False)
        self.flat = dotted(raw)
        """The settings by dotted key, with references unresolved."""
        for text in _texts(raw):
            self._referred.update(re.findall(r"\w+", " ".join(_REFERENCE.findall(text))))
            if "${" in _REFERENCE.sub("", text):
                return  # OmegaConf must resolve it after keys are overridden
        try:
            self._plain = _plain(settings)
        except OmegaConfBaseException:  # a value is still missing
            return

    def changed(self, keys: Sequence[Override]) -> dict[str, Any] | None:
        """Return the plain settings with keys overridden, or None if OmegaConf has to do that.

        This shortcut only gives a scalar to a key that exists and that no reference mentions.
        """
        if self._plain is None:
            return None
        result = dict(self._plain)
        for override in keys:
            value = override.value()
            *sections, name = override.key_or_group.split(".")
            if not _is_simple(override, value) or self._referred & {*sections, name}:
                return None
            inner = result
            for section in sections:
                if not isinstance(inner.get(section), dict):
                    return None
                inner[section] = dict(inner[section])
                inner = inner[section]
            if name not in inner or isinstance(inner[name], dict | list):
                return None
            inner[name] = value
        return result


def _is_simple(override: Override, value: object) -> bool:
    """Return whether an override changes a key to a scalar without references."""
    if override.type is not OverrideType.CHANGE or override.package is not None:
        return False
    if not _KEY.fullmatch(override.key_or_group):
        return False
    if isinstance(value, str):
        return "$" not in value and value != "???"
    return value is None or isinstance(value, bool | int | float)


def _texts(value: object) -> Iterable[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping):
        for inner in value.values():
            yield from _texts(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _texts(inner)


def _plain(settings: DictConfig) -> dict[str, Any]:
    found: Any = OmegaConf.to_container(settings, resolve=True, throw_on_missing=True)
    return found


def checked(plain: Mapping[str, Any]) -> ExperimentCfg:
    """Return composed settings as a checked experiment.

    Raises:
        ConfigError: if a key is unknown or missing, or a value is wrong.
    """
    # Imported late: the schema loads the simulator and torch, and wrong names are reported before.
    from pgdm.config.identity import default_run_dir
    from pgdm.config.schema import ExperimentCfg, check_device

    chosen = plain.get("run_dir")
    given = {"run_dir": "." if chosen is None else chosen}
    if plain.get("budget") == "paper":
        given["budget"] = _budget(plain.get("total_frames"))
    # ``sweep`` belongs to the command, not to a run.
    own = {str(key): value for key, value in plain.items() if key != "sweep"}
    cfg = build(ExperimentCfg, own | given)
    cfg.validate()
    check_device(cfg.device)
    return cfg if chosen is not None else dataclasses.replace(cfg, run_dir=default_run_dir(cfg))


def _budget(total_frames: object) -> str:
    """Return the label for ``budget=paper``: ``reduced`` if the run is shorter than the paper's."""
    whole = isinstance(total_frames, int) and total_frames >= PAPER_FRAMES
    return "paper" if whole else "reduced"


def compose(
    overrides: Sequence[str] = (), config_dir: str | os.PathLike[str] | None = None
) -> ExperimentCfg:
    """Compose an experiment as ``pgdm-run`` would, inside or outside of a Hydra application.

    Args:
        overrides: as on the command line, such as ``["task=cup-pour1", "seed=3"]``.
        config_dir: a folder of your own settings, searched after pgdm's.

    Raises:
        ConfigError: if a key, an option or a value is wrong, or a file of yours has the name of
            one of pgdm's.
    """
    if isinstance(overrides, str) or not all(isinstance(text, str) for text in overrides):
        raise ConfigError(f"overrides are {overrides!r}; give a list of strings such as 'seed=3'")
    folder = None if config_dir is None else str(paths.expanded(config_dir))
    if folder is not None and not Path(folder).is_dir():
        raise ConfigError(f"config_dir '{folder}' is not a folder")
    return _typed(tuple(overrides), folder, _stamp(folder))


def compose_plain(overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Compose as ``compose`` does, but to plain containers, unchecked, and in a tenth of its time.

    Raises:
        ConfigError: if a key or an option is wrong.
    """
    return copy.deepcopy(_plain_settings(tuple(overrides), None, _stamp(None)))


def _stamp(folder: str | None) -> int:
    """Return a number that changes when a settings file is edited."""
    files = [path for one in folders(folder) for path in one.rglob("*.yaml") if path.exists()]
    return hash(tuple((str(path), path.stat().st_mtime_ns) for path in files))


@lru_cache(maxsize=256)
def _typed(overrides: tuple[str, ...], folder: str | None, stamp: int) -> ExperimentCfg:
    return checked(_plain_settings(overrides, folder, stamp))


def _plain_settings(overrides: tuple[str, ...], folder: str | None, stamp: int) -> dict[str, Any]:
    check_own(folder)  # not cached, since the stamp does not cover sweep files
    if any(text.startswith(_SEARCH_PATH) for text in overrides):
        return Composer(folder, overrides).plain(overrides)
    return _composer(folder, stamp).plain(overrides)


@lru_cache(maxsize=4)
def _composer(folder: str | None, _stamp: int) -> Composer:
    return Composer(folder)


def check_overrides(overrides: Sequence[str]) -> None:
    """Refuse overrides that Hydra would silently misread, or refuse without a clear message.

    Raises:
        ConfigError: if an override has no key, gives a group several options, or would run code.
    """
    for override in overrides:
        key, _, value = override.partition("=")
        check_settings({key: value}, "the command line", typed=True)
        if not key.strip("+~"):
            raise ConfigError(f"cannot read '{override}'; write key=value, such as seed=3")
        if key == "suite":
            raise ConfigError(f"a suite is chosen by the key task: pgdm-run -m task={value}")
        if value.startswith("[") and key in groups():
            # Hydra would merge the options, so that the last one wins.
            raise ConfigError(
                f"{key} takes one option, not the list {value}; to run each of them: "
                f"-m {key}={value.strip('[]')}"
            )
