"""Everything pgdm uses of Hydra's private interfaces; only this module imports ``hydra._internal``.

Hydra's public functions compose one set of overrides at a time and reread every file, which is too
slow for a sweep of thousands of runs.
"""

from __future__ import annotations

import inspect
import pickle
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import hydra
from hydra import version
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.utils import setup_globals
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from pgdm.config.foreign import check_file
from pgdm.errors import PgdmError

CHECKED_WITH = "1.3.8"
"""Version of hydra-core for whose private interfaces this module was written."""


def _changed(what: str) -> PgdmError:
    return PgdmError(
        f"hydra-core {hydra.__version__} has changed {what}, which pgdm needs; "
        f"install hydra-core=={CHECKED_WITH}"
    )


try:
    from hydra._internal import defaults_list as _defaults
    from hydra._internal.config_loader_impl import ConfigLoaderImpl
    from hydra._internal.utils import create_config_search_path
except ImportError as error:
    raise _changed(str(error)) from error

_USED = {
    "load_configuration": "self config_name overrides run_mode from_shell validate_sweep_overrides",
    "validate_sweep_overrides_legal": "overrides run_mode from_shell",
    "_parse_overrides_and_create_caching_repo": "self config_name overrides",
    "_compose_config_from_defaults_list": "self defaults repo",
    "_apply_overrides_to_config": "overrides cfg",
    "create_defaults_list": "repo config_name overrides_list prepend_hydra skip_missing",
    "_create_interpolation_map": "overrides defaults_list self_added",
}
"""Methods of ConfigLoaderImpl and functions of defaults_list with their parameters."""

_CONFIG, _VERSION_BASE = "config", "1.3"

_LOCK = threading.RLock()  # Hydra's version base is global to the process


def check_interfaces() -> None:
    """Check that the installed Hydra has the private functions used here.

    Raises:
        PgdmError: if one is missing or takes other parameters.
    """
    for name, parameters in _USED.items():
        function = getattr(ConfigLoaderImpl, name, None) or getattr(_defaults, name, None)
        if function is None or list(inspect.signature(function).parameters) != parameters.split():
            raise _changed(f"its private function {name}")


class _ReadOnce(ConfigLoaderImpl):
    """Hydra's loader, which here reads each file only once, for all compositions."""

    def __init__(self, search_path: Any) -> None:
        super().__init__(search_path)
        self._files: Any = None
        self._loaded: dict[tuple[Any, ...], tuple[ConfigResult, bytes]] = {}

    def _parse_overrides_and_create_caching_repo(
        self, config_name: str | None, overrides: list[str]
    ) -> tuple[list[Override], Any]:
        if self._files is None:
            parsed, self._files = super()._parse_overrides_and_create_caching_repo(
                config_name, overrides
            )
            for source in self._files.get_sources()[2:]:  # after Hydra's own and pgdm's
                _check_before_reading(source)
            return parsed, self._files
        return OverridesParser.create().parse_overrides(overrides), self._files

    def _load_single_config(self, default: Any, repo: Any) -> ConfigResult:
        key = default.config_path, default.package, default.primary
        if key not in self._loaded:
            found = super()._load_single_config(default, repo)
            self._loaded[key] = found, pickle.dumps(found.config)
        # A copy, since Hydra merges later files and overrides into these nodes in place, which
        # would change all later compositions.
        found, config = self._loaded[key]
        return replace(found, config=pickle.loads(config))


def _check_before_reading(source: ConfigSource) -> None:
    """Make a source of settings check each of its files before Hydra reads it."""
    read = source.load_config

    def load_config(config_path: str) -> ConfigResult:
        if source.scheme() == "file":
            check_file(Path(source.path, source._normalize_file_name(config_path)))
        return read(config_path)

    source.load_config = load_config  # type: ignore[method-assign]


class Loader:
    """Hydra's loader over pgdm's settings and a user's; each file is read once.

    Methods raise what Hydra raises; see ``pgdm.config.explain.COMPOSITION_ERRORS``.

    Args:
        conf: folder with ``config.yaml``.
        own: further folders, in the order in which Hydra searches them.
        search: ``hydra.searchpath=`` overrides.
    """

    def __init__(self, conf: Path, own: Sequence[Path], search: Sequence[str]) -> None:
        check_interfaces()
        setup_globals()  # the resolvers ``now`` and ``hydra``
        path = create_config_search_path(str(conf))
        for folder in own:
            path.prepend("command-line", f"file://{folder}", SearchPathQuery("schema", None))
        self._loader = _ReadOnce(path)
        self._parser = OverridesParser.create(config_loader=self._loader)
        with _composing():
            _, self._files = self._loader._parse_overrides_and_create_caching_repo(
                _CONFIG, list(search)
            )

    def whole(self, overrides: Sequence[str], multirun: bool) -> DictConfig:
        """Compose an application's settings, with Hydra's own under ``hydra``.

        Args:
            overrides: as typed.
            multirun: leave out overrides with several values instead of refusing them.
        """
        mode = RunMode.MULTIRUN if multirun else RunMode.RUN
        with _composing():
            return self._loader.load_configuration(_CONFIG, list(overrides), mode, False)

    def parse(self, texts: Sequence[str]) -> list[Override]:
        """Parse overrides."""
        return self._parser.parse_overrides(list(texts))

    def is_choice(self, override: Override) -> bool:
        """Return whether an override chooses an option of a group."""
        known = self._files.group_exists(override.key_or_group)
        return known and not isinstance(override.value(), dict)

    def chosen(self, choices: Sequence[Override]) -> DictConfig:
        """Compose the settings for chosen options, without Hydra's own."""
        with _composing():
            found = _defaults.create_defaults_list(
                repo=self._files,
                config_name=_CONFIG,
                overrides_list=list(choices),
                prepend_hydra=True,  # config.yaml overrides some of Hydra's options
                skip_missing=False,
            )
            own = [d for d in found.defaults if not (d.config_path or "").startswith("hydra/")]
            settings = self._loader._compose_config_from_defaults_list(own, self._files)
        del settings["hydra"]
        OmegaConf.set_struct(settings, True)
        return settings

    def check_single(self, overrides: Sequence[Override]) -> None:
        """Refuse overrides with several values."""
        ConfigLoaderImpl.validate_sweep_overrides_legal(list(overrides), RunMode.RUN, False)

    def apply(self, overrides: Sequence[Override], settings: DictConfig) -> None:
        """Apply overrides of keys to composed settings, in place."""
        ConfigLoaderImpl._apply_overrides_to_config(list(overrides), settings)


@contextmanager
def _composing() -> Iterator[None]:
    """Lock Hydra's global state, and skip its slowest step: building maps that nothing reads."""
    with _LOCK:
        version.setbase(_VERSION_BASE)
        before = _defaults._create_interpolation_map
        _defaults._create_interpolation_map = _only_if_read(before)
        try:
            yield
        finally:
            _defaults._create_interpolation_map = before


def _only_if_read(build: Callable[..., Any]) -> Callable[..., Any]:
    """Make Hydra's function that maps the references in a defaults list skip unused maps."""

    def build_if_read(overrides: Any, defaults_list: list[Any], self_added: bool) -> Any:
        read = any(not entry.is_self() and entry.is_interpolation() for entry in defaults_list)
        return build(overrides, defaults_list, self_added) if read else None

    return build_if_read
